"""Formats of files for other programs: what each holds, and how it is written and read."""

from mien.formats.format import Content, Format, Holds, Options
from mien.formats.registry import endings, find_format, format_of, formats, numbered

__all__ = ["Content", "Format", "Holds", "Options", "endings", "find_format", "format_of", "formats", "numbered"]
