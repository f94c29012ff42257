"""Datasets that are tracked on FLAME: what independent writers wrote is imported, and lies on its pictures.

A tracking on another version of its face model is refused, by the colours of the skin."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import dataset_checks as checks
import dataset_layouts as layouts
import dataset_writers as writers
from dataset_checks import read
from dataset_layouts import draw_at
from dataset_scene import SIDE, NoDetector, Scene, draw, drawn_person, unfound
from dataset_writers import write_benchmark, write_flash_avatar, write_imavatar, write_insta, write_vhap
from flame_like import write_npz
from mien.datasets import insta, overlay, pictures, sequences
from mien.datasets.dataset import TrackedSequence
from mien.datasets.overlay import Steadiness, check_overlay, measure_steadiness
from mien.datasets.pictures import read_picture
from mien.datasets.registry import find_dataset
from mien.datasets.writing import write_sequence
from mien.errors import UserError
from mien.face import FaceModel, FaceParams
from mien.face.models import teeth
from mien.face.models.flame import flame_face_model, read_flame
from mien.tracking.landmarks.regions import with_regions_by_landmarks
from mien.training.footage.clothes import clothes_mask
from mien.training.settings.splits import OwnSplit
from refusals import refuses

CHECKED = ("insta", "imavatar", "vhap, one camera")
"""One layout of each importer, whose calls are checked."""
EACH = [*CHECKED, *(pytest.param(name, marks=pytest.mark.unchecked) for name in layouts.TRACKED if name not in CHECKED)]


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Return the drawn person. The detector is left out, since it finds no face in drawings this small."""
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    monkeypatch.setattr(sequences, "detected_landmarks", unfound)
    return drawn_person()


def refused(folder: Path, scene: Scene, words: str, name: str = "insta") -> None:
    refuses(words, checks.read, folder, name, scene.model)


def check_retracked(folder: Path, name: str, scene: Scene) -> None:
    sequence, layout = checks.read_pictures(folder), layouts.TRACKED[name]
    checks.check_view(checks.filmed_camera(sequence), writers.MIRROR, np.zeros(3))
    for timestep in range(len(scene)):
        view = layout.view(timestep, 0)
        checks.check_intrinsics(checks.filmed_camera(sequence), view[0])
        checks.check_pictures(sequence, timestep, draw(scene, layout.vertices(scene, timestep), *view, layout.size))


@pytest.mark.parametrize("name", EACH)
def test_what_was_written_comes_back(name: str, scene: Scene, tmp_path: Path) -> None:
    layout = layouts.TRACKED[name]
    folder = layout.write(tmp_path / "me", scene)
    checks.check_import(checks.read(folder, layout.reads, scene.model), layout, scene)
    found = checks.surveyed(folder)
    assert sum(clip.frames or 0 for clip in found.clips) == sum(map(len, layout.clips.values()))
    assert not any("mattes" in each for each in found.missing)
    if layout.retracked:
        check_retracked(folder, name, scene)


@pytest.mark.unchecked
def test_imavatar_keeps_the_masks_of_clothes(scene: Scene, tmp_path: Path) -> None:
    folder = writers.write_imavatar(tmp_path / "me", scene)
    assert checks.surveyed(folder).split == "the clip MVI_1812 is held out"
    _, test = checks.read(folder, "imavatar", scene.model)
    for timestep in range(3):
        expected = np.isin(writers.imavatar_classes(test.capture.mattes[timestep, 0]), (15, 16))
        assert expected.any()
        found = clothes_mask(np.asarray(test.foreign["clothes"]), timestep, expected.shape[1])
        assert np.array_equal(found, expected)
    shutil.rmtree(folder / "me/MVI_1810/semantic")
    assert checks.surveyed(folder).missing == ("semantic of MVI_1810: figures without clothes need it",)
    assert not checks.read(folder, "imavatar", scene.model)[0].foreign


