"""Make the pictures of docs/troubleshooting.md: `python docs/pictures/make.py --out out/pictures`.

Every symptom is real. A synthetic person is drawn at 256 pixels; avatars are trained, and faces tracked, with what
causes the symptom and with what mends it. This takes some five minutes of one core. What is finished is kept in
the folder of `--out`, and the pictures are written beside this file.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mien.avatar import load_avatar
from mien.camera import Camera
from mien.capture import capture_video, write_capture
from mien.capture.capture import Capture
from mien.capture.settings import CaptureSettings
from mien.capture.store import read_capture_hash
from mien.face import FaceModel, FaceParams, load_face_model
from mien.lab.synthetic import RECIPES
from mien.lab.synthetic.captures import write_synthetic_video
from mien.lab.synthetic.recipe import Segment, SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from mien.media.video import write_video
from mien.render import rasterize
from mien.tracking import read_tracking, track, write_tracking
from mien.tracking.scoring import make_scoring
from mien.tracking.scoring_files import write_scoring
from mien.tracking.settings import SmoothnessSettings, TrackingSettings
from mien.training import PRESETS, read_sequence, train

SIZE, PERSON = 256, 3
HERE = Path(__file__).parent
QUALITY = 82
"""Quality of the WebP files, of 100."""
STEPS = 3_000

_BASE = replace(RECIPES["demo"], width=SIZE, height=SIZE, fps=10.0, glasses=False)
WHOLE = replace(_BASE, name="whole", script=(Segment("expressions", 6), Segment("turns", 6.6)))
CLIPS: dict[str, SyntheticRecipe] = {
    "whole": WHOLE,
    "closed": replace(WHOLE, name="closed", expression=0.0),
    "frontal": replace(WHOLE, name="frontal", turns=(6.0, 4.0), rotation=(6.0, 4.0, 3.0)),
}
"""What the avatars are trained on: the whole range, the mouth always closed, the head always to the front."""
MOTION, UNSEEN_MOTION = 8, 32
"""Seeds of the motion in the clips, and in the frames that the avatars are compared with."""


@dataclass(frozen=True)
class View:
    """A frame that no avatar was trained on."""

    truth: np.ndarray
    """The drawn picture over white."""
    face: FaceParams
    camera: Camera


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
        scoring = make_scoring(capture, scene.tracking(), scene.model)
        write_scoring(folder / "scoring", scoring, read_capture_hash(folder / "capture"))
    return folder


def train_on(name: str, out: Path) -> Path:
    """Train on a clip with true tracking, and return the folder of the run."""
    sequence = read_sequence(write_clip(name, out))
    preset = PRESETS["draft"]
    settings = replace(preset.settings, steps=STEPS, split="none")
    run = out / f"run-{name}"
    train([sequence], load_face_model(sequence.tracking.face_model), preset.config("gaussian_avatars"), settings, run)
    return run


def unseen(score: Callable[[FaceParams, FaceModel], torch.Tensor]) -> View:
    """The frame of a clip with other motion that has the largest score."""
    scene = SyntheticScene(WHOLE, PERSON, UNSEEN_MOTION)
    timestep = int(score(scene.face, scene.model).argmax())
    [[frame]] = scene.all_frames([timestep], (0,))
    alpha = frame.matte[..., None] / 255
    picture = (frame.image * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
    return View(picture, scene.face[timestep], scene.camera)


def draw(run: Path, view: View) -> np.ndarray:
    """The avatar of a run in a frame's pose, as its camera sees it, over white."""
    avatar = load_avatar(run)
    with torch.no_grad():
        gaussians = avatar.pose(view.face).gaussians.timestep(0)
        image = rasterize(gaussians, view.camera, background=torch.ones(3)).image
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def write_row(name: str, panels: dict[str, np.ndarray], height: int = SIZE) -> None:
    """Write pictures side by side, each with a line of text below."""
    widths = [height * panel.shape[1] / panel.shape[0] for panel in panels.values()]
    line, gap = 26, 6
    figure = Figure((sum(widths) / 100 + gap * (len(widths) - 1) / 100, (height + line) / 100), dpi=100)
    total, left = sum(widths) + gap * (len(widths) - 1), 0.0
    for (label, panel), width in zip(panels.items(), widths, strict=True):
        axes = figure.add_axes((left / total, line / (height + line), width / total, height / (height + line)))
        axes.imshow(cv2.resize(panel, (round(width), height), interpolation=cv2.INTER_CUBIC), aspect="auto")
        axes.set_axis_off()
        figure.text((left + width / 2) / total, 7 / (height + line), label, ha="center", va="bottom", fontsize=8.5)
        left += width + gap
    write_figure(name, figure)


