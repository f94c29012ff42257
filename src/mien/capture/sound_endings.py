"""Endings of files with sound alone. The file imports nothing, so that options are checked quickly."""

SOUND_ENDINGS = (".wav", ".mp3", ".flac", ".ogg", ".opus", ".m4a", ".aac", ".aif", ".aiff")
