"""Layouts: a tracked capture of mien as the files of other laboratories, for training outside. One file for each.

`registry` lists them and `layout` says what one is. `writing` makes the folder, with README.txt and `scoring`.
"""
