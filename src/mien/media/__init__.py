"""Pictures, videos, sound and cameras: `source` opens them, `video_file` and `decoding` do so safely.

`display`, `tone`, `colors` and `color_correction` lead to sRGB, `lens` and `fields` undo what a camera did, `pace`
measures the frame rate, and `output` and `writing` write stills and films.
"""
