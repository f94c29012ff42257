"""A textured mesh with trained offsets, under light by spherical harmonics: the plain baseline of all methods."""
