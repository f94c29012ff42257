"""Files that would take gigabytes or minutes, hold huge numbers, or were findings of the fuzzers: refused in one line.
Each is refused before memory is taken, and the line names the file."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import train_toy
from bounded_memory import MIB, allocating_at_most, refused
from fuzzing.material import new_avatar, tiny_flame
from fuzzing.repairs import joined, split
from mien import runtime
from mien.avatar.baking import make_portable
from mien.capture.person import given
from mien.capture.person.crop import whole_picture
from mien.capture.person.faces import LANDMARKS
from mien.capture.person.given import GivenMattes, read_landmarks
from mien.disk.limits import rigid_fault
from mien.disk.reading import parse_json
from mien.driving import drive, motion
from mien.driving.blendshape_json import read_blendshape_json
from mien.driving.live_link_face import read_live_link_face
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.models.flame import read_flame
from mien.formats import ply, read_ply, write_ply
from mien.formats.glb import EXTENSION, read_glb_avatar
from mien.formats.ply import property_names
from mien.gaussians import Gaussians
from mien.media.picture_files import decode_png, png_fits
from mien.media.source import FrameSelection, open_source
from mien.runtime.checks import check
from mien.training import train
from recordings import row, write_csv, write_json
from refusals import complaint, refuses
from shared_things import MadeOnce, toy_workspace
from test_glb_avatar import rewritten, written
from toy_scene import toy_camera, toy_sequence

DIGITS = int("9" * 400)


def sparse(path: Path, size: int, head: bytes = b"") -> Path:
    """Write a file with a hole, which has any size and takes no place on the disk."""
    with path.open("wb") as file:
        file.write(head)
        file.truncate(size)
    return path


def test_arrays_of_a_glb_have_bounds(tmp_path: Path) -> None:
    def share(content: dict[str, Any]) -> None:
        tensors = content["extensions"][EXTENSION]["tensors"]
        largest = max((one for one in tensors.values() if "bufferView" in one), key=lambda one: np.prod(one["shape"]))
        tensors.update({f"x{index}": largest for index in range(3000)})

    path = rewritten(written("gaussian_avatars", tmp_path)[0], tmp_path / "a.glb", share)
    refused(read_glb_avatar, path, r"tensors.x0: bufferView \d+ belongs to another array")


def test_rows_of_a_ply_and_lists_of_json_have_a_bound(tmp_path: Path) -> None:
    names = [*property_names(1), *(f"more_{index}" for index in range(2000))]
    lines = "".join(f"property float {name}\n" for name in names)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 1000000\n{lines}end_header\n"
    path = sparse(tmp_path / "a.ply", 10 << 30, head.encode())
    refused(read_ply, path, "bytes of vertices, more than 536,870,912; leave columns out")
    # Empty lists take twenty times their text.
    path = tmp_path / "a.json"
    path.write_text("[" + "[]," * (20 << 20) + "[]]")
    refused(read_blendshape_json, path, "too many lists, objects or numbers", 200 * MIB)
    names = ",".join(f'"{index}": 0' for index in range(30_000))
    with allocating_at_most(256 * MIB, 60), pytest.raises(ValueError, match="it holds '0' twice"):
        parse_json(f'{{{names}, "0": 1}}', unique_names=True)


def test_landmarks_are_as_large_as_their_frames_need(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = 900 * MIB
    head = joined({"landmarks": {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}}, b"")
    path = sparse(tmp_path / "a.safetensors", len(head) + size, head)
    refused(lambda path: read_landmarks(path, 10), path, "landmarks of 10 frames have at most 1,201,536; write")
    path = sparse(tmp_path / "a.csv", 6 << 30)
    refused(lambda path: read_landmarks(path, 10), path, "a line has more than 61,184 characters")
    cells = ["0.5"] * (2 * LANDMARKS - 1)
    for last, words in ((DIGITS, "infinite or beyond"), ("x" * 3000, r"'x{40}\.\.\.' is not a number")):
        path.write_text(",".join([*cells, "1"]) + "\n" + ",".join([*cells, str(last)]) + "\n")
        refused(lambda path: read_landmarks(path, 2), path, words)
    path.write_text(",".join([*cells, "0.5"]) + "\n")
    assert read_landmarks(path, 1).shape == (1, LANDMARKS, 2)
    path.write_text("\n" * 1000)
    read = []
    monkeypatch.setattr(given.np, "array", lambda *values, array=np.array: read.append(1) or array(*values))
    refused(lambda path: read_landmarks(path, 3), path, r"has landmarks of shape \[4, 478, 2\]")
    assert len(read) < 10, "only as many as there are frames are held"


def test_a_message_shows_the_beginning_and_the_remedy() -> None:
    """A value of a stranger's file would fill the terminal."""
    said = str(UserError(f"a.json: {'x' * 30_000}; train it again"))
    assert len(said) < 2100
    assert said.startswith("a.json: xx")
    assert said.endswith("x; train it again")


