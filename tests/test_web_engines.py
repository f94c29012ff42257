"""Avatars in scenes of three.js, Spark, PlayCanvas and Babylon.js, and the arrays of Gaussians that they get."""

import gzip
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import web_case as web
from mien import runtime
from mien.formats.glb import write_glb
from mien.formats.page import write_packed
from mien.rotation import matrix_from_axis_angle, matrix_from_quaternion
from test_glb import mesh_model
from test_web import points
from web_case import WEB, drawn_head, faces_of, package, painted_head

ENGINES = {"three": "three", "spark": "@sparkjsdev/spark", "playcanvas": "playcanvas", "babylon": "@babylonjs/core"}
SPEC = WEB.parent / "docs" / "spec"
TURN = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
"""A rotation of the object that no axis shares."""
PLACE, SIZE, EYE = np.array([0.1, -0.2, 0.3], np.float32), np.float32(1.5), (0.3, 0.2, 1.0)


def matrices(quats: np.ndarray) -> np.ndarray:
    """Return rotation matrices of quaternions wxyz."""
    return matrix_from_quaternion(torch.from_numpy(np.ascontiguousarray(quats, np.float32))).numpy()


@pytest.mark.parametrize("simd", [True, False])
@pytest.mark.parametrize(
    ("head", "equal", "coarse"),
    [(lambda: drawn_head(300, 3), 2e-5, 2e-5), (lambda: drawn_head(300, sh=4, sh_frame="world"), 2e-5, 2e-5),
     (lambda: drawn_head(301, 5, columns=2, features=16), 2e-5, 1e-2), (lambda: painted_head(99), 1e-4, 6e-3),
     (lambda: points(100)["points, softplus"], 1e-3, 1e-3)],
)  # fmt: skip
def test_arrays_have_the_gaussians_of_python(
    built: Path, tmp_path: Path, head, equal: float, coarse: float, simd: bool
) -> None:
    """All five arrays, in a place of the scene, for any record. With WebAssembly, bases of features have 8 bits."""
    equal = coarse if simd else equal
    portable = web.stored(tmp_path / "a.packed", head())
    (face,) = faces_of(portable, 1)
    posed = runtime.pose(portable.baked, face)
    transform = np.eye(4, dtype=np.float32)
    transform[:3, :3], transform[:3, 3] = SIZE * TURN, PLACE
    told = web.run_node(
        "gaussians.mjs",
        built,
        tmp_path / "a.packed",
        web.as_json([face])[0],
        transform.T.reshape(-1).tolist(),
        EYE,
        simd,
    )
    n = len(posed.opacities)
    centres, covariances, rotations, scales, colors = (np.array(part, np.float32).reshape(n, -1) for part in told)
    # Python poses some records in the world: this takes them back to the head.
    local = np.linalg.inv(head_of(face) if is_world(portable) else np.eye(4)).astype(np.float32)
    means = posed.means @ local[:3, :3].T + local[:3, 3]
    turns = TURN @ local[:3, :3] @ matrices(posed.quats)
    np.testing.assert_allclose(centres, SIZE * means @ TURN.T + PLACE, rtol=0, atol=2e-5)
    np.testing.assert_allclose(scales, SIZE * posed.scales, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(matrices(rotations[:, [3, 0, 1, 2]]), turns, rtol=0, atol=2e-3)
    expected = np.einsum("nij,nj,nkj->nik", turns, (SIZE * posed.scales) ** 2, turns)
    upper = expected[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(covariances, upper, rtol=0, atol=2e-3 * np.abs(upper).max())
    np.testing.assert_allclose(colors[:, 3], posed.opacities, rtol=0, atol=equal)
    seen = TURN.T @ (np.array(EYE, np.float32) - PLACE) / SIZE
    np.testing.assert_allclose(colors[:, :3], seen_colors(posed.sh, means - seen, local), rtol=0, atol=2 * equal)


def is_world(portable: runtime.PortableAvatar) -> bool:
    return isinstance(portable.baked, runtime.MeshBound) and portable.baked.sh_frame == "world"


def head_of(face: runtime.Face) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = matrix_from_axis_angle(torch.from_numpy(face.head_rotation)).numpy()
    T[:3, 3] = face.head_translation
    return T


def seen_colors(sh: np.ndarray, directions: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Return colours along directions of the head frame."""
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True) @ local[:3, :3]).T[:, :, None]
    color = 0.5 + 0.28209479177387814 * sh[:, 0]
    if sh.shape[1] > 1:
        color = color + 0.4886025119029199 * (-y * sh[:, 1] + z * sh[:, 2] - x * sh[:, 3])
    return color.clip(0)


def test_adapters_are_small(built: Path) -> None:
    for engine in ENGINES:
        assert len(gzip.compress((built / f"{engine}.js").read_bytes(), 9)) <= 4000
        assert (WEB / "src" / f"{engine}.ts").read_text().count("\n") <= 200


def write_set(folder: Path) -> None:
    options = ["--gaussians", "3000", "--side", "160", "--faces", "2", "--people", "2"]
    made = [sys.executable, str(WEB / "conformance" / "make.py"), "--out", str(folder / "set"), *options]
    subprocess.run(made, check=True, capture_output=True)


@pytest.fixture(scope="module")
def site(built: Path, made_once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the conformance page, with a set of few small pictures."""
    folder = Path(
        shutil.copytree(made_once("conformance", write_set), tmp_path_factory.mktemp("site"), dirs_exist_ok=True)
    )
    shutil.copy(WEB / "conformance" / "index.html", folder)
    for name in (*(name for name, needed in ENGINES.items() if package(needed)), "run"):
        bundled(built, WEB / "conformance" / f"{name}.js", folder / "built" / f"{name}.js")
    return folder


def bundled(built: Path, source: Path, out: Path) -> None:
    names = ("motion", "gaussians", *ENGINES)
    aliases = [f"--alias:mien-web/{name}={built / name}.js" for name in names]
    web.bundle(source, out, f"--alias:mien-web={built / 'mien.js'}", *aliases)


END = """
while (!window.rows && !window.failed) await new Promise((done) => setTimeout(done, 100));
return window.rows ?? window.failed;
"""


@pytest.mark.unchecked
@pytest.mark.parametrize("engine", ENGINES)
def test_the_conformance_page_passes(site: Path, engine: str) -> None:
    """Faces, a box before and behind the head, two avatars, and what an object of a scene does."""
    with web.served(site) as address:
        told = web.browse(f"{address}/index.html?engine={engine}", [web.script(END)], size=(400, 600))
    (rows,) = told["results"]
    assert isinstance(rows, list), rows
    assert len(rows) == 2 * 2 + 2 + 1 + 5
    assert [row for row in rows if not row["passed"]] == []


def test_the_lines_of_the_docs_show_an_avatar(built: Path, site: Path) -> None:
    """The five lines of each engine run in a scene of the conformance page."""
    blocks = re.findall(r"```js\n(const stage.*?)```", (WEB.parent / "docs" / "web.md").read_text(), re.DOTALL)
    assert [block.count("\n") for block in blocks] == [5] * 4
    write_packed(site / "few.packed", drawn_head(300))
    folder = WEB / "conformance"
    shutil.copy(folder / "three_scene.js", site)
    shown = """
      const {{ open }} = await import("./five/{engine}.js"), canvas = document.querySelector("canvas");
      canvas.width = canvas.height = 100;
      const host = await open(canvas, [1, 1, 1]);
      host.look([0, 1.6, 0.9], [0, 1.6, 0], 25);
      const ada = await host.five(new Uint8Array(await (await fetch("few.packed")).arrayBuffer()));
      for (let i = 0; i < 6; ++i) await new Promise(requestAnimationFrame);
      return [await host.draw(), ada.face.expression.some((x, k) => x !== ada.avatar.neutral.expression[k])];
    """
    steps = []
    for engine, block in zip(ENGINES, blocks, strict=True):
        source = (folder / f"{engine}.js").read_text()
        five = f"  return {{\n    async five(file) {{\n{block}\n      return ada;\n    }},\n"
        text = 'import { readAny } from "mien-web";\n' + source.replace("  return {\n", five, 1)
        (site / f"{engine}.five.js").write_text(text)
        bundled(built, site / f"{engine}.five.js", site / "five" / f"{engine}.js")
        steps.append(web.script(shown.format(engine=engine)))
    with web.served(site) as address:
        told = [web.browse(f"{address}/index.html", [step], size=(300, 300)) for step in steps]
    for engine, one in zip(ENGINES, told, strict=True):
        ((picture, smiles),) = one["results"]
        assert smiles, engine
        assert (web.picture(picture)[..., :3].std(-1) > 0.02).mean() > 0.1, f"{engine}: colours are seen"


@pytest.mark.parametrize("engine", ENGINES)
def test_the_room_of_each_engine_runs(built: Path, site: Path, engine: str) -> None:
    folder = site / f"room_{engine}"
    folder.mkdir()
    example = WEB / "examples" / engine
    bundled(built, example / "main.js", folder / "main.bundle.js")
    shutil.copy(example / "index.html", folder)
    write_packed(folder / "me.packed", drawn_head(300))
    wait = """
      while (!window.made) await new Promise((done) => setTimeout(done, 50));
      const { left, right, cube, stage } = made;
      left.setFace({ smile: 1 });
      for (let i = 0; i < 5; ++i) await new Promise(requestAnimationFrame);
      return [stage.avatars.length, left.changed, document.querySelectorAll("canvas").length];
    """
    with web.served(folder) as address:
        told = web.browse(address, [web.script(wait)], size=(240, 160))
    assert told["results"] == [[2, False, 1]]
    assert [message for message in told["messages"] if "Error" in message] == []


def test_the_reference_of_the_spec_poses_as_python(tmp_path: Path) -> None:
    """Centres, covariances, colours and opacities of a .glb, by 141 lines that share no code with the package."""
    portable = drawn_head(200, 5, columns=2, features=16)
    write_glb(tmp_path / "a.glb", portable, mesh_model(portable), 64)
    (face,) = faces_of(portable, 1)
    told = web.run_node("reference.mjs", SPEC / "reference.mjs", tmp_path / "a.glb", web.as_json([face])[0])
    posed = runtime.pose(portable.baked, face)
    R = matrices(posed.quats)
    expected = np.einsum("nij,nj,nkj->nik", R, posed.scales**2, R).reshape(-1, 9)
    centres, covariances, colors, opacities = (np.array(part) for part in told["gaussians"])
    np.testing.assert_allclose(centres, posed.means, rtol=0, atol=1e-5)
    np.testing.assert_allclose(covariances, expected, rtol=0, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(colors, (0.5 + 0.28209479177387814 * posed.sh[:, 0]).clip(0), rtol=0, atol=1e-4)
    np.testing.assert_allclose(opacities, posed.opacities, rtol=0, atol=1e-4)
    assert (SPEC / "reference.mjs").read_text().count("\n") <= 150
    schema = json.loads((SPEC / "EXT_gaussian_avatar.schema.json").read_text())
    assert faults(schema, told["extension"], schema) == []
    broken = told["extension"] | {"tensors": {"baked.means": {"dtype": "float64", "shape": [-1]}}}
    assert len(faults(schema, broken, schema)) == 2


def faults(schema: dict, value: object, root: dict, at: str = "") -> list[str]:
    """Return the places of a value that a schema refuses, by those words of JSON schema that ours has."""
    if "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rpartition("/")[2]]
    kinds = {"object": dict, "array": list, "string": str, "integer": int}
    if "const" in schema or "enum" in schema:
        return [] if value in schema.get("enum", [schema.get("const")]) else [at]
    if not isinstance(value, kinds.get(schema.get("type", ""), object)):
        return [at]
    found = [at] if isinstance(value, int) and value < schema.get("minimum", value) else []
    if isinstance(value, dict):
        found += [f"{at}/{name}" for name in schema.get("required", []) if name not in value]
        for name, part in value.items():
            more = schema.get("additionalProperties", {})
            found += faults(
                schema.get("properties", {}).get(name, {} if more is True else more), part, root, f"{at}/{name}"
            )
    elif isinstance(value, list):
        found += [fault for part in value for fault in faults(schema.get("items", {}), part, root, at)]
    return found
