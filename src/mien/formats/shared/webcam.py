"""A webcam in a page: MediaPipe's face landmarker, embedded with its model (docs/web.md).

webcam.html beside this file is built from web/ and committed. The landmarker's model comes with mien, in the folder
`landmarker` beside this file, compressed and in two parts. The second holds the network for blend shapes, which only
pages need, so that source distributions leave it out. The landmarker's code is that of the npm package
@mediapipe/tasks-vision, which `make setup` puts into the same folder.
"""

import base64
import gzip
import hashlib
import html
import io
import lzma
import os
import zipfile
from pathlib import Path

from mien.disk.reading import read_bytes
from mien.errors import UserError

TEMPLATE = Path(__file__).with_name("webcam.html")
NOTICES = Path(__file__).with_name("webcam_notices.txt")
"""Copyright notices and licences of what the page embeds. A new version of the package needs another look at them."""
PACKAGE, VERSION = "@mediapipe/tasks-vision", "0.10.35"
"""The npm package, and the version that pages are tested with. Later versions send statistics to their maker."""
PACKAGE_VARIABLE, MODEL_VARIABLE = "MIEN_TASKS_VISION", "MIEN_FACE_LANDMARKER"
"""Environment variables that name the package's folder and the model's file, in place of mien's own."""
OWN = Path(__file__).with_name("landmarker")
"""Folder of what comes with mien: the model, its licence, and the files of the package, which `make landmarker` puts
there."""
POLICY = " blob: 'wasm-unsafe-eval'; worker-src blob:; connect-src 'none'; form-action 'none'; base-uri 'none'"
"""What the page's policy allows in addition: scripts and a worker that are in the page itself. Nothing else, and no
connection at all."""
_FILES = {
    "vision": ("vision_bundle.cjs", "7fba4f9807297e229371318df577e96fc9f1b3d93e79075e3798ade2fc790c9e"),
    "loader": ("vision_wasm_internal.js", "e7fd9858e8e8f221d9b96eddc11f8e077f263e0b7bbd79d3cbe882b134274f8c"),
    "wasm": ("vision_wasm_internal.wasm", "6a5c64584c2ab61c763b6e204afbdbc7ce1caf7f5216187322bca8df94f646bc"),
}
"""Files of the package, with their SHA-256. Other files are refused, because later versions send statistics."""
_MEMBERS = {"face_detector.tflite", "face_landmarks_detector.tflite", "face_blendshapes.tflite"}
"""Networks in a model that finds blend shapes."""
_MOST_BYTES = 64 << 20
"""Largest file that goes into a page."""
_MODEL_PARTS = ("face_landmarker.task.xz.1", "face_landmarker.task.xz.2")
"""The model in mien's own folder: parts that are decompressed one by one and put together."""
_SHRUNK = ".xz"
"""Further ending of files that lie compressed in mien's own folder, so that mien is quickly downloaded."""


def webcam_files(model: Path | None = None) -> dict[str, bytes]:
    """Return the contents of the landmarker's files: its code, and the given model, a variable's, or else mien's."""
    named = os.environ.get(MODEL_VARIABLE)
    return {**_package(), "model": _model(model or (Path(named) if named else None))}


def webcam_part(model: Path | None = None) -> str:
    """Return what a page holds for the webcam, as html."""
    parts = "\n".join(
        f'<script type="application/octet-stream" id="webcam-{name}">{_packed(content)}</script>'
        for name, content in webcam_files(model).items()
    )
    page = TEMPLATE.read_text(encoding="utf-8").replace("{{notices}}", html.escape(NOTICES.read_text(encoding="utf-8")))
    return page.replace("{{parts}}", parts)


def own_model() -> bytes:
    """Return the bytes of the face_landmarker.task that comes with mien."""
    return b"".join(_content(OWN / part) for part in _MODEL_PARTS)


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _content(path: Path) -> bytes:
    """The bytes of a file, which may lie compressed. A file that is too large or damaged is a ValueError."""
    content = read_bytes(path, _MOST_BYTES)
    if _SHRUNK not in path.suffixes:
        return content
    try:
        return lzma.LZMADecompressor(memlimit=4 * _MOST_BYTES).decompress(content, _MOST_BYTES)
    except lzma.LZMAError as error:
        raise ValueError(str(error)) from None


def _package() -> dict[str, bytes]:
    named = os.environ.get(PACKAGE_VARIABLE)
    folder, contents = Path(named) if named else OWN, {}
    remedy = (
        f"run `make landmarker` in mien's checkout, or unpack the result of `npm pack {PACKAGE}@{VERSION}` and set "
        f"{PACKAGE_VARIABLE} to its folder"
    )
    for part, (name, expected) in _FILES.items():
        # Some of the package's files lie in its folder `wasm`, and some of mien's lie compressed.
        places = (folder / name, folder / "wasm" / name, folder / f"{name}{_SHRUNK}")
        path = next((path for path in places if path.is_file()), folder / name)
        try:
            contents[part] = _content(path)
        except (OSError, ValueError):
            raise UserError(f"{folder}: --webcam needs {name} of the npm package {PACKAGE}; {remedy}") from None
        if hashlib.sha256(contents[part]).hexdigest() != expected:
            raise UserError(f"{path}: is not that of version {VERSION} of {PACKAGE}, which pages need; {remedy}")
    return contents


def _model(path: Path | None) -> bytes:
    """The content of a model's file, or of mien's own model."""
    own = all((OWN / part).is_file() for part in _MODEL_PARTS)
    if path is None and own:
        return own_model()
    if path is None:
        raise UserError(
            "--webcam needs MediaPipe's network for blend shapes, which mien's source distribution leaves out: install "
            "mien from a wheel or a checkout, or give MediaPipe's face_landmarker.task with --webcam-model"
        )
    remedy = "give MediaPipe's face landmarker with blend shapes" + (", or leave it out: mien has one" if own else "")
    if not path.is_file():
        raise UserError(f"{path}: no such file; {remedy}")
    try:
        content = _content(path)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if set(archive.namelist()) >= _MEMBERS:
                return content
    except (OSError, ValueError, zipfile.BadZipFile):
        pass
    raise UserError(f"{path}: is no face_landmarker.task with blend shapes; {remedy}")
