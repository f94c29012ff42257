"""User studies: people compare methods blind beside the truth, and their answers become percentages.

`making` writes the page and its key, from clips that `clips` chooses and `drawing` draws; `shuffling` is the order in
which a participant sees them; `files` are the key and the answers; `tally` counts. The last three need no torch.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.lab.analysis.study.clips import StudyRuns
    from mien.lab.analysis.study.files import Answers, StudyKey, read_answers, read_key
    from mien.lab.analysis.study.making import write_study
    from mien.lab.analysis.study.settings import StudySettings
    from mien.lab.analysis.study.tally import tally_content, tally_text
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "Answers",
    "StudyKey",
    "StudyRuns",
    "StudySettings",
    "read_answers",
    "read_key",
    "tally_content",
    "tally_text",
    "write_study",
]
