"""The families of head models that are read, and safe readers of their files."""
