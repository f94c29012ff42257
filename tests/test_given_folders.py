"""Folders that users give: what systems leave in them is no picture, video or table; pictures drive an avatar."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mien.capture.calibration import CalibratedCamera, match_sources, read_calibration
from mien.capture.source import list_images
from mien.commands.stages import driving
from mien.commands.stages.batch_table import read_table
from mien.datasets.live_link_face_take import LIVE_LINK_FACE
from mien.errors import UserError
from mien.evaluation.image_source import open_pictures
from mien.inside import listed
from mien.workspace import Workspace
from recordings import live_link_face
from toy_scene import toy_camera

LEFT = ("._{}", ".{}", ".DS_Store", "Thumbs.db", "desktop.ini", "__MACOSX/{}", "__MACOSX/._{}")
"""What systems leave beside a file of some name."""


def given(folder: Path, *names: str) -> Path:
    """Return a folder with small files or pictures of these names, and what systems leave beside each."""
    picture = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    for name in names:
        for each in (name, *(left.format(name) for left in LEFT)):
            path = folder / each
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(picture if each == name else b"\0\x05\x16\x07")
    return folder


def cameras() -> list[CalibratedCamera]:
    return [CalibratedCamera(name, toy_camera(16)) for name in ("00", "01")]


@pytest.mark.parametrize(("names", "read"), [
    (("2.png", "10.png"), list_images),
    (("00.mp4", "01.mp4"), lambda folder: match_sources([folder], cameras(), folder / "cameras.json")),
    (("ann.mp4", "bob.mov"), lambda folder: [Path(row.steps[0][1]) for row in read_table(folder)]),
    (("a.png", "b.png"), lambda folder: list(open_pictures(folder).files.values())),
    (("a.obj", "b.obj"), lambda folder: listed(folder, "*.obj")),
])  # fmt: skip
def test_what_systems_leave_is_skipped(
    tmp_path: Path, names: tuple[str, ...], read: Callable[[Path], list[Path]]
) -> None:
    assert [path.name for path in read(given(tmp_path / "people", *names))] == list(names)


def test_a_take_with_what_systems_leave_is_recognised(tmp_path: Path) -> None:
    given(tmp_path, "take.mov", "take.csv")
    live_link_face(tmp_path, [{}] * 3)
    assert LIVE_LINK_FACE.recognises(tmp_path) == "a take of Live Link Face (a video, coefficients)"


def test_a_folder_whose_own_name_is_hidden_is_read(tmp_path: Path) -> None:
    assert [path.name for path in list_images(given(tmp_path / ".hidden" / "__MACOSX", "a.png"))] == ["a.png"]


@pytest.mark.parametrize(
    ("names", "count"), [(("a.png",), 3), (("a.png", "b.png"), 6), (("a.png", "b.png", "c.png"), 3)]
)
@pytest.mark.parametrize("whole", [True, False])
def test_pictures_drive_an_avatar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...], count: int, whole: bool
) -> None:
    """A picture, or a folder of few, is repeated, because tracking needs three frames."""
    captured: list[Path] = []
    monkeypatch.setattr(driving, "run_capture_stage", lambda _, source, *__: captured.extend(list_images(source)))
    monkeypatch.setattr(driving, "run_tracking_stage", lambda *_, **__: {"clip": None})
    monkeypatch.setattr(driving, "cache_folder", lambda: tmp_path / "cache")
    folder = given(tmp_path / "people", *names)
    film = folder if whole else folder / names[0]
    workspace, found = driving.tracked_film(film, "anny")
    assert isinstance(workspace, Workspace)
    assert found == ["clip"]
    assert len(captured) == (count if whole else 3)
    assert captured[0].read_bytes() == (folder / names[0]).read_bytes()


@pytest.mark.parametrize("name", ["transforms.json", "cameras.json"])
def test_a_calibration_of_nerfstudio_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    path.write_text(json.dumps({"fl_x": 500, "frames": frames}))
    with pytest.raises(UserError, match=rf"{name}: is nerfstudio's transforms.json, .*matrices are camera-to-world"):
        read_calibration(path)
    path.write_text(json.dumps({"frames": 3}))
    with pytest.raises(UserError, match="write it as described in docs/using.md"):
        read_calibration(path)
