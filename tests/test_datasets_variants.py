"""Variants of the layouts: what GaussianBlendshapes, RGBAvatar, SplattingAvatar and metrical-tracker leave, and VHAP's.

None was tried with real files. The folders follow the loaders of those programs.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dataset_cases import NoDetector, tiny_scene
from dataset_checks import (
    check_intrinsics,
    check_pictures,
    check_projection,
    check_silhouette,
    check_view,
    filmed_camera,
)
from dataset_scene import SIDE, Scene, draw, head_view, make_scene
from dataset_variants import (
    TEETH,
    draw_larger,
    enlarged,
    lip_rings,
    with_teeth,
    write_gaussian_blendshapes,
    write_larger,
    write_masked,
    write_offset,
    write_splatting_avatar,
    write_tracker_output,
    write_union,
)
from dataset_writers import (
    IMAVATAR_PLACE,
    OFF_CENTRE,
    UNEQUAL,
    seen_by_tracker,
    tracker_frame,
    write_flash_avatar,
    write_frame,
    write_insta,
)
from flame_like import write_npz
from mien.datasets import FilmedSequence, Findings, TrackedSequence, matting, overlay, recognised, sequences
from mien.errors import UserError
from mien.face import teeth
from mien.face.flame import flame_face_model, read_flame
from mien.training import OwnSplit

MIRROR = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def scene(anny, tmp_path_factory) -> Scene:
    return make_scene(anny, tmp_path_factory.mktemp("flame"))


@pytest.fixture(autouse=True)
def _undetected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the detector, which finds no face in drawings this small."""

    def found(images: np.ndarray) -> np.ndarray:
        return np.full((*images.shape[:2], 478, 2), 5, np.float32)

    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    monkeypatch.setattr(sequences, "detected_landmarks", found)


