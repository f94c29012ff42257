"""Names of cameras for `mien drive --by`, and devices that are missing or no camera."""

from pathlib import Path

import pytest

from mien.capture.camera_names import CameraName, camera_named, is_camera
from mien.capture.live_camera import LiveCamera
from mien.errors import UserError


def test_names_of_cameras(tmp_path: Path) -> None:
    assert is_camera("camera")
    assert is_camera("camera:/dev/video7")
    assert not is_camera("camera.mp4")
    assert not is_camera("out/camera")
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"x")
    assert camera_named(f"camera:{clip}", None).is_file
    assert camera_named("camera:rtsp://host/live", None).is_stream
    assert camera_named("camera:0", "avfoundation") == CameraName("0", "avfoundation")
    with pytest.raises(UserError, match="names no camera"):
        camera_named("camera:", None)
    with pytest.raises(UserError, match="is a folder"):
        camera_named(f"camera:{tmp_path}", None)


def test_a_missing_device_is_named_with_those_that_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="there is no /dev/video99.*camera:clip.mp4|there is no /dev/video99.*these"):
        camera_named("camera:/dev/video99", "v4l2")
    monkeypatch.setattr("mien.capture.camera_names._DEVICES", tmp_path)
    for name in ("video10", "video2", "null"):
        (tmp_path / name).touch()
    with pytest.raises(UserError, match=f"one of these: {tmp_path}/video2, {tmp_path}/video10$"):
        camera_named("camera:/dev/video99", "v4l2")


def test_a_device_that_is_no_camera_is_refused() -> None:
    with (
        pytest.raises(UserError, match="camera:/dev/null: cannot be opened"),
        LiveCamera(camera_named("camera:/dev/null", "v4l2"), False),
    ):
        pass
