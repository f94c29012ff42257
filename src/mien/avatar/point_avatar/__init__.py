"""PointAvatar: isotropic points with colours by normals (Zheng et al., CVPR 2023)."""
