"""Parts that several formats share: columns of Gaussians, textures, the packed form of pages, FLAME's parameters."""
