from .content import read_arrays as read_arrays
from .dataset import Dataset as Dataset
from .dataset import TrackedSequence as TrackedSequence
from .sequences import tracked_sequence as tracked_sequence
