""".spz, .sog and USD files of Gaussians: round trips, other programs that open them, damage, and the command line."""

import gzip
import importlib.util
import math
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.camera import camera_from_fov
from mien.cli import main
from mien.errors import UserError
from mien.formats import in_world, read_ply, write_ply
from mien.formats.shared.world_space import with_y_down
from mien.formats.sog import cells_of, write_sog
from mien.formats.spz import write_spz
from mien.formats.usd import write_usd
from mien.gaussians import Gaussians
from mien.render import rasterize
from mien.rotation import multiply_quaternions
from needs import NO_PACKAGE, NO_SPLAT_TRANSFORM
from refusals import refuses
from shared_things import MadeOnce, toy_workspace
from splat_readers import read_sog, read_spz, read_usd
from web_case import WEB, node

WRITERS: dict[str, Callable[[Path, Gaussians], object]] = {
    ".ply": write_ply, ".spz": write_spz, "3.spz": partial(write_spz, version=3), ".sog": write_sog,
    ".usda": lambda path, gaussians: write_usd(path, [gaussians]),
}  # fmt: skip
SPLAT_TRANSFORM = WEB / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
HALF_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""From +y up, +z to the viewer, to +y down, +z away from the viewer, which is the frame of a capture's .ply."""
needs_usd = pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason=f"{NO_PACKAGE} 'pxr'")


def some(n: int, coefficients: int, seed: int = 0) -> Gaussians:
    """Return Gaussians of the size of a head, which lie more above, before and right of the origin than opposite."""
    random = partial(torch.randn, generator=torch.Generator().manual_seed(seed))
    sh = torch.cat([0.8 * random(n, 1, 3), 0.2 * random(n, coefficients - 1, 3)], dim=1)
    return Gaussians(
        means=0.08 * random(n, 3) + torch.tensor([0.03, 0.05, 0.07]), quats=random(n, 4),
        scales=(0.7 * random(n, 3) - 6).exp(), opacities=torch.sigmoid(2 * random(n)),
        sh=sh.clamp(-1, 1) if coefficients > 1 else sh.clamp(-3, 3),
    )  # fmt: skip


@dataclass(frozen=True)
class Loss:
    """Largest differences that a format may make; `color` is the first SH coefficient, and `higher` are the others.
    By default there are none. Rotations agree to float32: their angle is the arc cosine of a number next to 1, which
    has half of the digits."""

    meters: float = 0
    radians: float = 2e-3
    log_scale: float = 1e-6
    opacity: float = 0
    color: float = 0
    higher: float = 0


SPZ_LOSS = Loss(2**-17, 0.005, 1 / 32, 1 / 510, 1 / 0.15 / 510, 1 / 256)
SOG_LOSS = Loss(1e-5, 0.02, 0.03, 1 / 510, 0.02, 0.008)


def expect_near(found: Gaussians, expected: Gaussians, loss: Loss) -> None:
    assert found.sh.shape == expected.sh.shape
    turns, wanted = (torch.nn.functional.normalize(one.quats.double()) for one in (found, expected))
    # A half turn about an axis of its own does not change a Gaussian.
    same = [multiply_quaternions(wanted, half.expand_as(wanted)) for half in torch.eye(4, dtype=torch.float64)]
    cosines = torch.stack([(turns * one).sum(-1).abs() for one in same]).amax(0)
    differences = {
        "meters": found.means - expected.means, "radians": 2 * torch.arccos(cosines.clamp(max=1)),
        "log_scale": found.scales.log() - expected.scales.log(), "opacity": found.opacities - expected.opacities,
        "color": found.sh[:, 0] - expected.sh[:, 0], "higher": found.sh[:, 1:] - expected.sh[:, 1:],
    }  # fmt: skip
    for name, difference in differences.items():
        most = float(difference.abs().max()) if difference.numel() else 0.0
        assert most <= getattr(loss, name) + 1e-6, f"{name}: {most:.3g}"


def opened_elsewhere(path: Path, out: Path) -> Gaussians:
    if not SPLAT_TRANSFORM.is_file():
        pytest.skip(NO_SPLAT_TRANSFORM)
    subprocess.run([node(), str(SPLAT_TRANSFORM), "-w", str(path), str(out)], check=True, capture_output=True)
    return read_ply(out)


@pytest.mark.parametrize("coefficients", [1, 9, 16])
@pytest.mark.parametrize(
    ("ending", "read", "loss"),
    [(".ply", read_ply, Loss()), (".spz", read_spz, SPZ_LOSS), ("3.spz", read_spz, SPZ_LOSS),
     (".sog", read_sog, SOG_LOSS)],
)  # fmt: skip
def test_round_trip(tmp_path: Path, coefficients: int, ending: str, read, loss: Loss) -> None:
    written, a, b = some(1000, coefficients), tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    written.opacities[:2] = torch.tensor([0.0, 1.0])
    for path in (a, b):
        WRITERS[ending](path, written)
    expect_near(read(a), written, loss)
    assert a.read_bytes() == b.read_bytes()
    WRITERS[ending](b, written.select(torch.zeros(1000, dtype=torch.bool)))
    assert len(read(b)) == 0


