"""A webcam in a page: MediaPipe's face landmarker, embedded with its model (docs/web.md).

webcam.html beside this file is built from web/ and committed. The landmarker comes from the npm package
@mediapipe/tasks-vision, its model from a file of the user; neither comes with mien.
"""

import base64
import gzip
import html
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

from mien.bounded import read_bytes
from mien.errors import UserError

TEMPLATE = Path(__file__).with_name("webcam.html")
NOTICES = Path(__file__).with_name("webcam_notices.txt")
"""Copyright notices and licences of what the page embeds. A new version of the package needs another look at them."""
PACKAGE, VERSION = "@mediapipe/tasks-vision", "0.10.35"
"""The npm package, and the version that pages are tested with. Later versions send statistics to their maker."""
PACKAGE_VARIABLE, MODEL_VARIABLE = "MIEN_TASKS_VISION", "MIEN_FACE_LANDMARKER"
"""Environment variables that name the package's folder and the model's file."""
MODEL_ADDRESS = (
    "https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/float16/1/face_landmarker.task"
)
"""Where MediaPipe's documentation publishes the model (Apache-2.0)."""
POLICY = " blob: 'wasm-unsafe-eval'; worker-src blob:; connect-src 'none'; form-action 'none'; base-uri 'none'"
"""What the page's policy allows in addition: scripts and a worker that are in the page itself. Nothing else, and no
connection at all."""
_FILES = {
    "vision": "vision_bundle.cjs",
    "loader": "wasm/vision_wasm_internal.js",
    "wasm": "wasm/vision_wasm_internal.wasm",
}
_MEMBERS = {"face_detector.tflite", "face_landmarks_detector.tflite", "face_blendshapes.tflite"}
"""Networks in a model that finds blend shapes."""
_MOST_BYTES = 64 << 20
"""Largest file that goes into a page."""


@dataclass(frozen=True)
class WebcamFiles:
    """Where the landmarker's files are."""

    package: Path
    """Folder of the npm package."""
    model: Path
    """The file face_landmarker.task."""


def find_webcam_files(model: Path | None = None) -> WebcamFiles:
    """Return the landmarker's files on this machine.

    The package is in the folder that MIEN_TASKS_VISION names, or else in web/node_modules of the checkout.

    Args:
        model: The model's file. None for the one that MIEN_FACE_LANDMARKER names.

    Raises:
        UserError: one of them is missing, is of another version, or is no such model.
    """
    return WebcamFiles(_package(), _model(model))


def webcam_part(files: WebcamFiles) -> str:
    """Return what a page holds for the webcam, as html.

    Raises:
        UserError: a file cannot be read.
    """
    paths = {name: files.package / path for name, path in _FILES.items()} | {"model": files.model}
    parts = "\n".join(
        f'<script type="application/octet-stream" id="webcam-{name}">{_packed(path)}</script>'
        for name, path in paths.items()
    )
    page = TEMPLATE.read_text(encoding="utf-8").replace("{{notices}}", html.escape(NOTICES.read_text(encoding="utf-8")))
    return page.replace("{{parts}}", parts)


def _packed(path: Path) -> str:
    try:
        content = read_bytes(path, _MOST_BYTES)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _package() -> Path:
    named = os.environ.get(PACKAGE_VARIABLE)
    folder = Path(named) if named else Path(__file__).parents[3] / "web" / "node_modules" / PACKAGE
    remedy = (
        f"run `make web-packages` in mien's checkout, or unpack the result of `npm pack {PACKAGE}@{VERSION}` and set "
        f"{PACKAGE_VARIABLE} to its folder"
    )
    try:
        version = json.loads((folder / "package.json").read_text(encoding="utf-8")).get("version")
    except (OSError, ValueError, AttributeError):
        raise UserError(f"{folder}: --webcam needs the npm package {PACKAGE}, which is not there; {remedy}") from None
    if version != VERSION:
        raise UserError(f"{folder}: is version {version} of {PACKAGE}, and pages need {VERSION}; {remedy}")
    missing = [path for path in _FILES.values() if not (folder / path).is_file()]
    if missing:
        raise UserError(f"{folder}: lacks {missing[0]}; {remedy}")
    return folder


def _model(given: Path | None) -> Path:
    named = os.environ.get(MODEL_VARIABLE)
    path = given or (Path(named) if named else None)
    if path is None or not path.is_file():
        missing = f"{path}: no such file" if path else "--webcam: no model"
        raise UserError(
            f"{missing}; --webcam needs MediaPipe's face_landmarker.task (Apache-2.0, 4 MB), which does not come with "
            f"mien. Download it from {MODEL_ADDRESS}, and give its place with --webcam-model FILE, or set "
            f"{MODEL_VARIABLE} to it"
        )
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError
        with zipfile.ZipFile(path) as archive:
            sound = set(archive.namelist()) >= _MEMBERS
    except (OSError, ValueError, zipfile.BadZipFile):
        sound = False
    if not sound:
        raise UserError(f"{path}: is no face_landmarker.task with blend shapes; download it from {MODEL_ADDRESS}")
    return path
