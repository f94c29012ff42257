"""Pictures, videos, sound and cameras: `source` opens them, `video`, `video_file` and `decoding` read them safely.

`display`, `colors` and `color_correction` lead to sRGB, `lens` and `fields` undo what a camera did, and `output` and
`writing` write stills and films.
"""
