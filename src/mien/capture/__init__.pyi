from .from_video import capture_video as capture_video
from .store import read_capture as read_capture
from .store import write_capture as write_capture
