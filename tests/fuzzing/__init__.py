"""Fuzz readers and commands with files that are wrong in typical ways, and with odd command lines.

`make fuzz MINUTES=30` runs the fuzzers at length, and tests/test_damage.py runs them briefly. A case is named
`TARGET:SEED:NUMBER` and is always the same: `PYTHONPATH=tests .venv/bin/python -m fuzzing --replay CASE` repeats it."""
