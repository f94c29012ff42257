from .access import Door as Door
from .server import serve as serve
from .session import Session as Session
