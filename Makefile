# make setup | web-packages | chromium | web | demo | studio | test | test-long | test-312 | test-exact | sanitize | fuzz | kills | mutate | lint | docs | release | elsewhere | bench | gpu. The environment is VENV; everything else is in pyproject.toml.
# The first Python that runs: what lies on the PATH may be a stand-in of pyenv that leads nowhere.
PYTHON ?= $(shell for python in python3.11 python3.12; do $$python -c "" 2>/dev/null && break; done; echo $$python)
PYTHON312 ?= $(shell for python in python3.12 $(HOME)/.pyenv/versions/3.12*/bin/python3.12; do $$python -c "" 2>/dev/null && break; done; echo $$python)
VENV ?= .venv
BIN := $(VENV)/bin
NATIVE := $(wildcard native/*.*) CMakeLists.txt
# Nothing may be left out where MIEN_STRICT is set, as in CI: not tests that a missing program skips, either (tests/needs.py).
UNLESS_STRICT := test -z "$$MIEN_STRICT"
UV := uv==0.13.8
GSPLAT := gsplat==1.5.3
ZIGLANG := ziglang==0.17.1

.PHONY: setup landmarker web-packages chromium web build demo studio test test-long test-312 test-312-part test-exact sanitize fuzz fuzz-native fuzz-datasets kills mutate lint format docs release elsewhere bench gpu batch-engines test-engines lock clean
setup: $(VENV)/.built landmarker

$(VENV)/.packages: requirements/lock.txt requirements/uv.txt
	@"$(PYTHON)" -c "" 2>/dev/null || { echo "mien needs Python 3.11 or 3.12: install it, or run 'make PYTHON=/path/to/python3.11 ...'"; exit 1; }
	@command -v $${CXX:-g++} >/dev/null || { echo "mien needs a C++20 compiler: install g++ 11 or newer"; exit 1; }
	test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV)
	test -x $(BIN)/uv || $(BIN)/python -m pip install --disable-pip-version-check --require-hashes -r requirements/uv.txt
	@echo "Installing packages (torch alone is about 3 GB to download; this is the long part) ..."
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip sync --require-hashes requirements/lock.txt
	touch $@

# An editable install: Python from src/, the native core built into VENV.
$(VENV)/.built: $(VENV)/.packages pyproject.toml $(NATIVE)
	@echo "compiling the C++ core: one to four minutes ..."
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --no-build-isolation --no-deps --reinstall-package mien -e .
	@# Python reads .pth files in the locale's encoding, and under LC_ALL=C dies of an absolute path with an umlaut.
	sed -i 's|^/.*/src$$|../../../../src|' $(VENV)/lib/python3*/site-packages/_editable_skbc_mien.pth
	touch $@

build: setup

# MediaPipe's face landmarker for pages, for `mien export --webcam` and the wheel: one package of npm, in a version that
# sends nothing (src/mien/formats/shared/webcam.py checks its files by hash). Everything else works without it.
LANDMARKER := src/mien/formats/shared/landmarker
TASKS_VISION := @mediapipe/tasks-vision@0.10.35
landmarker: $(LANDMARKER)/vision_wasm_internal.wasm.xz
$(LANDMARKER)/vision_wasm_internal.wasm.xz:
	@if command -v npm >/dev/null; then mkdir -p build/landmarker && npm pack --silent --pack-destination build/landmarker $(TASKS_VISION) >/dev/null \
	  && tar -xzf build/landmarker/*.tgz -C build/landmarker && mv build/landmarker/package/vision_bundle.cjs \
	  build/landmarker/package/wasm/vision_wasm_internal.js $(LANDMARKER)/ && rm -f $(LANDMARKER)/vision_wasm_internal.wasm \
	  && "$(PYTHON)" -c 'import lzma, sys; sys.stdout.buffer.write(lzma.compress(sys.stdin.buffer.read(), preset=9 | lzma.PRESET_EXTREME))' \
	  < build/landmarker/package/wasm/vision_wasm_internal.wasm > build/landmarker/wasm.xz && mv build/landmarker/wasm.xz $@ \
	  && rm -r build/landmarker; else echo "No npm: pages have no webcam (mien export --webcam) until 'make landmarker' runs with it."; fi

# The web runtime's packages, for its build and its tests. Without npm, the tests that need them are skipped; MIEN_STRICT
# makes that an error, here and below.
web/node_modules/.installed: web/package-lock.json
	npm ci --prefix web --ignore-scripts --no-audit --no-fund
	touch $@

web-packages:
	@if command -v npm >/dev/null; then $(MAKE) web/node_modules/.installed; else echo "No npm: web/ cannot be built or tested. Install Node.js 20 or newer."; $(UNLESS_STRICT); fi

# The browser of the tests of pages. Debian's package is installed where that needs no password: as root, as in containers.
BROWSER := $(or $(MIEN_CHROMIUM),chromium chromium-browser google-chrome)
chromium:
	@for browser in $(BROWSER); do if command -v "$$browser" >/dev/null; then exit 0; fi; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  echo "Installing Chromium for the tests of pages ..."; \
	  { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium; } >/dev/null && exit 0; fi; \
	echo "No Chromium: pages cannot be tested. Run 'apt-get install chromium', or set MIEN_CHROMIUM to a Chromium's path."; $(UNLESS_STRICT)

# dist/mien.js, and the page that `mien export` fills, which is committed.
web: web/node_modules/.installed
	npm run build --prefix web

demo: setup
	$(BIN)/mien demo --out out/demo

studio: setup
	$(BIN)/mien studio out/people

# Everything that a change can break: one process a core, each with one thread (tests/conftest.py says how many).
test: setup web-packages chromium
	MIEN_THREADS=1 $(BIN)/pytest -n auto -m "not long"

# Campaigns, which take hours. SAMPLE=1 runs a sample of each, as CI does. Its seed is the date of the commit, so that the same
# commit always runs the same sample; SEED says another.
SAMPLE ?=
SEED ?= $(if $(SAMPLE),$(or $(shell git log -1 --format=%cd --date=format:%Y%m%d 2>/dev/null),1),1)
test-long: setup web-packages chromium batch-engines
	@echo "test-long: one again with SEED=$(SEED)$(if $(SAMPLE), SAMPLE=$(SAMPLE))"
	$(MAKE) sanitize
	$(MAKE) fuzz SEED=$(SEED) $(if $(SAMPLE),MINUTES= CALLS=3000)
	$(MAKE) kills SEED=$(SEED) $(if $(SAMPLE),KILLS=4)
	$(MAKE) mutate SEED=$(SEED) $(if $(SAMPLE),MUTATIONS=4)
	$(MAKE) test-exact
	$(MAKE) test-312
	MIEN_SEED=$(SEED) MIEN_THREADS=1 $(BIN)/pytest -n auto -m long

# A broad and fast part of the suite on Python 3.12, in an environment of its own. All of it: make test VENV=.venv312 PYTHON=python3.12
PART := terminal startup cli inside rasterize training_native training_batch runtime export motion
test-312:
	@if "$(PYTHON312)" -c "" 2>/dev/null; then $(MAKE) VENV=.venv312 PYTHON="$(PYTHON312)" test-312-part; \
	else echo "No Python 3.12: skipped. Install it, or run 'make PYTHON312=/path/to/python3.12 test-312'."; $(UNLESS_STRICT); fi

test-312-part: setup
	MIEN_THREADS=1 $(BIN)/pytest -n auto -m "not long" $(PART:%=tests/test_%.py)

# The tests of docs/reproducibility.md once more, as an old and a middle-aged processor of the x86-64 family compute.
X86 := $(filter x86_64,$(shell uname -m))
test-exact: setup
	MKL_CBWR=COMPATIBLE ATEN_CPU_CAPABILITY=default OPENBLAS_CORETYPE=$(if $(X86),Nehalem) MIEN_ISA=$(if $(X86),sse4) \
	  $(BIN)/pytest -m exact -q
	MKL_CBWR=AVX2 ATEN_CPU_CAPABILITY=$(if $(X86),avx2) OPENBLAS_CORETYPE=$(if $(X86),Haswell) MIEN_ISA=$(if $(X86),avx2) \
	  $(BIN)/pytest -m exact -q

# The native core's own checks under AddressSanitizer, UndefinedBehaviorSanitizer and ThreadSanitizer; needs no Python.
sanitize:
	$(MAKE) -C native/checks -j2

# Every native function with random arguments under AddressSanitizer and UndefinedBehaviorSanitizer.
CALLS ?= 50000
SANITIZED := build/sanitize-native
fuzz-native: setup
	$(BIN)/cmake -S . -B $(SANITIZED) -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN)/ninja) -DCMAKE_BUILD_TYPE=Debug -DMIEN_SANITIZE=ON \
	  -DPython_EXECUTABLE=$(abspath $(BIN)/python) -Dnanobind_DIR=$$($(BIN)/python -m nanobind --cmake_dir) > /dev/null
	$(BIN)/ninja --quiet -C $(SANITIZED)
	PYTHONPATH=tests $(BIN)/python -m fuzzing.native_calls $(SANITIZED)/native --calls $(CALLS) --seed $(SEED)

# Faults in files of every format and odd command lines, native calls; findings go to out/fuzz/findings.jsonl. It goes on with further
# seeds for MINUTES, or ends after CASES.
MINUTES ?= 10
CASES ?= 5000
fuzz: setup
	PYTHONPATH=tests $(BIN)/python -m fuzzing --self-check --seed $(SEED) --cases $(CASES) $(MINUTES:%=--minutes %) --workers 2 \
	  --findings out/fuzz/findings.jsonl
	$(MAKE) fuzz-native

# FAULTS faults in each layout that `mien import` reads, layouts side by side, without the tests' checks of types at run time, as
# users have it. About ten minutes on two free cores.
FAULTS ?= 2000
fuzz-datasets: setup
	MIEN_DATASET_FUZZ=$(FAULTS) MIEN_THREADS=1 \
	  $(BIN)/pytest -q -o addopts= -n auto --dist load --timeout 0 tests/test_datasets_fuzz.py -m 'not long'

# Commands that are killed at random moments and run again, until there are KILLS kills; findings go to out/fuzz/kills.jsonl.
KILLS ?= 200
kills: setup
	PYTHONPATH=tests $(BIN)/python -m fuzzing.kills --kills $(KILLS) --seed $(SEED) --findings out/fuzz/kills.jsonl

# Mistakes put into copies of the code, one at a time: the tests must catch 95 % of them. About ten minutes on two free cores.
# MUTATIONS tries that many of them, drawn by SEED.
MUTATIONS ?=
mutate: setup web-packages
	PYTHONPATH=tests $(BIN)/python -m mutations --workers 2 $(if $(MUTATIONS),--sample $(MUTATIONS) --seed $(SEED))

# pyright's wrapper asks the package index for a newer version unless it is told not to.
lint: setup
	$(BIN)/ruff check src tests examples benchmarks release docs/site docs/pictures web/conformance
	$(BIN)/ruff format --check src tests examples benchmarks release docs/site docs/pictures web/conformance
	$(BIN)/clang-format --dry-run --Werror $(wildcard native/*.cpp native/*.h native/*/*.cpp native/*/*.h)
	$(BIN)/python tests/sizes.py
	$(BIN)/python tests/rooms.py mien
	$(BIN)/python tests/seams.py
	$(BIN)/typos
	$(BIN)/lint-imports
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright --pythonpath $(BIN)/python

format: setup
	$(BIN)/ruff check --fix src tests examples benchmarks release docs/site docs/pictures web/conformance
	$(BIN)/ruff format src tests examples benchmarks release docs/site docs/pictures web/conformance
	$(BIN)/clang-format -i $(wildcard native/*.cpp native/*.h native/*/*.cpp native/*/*.h)

# The site of the documentation, with the reference of the public API: build/docs/index.html. A broken link is an error.
# `make demo docs` puts the demo's person, alive, on its first page.
docs: setup
	$(BIN)/python docs/site/build.py --out build/docs
	@echo "open build/docs/index.html"

# Re-resolve the locked requirements (both Pythons, every platform) after a change in pyproject.toml or overrides.txt.
lock: $(VENV)/.packages
	$(BIN)/uv pip compile pyproject.toml --group dev --extra create --overrides requirements/overrides.txt --universal \
	  --python-version 3.11 --generate-hashes --no-emit-index-url --custom-compile-command "make lock" \
	  -o requirements/lock.txt
	for package in $(UV) $(GSPLAT) $(ZIGLANG); do echo "$$package" | $(BIN)/uv pip compile - --no-deps --universal --python-version 3.11 \
	  --generate-hashes --no-emit-index-url --no-annotate --custom-compile-command "make lock" \
	  -o "requirements/$${package%%==*}.txt" || exit 1; done

# The engines of `mien batch` on clusters, which the base set-up leaves out.
batch-engines: setup
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install -r requirements/batch.in

# The tests of `mien batch` on Ray and with an object store, which `make test` skips where they are missing.
test-engines: batch-engines
	MIEN_THREADS=1 $(BIN)/pytest tests/test_batch_engines.py tests/test_batch.py

# Everything of a release into dist/, with the times of its commit (release/make.py).
release: setup
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python release/make.py --out dist

# The native core for other systems: built by zig, run under qemu-user (aarch64) and Wine (Windows), linked for macOS.
elsewhere: setup
	@for program in qemu-aarch64-static wine /usr/aarch64-linux-gnu/lib/ld-linux-aarch64.so.1; do command -v $$program >/dev/null || { \
	  echo "No $$program: run 'apt-get install qemu-user-static libc6-arm64-cross wine'."; exit 1; }; done
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --require-hashes --no-deps -r requirements/ziglang.txt
	$(MAKE) -C native/checks elsewhere ZIG="$(abspath $(BIN))/python -m ziglang"

bench: setup
	$(BIN)/mien bench render

# On a machine with an NVIDIA GPU and the CUDA toolkit (gsplat compiles its kernels at first use): the tests marked gpu, a step
# of each method and `mien create` on a clip (VIDEO=FILE, or a synthetic head), in eight minutes. It prints a table.
VIDEO ?=
gpu: setup
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --require-hashes --no-deps -r requirements/gsplat.txt
	$(BIN)/python benchmarks/device.py --out out/gpu $(VIDEO:%=--video %)

clean:
	rm -rf build dist out .venv .venv312