def test_what_lacks_flame_or_fits_no_pictures_is_refused_with_a_remedy(scene: Scene, anny: FaceModel, tmp_path) -> None:
    folder = writers.write_insta(tmp_path / "me", scene)
    assert checks.surveyed(folder).face_model == "FLAME 2020"
    for model in (None, anny):
        refuses(r"its tracking needs FLAME 2020 \(generic_model.pkl\)", checks.read, folder, "insta", model)
    folder = writers.write_insta(tmp_path / "me", scene)
    for number in range(7):
        frame = writers.tracker_frame(scene, min(number, 5), writers.OFF_CENTRE)
        frame["opencv"]["t"] += np.array([0.15, 0, 0], np.float32)
        writers.write_frame(folder / f"checkpoint/{number:05d}.frame", frame)
    refused(folder, scene, "of the tracked head lies on the person in me")


@pytest.mark.parametrize("name", ["insta", "vhap"])
def test_the_imported_mesh_is_drawn_over_some_pictures(name: str, scene: Scene, tmp_path: Path) -> None:
    """The drawn mesh covers the person, and nothing else."""
    folder = layouts.TRACKED[name].write(tmp_path / "me", scene)
    (sequence,) = checks.read(folder, name, scene.model)
    write_sequence(tmp_path / "out", sequence, find_dataset(name), folder)
    pixels = read_picture(tmp_path / "out/tracking/overlay.png")[0].astype(int)
    assert pixels.shape == (480, 240 * 6, 3)
    above, below = pixels[20:240], pixels[260:]  # without the line that names the frame
    person, drawn = (above < 250).any(-1), np.abs(above - below).max(-1) > 3
    assert (person & drawn).sum() > 0.95 * (person | drawn).sum()
    assert 0.2 < person.mean() < 0.9
    seen = [pixels[:240, at : at + 240] for at in range(0, 240 * 6, 240)]
    assert all(np.abs(one - other).max() > 50 for one, other in zip(seen, seen[1:], strict=False))


# Mattes, sizes and splits of what metrical-tracker leaves -------------------------------------------------------------


@pytest.mark.unchecked
def test_the_output_of_metrical_tracker_gets_mattes(scene: Scene, tmp_path: Path, monkeypatch, capsys) -> None:
    matted: list[np.ndarray] = []

    def fill(images: np.ndarray, mattes: np.ndarray, plate: np.ndarray | None = None) -> None:
        assert not mattes.any()
        matted.append(np.array(images))
        for timestep in range(len(images)):
            mattes[timestep, 0] = writers.seen_by_tracker(scene, timestep, writers.OFF_CENTRE)[1]

    monkeypatch.setattr(pictures, "fill_mattes", fill)
    folder = layouts.write_tracker_output(tmp_path / "me", scene)
    found = checks.read(folder, "insta", scene.model)
    checks.check_import(found, layouts.TRACKED["insta"], scene)
    assert "lids are closed in 100% of the frames" in capsys.readouterr().err, "one of the two is enough"
    check_retracked(folder, "insta", scene)
    assert "mattes: they are made by mien" in checks.surveyed(folder).missing
    assert len(matted) == 2
    assert all(np.array_equal(images, found[0].capture.images) for images in matted)
    # Pictures with opacities are preferred to those without.
    layouts.write_gaussian_blendshapes(tmp_path / "other", scene)
    (tmp_path / "other/images").rename(folder / "matted")
    checks.check_import(checks.read(folder, "insta", scene.model), layouts.TRACKED["insta"], scene)
    assert len(matted) == 2