@pytest.mark.parametrize("coefficients", [1, 16])
def test_half_a_turn_for_viewers_with_y_down_is_exact(coefficients: int) -> None:
    """A camera that turns as well sees the same picture, and the second half turn gives the same numbers."""
    gaussians, turn = some(80, coefficients), HALF_TURN
    turned = with_y_down(gaussians)
    assert torch.equal(turned.means, gaussians.means @ turn[:3, :3])
    again = with_y_down(turned)
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(again, name), getattr(gaussians, name))
    assert torch.equal(again.quats, -gaussians.quats), "the same rotation"
    viewmat = HALF_TURN.clone()
    viewmat[2, 3] = 0.6
    camera = camera_from_fov(0.6, 48, 40, viewmat)
    pairs = ((gaussians, camera), (turned, replace(camera, viewmat=viewmat @ turn)))
    with torch.no_grad():
        pictures = [rasterize(*pair, torch.ones(3), backend="reference").image for pair in pairs]
    assert float(pictures[0].std()) > 0.05
    torch.testing.assert_close(*pictures, atol=1e-5, rtol=0)


def test_the_command_turns_files_for_such_viewers(tmp_path: Path, made_once: MadeOnce) -> None:
    for ending, read in ((".ply", read_ply), (".sog", read_sog)):
        for name, *options in (("up",), ("down", "--y-down")):
            line = ["export", str(toy_workspace(made_once)), "--out", str(tmp_path / f"{name}{ending}"), *options]
            assert main(line) == 0
        up, down = (read(tmp_path / f"{name}{ending}").means for name in ("up", "down"))
        torch.testing.assert_close(down, up * torch.tensor([1, -1, -1]), atol=1e-5, rtol=0)


QUATS_IN_SPZ = {
    (1.0, 0.0, 0.0, 0.0): 3 << 30, (0.8, 0.6, 0.0, 0.0): 3 << 30 | 434 << 20,
    (0.8, 0.0, -0.6, 0.0): 3 << 30 | (1 << 9 | 434) << 10, (0.8, 0.0, 0.0, 0.6): 3 << 30 | 434,
    (0.0, 1.0, 0.0, 0.0): 0, (0.6, -0.8, 0.0, 0.0): 1 << 9 | 434, (0.0, 0.6, 0.0, 0.8): 2 << 30 | 434 << 20,
}  # fmt: skip
"""Quaternions wxyz, and their 32 bits in version 3 of .spz: the index of the largest component of xyzw, then the other
three in that order, a sign and 9 bits of size each, in steps of sqrt(1/2) / 511. 0.6 is 434 steps."""


def test_quaternions_lie_in_spz_as_its_specification_says(tmp_path: Path) -> None:
    """Writer and reader could swap components alike, which no round trip would see."""
    quats = torch.tensor(list(QUATS_IN_SPZ))
    write_spz(tmp_path / "a.spz", replace(some(len(quats), 1), quats=quats), version=3)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert np.frombuffer(content[-4 * len(quats) :], "<u4").tolist() == list(QUATS_IN_SPZ.values())
    same = (read_spz(tmp_path / "a.spz").quats * quats).sum(-1).abs()
    torch.testing.assert_close(same, torch.ones(len(quats)), atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("ending", "coefficients"), [(".spz", 1), ("3.spz", 4), (".spz", 16), (".sog", 1), (".sog", 16)]
)
def test_another_program_opens_them(tmp_path: Path, ending: str, coefficients: int) -> None:
    """It knows that .spz has +y up, and turns its .ply into the frame of captures."""
    written, path = some(1000, coefficients), tmp_path / f"a{ending}"
    WRITERS[ending](path, written)
    found = opened_elsewhere(path, tmp_path / "a.ply")
    if ending == ".sog":
        expect_near(found, written, SOG_LOSS)
        expect_near(found, read_sog(path), Loss(opacity=1e-6))
    else:
        found = in_world(replace(found, T_world_local=HALF_TURN))
        expect_near(found, written, SPZ_LOSS)
        expect_near(found, read_spz(path), Loss(color=1e-5, higher=1e-5, opacity=1e-6))


def test_far_positions_in_spz_are_coarser(tmp_path: Path) -> None:
    """Positions beyond 128 m take bits from behind the point; what no bits can hold is refused."""
    near, path = some(10, 1), tmp_path / "a.spz"
    for away, step in ((0, 2**-16), (100, 2**-16), (-100, 2**-16), (150, 2**-15), (1000, 2**-13), (-1000, 2**-13)):
        far = replace(near, means=near.means + away)
        write_spz(path, far)
        expect_near(read_spz(path), far, replace(SPZ_LOSS, meters=step / 2))
    for edge in (128 - 2**-16, 128 - 2**-17, 128, 2**23 - 1):  # the largest number of 24 bits, and beside it
        far = replace(near, means=torch.tensor([[edge, -edge, 0.0]]).repeat(10, 1))
        write_spz(path, far)
        torch.testing.assert_close(read_spz(path).means, far.means, rtol=0, atol=2**-16)
    for away in (1e9, -1e9):
        with pytest.raises(UserError, match=r"a\.spz: a Gaussian is 1e\+09 m away, too far for \.spz"):
            write_spz(path, replace(near, means=near.means + away))


