"""The sub-commands: one file each, with a dataclass of arguments that has `run()` and mostly `check()` (`parsing`).

Neither the import of a sub-command nor its `check()` imports torch or another heavy library, so mistakes are reported
at once.
"""
