"""USD's endings and its package, usd-core, checked before any work and without heavy libraries."""

import importlib.util
from pathlib import Path

from mien.errors import UserError

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")


def check_usd(path: Path) -> None:
    """Check that usd-core, which writes and reads `path`, is installed."""
    if importlib.util.find_spec("pxr") is None:
        raise UserError(f"{path}: needs the package usd-core, which is missing; run `pip install 'mien[usd]'`")
