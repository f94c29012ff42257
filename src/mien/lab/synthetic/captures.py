"""Draw whole synthetic captures: in memory, as a video file, or into a folder with their truth.

A folder is drawn frame by frame in bounded memory. If drawing is interrupted, it continues where it stopped.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.capture.person.faces import LANDMARKS, LandmarkDetector
from mien.capture.store import write_capture
from mien.disk.files import read_json, write_json
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.face.loading import face_model_edition
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticFrame, SyntheticScene
from mien.lab.synthetic.truth import Truth, truth_of, write_truth
from mien.machine.progress import progress_bar, say, track_progress
from mien.media.video import write_video
from mien.tracking.tracking import Tracking

FORMAT, VERSION = "mien.synthetic_capture", 1
_JSON, _WORK, _STATE = "synthetic.json", ".drawing", "state.json"
VIDEO_NAME, CAPTURE_NAME, TRUTH_NAME = "video.mp4", "capture", "truth"
DRAWING = 3
"""Drawing version, raised whenever a recipe would be drawn differently. Every key depends on it."""


def synthesize(recipe: SyntheticRecipe, seed: int) -> tuple[Capture, Tracking]:
    """Draw a capture and return it with its exact tracking (ground truth), with a progress bar.

    The same recipe and seed give the same bytes on the same machine. Landmarks are the face model's own, projected.
    Mattes are exact.

    Example:
        >>> capture, truth = synthesize(RECIPES["plain"], seed=3)
    """
    scene = SyntheticScene(recipe, seed)
    cameras = len(scene.cameras)
    shape = (recipe.timesteps, cameras, recipe.height, recipe.width)
    images, mattes = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint8)
    drawn = track_progress(scene.all_frames(range(recipe.timesteps)), f"Drawing {recipe.name}", recipe.timesteps)
    for timestep, frames in enumerate(drawn):
        for camera, frame in enumerate(frames):
            images[timestep, camera], mattes[timestep, camera] = frame.image, frame.matte
    landmarks = np.stack([scene.landmarks(camera) for camera in range(cameras)], axis=1)
    calibration = scene.cameras if cameras > 1 else None
    return _make_capture(scene, images, mattes, landmarks, scene.source, calibration), scene.tracking()


def write_synthetic_video(recipe: SyntheticRecipe, path: Path, seed: int) -> None:
    """Draw a clip into a video file with a few frames in memory at a time, with a progress bar."""
    scene = SyntheticScene(recipe, seed)

    def images() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for frame in track_progress(scene.frames(), f"Drawing {recipe.name}", recipe.timesteps):
            yield frame.image

    write_video(path, images(), recipe.fps, recipe.detail.compression)


def write_synthetic_capture(recipe: SyntheticRecipe, seed: int, folder: Path) -> str:
    """Draw a recipe and a seed with `write_scene`."""
    return write_scene(SyntheticScene(recipe, seed), folder)


def write_scene(scene: SyntheticScene, folder: Path) -> str:
    """Draw a capture into a folder and return its key, which is the same on every machine (`scene_key`).

    With one camera, FOLDER/video.mp4 is what a user would have filmed. With several, FOLDER/capture is a Capture with
    calibration, exact mattes, and landmarks that a detector finds in the drawn pictures (NaN where it finds none).
    FOLDER/truth is for `read_truth`. A complete folder is left as it is; an interrupted one is continued.
    """
    inputs = inputs_hash(scene)
    if not _is_current(folder / _JSON, inputs):
        try:
            content_hash = _draw_all(scene, folder, inputs)
        except OSError as error:
            raise UserError(f"{folder}: cannot be written ({error.strerror or error}); choose another place") from None
        say(f"{scene.recipe.name}: drawn (key {scene_key(scene)}, content hash {content_hash})")
    return scene_key(scene)


def scene_key(scene: SyntheticScene) -> str:
    """Return the key that is quoted with figures on a capture: 16 hex digits of recipe, seeds, face model, `DRAWING`.

    It is known before anything is drawn, and is the same on every machine, since it depends on no computed numbers.
    `tests/reference_signatures.py` checks whether two machines draw the same under one key.
    """
    marks = scene.model.landmarks["mediapipe"]  # as read from disk; they place paint and strands
    content = {
        "drawing": DRAWING,
        "recipe": scene.recipe.record,
        "seed": scene.seed,
        "motion_seed": scene.motion_seed,
        "face_model": [scene.model.name, face_model_edition(scene.model)],
        "landmarks": [
            marks.faces.tolist(),
            [[round(1e4 * weight) for weight in row] for row in marks.barycentric.tolist()],
        ],
        **scene.extent,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def inputs_hash(scene: SyntheticScene) -> str:
    """Return a hash of all that decides the bytes on this machine, which shows whether a folder is up to date."""
    content = {"drawing": DRAWING, "name": scene.recipe.name, "source": scene.source}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _is_current(record: Path, inputs: str) -> bool:
    try:
        return read_json(record, FORMAT, VERSION).get("inputs") == inputs
    except UserError:
        return False


def _draw_all(scene: SyntheticScene, folder: Path, inputs: str) -> str:
    (folder / _JSON).unlink(missing_ok=True)
    recipe, total = scene.recipe, scene.timesteps
    store = Pictures(folder / _WORK, scene)
    done = store.resume(inputs)
    with progress_bar(f"Drawing {recipe.name}", total, done) as advance:
        for timestep, frames in enumerate(scene.all_frames(range(done, total)), done):
            store.write(timestep, frames)
            advance()
    images, mattes = store.maps()
    truth = truth_of(scene)
    content_hash = _hash_content(scene, images, mattes, truth)
    if recipe.cameras == "front":
        write_video(folder / VIDEO_NAME, (frame[0] for frame in images), recipe.fps, recipe.detail.compression)
    else:
        landmarks = np.stack(list(_detect_landmarks(scene, images)), axis=1)
        source = {**scene.source, "key": scene_key(scene), "drawn_hash": content_hash}
        write_capture(folder / CAPTURE_NAME, _make_capture(scene, images, mattes, landmarks, source, scene.cameras))
    write_truth(folder / TRUTH_NAME, truth)
    content = {
        "key": scene_key(scene),
        "content_hash": content_hash,
        "inputs": inputs,
        "seed": scene.seed,
        "motion_seed": scene.motion_seed,
        "recipe": recipe.record,
        **scene.extent,
    }
    write_json(folder / _JSON, FORMAT, VERSION, content)
    del images, mattes
    remove_tree(folder / _WORK)
    return content_hash


def _hash_content(scene: SyntheticScene, images: np.ndarray, mattes: np.ndarray, truth: Truth) -> str:
    """A hash of all pictures, mattes and the truth. Another processor may draw a pixel one grey level differently."""
    digest = hashlib.sha256(repr((scene.timesteps, scene.recipe.camera_ids)).encode())
    for timestep in range(scene.timesteps):
        digest.update(images[timestep].tobytes())
        digest.update(mattes[timestep].tobytes())
    for array in truth.stored.values():
        digest.update(array.tobytes())
    return digest.hexdigest()[:16]


class Pictures:
    """Raw frames and mattes of an unfinished drawing: two files that grow by whole timesteps."""

    def __init__(self, folder: Path, scene: SyntheticScene) -> None:
        self._folder, recipe = folder, scene.recipe
        self._shape = (scene.timesteps, len(recipe.camera_ids), recipe.height, recipe.width)

    def resume(self, inputs: str) -> int:
        """Continue a drawing of the same inputs, or else start again. Returns the number of complete timesteps."""
        if not _is_current(self._folder / _STATE, inputs):
            remove_tree(self._folder)
            self._folder.mkdir(parents=True)
            for name in ("frames.u8", "mattes.u8"):
                (self._folder / name).touch()
            write_json(self._folder / _STATE, FORMAT, VERSION, {"inputs": inputs})
        size = math.prod(self._shape[1:])
        sizes = {"frames.u8": 3 * size, "mattes.u8": size}
        return min((self._folder / name).stat().st_size // size for name, size in sizes.items())

    def write(self, timestep: int, frames: Sequence[SyntheticFrame]) -> None:
        """Write one timestep at its position, by plain writes, since a full disk would make a memory map crash."""
        for name, parts in (("frames.u8", [f.image for f in frames]), ("mattes.u8", [f.matte for f in frames])):
            data = b"".join(part.tobytes() for part in parts)
            with (self._folder / name).open("r+b") as file:
                file.seek(timestep * len(data))
                file.write(data)

    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all frames [t, c, h, w, 3] and mattes [t, c, h, w] as memory maps."""
        images = np.memmap(self._folder / "frames.u8", np.uint8, "r", shape=(*self._shape, 3))
        return images, np.memmap(self._folder / "mattes.u8", np.uint8, "r", shape=self._shape)


