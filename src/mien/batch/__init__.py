"""Many captures: a plan of rows, one process for each row, engines that start them, and what comes of it.

`plan` has rows and their states on disk, `row` claims and runs one, `steps` has what a row does, and `store` copies
working sets to other machines. `engines` has an adapter for each engine, and `drive` runs all rows with one of them.
`progress` tells how far a batch is; `results` and `wall` show what came of it.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.batch.drive import Driver, shard_of
    from mien.batch.engines import ENGINES, Engine, EngineOptions, engine_named, engine_names
    from mien.batch.plan import WORKSPACE, Batch, Row, State, with_fingerprint
    from mien.batch.progress import batch_progress, progress_text
    from mien.batch.results import RESULT_COLUMNS, latex_table, markdown_table, means_by, result_rows, write_results
    from mien.batch.row import repeat_command, row_process, run_row
    from mien.batch.steps import do_with
    from mien.batch.store import is_url
    from mien.batch.wall import write_wall
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "ENGINES", "RESULT_COLUMNS", "WORKSPACE", "Batch", "Driver", "Engine", "EngineOptions", "Row", "State",
    "batch_progress", "do_with", "engine_named", "engine_names", "is_url", "latex_table", "markdown_table", "means_by",
    "progress_text", "repeat_command", "result_rows", "row_process", "run_row", "shard_of", "with_fingerprint",
    "write_results", "write_wall",
]  # fmt: skip
