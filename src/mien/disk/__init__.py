"""Files on disk: `reading` and `limits` bound what is read, and `files` writes whole files or none.

`inside` follows no link. `config` has settings with their ranges, `tables` reads csv, `locks` says who is at work,
and `workspace` has the paths.
"""
