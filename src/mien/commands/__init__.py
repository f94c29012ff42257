"""The sub-commands: one file each, a dataclass of arguments with `run()`."""
