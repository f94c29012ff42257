"""`mien import` on the command line: what is told before, the workspace, its split, and mistakes.
An exported GaussianAvatars folder is imported, posed at any frame, rendered, and exported again."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import color_charts
from dataset_scene import NoDetector, Scene, drawn_person, unfound
from dataset_writers import FRONTAL, write_imavatar, write_insta, write_nersemble, write_picture
from known import known
from mien.avatar import load_avatar
from mien.camera import Camera
from mien.capture import read_capture
from mien.capture.capture import Capture
from mien.cli import main
from mien.datasets import overlay, sequences
from mien.disk.files import write_json
from mien.face.loading import add_face_model
from mien.lab.synthetic import RECIPES
from mien.lab.synthetic.recipe import Segment
from mien.lab.synthetic.scene import SyntheticScene
from mien.media.source import read_image
from mien.media.video import write_video
from mien.pipeline import import_dataset as importing
from mien.runtime import load as load_portable
from mien.training import TrainSettings, read_sequence
from mien.training.footage.frames import training_frames
from mien.training.run import read_curves, read_face_track
from mien.training.settings.splits import OwnSplit, Recorded, Recordings, fill_in, read_own_split, write_own_split
from refusals import complaint
from shared_things import MadeOnce, toy_workspace, write_toy_workspace

CLIPS = ("MVI_1810", "MVI_1812")


scene = pytest.fixture(scope="module")(drawn_person)


@pytest.fixture(scope="module")
def subject(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_imavatar(tmp_path_factory.mktemp("given") / "subject1", scene, CLIPS)


@pytest.fixture
def added(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the head in FLAME's schema to the user's face models, under the name `flame`."""
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(replace(scene.model, name="flame"), Path("flame.npz"), "0")