def test_a_tensor_of_thirty_thousand_axes_is_refused(made_once: MadeOnce, tmp_path: Path, capsys) -> None:
    shutil.copytree(toy_workspace(made_once), tmp_path / "W")
    track = tmp_path / "W" / "runs" / "toy" / "face_track.safetensors"
    header, body = split(track.read_bytes())
    del header["__metadata__"]
    header["head_rotation"]["shape"] += [1] * 30_000
    track.write_bytes(joined(header, body))
    assert f"{track}: " in complaint(capsys, "evaluate", str(tmp_path / "W"))


START = [row(f"0:00:00:0{frame}.0") for frame in range(6)]
MATRIX = {"facialTransformationMatrixes": [{"data": [*([0] * 15), DIGITS]}], "faceBlendshapes": []}
CSV = (
    ([row(f"0:0:0:{DIGITS}")], "line 2: Timecode '0:0:0:9999"),
    ([row("0:0:0:0", JawOpen=str(DIGITS))], r"JawOpen is 9{80}\.\.\.; coefficients go"),
    ([row("0:0:0:0", HeadYaw=str(DIGITS))], r"HeadYaw is 9{80}\.\.\.; angles are in radians"),
    ([row("0:0:0:0", JawOpen="x" * 5000)], r"JawOpen is 'x{80}\.\.\.', not a number"),
    ([row("0:0:0:0", JawOpen="1" + "0" * 5000)], "coefficients go from 0 to 1"),
    ([row("\u0660:\u0660:\u0660:\u0660")], "line 2: Timecode"),
    ([*START[:3], row("8760:00:00:00.0")], "line 5: comes 31,536,000 s after"),
    ([*START, *(row(f"0:{minute:02d}:00:00.0") for minute in range(1, 5))], "give 5,760 moments, more than 5,000"),
)
JSON = (
    ([{"timestamp_ms": DIGITS, "blendshapes": {}}], "timestamp_ms is 9999"),
    ([{"timestamp_ms": time, "blendshapes": {}} for time in (0, 33, 66, 1e12)], "frame 3: comes 1,000,000,000 s after"),
    ([{"blendshapes": {"jawOpen": DIGITS}}], "jawOpen is 9999"),
    ([{"blendshapes": {"x" * 3000: 1}}], r"no blend shape 'x+\.\.\.$"),
    ([{"blendshapes": {"jawOpen": [[1] * 3000]}}], r"jawOpen is \[\[1"),
    (MATRIX, "layout of a FaceLandmarker"),
    ({**MATRIX, "facialTransformationMatrixes": [{"data": [1e30] * 16}]}, "contains NaN or huge numbers"),
    ({"faceBlendshapes": {"a": 1}}, "layout of a FaceLandmarker"),
    ({"faceBlendshapes": [{"categories": [{"categoryName": [], "score": 1}]}]}, "layout of a FaceLandmarker"),
)


