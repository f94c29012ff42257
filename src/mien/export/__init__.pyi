from .gaussian_avatars_folder import read_gaussian_avatars_folder as read_gaussian_avatars_folder
from .gaussian_avatars_folder import write_gaussian_avatars_folder as write_gaussian_avatars_folder
from .ply import read_ply as read_ply
from .ply import write_ply as write_ply
from .world_space import in_world as in_world
