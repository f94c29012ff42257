from .engines import Engine as Engine
from .engines import EngineOptions as EngineOptions
from .plan import Row as Row
