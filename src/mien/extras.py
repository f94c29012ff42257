"""Packages that only some commands need: which extra of mien brings each, and what is said if one is missing.

`pip install mien` installs what opens, draws and exports a finished avatar. The rest belongs to extras, because it
takes gigabytes. The names of packages are those of pyproject.toml; `tests/test_startup.py` compares both.
"""

import sys

EXTRA_OF = {
    "torch": "create",
    "filelock": "create",
    "av": "video",
    "cv2": "create",
    "mediapipe": "create",
    "ai_edge_litert": "create",
    "anny": "create",
    "stlpips_pytorch": "create",
    "matplotlib": "create",
    "PIL": "create",
    "jinja2": "create",
    "scipy": "create",
    "zstandard": "create",
    "viser": "viewer",
    "pxr": "usd",
    "gsplat": "cuda",
    "submitit": "batch",
    "ray": "batch",
    "fsspec": "batch",
    "s3fs": "batch",
}
"""Name of a module -> the extra that installs it."""
PACKAGE_OF = {
    "cv2": "opencv-python-headless",
    "ai_edge_litert": "ai-edge-litert",
    "stlpips_pytorch": "stlpips-pytorch",
    "PIL": "pillow",
    "pxr": "usd-core",
}
"""Name of a module -> name of its package, if that is another."""
_OF_FILES = ("render", "view", "drive")
"""Sub-commands that need nothing but PyAV to write a film of a .mien file. Others need all of `create` soon after."""
_LAST_PYTHON_OF_MEDIAPIPE = (3, 12)
_LIBRARY = ": cannot open shared object file"


def missing_package(error: ImportError, command: str = "") -> str | None:
    """One line about a package that is missing, with the command that installs it. None if it is none of the extras'.

    Args:
        error: What an import raised.
        command: The sub-command that runs.
    """
    module = (error.name or "").partition(".")[0]
    if _LIBRARY in str(error):
        library = str(error).partition(_LIBRARY)[0].split()[-1]
        return (
            f"a package needs the system's library {library}, which is missing; install it (Debian and Ubuntu: "
            "apt-get install libgl1 libglib2.0-0), or install opencv-python-headless in place of opencv-contrib-python"
        )
    if module not in EXTRA_OF or not isinstance(error, ModuleNotFoundError):
        return None
    package, extra = PACKAGE_OF.get(module, module), EXTRA_OF[module]
    if extra == "video" and command not in _OF_FILES:
        extra = "create"
    if module == "mediapipe" and sys.version_info[:2] > _LAST_PYTHON_OF_MEDIAPIPE:
        here = ".".join(map(str, sys.version_info[:2]))
        return (
            f"the detector mediapipe 0.10.21 has no package for Python {here}; leave out --capture.detector, so that "
            "ai-edge-litert finds the faces"
        )
    return f"this needs the package {package}, which is not installed; run `pip install 'mien[{extra}]'`"
