"""Recordings move a page's avatar as they move it in Python, and its signs of life are calm."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mien import runtime
from mien.driving import drive, face_of_motion, read_blendshape_json, read_live_link_face, rest_of
from mien.driving.sides import PAIRS
from mien.export import write_page
from mien.face import FaceParams, load_face_model
from recordings import COLUMNS, LAYOUTS, row, write_csv, write_json
from web_case import browse, drawn_head, run_node

EQUAL = 1e-4
COUNT = 150_000


def read_by_node(built: Path, folder: Path, recording: Path) -> dict[str, Any]:
    avatar = folder / "head.mien"
    if not avatar.exists():
        runtime.write_portable(avatar, drawn_head(10))
    return run_node("motion.mjs", built / "mien.js", built / "motion.js", avatar, recording)


def driven_by_python(recording: Path) -> tuple[float, FaceParams]:
    portable, model = drawn_head(10), load_face_model("anny")
    read = read_live_link_face if recording.suffix == ".csv" else read_blendshape_json
    motion = read(recording)
    face, rest = face_of_motion(motion, model)
    near = portable.neutral
    neutral = FaceParams(
        model.neutral().identity,
        *(torch.from_numpy(array)[None] for array in (near.expression, near.joints)),
        *(torch.from_numpy(array)[None] for array in (near.head_rotation, near.head_translation)),
    )
    return motion.fps, drive(face, rest_of(rest, model).face, neutral, model.expression_bounds)


def plain_recording(folder: Path) -> Path:
    """Return a json with a frame that has no face."""
    frames: list[dict[str, Any]] = [
        {"timestamp_ms": 40 * at, "blendshapes": {"jawOpen": at / 9, "mouthSmileLeft": 0.3}} for at in range(5)
    ]
    frames[2]["blendshapes"] = None
    return write_json(folder / "plain.json", frames)


def turned_rows() -> list[list[str]]:
    """Return rows of a csv with gaze and turns about all axes."""
    turns = np.random.default_rng(0).uniform(-0.4, 0.4, (6, 3))
    return [
        row(f"0:00:00:{2 * at:02d}.0", JawOpen=at / 8, EyeBlinkLeft=0.5, EyeLookOutLeft=0.4, EyeLookInRight=0.4,
            EyeLookUpLeft=0.2, HeadYaw=yaw, HeadPitch=pitch, HeadRoll=roll)
        for at, (yaw, pitch, roll) in enumerate(turns)
    ]  # fmt: skip


def test_every_layout_is_read_as_in_python(built: Path, tmp_path: Path) -> None:
    """Each coefficient goes to the same side, in every layout of every source."""
    names = [name for pair in PAIRS for name in pair]
    for write in (write for writers in LAYOUTS.values() for write in writers):
        recording = write(tmp_path, [{}, *({name: 0.5} for name in names), {"jawOpen": 0.5}])
        found = read_by_node(built, tmp_path, recording)
        assert found["notes"] == []
        fps, face = driven_by_python(recording)
        assert found["fps"] == pytest.approx(fps, rel=1e-6)
        expected = face.expression.numpy().reshape(-1)
        np.testing.assert_allclose(found["expression"], expected, rtol=0, atol=EQUAL, err_msg=recording.name)


def test_odd_recordings_are_read_as_in_python(built: Path, tmp_path: Path) -> None:
    """Midnight, repeats, gaps, faces that are lost at first, decimal commas, transposed matrices, turns and gaze."""
    codes = ("23:59:59:56", "23:59:59:58", "23:59:59:58", "0:00:00:00", "0:00:00:06", "0:00:00:08")
    rows = [row(code, JawOpen=index / 8, MouthLeft=0.5, HeadYaw=0.1 * index) for index, code in enumerate(codes)]
    keep = [index for index, name in enumerate(COLUMNS) if name != "TongueOut"]
    lines = [";".join(cells[index].replace(".", ",") for index in keep) for cells in (COLUMNS, *rows)]
    table = tmp_path / "take.csv"
    lost = ";".join(["23:59:59:54", "0"])
    table.write_text("\n".join(["sep=;", lines[0], lost, *lines[1:]]), encoding="utf-8-sig")
    turn = [[0.8, 0.6, 0, 0], [-0.6, 0.8, 0, 0], [0, 0, 1, 0], [1, 2, -40, 1]]
    results = [
        {
            "time": time,
            "face_blendshapes": [[{"category_name": "mouthLeft", "score": time}]],
            "facial_transformation_matrixes": [turn if time else np.eye(4).tolist()],
        }
        for time in (0.0, 0.1, 0.2, 0.5, 0.5)
    ]
    task = write_json(tmp_path / "task.json", results)
    turned = write_csv(tmp_path / "turned.csv", *turned_rows())
    for recording, notes in ((table, 2), (task, 2), (turned, 0)):
        found = read_by_node(built, tmp_path, recording)
        assert len(found["notes"]) == notes, found
        fps, face = driven_by_python(recording)
        assert found["fps"] == pytest.approx(fps, rel=1e-6)
        for name in ("expression", "joints", "head_rotation"):
            expected = getattr(face, name).numpy().reshape(-1)
            np.testing.assert_allclose(found[name], expected, rtol=0, atol=EQUAL, err_msg=f"{recording.name}: {name}")


def test_a_page_takes_as_long_a_csv_as_python(built: Path, tmp_path: Path) -> None:
    """A long list of rows is not spread into the arguments of a call, of which engines take some 100,000."""
    rows = [
        f"{at // 108000}:{at // 1800 % 60:02d}:{at // 30 % 60:02d}:{at % 30:02d},61,{at % 10 / 10}"
        for at in range(COUNT)
    ]
    (tmp_path / "long.csv").write_text("\n".join(["Timecode,BlendshapeCount,JawOpen", *rows]))
    found = read_by_node(built, tmp_path, tmp_path / "long.csv")
    assert "error" not in found
    assert (found["moments"], found["fps"]) == (COUNT, pytest.approx(30))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "hello", "is no csv of Live Link Face"),
        ("a.csv", "Timecode,BlendshapeCount,JawOpen\n0:0:0:1,61,wide\n", "has wide for jawopen in line 2"),
        ("a.csv", "Timecode,BlendshapeCount,JawOpen\nnoon,61,0\n", 'has the timecode "noon" in line 2'),
        ("a.csv", "Timecode,BlendshapeCount,JawOpen\n0:0:0:5,61,0\n0:0:0:4,61,0\n", "has times that do not increase"),
        ("a.json", "[{", "is no json"),
        ("a.json", "[]", "has no frame with blend shapes"),
        ("a.json", '[{"blendshapes": {"jawOpen": "wide"}}]', "has a value that is no number in frame 0"),
        ("a.csv", "Timecode,JawOpen\n1:0:0:5,0\n1:0:0:5,0\n", "has times that do not increase"),
        ("a.csv", "Timecode,JawOpen\n1:0:0:5,0\n1:2:0:5,0\n", "has a gap of more than 60 s"),
        (
            "a.json",
            json.dumps([{"timestamp_ms": i / 30, "blendshapes": {"jawOpen": 0}} for i in range(3)]),
            'has 30000 frames in a second; give milliseconds, or call seconds "time"',
        ),
        (
            "a.json",
            json.dumps([{"time": 33 * i, "blendshapes": {"jawOpen": 0}} for i in range(3)]),
            'has frames of 33 s; give seconds, or call milliseconds "timestamp_ms"',
        ),
        (
            "a.json",
            json.dumps([{"face_blendshapes": [[]], "facial_transformation_matrixes": [[[1] * 4] * 4]}]),
            "has a matrix whose last row is not 0 0 0 1 in frame 0",
        ),
        ("a.json", '{"names": ["jawOpen"], "frames": [{"weights": []}]}', "has other numbers of names and weights"),
        ("a.json", '[{"blendshapes": {"smile": 1}}]', "has none of this avatar's expressions"),
    ],
)
def test_what_is_no_recording_is_said(built: Path, tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    assert read_by_node(built, tmp_path, tmp_path / name)["error"] == message


def test_signs_of_life_are_calm(built: Path, tmp_path: Path) -> None:
    """A minute has 10 to 30 blinks, each below half a second, and the head turns by less than 4 degrees."""
    found = read_by_node(built, tmp_path, plain_recording(tmp_path))
    closed = np.array(found["blinks"]) > 0
    starts = np.flatnonzero(np.diff(closed.astype(int)) == 1)
    assert 10 <= len(starts) <= 30
    assert closed.mean() < 0.12
    assert max(found["blinks"]) > 0.9
    assert min(found["blinks"]) == 0
    assert 0.01 < np.linalg.norm(found["sways"], axis=1).max() < np.radians(4)


DROP = """(async () => {
  const viewer = await mien, given = new DataTransfer(), before = viewer.motion;
  document.getElementById("message").textContent = "";
  given.items.add(new File([%s], "take.%s"));
  document.dispatchEvent(new DragEvent("drop", { dataTransfer: given, bubbles: true }));
  for (let i = 0; i < 100 && viewer.motion === before && !document.getElementById("message").textContent; ++i)
    await new Promise((done) => setTimeout(done, 50));
  viewer.play(false);
  if (viewer.motion) viewer.seek(3);
  const row = document.getElementById("motion");
  return [document.getElementById("message").textContent, row.hidden, Array.from(viewer.face.expression)];
})()"""

LIVE = """(async () => {
  const viewer = await mien;
  document.getElementById("reset").click();
  for (const id of ["idle", "gaze"]) document.getElementById(id).click();
  const box = viewer.canvas.getBoundingClientRect(), blink = viewer.avatar.expression_names.indexOf("eyeBlinkLeft");
  const eye = 3 * viewer.avatar.joint_names.indexOf("left_eye"), began = performance.now();
  let closed = 0, gaze = [0, 0, 0], head_rotation;
  // Eyes follow a pointer for some seconds. A blink may come later, or at once: the pointer moves until both are seen.
  while (performance.now() - began < 30000 && (closed < 0.3 || gaze[0] > -0.1 || gaze[1] < 0.2)) {
    dispatchEvent(new PointerEvent("pointermove", { clientX: box.right, clientY: box.top }));
    closed = Math.max(closed, viewer.shown.expression[blink]);
    gaze = Array.from(viewer.shown.joints.subarray(eye, eye + 3));
    ({ head_rotation } = viewer.shown);
    await new Promise((done) => setTimeout(done, 10));
  }
  const turned = Array.from(head_rotation), blinks = () => viewer.shown.expression[blink] > 0;
  for (const id of ["idle", "gaze"]) document.getElementById(id).click();
  for (let i = 0; i < 100 && viewer.shown !== viewer.face && blinks(); ++i)
    await new Promise((done) => setTimeout(done, 50));
  return [closed, gaze, turned, viewer.shown.expression[blink], Array.from(viewer.shown.head_rotation)];
})()"""


def test_a_page_plays_dropped_recordings_and_lives(tmp_path: Path) -> None:
    portable = drawn_head(500)
    write_page(tmp_path / "a.html", portable)
    plain = plain_recording(tmp_path)
    table = write_csv(tmp_path / "take.csv", *turned_rows())
    bad = DROP % (json.dumps("hello"), "csv")
    good = DROP % (json.dumps(table.read_text()), "csv")
    other = DROP % (json.dumps(plain.read_text()), "json")
    told = browse(tmp_path / "a.html", [bad, good, other, LIVE], size=(500, 300))
    assert told["requests"] == []
    assert told["messages"] == []
    refused, first, second, (closed, gaze, turned, opened, still) = told["results"]
    assert refused[0] == "take.csv is no csv of Live Link Face. Give a csv of Live Link Face, or blend shapes as json."
    assert refused[1] is True
    for recording, (message, hidden, expression) in ((table, first), (plain, second)):
        assert (message, hidden) == ("", False)
        np.testing.assert_allclose(expression, driven_by_python(recording)[1].expression[3], atol=EQUAL)
    assert closed >= 0.3
    assert gaze[0] < -0.1  # up
    assert gaze[1] > 0.2  # to the right of the picture, which is the subject's left
    assert np.abs(np.array(turned) - still).max() > 1e-3
    assert opened == pytest.approx(portable.neutral.expression[portable.expression_names.index("eyeBlinkLeft")])
    np.testing.assert_allclose(still, portable.neutral.head_rotation, atol=1e-6)
