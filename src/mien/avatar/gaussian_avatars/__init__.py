"""GaussianAvatars: Gaussians bound to the triangles of a head model (Qian et al., CVPR 2024)."""
