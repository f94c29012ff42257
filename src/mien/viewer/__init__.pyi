from .access import Door as Door
from .access import address_of as address_of
from .access import listen as listen
from .server import serve as serve
from .session import Session as Session
