"""Files that would take gigabytes or minutes, or hold huge numbers: refused in one line, before memory is taken."""

import io
import json
import shutil
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import torch
from PIL import Image

from bounded_memory import MIB, allocating_at_most, refused
from mien.bounded import parse_json
from mien.capture import given
from mien.capture.faces import LANDMARKS
from mien.capture.given import read_landmarks
from mien.cli import main
from mien.driving import motion, read_blendshape_json, read_live_link_face
from mien.errors import UserError
from mien.export import read_glb, read_glb_avatar, read_ply, read_sog, read_usd, write_sog, write_usd  # fmt: skip
from mien.export.glb_avatar import EXTENSION
from mien.export.glb_file import GlbWriter
from mien.export.ply import property_names
from mien.storage import write_tensors
from recordings import row, write_csv, write_json
from shared_things import MadeOnce, toy_workspace
from test_glb_avatar import rewritten, written
from test_splat_files import needs_usd, some

DIGITS = int("9" * 400)


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_members(path: Path, members: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def webp(width: int, height: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (width, height)).save(file, "WEBP", lossless=True)
    return file.getvalue()


def test_arrays_of_a_glb_that_share_their_bytes_are_refused(tmp_path: Path) -> None:
    source = written("gaussian_avatars", tmp_path)[0]

    def share(content: dict[str, Any]) -> None:
        tensors = content["extensions"][EXTENSION]["tensors"]
        largest = max((one for one in tensors.values() if "bufferView" in one), key=lambda one: np.prod(one["shape"]))
        tensors.update({f"x{index}": largest for index in range(3000)})

    path = rewritten(source, tmp_path / "a.glb", share)
    refused(read_glb_avatar, path, "its arrays are larger than its buffer")


def test_a_sparse_accessor_of_a_glb_has_a_bound(tmp_path: Path) -> None:
    writer = GlbWriter()
    writer.sparse(np.eye(4, dtype=np.float32))
    writer.accessors[0]["count"] = 1 << 40
    writer.write(tmp_path / "a.glb", {})
    with allocating_at_most(64 * MIB, 60), pytest.raises(ValueError, match="is not a whole number"):
        read_glb(tmp_path / "a.glb").array(0)


def test_pictures_of_a_sog_belong_to_its_gaussians(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", some(50, 4))
    members = members_of(tmp_path / "a.sog")
    large = webp(4096, 1024)
    assert len(large) < 6000
    for name in ("means_l", "quats", "sh0", "shN_labels", "shN_centroids"):
        path = write_members(tmp_path / "b.sog", members | {f"{name}.webp": large})
        refused(read_sog, path, "has more pixels than its 50 Gaussians need")


def test_other_numbers_of_a_sog_have_bounds(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", some(50, 4))
    members = members_of(tmp_path / "a.sog")
    meta = json.loads(members["meta.json"])
    for part, name, value in (
        ("shN", "bands", 10**18), ("shN", "bands", -1), ("sh0", "codebook", [[0.0] * 300] * 256),
        ("scales", "codebook", [1e4] * 256), ("sh0", "codebook", [0.0] * 99),
    ):  # fmt: skip
        changed = meta | {part: meta[part] | {name: value}}
        path = write_members(tmp_path / "b.sog", members | {"meta.json": json.dumps(changed).encode()})
        refused(read_sog, path, r"cannot be read as \.sog|NaN or infinite")
    text = json.dumps(meta).encode() + b" " * (2 << 20)
    refused(read_sog, write_members(tmp_path / "b.sog", members | {"meta.json": text}), "too large")


def test_members_that_python_cannot_unpack_are_told(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", some(50, 1))
    members = members_of(tmp_path / "a.sog")
    path = write_members(tmp_path / "b.sog", members, zipfile.ZIP_LZMA)
    refused(read_sog, path, "is compressed in an unusual way")
    data = bytearray((tmp_path / "a.sog").read_bytes())
    directory = data.index(b"PK\x01\x02")
    for place, value in ((8, b"\x01\x00"), (10, b"\x63\x00"), (8, b"\x20\x00")):  # encrypted, method 99, patched
        other = data.copy()
        other[directory + place : directory + place + 2] = value
        path.write_bytes(other)
        refused(read_sog, path, r"cannot be read as \.sog")


def test_rows_of_a_ply_have_a_bound(tmp_path: Path) -> None:
    """A file with a hole has any size, and takes no place on the disk."""
    names = [*property_names(1), *(f"more_{index}" for index in range(2000))]
    lines = "".join(f"property float {name}\n" for name in names)
    path = tmp_path / "a.ply"
    path.write_text(f"ply\nformat binary_little_endian 1.0\nelement vertex 1000000\n{lines}end_header\n")
    with path.open("r+b") as file:
        file.truncate(10 << 30)
    refused(read_ply, path, "bytes of vertices, more than 536,870,912; leave columns out")


def test_landmarks_are_as_large_as_their_frames_need(tmp_path: Path) -> None:
    size = 900 * MIB
    text = json.dumps({"landmarks": {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}}).encode()
    path = tmp_path / "a.safetensors"
    path.write_bytes(struct.pack("<Q", len(text)) + text)
    with path.open("r+b") as file:
        file.truncate(8 + len(text) + size)
    refused(lambda path: read_landmarks(path, 10), path, "landmarks of 10 frames have at most 1,201,536; write")


def test_lines_of_a_csv_have_a_bound(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with path.open("wb") as file:
        file.truncate(6 << 30)
    refused(lambda path: read_landmarks(path, 10), path, "a line has more than 61,184 characters")
    path.write_text(",".join(["0.5"] * 2 * LANDMARKS) + "\n")
    assert read_landmarks(path, 1).shape == (1, LANDMARKS, 2)
    path.write_text("12," * (8 << 20))
    refused(read_live_link_face, path, "a line has more than 1,048,576 characters")


def test_values_of_a_csv_have_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mien.driving.live_link_face.MAX_CELLS_BYTES", 1 << 20)
    path = tmp_path / "a.csv"
    path.write_text("Timecode,EyeBlinkLeft\n" + "12,12,12,12,12,12,12,12,12\n" * 5000)
    refused(read_live_link_face, path, "it has too many values; cut it into shorter recordings")


def test_lists_of_json_have_a_bound(tmp_path: Path) -> None:
    """Empty lists take twenty times their text."""
    path = tmp_path / "a.json"
    path.write_text("[" + "[]," * (20 << 20) + "[]]")
    refused(read_blendshape_json, path, "too many lists, objects or numbers", 200 * MIB)
    names = ",".join(f'"{index}": 0' for index in range(30_000))
    with allocating_at_most(256 * MIB, 60), pytest.raises(ValueError, match="it holds '0' twice"):
        parse_json(f'{{{names}, "0": 1}}', unique_names=True)


def test_a_message_shows_the_beginning_and_the_remedy(
    made_once: MadeOnce, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A shape of thirty thousand sides would fill the terminal."""
    shutil.copytree(toy_workspace(made_once), tmp_path / "W")
    track = tmp_path / "W" / "runs" / "toy" / "face_track.safetensors"
    tensors = safetensors.numpy.load_file(track)
    write_tensors(track, {name: torch.from_numpy(array) for name, array in tensors.items()})
    text = track.read_bytes()
    (size,) = struct.unpack_from("<Q", text)
    header = json.loads(text[8 : 8 + size])
    del header["__metadata__"]
    header["head_rotation"]["shape"] += [1] * 30_000
    changed = json.dumps(header).encode()
    track.write_bytes(struct.pack("<Q", len(changed)) + changed + text[8 + size :])
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "W")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert len(said) < 2100
    assert said.startswith(f"mien: {track}: ")
    assert said.endswith("train it again\n")


@needs_usd
def test_a_stage_that_names_other_files_is_refused(tmp_path: Path) -> None:
    """No other file is opened, and infinity is refused as in the other formats."""
    write_usd(tmp_path / "good.usda", [some(4, 1)])
    good = (tmp_path / "good.usda").read_text()
    assert len(read_usd(tmp_path / "good.usda")) == 4
    path = tmp_path / "a.usda"
    for text in (
        "#usda 1.0\n(\n    subLayers = [@good.usda@]\n)\n",
        '#usda 1.0\ndef "a" (\n    references = @good.usda@\n)\n{\n}\n',
        '#usda 1.0\ndef "a" (\n    payload = @good.usda@\n)\n{\n}\n',
        '#usda 1.0\ndef "a" (\n    variants = { string v = "x" }\n    prepend variantSets = "v"\n)\n{\n'
        '    variantSet "v" = {\n        "x" (references = @good.usda@) {\n        }\n    }\n}\n',
        '#usda 1.0\ndef "a" (\n    clips = { dictionary default = { asset[] assetPaths = [@good.usda@] } }\n)\n{\n}\n',
    ):
        path.write_text(text)
        refused(read_usd, path, "refers to other files, which are not opened; flatten it into one file")
    start = good.index("point3f[] positions = [(") + len("point3f[] positions = [(")
    for number in ("inf", "nan", "1e300"):
        path.write_text(good[:start] + number + good[good.index(",", start) :])
        refused(read_usd, path, "1 of 4 Gaussians are NaN or infinite")
    path.write_text(good.replace("point3f[] positions", "string[] positions").replace("[(", '["', 1))
    with pytest.raises(UserError):
        read_usd(path)


# Motion and landmarks -------------------------------------------------------------------------------------------------


def test_a_gap_in_a_csv_is_told_with_its_line(tmp_path: Path) -> None:
    """A year between two rows would be filled with two billion moments."""
    path = tmp_path / "a.csv"
    start = [row("0:00:00:00.0"), row("0:00:00:01.0"), row("0:00:00:02.0")]
    refused(read_live_link_face, write_csv(path, *start, row("8760:00:00:00.0")), "line 5: comes 31,536,000 s after")
    assert len(read_live_link_face(write_csv(path, *start, row("0:00:59:00.0")), fps=60.0)) == 3541


def test_many_gaps_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many gaps are reported that are not long by themselves, but are long together."""
    monkeypatch.setattr(motion, "MAX_MOMENTS", 5_000)
    start = [row(f"0:00:00:0{frame}.0") for frame in range(6)]
    later = [row(f"0:{minute:02d}:00:00.0") for minute in range(1, 5)]
    refused(read_live_link_face, write_csv(tmp_path / "a.csv", *start, *later), "give 5,760 moments, more than 5,000")


def test_a_gap_in_json_is_told_with_its_frame(tmp_path: Path) -> None:
    frames = [{"timestamp_ms": time, "blendshapes": {}} for time in (0, 33, 66, 1e12)]
    refused(read_blendshape_json, write_json(tmp_path / "a.json", frames), "frame 3: comes 1,000,000,000 s after")


def test_numbers_of_hundreds_of_digits_in_csv(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    for rows, words in (
        ([row(f"0:0:0:{DIGITS}")], "line 2: Timecode '0:0:0:9999"),
        ([row(f"{DIGITS}:0:0:0")], "line 2: Timecode '9999"),
        ([row("0:0:0:0", JawOpen=str(DIGITS))], r"JawOpen is 9{80}\.\.\.; coefficients go"),
        ([row("0:0:0:0", HeadYaw=str(DIGITS))], r"HeadYaw is 9{80}\.\.\.; angles are in radians"),
        ([row("0:0:0:0", JawOpen="x" * 5000)], r"JawOpen is 'x{80}\.\.\.', not a number"),
        ([row("0:0:0:0", JawOpen="1" + "0" * 5000)], "coefficients go from 0 to 1"),
        ([row("\u0660:\u0660:\u0660:\u0660")], "line 2: Timecode"),
    ):
        refused(read_live_link_face, write_csv(path, *rows), words)


def test_numbers_of_hundreds_of_digits_in_json(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    matrix = {"facialTransformationMatrixes": [{"data": [*([0] * 15), DIGITS]}], "faceBlendshapes": []}
    for content, words in (
        ([{"timestamp_ms": DIGITS, "blendshapes": {}}], "timestamp_ms is 9999"),
        ([{"timestamp_ms": 1e300, "blendshapes": {}}], r"timestamp_ms is 1e\+300"),
        ([{"blendshapes": {"jawOpen": DIGITS}}], "jawOpen is 9999"),
        ([{"blendshapes": {"x" * 3000: 1}}], r"no blend shape 'x+\.\.\.$"),
        ([{"blendshapes": {"jawOpen": [[1] * 3000]}}], r"jawOpen is \[\[1"),
        (matrix, "layout of a FaceLandmarker"),
        ({**matrix, "facialTransformationMatrixes": [{"data": [1e30] * 16}]}, "contains NaN or huge numbers"),
        ({"faceBlendshapes": {"a": 1}}, "layout of a FaceLandmarker"),
        ({"faceBlendshapes": [{"categories": [{"categoryName": [], "score": 1}]}]}, "layout of a FaceLandmarker"),
        ({"faceBlendshapes": [], "facialTransformationMatrixes": {"a": 1}}, "layout of a FaceLandmarker"),
    ):
        refused(read_blendshape_json, write_json(path, content), words)
    path.write_text('[{"timestamp_ms": 1' + "0" * 5000 + ', "blendshapes": {}}]')
    refused(read_blendshape_json, path, "cannot be read as json")
    path.write_text("[" * 100_000)
    refused(read_blendshape_json, path, "cannot be read as json")


@pytest.mark.parametrize("read", [read_live_link_face, read_blendshape_json])
def test_huge_recordings_are_not_read(read, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with path.open("wb") as file:
        file.truncate(motion.MAX_FILE_BYTES + 1)
    refused(read, path, "has more than 134,217,728 bytes")


def test_landmarks_that_are_no_pixels(tmp_path: Path) -> None:
    cells = ",".join(["1"] * (2 * LANDMARKS - 1))
    (tmp_path / "a.csv").write_text(f"{cells},{DIGITS}\n{cells},1\n")
    refused(lambda path: read_landmarks(path, 2), tmp_path / "a.csv", "infinite or beyond")
    (tmp_path / "a.csv").write_text(f"{cells},1\n{cells},{'x' * 3000}\n")
    refused(lambda path: read_landmarks(path, 2), tmp_path / "a.csv", r"'x{40}\.\.\.' is not a number")


def test_only_as_many_landmarks_as_frames_are_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n" * 1000)
    read = []
    monkeypatch.setattr(given.np, "array", lambda *values, array=np.array: read.append(1) or array(*values))
    refused(lambda path: read_landmarks(path, 3), path, r"has landmarks of shape \[4, 478, 2\]")
    assert len(read) < 10
