"""Files that would exhaust a page, and names that would fill one or be code in one."""

import copy
import gzip
import json
import struct
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mien import runtime
from mien.errors import UserError
from mien.formats.page import TEMPLATE, write_page
from mien.formats.shared.packed import pack
from mien.pages.pages import render, with_code
from web_case import WEB, drawn_head, node

pytestmark = pytest.mark.unchecked
MOST_BYTES, SECONDS = 1 << 30, 120


def read_by_node(built: Path, content: bytes, tmp_path: Path) -> str:
    """Return the error of the web runtime for a file. It must keep to its time and its memory."""
    path = tmp_path / "head.packed"
    path.write_bytes(content)
    script = [node(), str(WEB / "tests" / "read.mjs"), str(built / "mien.js"), str(path)]
    found = json.loads(subprocess.run(script, check=True, capture_output=True, timeout=SECONDS).stdout)
    assert found["memory"] < MOST_BYTES
    return found["message"]


def parts() -> tuple[dict[str, Any], bytes]:
    whole = gzip.decompress(pack(drawn_head(200, 3)))
    (size,) = struct.unpack_from("<I", whole)
    return json.loads(whole[4 : 4 + size]), whole[4 + size :]


def packed(header: dict[str, Any], arrays: bytes) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-(4 + len(text)) % 4)
    return gzip.compress(struct.pack("<I", len(text)) + text + arrays, 1)


def test_numbers_that_lead_nowhere_are_refused(built: Path, tmp_path: Path) -> None:
    array, rig, changes = "tensors/avatar.baked.means", "content/avatar/baked/rig", "content/avatar/baked/changes"
    header, arrays = parts()
    assert read_by_node(built, packed(header, arrays), tmp_path) == "", "the whole file is read"
    for place, value in (
        (f"{array}/middle", {"length": 1e15}), (f"{array}/middle", []), (f"{array}/shape", [1e9, 1e9]),
        (f"{array}/shape", {"length": 3e9}), (f"{array}/shape", [-5, -3]), (f"{array}/bits", 1e-9),
        (f"{array}/at", -1e15), (array, None), ("tensors", None),
        ("content/avatar/expression_names", {"length": 3e9}), ("content/avatar/baked/faces", {"length": 3e9}),
        ("content/avatar/baked/means", {"tensor": "avatar.baked.rig.expression_basis", "length": 3e9}),
        ("content/avatar/baked", None), (f"{rig}/joint_template", [0, 1, 2]), (f"{rig}/joint_parents", [5, 5, 5]),
        (f"{rig}/joint_parents", [-1, [[]], 0]), (f"{rig}/joint_names", "x" * 100_000),
        (f"{changes}/rest", [0]), (f"{changes}/shares", [0, 1]), (f"{changes}/head/rest", [0]),
        ("content/avatar/neutral", None), ("content/avatar/camera", []), ("content/motion", {"fps": 30}),
    ):  # fmt: skip
        changed = copy.deepcopy(header)
        *way, last = place.split("/")
        part: Any = changed
        for name in way:
            part = part[name]
        part[last] = value
        assert read_by_node(built, packed(changed, arrays), tmp_path).startswith("is damaged"), (place, value)
    whole = packed(header, arrays)
    for content in (whole[:4000], whole[:4000] + bytes(100) + whole[4100:]):
        assert read_by_node(built, content, tmp_path) == "is damaged: it cannot be unpacked"


def test_files_that_would_become_gigabytes_are_refused(built: Path, tmp_path: Path) -> None:
    """Arrays that share their bytes, of a .packed and of a .mien file, and a file that unpacks to 3 GB."""
    header, arrays = parts()
    count = 1 << 20
    described = {"shape": [count], "bits": 8, "axis": "columns", "middle": [0], "step": [1], "at": len(arrays)}
    header["tensors"] |= {f"x{index}": described for index in range(1000)}
    header["content"]["more"] = [{"tensor": f"x{index}"} for index in range(1000)]
    message = read_by_node(built, packed(header, arrays + bytes(count)), tmp_path)
    assert message == "is damaged: an array lies beyond its end"
    runtime.write_portable(tmp_path / "head.mien", drawn_head(200, 0))
    data = (tmp_path / "head.mien").read_bytes()
    (size,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + size])
    told = json.loads(header["__metadata__"]["mien"])
    largest = max((name for name in header if name != "__metadata__"), key=lambda name: header[name]["data_offsets"][1])
    told["content"]["more"] = [{"tensor": largest}] * 50_000
    header["__metadata__"]["mien"] = json.dumps(told)
    text = json.dumps(header).encode()
    content = struct.pack("<Q", len(text)) + text + data[8 + size :]
    assert read_by_node(built, content, tmp_path) == "is damaged: an array lies beyond its end"
    # Members of one gzip file follow each other.
    content = packed(*parts()) + 12 * gzip.compress(bytes(1 << 28), 9)
    assert len(content) < 4 << 20
    assert read_by_node(built, content, tmp_path) == "is larger than 128 MB"


def named(name: str) -> runtime.PortableAvatar:
    head = drawn_head(200, 0)
    return replace(head, about=replace(head.about, name=name))


def test_a_name_that_looks_like_a_mark_stays_a_name(tmp_path: Path) -> None:
    """It would take the place of the avatar, a thousand times. Longer names are refused."""
    name = "{{avatar}}{{webgpu}}" * 25
    plain = write_page(tmp_path / "plain.html", named("x" * len(name)))
    assert write_page(tmp_path / "page.html", named(name)).size < plain.size + 1000
    assert (tmp_path / "page.html").read_text().count(name) == TEMPLATE.read_text().count("{{title}}")
    with pytest.raises(UserError, match="a name in it has more than 1,000 characters"):
        runtime.write_portable(tmp_path / "a.mien", named("{{avatar}}" * 1000))


def test_code_is_marked_and_texts_are_escaped() -> None:
    assert with_code("run `mien <b>` & wait") == "run <code>mien &lt;b&gt;</code> &amp; wait"
    content = {"stage": "", "done": "", "seconds": "", "clock": "", "rows": [], "charts": []}
    page = render("tracking/report/templates/preview.html", refresh=None, name='"><script>', **content)
    assert not any(part in page for part in ("<script>", "http-equiv"))
    assert 'content="3"' in render("tracking/report/templates/preview.html", refresh="3", name="", **content)
