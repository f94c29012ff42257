"""Choices that settings and checks name, without any library."""

from typing import Literal

Deinterlace = Literal["auto", "always", "never"]
SOUND_ENDINGS = (".wav", ".mp3", ".flac", ".ogg", ".opus", ".m4a", ".aac", ".aif", ".aiff")