@pytest.fixture
def matted(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Replace the network of mattes by the drawn ones. Return the list of the pictures that it was asked about."""
    asked: list[np.ndarray] = []

    def fill(images: np.ndarray, mattes: np.ndarray, plate: np.ndarray | None = None) -> None:
        assert not mattes.any()
        asked.append(np.array(images))
        for timestep in range(len(images)):
            mattes[timestep, 0] = seen_by_tracker(scene, timestep, OFF_CENTRE)[1]

    monkeypatch.setattr(matting, "fill_mattes", fill)
    return asked


def read(path: Path, scene: Scene, name: str = "insta") -> list[TrackedSequence]:
    dataset, _ = recognised(path)
    assert dataset.name == name
    found = list(dataset.read(path, scene.model))  # type: ignore[arg-type]
    assert all(isinstance(each, TrackedSequence) for each in found)
    return found  # type: ignore[return-value]


def read_pictures(path: Path) -> FilmedSequence:
    """Return what `mien import --retrack` tracks again."""
    dataset, _ = recognised(path)
    assert dataset.read_pictures is not None
    (found,) = dataset.read_pictures(path)
    assert isinstance(found, FilmedSequence)
    return found


def surveyed(path: Path) -> Findings:
    dataset, _ = recognised(path)
    assert dataset.survey is not None
    return dataset.survey(path)


def check_tracked(sequence: TrackedSequence, scene: Scene) -> None:
    """Check a sequence of metrical-tracker, whose pictures are those that were tracked."""
    for timestep in range(len(scene)):
        vertices = scene.vertices(timestep, root=False, neck=False)
        check_projection(sequence, timestep, vertices, (OFF_CENTRE, *head_view(timestep)))
        check_pictures(sequence, timestep, seen_by_tracker(scene, timestep, OFF_CENTRE))
    check_silhouette(sequence)


def check_retracked(path: Path, scene: Scene) -> None:
    """Check what is tracked again: the tracker's camera, pictures and mattes."""
    sequence = read_pictures(path)
    camera = filmed_camera(sequence)
    check_intrinsics(camera, OFF_CENTRE)
    check_view(camera, MIRROR, np.zeros(3))
    for timestep in range(len(scene)):
        check_pictures(sequence, timestep, seen_by_tracker(scene, timestep, OFF_CENTRE))


def test_gaussian_blendshapes_and_rgb_avatar(scene: Scene, tmp_path: Path) -> None:
    folder = write_gaussian_blendshapes(tmp_path / "bala", scene)
    (sequence,) = read(folder, scene)
    check_tracked(sequence, scene)
    check_retracked(folder, scene)
    assert not any("mattes" in each for each in surveyed(folder).missing)


def test_flash_avatar_is_tracked_again_with_the_tracker_s_camera(scene: Scene, tmp_path: Path) -> None:
    check_retracked(write_flash_avatar(tmp_path / "root", scene), scene)


def test_the_output_of_metrical_tracker_gets_mattes(
    scene: Scene, tmp_path: Path, matted: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_tracker_output(tmp_path / "duda", scene)
    (sequence,) = read(folder, scene)
    check_tracked(sequence, scene)
    check_retracked(folder, scene)
    assert "mattes: they are made by mien" in surveyed(folder).missing
    assert len(matted) == 2
    assert all(np.array_equal(images, sequence.capture.images) for images in matted)
    # A tracking that lies beside the person is refused, as anywhere.
    monkeypatch.setattr(matting, "fill_mattes", lambda images, mattes, plate=None: mattes[..., :9].fill(255))
    with pytest.raises(UserError, match="of the tracked head lies on the person in duda"):
        read(folder, scene)


def test_pictures_with_opacities_are_preferred_to_those_without(scene: Scene, tmp_path: Path) -> None:
    folder = write_tracker_output(tmp_path / "duda", scene)
    write_gaussian_blendshapes(tmp_path / "other", scene)
    (tmp_path / "other/images").rename(folder / "matted")
    (sequence,) = read(folder, scene)
    check_tracked(sequence, scene)


def test_some_pictures_without_opacity_are_a_damaged_copy(scene: Scene, tmp_path: Path) -> None:
    folder = write_gaussian_blendshapes(tmp_path / "bala", scene)
    file = folder / "images/00004.png"
    pixels = cv2.imread(str(file))
    assert pixels is not None
    assert cv2.imwrite(str(file), pixels)
    with pytest.raises(UserError, match=r"00004.png: has no opacity and no matte; copy"):
        read(folder, scene)


@pytest.mark.parametrize("channels", [1, 3])
def test_the_copies_of_nerf_blendshape_have_masks_beside(scene: Scene, tmp_path: Path, channels: int) -> None:
    folder = write_masked(tmp_path / "id1", scene, channels)
    (sequence,) = read(folder, scene)
    check_tracked(sequence, scene)
    check_retracked(folder, scene)
    assert not any("mattes" in each for each in surveyed(folder).missing)
    (folder / "image_mask/mask_00002.png").unlink()
    with pytest.raises(UserError, match=r"00002.png: has no opacity and no matte; copy"):
        read(folder, scene)


@pytest.mark.parametrize("factor", [2, 3])
def test_larger_pictures_have_a_larger_camera(scene: Scene, tmp_path: Path, factor: int) -> None:
    folder = write_larger(tmp_path / "bala", scene, factor)
    (sequence,) = read(folder, scene)
    assert sequence.capture.images.shape[2:4] == (factor * SIDE, factor * SIDE)
    for timestep in range(len(scene)):
        vertices = scene.vertices(timestep, root=False, neck=False)
        check_projection(sequence, timestep, vertices, (enlarged(OFF_CENTRE, factor), *head_view(timestep)))
        check_pictures(sequence, timestep, draw_larger(scene, timestep, factor))
    check_silhouette(sequence)
    check_intrinsics(filmed_camera(read_pictures(folder)), enlarged(OFF_CENTRE, factor))


def test_the_larger_pictures_beside_images_are_told(scene: Scene, tmp_path: Path) -> None:
    folder = write_insta(tmp_path / "bala", scene)
    write_larger(tmp_path / "other", scene)
    (tmp_path / "other/images.HQ").rename(folder / "images.HQ")
    assert "the larger pictures of images.HQ, which are not used beside images" in surveyed(folder).missing
    check_tracked(read(folder, scene)[0], scene)
    # In place of those that were tracked, they are used, with the camera of transforms.json as well.
    for file in sorted((folder / "images.HQ").iterdir()):
        file.replace(folder / "images" / file.name)
    for sequence in (read(folder, scene)[0], read_pictures(folder)):
        check_intrinsics(filmed_camera(sequence), enlarged(OFF_CENTRE, 2))


def test_pictures_of_another_size_are_refused(scene: Scene, tmp_path: Path) -> None:
    folder = write_larger(tmp_path / "bala", scene)
    for file in sorted((folder / "images.HQ").iterdir()):
        pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        assert cv2.imwrite(str(file), pixels[:-1])
    with pytest.raises(UserError, match=r"have 256x255 pixels, which is no whole multiple of the 128x128 that were"):
        read(folder, scene)
    with pytest.raises(UserError, match=r"have 256x255 pixels, which is no whole multiple of the 128x128 that were"):
        read_pictures(folder)


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        (([SIDE, SIDE], [SIDE, 2 * SIDE]), "'img_size' is not the same in all checkpoints"),
        (([0, SIDE],), "'img_size' is not the height and width of a picture"),
        (([SIDE],), "'img_size' is not the height and width of a picture"),
        (([float("nan"), SIDE],), "'img_size' is not the height and width of a picture"),
    ],
)
def test_impossible_sizes_in_checkpoints_are_refused(
    scene: Scene, tmp_path: Path, sizes: tuple[list[float], ...], words: str
) -> None:
    folder = write_gaussian_blendshapes(tmp_path / "bala", scene)
    for number, size in enumerate(sizes):
        frame = {**tracker_frame(scene, number, OFF_CENTRE), "img_size": np.array(size)}
        write_frame(folder / f"checkpoint/{number:05d}.frame", frame)
    with pytest.raises(UserError, match=words):
        read(folder, scene)