def test_similar_gaussians_share_coefficients() -> None:
    rows = np.random.default_rng(0).standard_normal((1000, 3))
    cells = cells_of(rows, 64)
    assert set(np.bincount(cells)) == {15, 16}
    means = np.stack([rows[cells == cell].mean(0) for cell in range(64)])
    assert np.square(rows - means[cells]).mean() < 0.15
    np.testing.assert_array_equal(cells_of(rows, 1024), np.arange(1000))


@needs_usd
def test_usd_keeps_poses_and_follows_its_schema(tmp_path: Path) -> None:
    """USD's own checker finds nothing; the stage states frame, unit and time; values are those at each sample."""
    for ending, coefficients in (("usd", 1), ("usda", 4), ("usdc", 1), ("usdz", 4)):
        written = some(200, coefficients)
        assert write_usd(tmp_path / f"a.{ending}", [written]) == 1
        expect_near(read_usd(tmp_path / f"a.{ending}"), written, Loss())
    Usd, UsdGeom, UsdValidation, UsdVol = (
        importlib.import_module(f"pxr.{n}") for n in ("Usd", "UsdGeom", "UsdValidation", "UsdVol")
    )
    poses = [some(100, 4, seed) for seed in range(3)]
    for path in (tmp_path / "s.usda", tmp_path / "s.usdz"):  # a stage that was open once is not read again
        assert write_usd(path, iter(poses), 25.0) == 3
        stage = Usd.Stage.Open(str(path))
        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        faults = UsdValidation.ValidationContext(validators).Validate(stage)
        assert [fault.GetMessage() for fault in faults] == []
        assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 2, 25)
        assert stage.GetDefaultPrim().GetPath() == "/avatar"
        field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/avatar/gaussians"))
        known = set(field.GetPrim().GetPrimDefinition().GetPropertyNames())
        assert {attribute.GetName() for attribute in field.GetPrim().GetAuthoredProperties()} <= known
        assert field.GetPositionsAttr().GetTimeSamples() == [0, 1, 2]
        assert field.GetPositionsAttr().Get() is None, "without a time, there is no pose"
        assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
        quat = field.GetOrientationsAttr().Get(1)[5]
        expected = torch.nn.functional.normalize(poses[1].quats, dim=-1)[5]
        np.testing.assert_allclose([quat.GetReal(), *quat.GetImaginary()], expected, atol=1e-6)
        low, high = np.array(field.GetExtentAttr().Get(1))
        assert ((low <= poses[1].means.numpy()) & (poses[1].means.numpy() <= high)).all()
        for time, pose in enumerate(poses):
            expect_near(read_usd(path, float(time)), pose, Loss())


@needs_usd
def test_numbers_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    bad = some(5, 1)
    bad.means[3, 1] = math.nan
    for ending in (".ply", ".spz", ".sog", ".usda"):
        refuses("1 of 5 Gaussians are NaN or infinite", WRITERS[ending], tmp_path / f"a{ending}", bad)
    assert list(tmp_path.iterdir()) == []


@needs_usd
def test_export_writes_poses_and_sequences(tmp_path: Path, made_once: MadeOnce, capsys) -> None:
    """All formats have the same head: at the origin, +y up; and USD's samples are the files of a sequence."""
    workspace = str(toy_workspace(made_once))
    for ending in ("ply", "spz", "sog", "usdc"):
        assert main(["export", workspace, "--out", str(tmp_path / f"a.{ending}"), "--set", "drop=1"]) == 0
    pose = read_ply(tmp_path / "a.ply")
    expect_near(read_spz(tmp_path / "a.spz"), pose, SPZ_LOSS)
    expect_near(read_sog(tmp_path / "a.sog"), pose, SOG_LOSS)
    expect_near(read_usd(tmp_path / "a.usdc"), pose, Loss(opacity=1e-6))
    for ending in ("ply", "sog", "usdz"):
        out = str(tmp_path / f"s.{ending}")
        assert main(["export", workspace, "--out", out, "--series", "clip", "--every", "2"]) == 0
    files = sorted(tmp_path.glob("s_*.ply"))
    assert len(list(tmp_path.glob("s_*.sog"))) == len(files) > 1
    for index, file in enumerate(files):
        expect_near(read_usd(tmp_path / "s.usdz", float(index)), read_ply(file), Loss(opacity=1e-6))
    assert f"{len(files)} time samples" in capsys.readouterr().err
