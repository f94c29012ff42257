# make setup | demo | test | sanitize | lint | bench | gpu. The environment is .venv; everything else is in pyproject.toml.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || echo python3.11)
BIN := .venv/bin
NATIVE := $(wildcard native/*.*) CMakeLists.txt
UV_VERSION := 0.13.8

.PHONY: setup build demo test sanitize fuzz lint format bench gpu lock clean
setup: .venv/.built

.venv/.packages: requirements/lock.txt
	@command -v $(PYTHON) >/dev/null || { echo "mien needs Python 3.11 or 3.12: install it, or run 'make PYTHON=/path/to/python3.11 ...'"; exit 1; }
	@command -v $${CXX:-g++} >/dev/null || { echo "mien needs a C++20 compiler: install g++ 11 or newer"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	test -x $(BIN)/uv || $(BIN)/python -m pip install --disable-pip-version-check uv==$(UV_VERSION)
	@echo "Installing packages (torch alone is about 3 GB to download; this is the long part) ..."
	VIRTUAL_ENV=.venv $(BIN)/uv pip sync --require-hashes requirements/lock.txt
	touch $@

# An editable install: Python from src/, the native core built into .venv.
.venv/.built: .venv/.packages pyproject.toml $(NATIVE)
	@echo "compiling the C++ core: one to four minutes ..."
	VIRTUAL_ENV=.venv $(BIN)/uv pip install --no-build-isolation --no-deps --reinstall-package mien -e .
	touch $@

build: setup

demo: setup
	$(BIN)/mien demo --out out/demo

test: setup
	MIEN_THREADS=2 $(BIN)/pytest

# The native core's own checks under AddressSanitizer, UndefinedBehaviorSanitizer and ThreadSanitizer; needs no Python.
sanitize:
	$(MAKE) -C native/checks -j2

# Mutated files of every format and odd command lines, for so long; findings go to out/fuzz/findings.jsonl.
MINUTES ?= 10
SEED ?= 1
fuzz: setup
	PYTHONPATH=tests $(BIN)/python -m fuzzing --self-check --seed $(SEED) --cases 5000 --minutes $(MINUTES) --workers 2 \
	  --lines 300 --heavy 10 --findings out/fuzz/findings.jsonl
	@if [ -f tests/fuzzing/native_calls.py ]; then $(MAKE) fuzz-native; fi

lint: setup
	$(BIN)/ruff check src tests examples benchmarks
	$(BIN)/ruff format --check src tests examples benchmarks
	$(BIN)/clang-format --dry-run --Werror $(wildcard native/*.cpp native/*.h native/*/*.cpp native/*/*.h)
	$(BIN)/typos
	$(BIN)/lint-imports
	$(BIN)/pyright

format: setup
	$(BIN)/ruff check --fix src tests examples benchmarks
	$(BIN)/ruff format src tests examples benchmarks
	$(BIN)/clang-format -i $(wildcard native/*.cpp native/*.h native/*/*.cpp native/*/*.h)

# Re-resolve the locked requirements (both Pythons, every platform) after a change in pyproject.toml or overrides.txt.
lock: .venv/.packages
	$(BIN)/uv pip compile pyproject.toml --group dev --overrides requirements/overrides.txt --universal \
	  --python-version 3.11 --generate-hashes --no-emit-index-url --custom-compile-command "make lock" \
	  -o requirements/lock.txt

bench: setup
	$(BIN)/mien bench render

# On a machine with an NVIDIA GPU and the CUDA toolkit (gsplat compiles its kernels at first use): the tests marked
# gpu, then the figures for docs/results.md, into out/gpu.
gpu: setup
	VIRTUAL_ENV=.venv $(BIN)/uv pip install 'gsplat>=1.5'
	$(BIN)/pytest -m gpu
	mkdir -p out/gpu
	$(BIN)/mien bench render --device cuda --json > out/gpu/render.json
	$(BIN)/mien bench train-step --device cuda --json > out/gpu/train_step.json

clean:
	rm -rf build out .venv
