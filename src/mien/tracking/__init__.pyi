from .files import read_tracking as read_tracking
from .files import write_tracking as write_tracking
from .pipeline.track import track as track
from .pipeline.track import track_subject as track_subject
