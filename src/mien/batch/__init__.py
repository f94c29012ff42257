"""Many captures: a plan of rows, one process for each row, engines that start them, and what comes of it.

`plan` has rows and their states on disk, `row` claims and runs one, `steps` has what a row does, and `store` copies
workspaces to other machines. `drive` runs all rows with an engine: `local`, `slurm` or `on_ray`. `progress` tells how
far a batch is; `results` and `wall` show what came of it.
"""
