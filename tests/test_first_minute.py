"""The walk through a stranger's first minute: it takes its pictures, and stumbles where a stranger would."""

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from mien.capture.video import write_video
from mien.export import write_page
from web_case import browse, chromium, drawn_head, node

_FILE = Path(__file__).parents[1] / "docs" / "pictures" / "first_minute.py"


@pytest.fixture(scope="module")
def minute() -> Iterator[ModuleType]:
    spec = importlib.util.spec_from_file_location("first_minute", _FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["first_minute"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["first_minute"]


def test_a_page_is_walked_through(minute: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(minute, "node", lambda address, given: browse(address, **given))
    monkeypatch.setitem(minute.SCREENS, "landscape", (844, 390, 1))
    write_page(tmp_path / "me.html", drawn_head(800, rank=2))
    made = minute.Walk(tmp_path)
    minute.look_at_page(made, tmp_path / "me.html", "landscape", "dark")
    minute.write_sheet(made)
    names = ["first", "after_3_s", "smile", "laugh", "surprise", "more", "more_mouth"]
    assert [path.name for path in made.pictures] == [
        f"{number:02d}_page_landscape_dark_{name}.png" for number, name in enumerate(names, 1)
    ]
    shown = [np.asarray(cv2.imread(str(path))) for path in made.pictures]
    assert {picture.shape for picture in shown} == {(390, 844, 3)}
    rest, laugh, more = (shown[names.index(name)].astype(int) for name in ("first", "laugh", "more"))
    assert rest[:, :40].mean() < 80, "it is dark"
    assert np.abs(laugh - rest).max() > 30
    assert np.abs(more - rest)[100:, 550:].mean() > 5, "there is a panel"
    assert made.seconds["page_landscape_dark: first picture"] > 0
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.std() > 20


def test_the_walk_stumbles_where_a_stranger_would(
    minute: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chromium()
    node()
    own = minute.node
    monkeypatch.setitem(minute.SCREENS, "desktop", (320, 240, 1))
    monkeypatch.setattr(minute, "node", lambda address, given: browse(address, **given))
    portable, page = drawn_head(300), tmp_path / "me.html"
    unseen = replace(portable.baked.attributes, opacity_logits=np.full(300, -20, np.float32))
    write_page(page, replace(portable, baked=replace(portable.baked, attributes=unseen)))
    with pytest.raises(minute.WalkError, match="there is no head in the picture first"):
        minute.look_at_page(minute.Walk(tmp_path), page, "desktop", "light")
    for text, message in (
        ('<img src="http://127.0.0.1:9/a.png">', r"asks for \['http://127.0.0.1:9/a.png'\]"),
        ("<script>console.warn('careful')</script>", r"says \['careful'\]"),
    ):
        monkeypatch.setattr(minute, "node", own)
        page.write_text(f"<!doctype html><title>A</title>{text}")
        with pytest.raises(minute.WalkError, match=message):
            minute.shoot(minute.Walk(tmp_path), page, "a", {"": "walk.wait(100)"}, "phone")


def test_the_camera_begins_still_and_straight(minute: ModuleType, tmp_path: Path) -> None:
    greys = (60, 120, 180, 240)
    write_video(tmp_path / "a.mp4", [np.full((64, 64, 3), grey, np.uint8) for grey in greys for _ in range(5)], 25.0)
    minute.write_camera(tmp_path / "a.mp4", 12, tmp_path / "a.y4m")
    header, *frames = (tmp_path / "a.y4m").read_bytes().split(b"FRAME\n")
    side = minute.CAMERA_SIDE
    assert header == f"YUV4MPEG2 W{side} H{side} F{minute.CAMERA_FPS}:1 Ip A1:1 C420jpeg\n".encode()
    assert {len(frame) for frame in frames} == {side * side * 3 // 2}
    seen = np.array([np.frombuffer(frame, np.uint8)[: side * side].mean() for frame in frames])
    still, moving = seen[: minute.STILL], seen[minute.STILL :]
    assert np.ptp(still) == 0
    # Every fifth frame from the straight one on, and around. The brightness of video has a range of its own.
    assert np.argsort(moving).tolist() == [2, 3, 0, 1]
    assert still[0] == moving[0]
