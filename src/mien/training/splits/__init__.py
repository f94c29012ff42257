"""Which frames are held out, beside the last ones: `named` sequences, a `benchmark`'s, or a dataset's `own`."""
