"""Make the pictures of docs/troubleshooting.md: `python docs/pictures/make.py --out out/pictures`.

Every symptom is real. A synthetic person is drawn at 256 pixels; avatars are trained, and faces tracked, with what
causes the symptom and with what mends it. This takes about half an hour on one core. What is finished is kept in the
folder of `--out`, and the pictures are written beside this file.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure

from mien.avatar import load_avatar
from mien.capture import Capture, CaptureSettings, capture_video, write_capture
from mien.face import FaceParams, load_face_model
from mien.render import rasterize
from mien.synthetic import RECIPES, Segment, SyntheticRecipe, SyntheticScene, write_synthetic_video
from mien.tracking import (
    SmoothnessSettings,
    Tracking,
    TrackingSettings,
    make_scoring,
    track,
    write_scoring,
    write_tracking,
)
from mien.training import PRESETS, read_sequence, train

SIZE, PERSON = 256, 3
HERE = Path(__file__).parent
QUALITY = 82
"""Quality of the WebP files, of 100."""
STEPS = 3_000

_BASE = replace(RECIPES["demo"], width=SIZE, height=SIZE, fps=10.0, glasses=False)
WHOLE = replace(_BASE, name="whole", script=(Segment("expressions", 5), Segment("turns", 6.6)))
CLIPS: dict[str, SyntheticRecipe] = {
    "whole": WHOLE,
    "closed": replace(WHOLE, name="closed", expression=0.0),
    "frontal": replace(WHOLE, name="frontal", turns=(6.0, 4.0), rotation=(6.0, 4.0, 3.0)),
}
"""What the avatars are trained on: the whole range, the mouth always closed, the head always to the front."""
MOTION, UNSEEN_MOTION = 7, 2
"""Seeds of the motion in the clips, and in the frames that the avatars are compared with."""


@dataclass(frozen=True)
class View:
    """A frame that no avatar was trained on."""

    truth: np.ndarray
    """The drawn picture over white."""
    face: FaceParams
    camera: object


def write_clip(name: str, out: Path) -> Path:
    """Draw a clip with its true tracking, and return its folder."""
    folder = out / name
    if not (folder / "scoring").exists():
        scene = SyntheticScene(CLIPS[name], PERSON, MOTION)
        frames = list(scene.frames())
        count = len(frames)
        capture = Capture(
            name=name,
            camera_ids=("front",),
            fps=scene.recipe.fps,
            timestamps=np.arange(count) / scene.recipe.fps,
            images=np.stack([frame.image for frame in frames])[:, None],
            mattes=np.stack([frame.matte for frame in frames])[:, None],
            landmarks=scene.landmarks()[:, None],
            valid=np.ones((count, 1), bool),
            principal_point=np.full((1, 2), SIZE / 2, np.float32),
            source=scene.source,
        )
        write_capture(folder / "capture", capture)
        write_tracking(folder / "tracking", scene.tracking())
        write_scoring(folder / "scoring", make_scoring(capture, scene.tracking(), scene.model))
    return folder


def train_on(name: str, out: Path, background: str = "white") -> Path:
    """Train on a clip with true tracking, and return the folder of the run."""
    sequence = read_sequence(write_clip(name, out))
    preset = PRESETS["draft"]
    settings = replace(preset.settings, steps=STEPS, split="none", background=background)
    run = out / f"run-{name}-{background}"
    train([sequence], load_face_model(sequence.tracking.face_model), preset.config("gaussian_avatars"), settings, run)
    return run


def unseen(pick) -> View:
    """The frame of a clip with other motion for which `pick` (of face and model) is largest."""
    scene = SyntheticScene(WHOLE, PERSON, UNSEEN_MOTION)
    timestep = int(torch.as_tensor(pick(scene.face, scene.model)).argmax())
    [[frame]] = scene.all_frames([timestep], (0,))
    alpha = frame.matte[..., None] / 255
    picture = (frame.image * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
    return View(picture, scene.face[timestep], scene.camera)


def draw(run: Path, view: View, background: float = 1.0) -> np.ndarray:
    """The avatar of a run in a frame's pose, as its camera sees it."""
    avatar = load_avatar(run)
    with torch.no_grad():
        gaussians = avatar.pose(view.face).gaussians.timestep(0)
        image = rasterize(gaussians, view.camera, background=torch.full((3,), background)).image
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def write_row(name: str, panels: dict[str, np.ndarray], height: int = SIZE) -> None:
    """Write pictures side by side, each with a line of text below."""
    widths = [height * panel.shape[1] / panel.shape[0] for panel in panels.values()]
    line, gap = 26, 6
    figure = Figure((sum(widths) / 100 + gap * (len(widths) - 1) / 100, (height + line) / 100), dpi=100)
    total, left = sum(widths) + gap * (len(widths) - 1), 0.0
    for (label, panel), width in zip(panels.items(), widths, strict=True):
        axes = figure.add_axes((left / total, line / (height + line), width / total, height / (height + line)))
        axes.imshow(panel, interpolation="lanczos", aspect="auto")
        axes.set_axis_off()
        figure.text((left + width / 2) / total, 7 / (height + line), label, ha="center", va="bottom", fontsize=8.5)
        left += width + gap
    write_figure(name, figure)


