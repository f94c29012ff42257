"""Operations on Gaussians that have a native form: each takes plain tensors and has a reference in plain PyTorch."""
