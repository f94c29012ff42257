from .footage.sequence import read_sequence as read_sequence
from .settings import PRESETS as PRESETS
from .settings import TrainSettings as TrainSettings
from .trainer import train as train
