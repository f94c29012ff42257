"""Benchmarks of `mien bench`: timings on this machine, and tables of quality."""