def test_splatting_avatar(scene: Scene, tmp_path: Path) -> None:
    (sequence,) = read(write_splatting_avatar(tmp_path, scene), scene, "imavatar")
    view = (UNEQUAL, MIRROR, MIRROR @ IMAVATAR_PLACE / 4)
    for timestep in range(len(scene)):
        vertices = scene.vertices(timestep) - scene.translation[timestep]
        check_projection(sequence, timestep, vertices, view)
        check_pictures(sequence, timestep, draw(scene, vertices, *view))
    check_silhouette(sequence)


def check_vhap(sequence: TrackedSequence, shown: Scene, timestep: int) -> None:
    """Check a timestep of an export of VHAP in both cameras."""
    for camera in range(2):
        view = (UNEQUAL, *head_view(2 + camera, 1.0))
        check_projection(sequence, timestep, shown.vertices(timestep), view, camera)
        drawn = draw(shown, shown.vertices(timestep), *view, (SIDE, 136))
        check_pictures(sequence, timestep, drawn, camera)


def test_a_union_of_vhap_is_its_sequences_with_their_split(scene: Scene, tmp_path: Path) -> None:
    first, second = read(write_union(tmp_path, scene), scene, "vhap")
    assert [each.capture.name for each in (first, second)] == ["306_EMO-1", "306_EXP-2"]
    assert first.own_split == OwnSplit((), ("222200037",))
    assert second.own_split == OwnSplit(((0, len(scene)),))
    for sequence in (first, second):
        for timestep in range(len(scene)):
            check_vhap(sequence, scene, timestep)
        check_silhouette(sequence)


