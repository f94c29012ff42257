"""What `mien bench` runs: timings on this machine, as rows that a machine may read."""