def write_figure(name: str, figure: Figure) -> None:
    """Write a figure as WebP beside this file."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 2::-1])
    path = HERE / f"{name}.webp"
    cv2.imwrite(str(path), pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    print(f"{path.name}: {path.stat().st_size / 1024:.0f} KB")


def mouth(out: Path) -> None:
    """A mouth that was never open in training, and one that was."""
    view = unseen(lambda face, model: face.expression[:, model.expression_names.index("jawOpen")])
    part = (slice(142, 230), slice(102, 190))
    panels = {
        "a frame that was not trained on": view.truth,
        "trained with a closed mouth": draw(train_on("closed", out), view),
        "trained with open mouths, too": draw(train_on("whole", out), view),
    }
    write_row("mouth", {label: panel[part] for label, panel in panels.items()})


def aside(face: FaceParams, model: FaceModel) -> torch.Tensor:
    """How near the head's turn is to 40 degrees."""
    return -(face.head_rotation[:, 1].abs() - np.radians(40)).abs()


def shards(out: Path) -> None:
    """A side that was never filmed, and one that was."""
    view = unseen(aside)
    part = (slice(28, 228), slice(24, 224))
    panels = {
        "a frame that was not trained on": view.truth,
        "trained on frontal frames": draw(train_on("frontal", out), view),
        "trained on turns to both sides": draw(train_on("whole", out), view),
    }
    write_row("shards", {label: panel[part] for label, panel in panels.items()})


def nose_of(name: str, settings: TrackingSettings, out: Path) -> np.ndarray:
    """Where the tip of the nose is in each frame of the noisy clip, in pixels from the left, as it is tracked."""
    recipe = replace(_BASE, name="noisy", fps=25.0, noise=0.12, script=(Segment("still", 2.4),))
    video, folder = out / "noisy.mp4", out / f"noisy-{name}"
    if not video.exists():
        write_synthetic_video(recipe, video, PERSON)
    if not folder.exists():
        capture = capture_video(video, out / "noisy", CaptureSettings(size=SIZE, crop="none"))
        write_tracking(folder, track(capture, load_face_model(recipe.face_model), settings))
    tracking = read_tracking(folder)
    model = load_face_model(tracking.face_model)
    points = model.landmark_positions(model(tracking.face), "mediapipe")[:, 1]
    return tracking.cameras[0].project(points)[0][:, 0].detach().numpy()


def jitter(out: Path) -> None:
    """The tip of the nose while the head does not move, in a video with much noise."""
    rough = SmoothnessSettings(translation=10.0, depth=10.0, rotation=100.0, expression=1e4)
    calm = SmoothnessSettings(translation=0.05, depth=0.1, rotation=1.0, expression=50.0)
    kinds = (
        (
            "rough",
            "landmarks alone, hardly any smoothness",
            "C3",
            TrackingSettings(schedule="landmarks", smoothness=rough),
        ),
        ("default", "the defaults", "C0", TrackingSettings()),
        ("calm", "smaller values", "C2", TrackingSettings(smoothness=calm)),
    )
    figure = Figure((7.8, 2.4), dpi=100)
    axes = figure.add_axes((0.07, 0.2, 0.91, 0.68))
    for name, label, color, settings in kinds:
        nose = nose_of(name, settings, out)
        axes.plot(np.arange(len(nose)) / 25, nose - nose.mean(), color, label=label, linewidth=1.4)
    figure.legend(*axes.get_legend_handles_labels(), loc="upper center", ncols=3, frameon=False, fontsize=9)
    axes.set_xlabel("seconds, in which the head does not move", fontsize=9)
    axes.set_ylabel("nose, pixels", fontsize=9)
    axes.tick_params(labelsize=8)
    write_figure("jitter", figure)


def wrong_person(out: Path) -> None:
    """A recorded video call: the capture follows the larger face. After cropping, the other one is captured."""
    call, wanted = out / "call.mp4", out / "wanted.mp4"
    if not wanted.exists():
        recipe = replace(_BASE, script=(Segment("speech", 2),))
        large = SyntheticScene(replace(recipe, distance=0.85, hair="long", glasses=True), 11)
        small = SyntheticScene(replace(recipe, distance=1.3), PERSON)
        left, right = ([frame.image for frame in scene.frames()] for scene in (large, small))
        write_video(call, [np.concatenate(pair, axis=1) for pair in zip(left, right, strict=True)], recipe.fps)
        write_video(wanted, right, recipe.fps)
    settings = CaptureSettings(size=SIZE)
    wrong, correct = (capture_video(video, out / video.stem, settings) for video in (call, wanted))
    with_both = capture_video(call, out / "call-uncut", replace(settings, size=2 * SIZE, crop="none"))
    write_row(
        "wrong_person",
        {
            "the video": with_both.images[8, 0],
            "captured: the larger face": wrong.images[8, 0],
            "captured after cropping": correct.images[8, 0],
        },
        height=190,
    )


PICTURES = {function.__name__: function for function in (mouth, shards, jitter, wrong_person)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of clips and runs")
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES))
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name in options.only:
        PICTURES[name](options.out)
