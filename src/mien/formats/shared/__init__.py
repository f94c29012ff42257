"""What several formats hold: columns of Gaussians, textures, the packed form of pages, FLAME's parameters."""
