"""The sub-commands: one file each, a dataclass of arguments with `check()` and `run()`.

Neither importing one nor `check()` imports torch or another heavy library: mistakes are told at once.
"""