def _make_capture(
    scene: SyntheticScene, images: np.ndarray, mattes: np.ndarray, landmarks: np.ndarray, source: dict,
    calibration: tuple[Camera, ...] | None,
) -> Capture:  # fmt: skip
    recipe = scene.recipe
    return Capture(
        name=recipe.name, camera_ids=recipe.camera_ids, fps=recipe.fps,
        timestamps=np.array(scene.moments or range(scene.timesteps)) / recipe.fps, images=images, mattes=mattes,
        landmarks=landmarks, valid=np.isfinite(landmarks[..., 0, 0]),
        principal_point=np.tile(np.array([recipe.width / 2, recipe.height / 2], np.float32), (len(scene.cameras), 1)),
        source=source, calibration=calibration,
    )  # fmt: skip


def _detect_landmarks(scene: SyntheticScene, images: np.ndarray) -> Iterator[Float[np.ndarray, "t l 2"]]:
    with progress_bar(f"Detecting landmarks of {scene.recipe.name}", len(scene.cameras)) as advance:
        for camera in range(len(scene.cameras)):
            found = np.full((len(images), LANDMARKS, 2), np.nan, np.float32)
            with LandmarkDetector(several_faces=False) as detector:
                for timestep, frames in enumerate(images):
                    for points in detector.detect(np.ascontiguousarray(frames[camera]))[:1]:
                        found[timestep] = points
            yield found
            advance()
