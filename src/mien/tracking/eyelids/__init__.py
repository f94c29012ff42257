"""Eyelids, placed from the colours of each eye."""
