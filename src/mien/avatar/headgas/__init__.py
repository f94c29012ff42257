"""HeadGaS: Gaussians whose colour and opacity follow the expression (Dhamo et al., ECCV 2024)."""
