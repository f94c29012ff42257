"""Many captures: a plan of rows, one process for each row, engines that start them, and what comes of it.

`plan` has rows and their states on disk, `row` claims and runs one, `steps` has what a row does, and `store` copies
working sets to other machines. `engines` has an adapter for each engine, and `drive` runs all rows with one of them.
`progress` tells how far a batch is; `results` and `wall` show what came of it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
