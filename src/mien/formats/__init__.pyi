from .format import Content as Content
from .format import Format as Format
from .format import Options as Options
from .gaussian_avatars import read_gaussian_avatars_folder as read_gaussian_avatars_folder
from .gaussian_avatars import write_gaussian_avatars_folder as write_gaussian_avatars_folder
from .ply import read_ply as read_ply
from .ply import write_ply as write_ply
from .shared.world_space import in_world as in_world