def test_a_union_reads_nothing_beside_its_exports(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    union = write_union(tmp_path / "all", scene)
    content = (union / "transforms_test.json").read_text()
    (union / "transforms_test.json").write_text(content.replace("../306_EXP-2/images", "../../306_EXP-2/images"))
    (tmp_path / "all/306_EXP-2").rename(tmp_path / "306_EXP-2")
    (tmp_path / "all/306_EXP-2").symlink_to(tmp_path / "306_EXP-2")
    with pytest.raises(UserError, match="leads out of the dataset"):
        read(union, scene, "vhap")


def test_static_offsets_of_vhap_move_the_vertices(scene: Scene, tmp_path: Path) -> None:
    folder, shown = write_offset(tmp_path / "306_EMO-1", scene)
    (sequence,) = read(folder, scene, "vhap")
    assert np.abs(shown.vertices(0) - scene.vertices(0)).max() > 1e-3
    for timestep in range(len(scene)):
        check_vhap(sequence, shown, timestep)
    check_silhouette(sequence)


def test_vhap_with_teeth(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The model gets the teeth from mien, and the person in the pictures from the description of GaussianAvatars."""
    rings, count = lip_rings(scene), len(scene.arrays["v_template"])
    for name, value in (("VERTICES", count), ("FACES", len(scene.arrays["f"]))):
        monkeypatch.setattr(teeth, name, value)
    for name, ring in zip(("_UPPER", "_LOWER"), rings, strict=True):
        monkeypatch.setattr(teeth, name, tuple(ring.tolist()))
    file = read_flame(write_npz(tmp_path / "flame.npz", scene.arrays))
    model = replace(flame_face_model(teeth.with_teeth(file, "flame"), "flame"), landmarks=scene.model.landmarks)
    grown = replace(with_teeth(scene, teeth.tooth_triangles()), model=model)
    folder, shown = write_offset(tmp_path / "306_EMO-1", grown)
    (sequence,) = read(folder, grown, "vhap")
    assert len(sequence.face_model.template) == count + TEETH
    for timestep in range(len(scene)):
        check_vhap(sequence, shown, timestep)
    check_silhouette(sequence)
    with pytest.raises(UserError, match="static_offset"):
        read(folder, scene, "vhap")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "last"), [("gaussian-blendshapes", 350), ("flash-avatar", 500), ("masked", 500)])
def test_the_last_frames_are_held_out(tmp_path: Path, kind: str, last: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A subject of 502 frames has the split of its authors; one as long as the split has none."""
    import dataset_scene
    import dataset_writers

    for module in (dataset_scene, dataset_writers):
        monkeypatch.setattr(module, "SIDE", 16)
    K = np.array([[20.0, 0, 8.3], [0, 20.0, 7.8], [0, 0, 1]])
    monkeypatch.setattr(dataset_writers, "OFF_CENTRE", K)
    scene = tiny_scene(tmp_path)
    short = 3
    write = {"flash-avatar": write_flash_avatar, "masked": write_masked}.get(kind, write_gaussian_blendshapes)
    folder = write(tmp_path / "bala", scene)
    _repeat(folder, len(scene), last + short)
    findings = surveyed(folder)
    assert findings.clips[0].frames == last + short
    assert f"the last {last} frames are held out" in str(findings.split)
    (sequence,) = read(folder, scene)
    assert sequence.own_split == OwnSplit(((short, last + short),))
    for file in _files(folder, last, last + short):
        file.unlink()
    assert surveyed(folder).split is None
    assert any(f"{last} frames are too few for" in each for each in surveyed(folder).missing)


def _files(folder: Path, first: int, end: int) -> list[Path]:
    """All numbered files of the frames from `first` on, before `end`."""
    found = []
    for file in sorted(each for each in folder.rglob("*.*") if each.stem[-5:].isdigit()):
        number = int(file.stem[-5:]) - (file.parent.name in ("imgs", "alpha"))
        if first <= number < end:
            found.append(file)
    return found


def _repeat(folder: Path, count: int, wanted: int) -> None:
    """Make a subject longer by links to its first frame, after the last one."""
    last = count + 1  # there is a gap in the numbers of most layouts
    for file in _files(folder, 0, 1):
        begin, first = file.stem[:-5], int(file.stem[-5:])
        for number in range(last, last + wanted - count):
            file.with_name(f"{begin}{number + first:05d}{file.suffix}").hardlink_to(file)
