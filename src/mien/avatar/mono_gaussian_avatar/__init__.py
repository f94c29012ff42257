"""MonoGaussianAvatar: free points that deform with the face (Chen et al., SIGGRAPH 2024)."""
