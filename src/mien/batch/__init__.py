"""Many captures: a plan of rows, one process for each row, engines that start them, and what comes of it.

`plan` has rows and their states on disk, `row` claims and runs one, and `store` reads and writes files of other
machines. `drive` runs all rows with one of the `engines`. `progress` tells how far a batch is,
and `results` shows what came of it.
"""
