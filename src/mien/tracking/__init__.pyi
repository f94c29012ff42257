from .files import read_tracking as read_tracking
from .files import write_tracking as write_tracking
from .pipeline import track as track
from .pipeline import track_subject as track_subject
