"""Benchmarks of `mien bench`: timings on this machine, as machine-readable rows."""
