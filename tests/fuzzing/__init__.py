"""Structure-aware fuzzers: files that are wrong in the ways that readers trip over, and odd command lines.

`make fuzz MINUTES=30` runs them at length, tests/test_fuzz.py briefly. A case is named `TARGET:SEED:NUMBER` and is the
same every time: `PYTHONPATH=tests .venv/bin/python -m fuzzing --replay TARGET:SEED:NUMBER`.
"""
