"""Layouts: a tracked capture of mien as the files of other laboratories, for training outside. One file for each.

`layout` says what one is and lists them. `writing` makes the folder, with README.txt and `scoring`.
"""