def test_huge_numbers_lines_and_gaps_of_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gap would be filled with moments: a year between two rows with two billion."""
    csv, text = tmp_path / "a.csv", tmp_path / "a.json"
    assert len(read_live_link_face(write_csv(csv, *START[:3], row("0:00:59:00.0")), fps=60.0)) == 3541
    csv.write_text("12," * (8 << 20))
    refused(read_live_link_face, csv, "a line has more than 1,048,576 characters")
    for read in (read_live_link_face, read_blendshape_json):
        refused(read, sparse(csv, motion.MAX_FILE_BYTES + 1), "has more than 134,217,728 bytes")
    monkeypatch.setattr(motion, "MAX_MOMENTS", 5_000)
    monkeypatch.setattr("mien.disk.tables.MAX_CELLS_BYTES", 1 << 20)
    csv.write_text("Timecode,EyeBlinkLeft\n" + "12,12,12,12,12,12,12,12,12\n" * 5000)
    refused(read_live_link_face, csv, "it has too many values; cut it into shorter tables")
    for rows, words in CSV:
        refused(read_live_link_face, write_csv(csv, *rows), words)
    for content, words in JSON:
        refused(read_blendshape_json, write_json(text, content), words)
    for content in ('[{"timestamp_ms": 1' + "0" * 5000 + ', "blendshapes": {}}]', "[" * 100_000):
        text.write_text(content)
        refused(read_blendshape_json, text, "cannot be read as json")


def test_pictures_that_are_too_few_or_not_whole(tmp_path: Path) -> None:
    path = tmp_path / "0.png"
    assert cv2.imwrite(str(path), np.zeros((8, 8), np.uint8))
    refuses("ends before its frame 1", GivenMattes(tmp_path, (8, 8)).matte, 1, whole_picture(8, 8, 8))
    data = path.read_bytes()
    assert png_fits(data)
    assert png_fits(data + b"whatever other programs add")
    chunk = data.index(b"IDAT") - 4
    assert not png_fits(data[:chunk] + b"\xff\xff\xff\xf0" + data[chunk + 4 :]), "a decoder would allocate 4 GB"
    assert not png_fits(data[:-12])
    with pytest.raises(UserError, match="0.png: has 1,073,741,824 bytes, and a picture may have at most 603,979,776"):
        open_source(sparse(path, 1 << 30).parent, FrameSelection(), 25.0)
    path.write_bytes(b"\x89PNG\r\n\x1a\nIEND\xaeB`\x82")
    refuses(r"0\.png: damaged", decode_png, path, (8, 8), "capture again")


def test_faces_of_another_type_or_size_and_those_that_face_nowhere_are_named(tmp_path: Path) -> None:
    model, sequence = toy_sequence(timesteps=5, size=32)
    face = sequence.tracking.face
    with pytest.raises(UserError, match=r"here: expression is torch\.float64"):
        check_face_params(model, replace(face, expression=face.expression.double()), "here", "track again")
    with pytest.raises(UserError, match=r"^take\.csv has 0x3 joints parameters"):
        drive(replace(face, joints=face.joints[:, :0]), face, face, who="take.csv")
    tracking = replace(sequence.tracking, face=replace(face, identity=torch.zeros(0)))
    other = replace(sequence, tracking=tracking, folder=tmp_path / "clip")
    refuses(r"clip: identity is \[0\]", train, [other], model, train_toy.CONFIG, train_toy.SETTINGS, tmp_path / "run")
    arrays = tiny_flame()
    turned: dict[str, Any] = {**arrays, "f": arrays["f"][:, ::-1]}
    np.savez(tmp_path / "tiny.npz", **turned)
    refuses(r"tiny\.npz: 'f' has no triangle that faces outwards", read_flame, tmp_path / "tiny.npz")


# Matrices, which hold a rotation and a translation. `fuzzing.values` has those of cameras -----------------------------

TURN = np.array([[0.8, -0.6, 0, 0.1], [0.6, 0.8, 0, 0.2], [0, 0, 1, 0.7], [0, 0, 0, 1]])
SHEARED, TILTED, MIRRORED, LOST = TURN.copy(), TURN.copy(), TURN.copy(), TURN.copy()
SHEARED[0, 1] = 0.3
TILTED[3] = [0, 0, 0.5, 1]
MIRRORED[:, 0] *= -1
LOST[0, 3] = np.nan
BAD = (
    (TURN.T, "it is transposed; put the translation into the last column"),
    (TILTED, "its last row is 0 0 0.5 1; it must be 0 0 0 1"),
    (SHEARED, "not a rotation"), (MIRRORED, "not a rotation"), (LOST, "must be"), (TURN[:3], "must be"),
)  # fmt: skip


def test_bad_matrices_and_numbers_of_ply_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, pose = tmp_path / "a.ply", torch.from_numpy(TURN).float()
    turned = torch.nn.functional.normalize(torch.ones(5, 4), dim=1)
    write_ply(path, Gaussians(torch.zeros(5, 3), turned, torch.ones(5, 3), torch.ones(5), torch.zeros(5, 1, 3), pose))
    assert torch.equal(read_ply(path).T_world_local, pose)  # pyright: ignore[reportArgumentType]
    whole, words = path.read_bytes(), b"T_world_local row by row: "
    head, (line, rest) = whole.split(words)[0], whole.split(words)[1].split(b"\n", 1)
    assert rigid_fault(TURN) is None
    for matrix, told in BAD:
        assert told in str(rigid_fault(matrix))
        own = " ".join(str(value) for value in matrix.flatten()).encode()
        path.write_bytes(head + words + own + b"\n" + rest)
        refuses("has a damaged frame comment", read_ply, path)
    start = whole.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(whole[:start] + np.float32(np.nan).tobytes() + whole[start + 4 :])
    refuses("position of some Gaussians is NaN", read_ply, path)
    path.write_bytes(head + words + line + b"\n" + rest)
    monkeypatch.setattr(ply, "MAX_GAUSSIANS", 4)
    refuses(r"a\.ply: has 5 Gaussians, more than 4", read_ply, path)


def test_poses_of_mien_files() -> None:
    """The pose of the bone that stands still is a rigid pose, or the .mien file is refused."""
    portable = make_portable(new_avatar("mono_gaussian_avatar"), toy_camera(32), "skinned")
    baked = portable.baked
    assert isinstance(baked, runtime.BlendSkinned)
    weights = np.full(len(baked.attributes.quats), 0.1, np.float32)
    posed = replace(baked, still_weights=weights, still_pose=TURN.astype(np.float32))
    check(replace(portable, baked=posed), "a.mien")
    for wrong, words in (
        (weights[1:], "still_weights has the shape"), (np.append(weights, weights[:1]), "still_weights has the shape"),
        (None, "weights or a pose, but not both"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=words):
            check(replace(portable, baked=replace(posed, still_weights=wrong)), "a.mien")
    for matrix, words in BAD[:4]:
        refuses(words, check, replace(portable, baked=replace(posed, still_pose=matrix.astype(np.float32))), "a.mien")