def write_figure(name: str, figure: Figure) -> None:
    """Write a figure as WebP beside this file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 2::-1])
    path = HERE / f"{name}.webp"
    cv2.imwrite(str(path), pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    print(f"{path.name}: {path.stat().st_size / 1024:.0f} KB")


def mouth(out: Path) -> None:
    """A mouth that was never open in training, and one that was."""
    view = unseen(lambda face, model: face.expression[:, model.expression_names.index("jawOpen")])
    part = (slice(100, 220), slice(68, 188))
    panels = {
        "a frame that was not trained on": view.truth,
        "trained with a closed mouth": draw(train_on("closed", out), view),
        "trained with open mouths, too": draw(train_on("whole", out), view),
    }
    write_row("mouth", {label: panel[part] for label, panel in panels.items()})


def shards(out: Path) -> None:
    """A side that was never filmed, and one that was."""
    view = unseen(lambda face, model: -(face.head_rotation[:, 1].abs() - np.radians(40)).abs())
    write_row(
        "shards",
        {
            "40 degrees aside, not trained on": view.truth,
            "trained on frontal frames": draw(train_on("frontal", out), view),
            "trained on turns to both sides": draw(train_on("whole", out), view),
        },
    )


def needles(out: Path) -> None:
    """White needles over a dark background."""
    view = unseen(lambda face, model: -(face.head_rotation[:, 1].abs() - np.radians(40)).abs())
    write_row(
        "needles",
        {
            "trained over white, drawn over black": draw(train_on("whole", out), view, 0.0),
            "trained over random colours": draw(train_on("whole", out, "random"), view, 0.0),
        },
    )


def tracked(recipe: SyntheticRecipe, settings: TrackingSettings, out: Path) -> Tracking:
    """Draw a video, capture it with the landmark detector, and track it."""
    video = out / f"{recipe.name}.mp4"
    if not video.exists():
        write_synthetic_video(recipe, video, PERSON)
    capture = capture_video(video, out / f"{recipe.name}-capture", CaptureSettings(size=SIZE, crop="none"))
    return track(capture, load_face_model(recipe.face_model), settings)


def nose_of(tracking: Tracking) -> np.ndarray:
    """Rows [t, 2] of the tip of the nose, in pixels."""
    model = load_face_model(tracking.face_model)
    points = model.landmark_positions(model(tracking.face), "mediapipe")[:, 1]
    return tracking.cameras[0].project(points)[0].numpy()


def jitter(out: Path) -> None:
    """The tip of the nose while the head is still, in a clip with much noise."""
    recipe = replace(_BASE, name="noisy", fps=25.0, noise=0.12, script=(Segment("still", 2.4),))
    for label, settings in (
        ("rough", TrackingSettings(schedule="landmarks", smoothness=SmoothnessSettings(10, 10, 100, 10000))),
        ("landmarks", TrackingSettings(schedule="landmarks")),
        ("fast", TrackingSettings()),
        ("smooth", TrackingSettings(smoothness=SmoothnessSettings(0.05, 0.1, 1.0, 50.0))),
    ):
        nose = nose_of(tracked(recipe, settings, out))
        print(label, nose.std(axis=0), np.abs(np.diff(nose, 2, axis=0)).mean(axis=0))


PICTURES = {function.__name__: function for function in (mouth, shards, needles, jitter)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of clips and runs")
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES))
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name in options.only:
        PICTURES[name](options.out)
