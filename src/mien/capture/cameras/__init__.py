"""Rigs of several cameras: their calibration, the check of it, and the path of the head in their world."""