@pytest.mark.unchecked
def test_a_picture_without_opacity_or_mask_is_a_damaged_copy(scene: Scene, tmp_path: Path) -> None:
    folder = layouts.write_gaussian_blendshapes(tmp_path / "me", scene)
    file = folder / "images/00004.png"
    writers.write_picture(file, read_picture(file)[0])
    refused(folder, scene, r"00004.png: has no opacity and no matte; copy")
    folder = layouts.write_masked(tmp_path / "masked", scene)
    (folder / "image_mask/mask_00002.png").unlink()
    refused(folder, scene, r"00002.png: has no opacity and no matte; copy")
    # Impossible sizes are refused.
    folder = layouts.write_larger(tmp_path / "me", scene)
    for file in sorted((folder / "images.HQ").iterdir()):
        writers.write_picture(file, read_picture(file)[0][:-1], np.full((255, 256), 255, np.uint8))
    words = "have 256x255 pixels, which is no whole multiple of the 128x128 that were"
    refused(folder, scene, words)
    refuses(words, checks.read_pictures, folder)
    impossible = "'img_size' is not the height and width of a picture"
    for sizes, words in (
        (([SIDE, SIDE], [SIDE, 2 * SIDE]), "'img_size' is not the same in all checkpoints"),
        (([0, SIDE],), impossible), (([SIDE],), impossible), (([float("nan"), SIDE],), impossible),
    ):  # fmt: skip
        for number, size in enumerate(sizes):
            frame = {**writers.tracker_frame(scene, number, writers.OFF_CENTRE), "img_size": np.array(size)}
            writers.write_frame(folder / f"checkpoint/{number:05d}.frame", frame)
        refused(folder, scene, words)


@pytest.mark.unchecked
def test_larger_pictures_beside_images_are_told_and_in_their_place_used(scene: Scene, tmp_path: Path) -> None:
    folder = writers.write_insta(tmp_path / "me", scene)
    layouts.write_larger(tmp_path / "other", scene)
    (tmp_path / "other/images.HQ").rename(folder / "images.HQ")
    assert "the larger pictures of images.HQ, which are not used beside images" in checks.surveyed(folder).missing
    checks.check_import(checks.read(folder, "insta", scene.model), layouts.TRACKED["insta"], scene)
    for file in sorted((folder / "images.HQ").iterdir()):
        file.replace(folder / "images" / file.name)
    for sequence in (*checks.read(folder, "insta", scene.model), checks.read_pictures(folder)):
        checks.check_intrinsics(checks.filmed_camera(sequence), layouts.enlarged(writers.OFF_CENTRE, 2))


