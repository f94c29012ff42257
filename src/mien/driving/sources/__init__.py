"""Recordings of other programs and voices, read as motions."""