def test_a_dry_run_only_tells(subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", str(subject), "--out", str(tmp_path / "me"), "--dry-run"]) == 0
    told = capsys.readouterr().err
    for words in ("one person, 2 sequences", "MVI_1810: 3 frames, 1 camera", "split: the clip MVI_1812 is held out",
                  "face model: FLAME 2020; give yours with --face-model"):  # fmt: skip
        assert words in told
    assert not (tmp_path / "me").exists()


@pytest.mark.usefixtures("added")
def test_sequences_and_their_split(subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "me"
    again = ["import", str(subject), "--out", str(out), "--face-model", "flame"]
    assert main(again) == 0
    first = out / "sequences/MVI_1810/tracking/overlay.png"
    told = capsys.readouterr().err.splitlines()[-1]
    assert f"the imported mesh over some pictures: {first}, and 1 more; look at it before you train" in told
    read = [read_sequence(out / "sequences" / name) for name in CLIPS]
    splits = {sequence.name: Recorded(timesteps=3, own=read_own_split(sequence.folder)) for sequence in read}
    settings = fill_in(TrainSettings(split="dataset"), Recordings(splits))
    assert settings.held_out_sequences == (CLIPS[1],)
    assert {frame.sequence for frame in training_frames(read, settings)} == {0}
    assert "decides what is held out" in complaint(capsys, "train", out, "--split", "dataset", "--hold-out", CLIPS[0])
    assert "is there already" in complaint(capsys, *again, alone=False)
    assert main([*again, "--resume"]) == 0
    assert "all sequences are there already" in capsys.readouterr().err


@pytest.mark.usefixtures("added")
def test_pictures_are_tracked_again_if_asked(subject: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tracked: list[tuple[str, ...]] = []

    def track(workspace, face_model: str, settings: object) -> None:
        tracked.append((face_model, *workspace.sequence_names()))

    monkeypatch.setattr(importing, "run_tracking_stage", track)
    monkeypatch.setattr(sequences, "detected_landmarks", unfound)
    assert main(["import", str(subject), "--out", str(tmp_path / "me"), "--retrack"]) == 0
    assert tracked == [("anny", *CLIPS)]
    assert not (tmp_path / "me/sequences/MVI_1810/tracking").exists()
    assert read_own_split(tmp_path / "me/sequences/MVI_1812") == OwnSplit(((0, 3),))


@pytest.mark.usefixtures("added")
def test_mistakes_leave_nothing(scene: Scene, subject: Path, tmp_path: Path, capsys) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert "needs FLAME 2020" in complaint(capsys, "import", str(subject), *out, alone=False)
    assert "give only one" in complaint(capsys, "import", str(subject), *out, "--retrack", "--face-model", "flame")
    assert "holds 1 people (subject1); import each" in complaint(capsys, "import", str(subject.parent), *out)
    other = write_insta(tmp_path / "other", scene)
    frame = other / "checkpoint/00001.frame"
    frame.unlink()
    frame.symlink_to("/etc/hostname")
    assert "leads out of the dataset" in complaint(capsys, "import", other, *out, "--face-model", "flame", alone=False)
    wrong = ["import", str(other), *out, "--dataset", "vhap"]
    assert f"{other}: looks like insta, and cannot be read as vhap; leave --dataset out (" in complaint(capsys, *wrong)
    assert not list((tmp_path / "out").glob("sequences/*"))


@pytest.mark.unchecked
@pytest.mark.usefixtures("short_films")
def test_the_protocol_of_a_dataset_scores_its_mattes_and_its_frames(made_once: MadeOnce, tmp_path: Path, capsys):
    root = Path(shutil.copytree(toy_workspace(made_once), tmp_path / "W"))
    clip, file = root / "sequences/clip", root / "runs/toy/config.json"
    line = ["evaluate", str(root), "--protocol", "insta", "--no-perceptual"]
    assert "was not imported; leave --protocol insta out" in complaint(capsys, *line)
    write_own_split(clip, OwnSplit(((1, 3),)), {"imported": {"dataset": "insta", "from": "there"}})
    assert "was trained with --split" in complaint(capsys, *line)
    config = json.loads(file.read_text())
    config["settings"]["split"] = "dataset"
    content = {name: value for name, value in config.items() if name not in ("format", "version", "checksum")}
    write_json(file, config["format"], config["version"], content)
    assert "was imported from insta" in complaint(capsys, *line[:3], "imavatar", line[4])
    assert main(line) == 0
    (entry,) = json.loads((root / "runs/toy/metrics.json").read_text())["protocols"].values()
    assert entry["per_frame"]["timestep"] == [1, 2]
    assert (entry["split"], entry["dataset_protocol"], entry["edges"]) == ("dataset", "insta", "filmed")
    assert entry["mask"] == "the dataset's mattes, whole, over white"
    assert entry["scored_on"]["clip"]["mask"] == "matte"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the toy workspace W, its exported folder F, and the workspace I that F was imported into."""
    place = tmp_path_factory.mktemp("made")
    write_toy_workspace(place / "W")
    export = ["export", str(place / "W"), "--out", str(place / "F"), "--format", "gaussian-avatars"]
    assert main(export) == 0
    assert main(["import", str(place / "F"), "--out", str(place / "I")]) == 0
    return place


def test_frames_are_those_of_training(made: Path, tmp_path: Path) -> None:
    means = []
    for run in (made / "W/runs/toy", made / "I/runs/gaussian_avatars"):
        avatar = load_avatar(run)
        face = read_face_track(run, avatar.face_model)
        assert len(face) == 5
        means.append(avatar.pose(face).gaussians.means.detach())
    assert float((means[0] - means[1]).abs().max()) < 1e-6
    # Any frame is rendered.
    for timestep in ("0", "2"):
        out = str(tmp_path / f"{timestep}.png")
        assert (
            main(["render", str(made / "I"), "--out", out, "--timestep", timestep, "--size", "64", "--zoom", "1"]) == 0
        )
    first, third = (read_image(tmp_path / f"{timestep}.png").astype(int) for timestep in (0, 2))
    assert first.std() > 5
    assert np.abs(first - third).max() > 20
    film = [str(made / "I"), "--out", str(tmp_path / "film"), "--motion", "own", "--path", "still", "--size", "64"]
    assert main(["render", *film, "--zoom", "1"]) == 0
    frames = sorted((tmp_path / "film").iterdir())
    assert len(frames) == 5
    assert np.array_equal(read_image(frames[2]), third)
    # It is exported again.
    assert main(["export", str(made / "I"), "--out", str(tmp_path / "a.mien")]) == 0
    assert len(load_portable(tmp_path / "a.mien").portable.baked.attributes.quats) > 100
    assert main(["export", str(made / "I"), "--out", str(tmp_path / "F"), "--format", "gaussian-avatars"]) == 0
    for name in ("point_cloud.ply", "face_model.safetensors"):
        assert (tmp_path / "F" / name).read_bytes() == (made / "F" / name).read_bytes()


def test_mistakes_are_told(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(made / "F", tmp_path / "D")
    path = tmp_path / "D" / "point_cloud.ply"
    path.write_bytes(path.read_bytes()[:-4] + np.int32(-7).tobytes())
    imported, out = str(made / "I"), str(tmp_path / "N")
    into, as_folder = ("--out", out), ("--format", "gaussian-avatars")
    for line, message in (
        (("import", str(tmp_path / "gone"), *into), "no such file or folder; give one of gaussian-avatars ("),
        (("import", str(made / "W"), *into), "is no dataset that mien knows; give one of"),
        (("import", str(made / "W"), *into, "--dataset", "gaussian-avatars"), "has no point_cloud.ply"),
        (("import", str(made / "F"), *into, "--dataset", "nobody"), "there is no such dataset; choose one of"),
        (("import", str(made / "F"), "--out", imported), "is there already; give the imported run"),
        (("import", str(made / "F"), *into, "--run", "a/b"), "cannot be the name"),
        (("import", str(made / "F"), *into, "--face-model", "gone"), "no face model 'gone'"),
        (("import", str(tmp_path / "D"), *into), "binding_0 of Gaussian"),
        (("render", imported, "--out", f"{out}.png", "--timestep", "5"), "has the timesteps 0 to 4"),
        (("export", imported, "--out", f"{out}.ply", *as_folder), "writes a folder"),
        (("export", imported, *into, *as_folder, "--every", "2"), "--every is an option of html"),
        (("export", imported, "--out", f"{out}.mien", "--format", "ply"), "does not end in .ply"),
        (("export", imported, "--out", f"{out}.ply", "--format", "usd"), "in .usd, .usda, .usdc or .usdz"),
        (("evaluate", imported), ""),  # An imported run is not scored or continued.
        (("train", imported), ""),
    ):
        assert message in complaint(capsys, *line)
    assert not list(tmp_path.glob("N*/runs"))
    assert [path.name for path in tmp_path.iterdir() if path.suffix] == []


PERSON = replace(
    RECIPES["plain"], width=550, height=802, fps=25.0, turns=(25.0, 10.0), rotation=(14.0, 8.0, 4.0),
    script=(Segment("speech", 0.32),), texture_size=512,
)  # fmt: skip
SERIALS = (FRONTAL, "222200036", "222200046")
"""The cameras in the order of the drawn ring, whose first one is in front."""
STRIDE = 3
COLORS = {serial: color_charts.correction(seed) for seed, serial in enumerate(SERIALS)}
"""The correction of each camera's colours."""
FULL = 4
"""NeRSemble's pictures have so many times the side of those that are drawn here."""
LANDMARKS = ("--tracking.schedule", "landmarks", "--overlay", "none")
SMALL = ("--preset", "draft", "--training.resolution", "128")
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""


@pytest.fixture(scope="module")
def rig() -> SyntheticScene:
    turning = (Segment("turns", 0.6),)
    return SyntheticScene(replace(PERSON, cameras="ring", ring_size=3, fps=5.0, script=turning), 3)


def film(path: Path, pictures: list[np.ndarray], repeats: int = 1, fps: float = 73.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, (picture for picture in pictures for _ in range(repeats)), fps, crf=4)


def write_person(folder: Path, rig: SyntheticScene) -> list[np.ndarray]:
    """Write a person of NeRSemble's raw recordings, with one timestep in three pictures. Return the frontal mattes.
    The colours that the cameras film are others than those that were drawn, until they are corrected."""
    drawn = [list(rig.timestep_frames(timestep)) for timestep in range(rig.timesteps)]
    empty = (255 * known(rig.background)).astype(np.uint8)

    def video(path: Path, serial: str) -> None:
        own = (frames[SERIALS.index(serial)].image for frames in drawn)
        film(path, [color_charts.filmed(picture, COLORS[serial]) for picture in own], STRIDE)

    write_nersemble(folder, SERIALS, video, COLORS)
    for serial, matrix in COLORS.items():
        write_picture(folder / f"sequences/BACKGROUND/image_{serial}.jpg", color_charts.filmed(empty, matrix))
    full, cameras = np.diag([FULL, FULL, 1.0]), dict(zip(SERIALS, rig.cameras, strict=True))
    poses = {serial: camera.viewmat.double().tolist() for serial, camera in cameras.items()}
    intrinsics = {serial: (full @ camera.K.double().numpy()).tolist() for serial, camera in cameras.items()}
    content = {"world_2_cam": poses, "intrinsics": intrinsics}
    (folder / "calibration/camera_params.json").write_text(json.dumps(content))
    return [frames[SERIALS.index(FRONTAL)].matte for frames in drawn]


@pytest.mark.unchecked
def test_raw_recordings_of_nersemble_become_an_avatar(rig: SyntheticScene, tmp_path: Path) -> None:
    person, root = tmp_path / "017", tmp_path / "me"
    mattes = write_person(person, rig)
    assert main(["import", str(person), "--out", str(root)]) == 0
    assert main(["track", str(root), *LANDMARKS]) == 0
    folder = root / "sequences/EMO-1-shout+laugh"
    capture, tracking = read_capture(folder / "capture"), read_sequence(folder).tracking
    assert (capture.timesteps, capture.camera_ids) == (rig.timesteps, tuple(sorted(SERIALS)))
    check_cameras(rig, capture, tracking.cameras, mattes)
    check_colors(rig, capture)
    # The head is where it was drawn, in the dataset's world.
    off = tracking.face.head_translation - rig.tracking().face.head_translation
    assert float(off.norm(dim=1).median()) < 0.02
    assert (
        main(["train", str(root), "--run", "a", "--steps", "40", *SMALL, *PLAIN, "--training.record-every", "2"]) == 0
    )
    psnr = read_curves(root / "runs/a")["psnr"]
    assert psnr[-3:].mean() > psnr[:3].mean() + 1


def cropped(capture: Capture, serial: str, drawn: np.ndarray) -> np.ndarray:
    """Return the part of a drawn picture that a camera's captured pictures show."""
    crop = capture.source["cameras"][serial]["crop"]
    step = crop["width"] / capture.width
    to_drawn = np.array([[step, 0, crop["left"] + step / 2 - 0.5], [0, step, crop["top"] + step / 2 - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(drawn, to_drawn, (capture.width, capture.height), flags=flags)


def check_colors(rig: SyntheticScene, capture: Capture) -> None:
    """Captured pictures have the drawn colours. tests/test_capture_lens.py has the terms in any order."""
    frames = list(rig.timestep_frames(0))
    for index, serial in enumerate(capture.camera_ids):
        drawn = cropped(capture, serial, frames[SERIALS.index(serial)].image)
        off = np.abs(capture.images[0, index].astype(float) - drawn).mean((0, 1))
        assert off.max() < 1, (serial, off)  # the video is lossy


def check_cameras(rig: SyntheticScene, capture, cameras: tuple[Camera, ...], mattes: list[np.ndarray]) -> None:
    """Check that cameras are the drawn ones, up to the crop, and that mattes are the person's."""
    places = {serial: index for index, serial in enumerate(capture.camera_ids)}
    for serial, drawn in zip(SERIALS, rig.cameras, strict=True):
        assert float((cameras[places[serial]].viewmat - drawn.viewmat).abs().max()) < 1e-5
    crop = capture.source["cameras"][FRONTAL]["crop"]
    step = crop["width"] / capture.width
    K, front = cameras[places[FRONTAL]].K.double().numpy(), rig.cameras[0].K.double().numpy()
    moved = np.array([[1, 0, crop["left"]], [0, 1, crop["top"]], [0, 0, 1]]) @ np.diag([step, step, 1.0]) @ K
    assert np.abs(moved - front).max() < 0.01
    for matte, found in zip(mattes, capture.mattes[:, places[FRONTAL]], strict=True):
        expected = cropped(capture, FRONTAL, matte)
        both, either = ((found > 127) & (expected > 127)).sum(), ((found > 127) | (expected > 127)).sum()
        assert both > 0.85 * either  # the network's mattes fade at the shirt
