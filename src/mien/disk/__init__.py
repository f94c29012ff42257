"""Files on disk: `reading` is the door for what is read, `limits` checks its content, and `files` writes whole files.

`config` has settings with their ranges, `tables` reads csv, `locks` says who is at work, and `workspace` has the paths.
"""
