from .access import Door as Door
from .server import address_of as address_of
from .server import listen as listen
from .server import serve as serve
from .session import Session as Session
