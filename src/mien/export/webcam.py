"""A webcam in a page: MediaPipe's face landmarker, embedded with its model (docs/web.md).

webcam.html beside this file is built from web/ and committed. The landmarker comes from the npm package
@mediapipe/tasks-vision, its model from a file of the user; neither comes with mien.
"""

import base64
import gzip
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

from mien.errors import UserError
from mien.face.cache import cache_folder

TEMPLATE = Path(__file__).with_name("webcam.html")
PACKAGE, VERSION = "@mediapipe/tasks-vision", "0.10.35"
"""The npm package, and the version that pages are tested with. Later versions send statistics to their maker."""
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
        model: The model's file. None for face_landmarker.task in the user's cache (`mien.face.cache.cache_folder`).

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
    return TEMPLATE.read_text(encoding="utf-8").replace("{{parts}}", parts)


def _packed(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _package() -> Path:
    named = os.environ.get("MIEN_TASKS_VISION")
    folder = Path(named) if named else Path(__file__).parents[3] / "web" / "node_modules" / PACKAGE
    remedy = (
        f"run `make web-packages` in mien's checkout, or unpack the result of `npm pack {PACKAGE}@{VERSION}` and set "
        "MIEN_TASKS_VISION to its folder"
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
    path = given or cache_folder() / "face_landmarker.task"
    if not path.is_file():
        raise UserError(
            f"{path}: no such file. --webcam needs MediaPipe's model face_landmarker.task (Apache-2.0, 4 MB), which "
            f"does not come with mien. Download it from {MODEL_ADDRESS}, and put it there, or give its place with "
            "--webcam-model FILE"
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