@pytest.mark.unchecked
def test_the_last_frames_are_held_out(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A subject that is longer than the split of its authors has it; one as long as the split has none."""
    assert insta.TEST_FRAMES == {"INSTA": 350, "FlashAvatar": 500, "NeRFBlendShape": 500}
    for kind, name in (("INSTA", "gaussian-blendshapes"), ("FlashAvatar", "flash-avatar"), ("NeRFBlendShape", "masks")):
        folder = layouts.TRACKED[name].write(tmp_path / kind, scene)
        monkeypatch.setitem(insta.TEST_FRAMES, kind, 4)
        assert "the last 4 frames are held out" in str(checks.surveyed(folder).split)
        assert checks.read(folder, "insta", scene.model)[0].own_split == OwnSplit(((2, 6),))
        monkeypatch.setitem(insta.TEST_FRAMES, kind, 6)
        assert checks.surveyed(folder).split is None
        assert any("6 frames are too few for" in each for each in checks.surveyed(folder).missing)


@pytest.mark.unchecked
def test_a_union_reads_nothing_beside_its_exports(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    union = layouts.write_union(tmp_path / "all/UNION", scene)
    content = (union / "transforms_test.json").read_text()
    (union / "transforms_test.json").write_text(content.replace("../306_EXP-2/images", "../../306_EXP-2/images"))
    (tmp_path / "all/306_EXP-2").rename(tmp_path / "306_EXP-2")
    (tmp_path / "all/306_EXP-2").symlink_to(tmp_path / "306_EXP-2")
    refused(union, scene, "leads out of the dataset", "vhap")


@pytest.mark.unchecked
def test_vhap_with_teeth(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model with teeth reads static offsets of as many vertices, and the model without them refuses these."""
    file = read_flame(write_npz(tmp_path / "flame.npz", scene.arrays))
    apart = np.linalg.norm(file.template[:, None] - scene.marks(file.template)[[13, 17]], axis=-1)
    changed = {"VERTICES": len(file.template), "FACES": len(file.faces)}
    changed |= dict(zip(("UPPER_LIP", "LOWER_LIP"), apart.argsort(0)[:15].T.tolist(), strict=True))
    for name, value in changed.items():
        monkeypatch.setattr(teeth, name, value)
    grown = teeth.with_teeth(file, "flame")
    arrays = scene.arrays | {
        "v_template": grown.template, "f": grown.faces, "J_regressor": grown.regressor, "weights": grown.weights,
        "shapedirs": np.moveaxis(np.concatenate([grown.identity, grown.expression]), 0, 2),
        "posedirs": np.moveaxis(grown.correctives, 0, 2),
    }  # fmt: skip
    model = replace(flame_face_model(grown, "flame"), landmarks=scene.model.landmarks)
    by_marks = with_regions_by_landmarks(model)
    assert {"lips", "mouth"} <= set(by_marks.region_names)
    assert by_marks.region_mask("teeth").nonzero()[:, 0].tolist() == list(range(len(file.faces), len(grown.faces)))
    person = replace(scene, arrays=arrays, model=model, colors=torch.full(grown.template.shape, 0.7))
    folder = layouts.write_offset(tmp_path / "me", person)
    checks.check_import(checks.read(folder, "vhap", model), layouts.TRACKED["vhap, static offsets"], person)
    refused(folder, scene, "static_offset", "vhap")
    assert np.abs(layouts.with_static_offset(scene)[0].vertices(0) - scene.vertices(0)).max() > 1e-3


TIMESTEPS = 10
PAINTS = {
    "lips": (0.7, 0.25, 0.25), "brows": (0.2, 0.12, 0.08), "irises": (0.1, 0.1, 0.15), "scalp": (0.2, 0.15, 0.1),
    "eyes": (0.95, 0.95, 0.95),
}  # fmt: skip


@pytest.fixture
def larger_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw pictures of twice the size, and leave out the detector, which takes seconds."""
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    draw_at(2, monkeypatch)


@pytest.fixture(scope="module")
def painted_scene() -> Scene:
    """Return a head with lips, brows and eyes that moves, with an identity as large as a person's."""
    made = drawn_person(TIMESTEPS)
    painted = with_regions_by_landmarks(made.model)
    colors = torch.tensor([0.85, 0.65, 0.55]).repeat(len(made.model.template), 1)
    for region, color in PAINTS.items():
        colors[painted.faces[painted.region_mask(region)].unique()] = torch.tensor(color)
    return replace(made, colors=colors)


def mixed(painted_scene: Scene, folder: Path, of: str) -> FaceModel:
    """Return another version: the mean head is the same, and its identities or expressions are in another order."""
    random, count = np.random.default_rng(0), int(painted_scene.arrays["identities"])
    identities, expressions = np.split(painted_scene.arrays["shapedirs"], [count], axis=2)
    if of != "expressions":
        identities = identities[..., random.permutation(count)]
    if of != "identity":
        expressions = expressions[..., random.permutation(expressions.shape[2])]
    basis = np.concatenate([identities, expressions], axis=2)
    path = write_npz(folder / f"{of}.npz", {**painted_scene.arrays, "shapedirs": basis})
    return replace(flame_face_model(read_flame(path), f"other_{of}"), landmarks=painted_scene.model.landmarks)


def of_insta(painted_scene: Scene, tmp_path: Path) -> TrackedSequence:
    (sequence,) = read(write_insta(tmp_path / "me", painted_scene), "insta", painted_scene.model)
    return sequence


@pytest.fixture(scope="module")
def others(painted_scene: Scene, tmp_path_factory) -> dict[str, FaceModel]:
    folder = tmp_path_factory.mktemp("other")
    return {of: mixed(painted_scene, folder, of) for of in ("identity", "expressions")}


@pytest.mark.unchecked
@pytest.mark.usefixtures("larger_pictures")
def test_other_versions_are_found_in_every_layout(painted_scene: Scene, others, tmp_path: Path) -> None:
    layouts: dict[str, tuple[str, Callable[[Path, Scene], Path]]] = {
        "flash-avatar": ("insta", write_flash_avatar),
        "imavatar": ("imavatar", lambda folder, painted_scene: write_imavatar(folder, painted_scene, ("MVI_1810",))),
        "vhap": ("vhap", write_vhap),
        "benchmark": ("nersemble-benchmark", write_benchmark),
    }
    for name, (dataset, write) in layouts.items():
        folder = write(tmp_path / name, painted_scene)
        assert read(folder, dataset, painted_scene.model)
        for of, told in (("identity", "identity"), ("expressions", "expressions")):
            with pytest.raises(UserError, match=f"{told} on 'other_{of}' than without, so this is another version"):
                read(folder, dataset, others[of])


@pytest.mark.unchecked
@pytest.mark.usefixtures("larger_pictures")
def test_what_cannot_be_compared_is_left_out(painted_scene: Scene, tmp_path: Path) -> None:
    """Few frames, a small face, a face without expressions, and a head without motion say nothing of a version."""
    sequence = of_insta(painted_scene, tmp_path)
    face, capture = sequence.tracking.face, sequence.capture

    def measured(face: FaceParams, images: np.ndarray = capture.images) -> Steadiness:
        tracking = replace(sequence.tracking, face=face)
        few = replace(
            capture, images=images, timestamps=capture.timestamps[: len(face)], mattes=capture.mattes[: len(face)],
            landmarks=capture.landmarks[: len(face)], valid=capture.valid[: len(face)],
        )  # fmt: skip
        return measure_steadiness(replace(sequence, capture=few, tracking=tracking))

    assert measured(face[:7], capture.images[:7]) == Steadiness(None, None)
    assert measured(replace(face, head_translation=3 * face.head_translation)) == Steadiness(None, None)
    assert measured(replace(face, expression=0.1 * face.expression)).expression is None
    fixed = {name: getattr(face, name)[:1].expand(len(face), 3) for name in ("head_rotation", "head_translation")}
    assert measured(replace(face, **fixed)).identity is None
    # Each frame is moved to where it fits best: without that, the shares below are 0.73 and 0.81.
    off = torch.tensor(np.random.default_rng(2).uniform(-0.0025, 0.0025, (TIMESTEPS, 3)) * (1, 1, 0)).float()
    face = replace(sequence.tracking.face, head_translation=sequence.tracking.face.head_translation + off)
    found = measure_steadiness(replace(sequence, tracking=replace(sequence.tracking, face=face)))
    assert 0 < (found.identity or 0) < 0.66
    assert 0 < (found.expression or 0) < 0.75
    # Pictures of another size are told.
    capture, (view,) = sequence.capture, sequence.tracking.cameras
    images, mattes = (
        np.stack([cv2.resize(each, (400, 384)) for each in all_of[:, 0]])[:, None]
        for all_of in (capture.images, capture.mattes)
    )
    views = (replace(view, width=400, height=384),)
    resized = replace(capture, images=images, mattes=mattes, calibration=views)
    larger = replace(sequence, capture=resized, tracking=replace(sequence.tracking, cameras=views))
    with pytest.raises(UserError, match="these have 400x384 pixels, and the tracking was made on about 265x248, so"):
        check_overlay(tmp_path, larger, "FLAME")
    check_overlay(tmp_path, sequence, "FLAME")
