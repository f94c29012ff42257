from .format import Content as Content
from .format import Format as Format
from .format import Options as Options
