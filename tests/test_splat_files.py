""".spz, .sog and USD files of Gaussians: round trips, other programs that open them, damage, and the command line."""

import gzip
import importlib.util
import json
import math
import struct
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard

from mien.cli import main
from mien.errors import UserError
from mien.export import in_world, read_ply, read_sog, read_spz, read_usd, write_ply, write_sog, write_spz, write_usd
from mien.export.sog import cells_of
from mien.gaussians import Gaussians
from mien.rotation import multiply_quaternions
from needs import NO_PACKAGE, NO_SPLAT_TRANSFORM
from shared_things import MadeOnce, toy_workspace
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
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    sh = torch.cat([0.8 * random(n, 1, 3), 0.2 * random(n, coefficients - 1, 3)], dim=1)
    return Gaussians(
        means=0.08 * random(n, 3) + torch.tensor([0.03, 0.05, 0.07]),
        quats=random(n, 4),
        scales=(0.7 * random(n, 3) - 6).exp(),
        opacities=torch.sigmoid(2 * random(n)),
        sh=sh.clamp(-1, 1) if coefficients > 1 else sh.clamp(-3, 3),
    )


@dataclass(frozen=True)
class Loss:
    """Largest differences that a format may make."""

    meters: float
    radians: float
    log_scale: float
    opacity: float
    color: float
    """Of the first SH coefficient."""
    higher: float
    """Of the other SH coefficients."""


SPZ_LOSS = Loss(2**-17, 0.005, 1 / 32, 1 / 510, 1 / 0.15 / 510, 1 / 256)
SOG_LOSS = Loss(1e-5, 0.02, 0.03, 1 / 510, 0.02, 0.008)
NO_LOSS = Loss(0, 2e-3, 1e-6, 0, 0, 0)
"""Rotations agree to float32. Their angle is the arc cosine of a number next to 1, which has half of the digits."""


def expect_near(found: Gaussians, expected: Gaussians, loss: Loss) -> None:
    slack = 1e-6
    assert found.sh.shape == expected.sh.shape
    turns, wanted = (torch.nn.functional.normalize(one.quats.double()) for one in (found, expected))
    # A half turn about an axis of its own does not change a Gaussian.
    same = [multiply_quaternions(wanted, half.expand_as(wanted)) for half in torch.eye(4, dtype=torch.float64)]
    cosines = torch.stack([(turns * one).sum(-1).abs() for one in same]).amax(0)
    differences = {
        "meters": found.means - expected.means,
        "radians": 2 * torch.arccos(cosines.clamp(max=1)),
        "log_scale": found.scales.log() - expected.scales.log(),
        "opacity": found.opacities - expected.opacities,
        "color": found.sh[:, 0] - expected.sh[:, 0],
        "higher": found.sh[:, 1:] - expected.sh[:, 1:],
    }
    for name, difference in differences.items():
        most = float(difference.abs().max()) if difference.numel() else 0.0
        assert most <= getattr(loss, name) + slack, f"{name}: {most:.3g}"


def opened_elsewhere(path: Path, out: Path) -> Gaussians:
    """Return what PlayCanvas' splat-transform, with Niantic's own reader of .spz, reads from a file."""
    if not SPLAT_TRANSFORM.is_file():
        pytest.skip(NO_SPLAT_TRANSFORM)
    subprocess.run([node(), str(SPLAT_TRANSFORM), "-w", str(path), str(out)], check=True, capture_output=True)
    return read_ply(out)


@pytest.mark.parametrize("coefficients", [1, 9, 16])
@pytest.mark.parametrize(
    ("ending", "read", "loss"),
    [(".ply", read_ply, NO_LOSS), (".spz", read_spz, SPZ_LOSS), ("3.spz", read_spz, SPZ_LOSS),
     (".sog", read_sog, SOG_LOSS)],
)  # fmt: skip
def test_round_trip(
    tmp_path: Path, coefficients: int, ending: str, read: Callable[[Path], Gaussians], loss: Loss
) -> None:
    written, write = some(1000, coefficients), WRITERS[ending]
    written.opacities[:2] = torch.tensor([0.0, 1.0])
    write(tmp_path / f"a{ending}", written)
    expect_near(read(tmp_path / f"a{ending}"), written, loss)
    write(tmp_path / f"b{ending}", written)
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()
    none = written.select(torch.zeros(1000, dtype=torch.bool))
    write(tmp_path / f"none{ending}", none)
    assert len(read(tmp_path / f"none{ending}")) == 0


QUATS_IN_SPZ = {
    (1.0, 0.0, 0.0, 0.0): 3 << 30,
    (0.8, 0.6, 0.0, 0.0): 3 << 30 | 434 << 20,
    (0.8, 0.0, -0.6, 0.0): 3 << 30 | (1 << 9 | 434) << 10,
    (0.8, 0.0, 0.0, 0.6): 3 << 30 | 434,
    (0.0, 1.0, 0.0, 0.0): 0,
    (0.6, -0.8, 0.0, 0.0): 1 << 9 | 434,
    (0.0, 0.6, 0.0, 0.8): 2 << 30 | 434 << 20,
}
"""Quaternions wxyz, and their 32 bits in version 3 of .spz: the index of the largest component of xyzw, then the other
three in that order, a sign and 9 bits of size each, in steps of sqrt(1/2) / 511. 0.6 is 434 steps."""


def test_quaternions_lie_in_spz_in_the_order_of_its_specification(tmp_path: Path) -> None:
    """Writer and reader could swap components alike, which no round trip would see."""
    one = replace(some(len(QUATS_IN_SPZ), 1), quats=torch.tensor(list(QUATS_IN_SPZ)))
    write_spz(tmp_path / "a.spz", one, version=3)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    words = np.frombuffer(content[-4 * len(one) :], "<u4")
    assert [f"{word:032b}" for word in words.tolist()] == [f"{word:032b}" for word in QUATS_IN_SPZ.values()]
    found = read_spz(tmp_path / "a.spz").quats
    same = (found * torch.tensor(list(QUATS_IN_SPZ))).sum(-1).abs()
    torch.testing.assert_close(same, torch.ones(len(one)), atol=1e-4, rtol=0)


@pytest.mark.parametrize("case", [(".spz", 1), ("3.spz", 4), (".spz", 16), (".sog", 1), (".sog", 16)])
def test_another_program_opens_them(tmp_path: Path, case: tuple[str, int]) -> None:
    """It knows that .spz has +y up, and turns its .ply into the frame of captures."""
    ending, coefficients = case
    written, path = some(1000, coefficients), tmp_path / f"a{ending}"
    WRITERS[ending](path, written)
    found = opened_elsewhere(path, tmp_path / "a.ply")
    if ending == ".sog":
        expect_near(found, written, SOG_LOSS)
        expect_near(found, read_sog(path), replace(NO_LOSS, opacity=1e-6))
    else:
        found = in_world(replace(found, T_world_local=HALF_TURN))
        expect_near(found, written, SPZ_LOSS)
        expect_near(found, read_spz(path), replace(NO_LOSS, color=1e-5, higher=1e-5, opacity=1e-6))


def test_far_positions_in_spz_are_coarser(tmp_path: Path) -> None:
    """Positions beyond 128 m take bits from behind the point; what no bits can hold is refused."""
    near = some(10, 1)
    far = replace(near, means=near.means + 1000)
    write_spz(tmp_path / "a.spz", far)
    expect_near(read_spz(tmp_path / "a.spz"), far, replace(SPZ_LOSS, meters=2**-13))
    with pytest.raises(UserError, match=r"a\.spz: a Gaussian is 1e\+09 m away, too far for \.spz"):
        write_spz(tmp_path / "a.spz", replace(near, means=near.means + 1e9))


def test_similar_gaussians_share_coefficients() -> None:
    """Cells are as many as allowed, about equally full, and small."""
    rows = np.random.default_rng(0).standard_normal((1000, 3))
    cells = cells_of(rows, 64)
    counts = np.bincount(cells)
    assert len(counts) == 64
    assert counts.min() >= 15
    assert counts.max() <= 16
    means = np.stack([rows[cells == cell].mean(0) for cell in range(64)])
    assert np.square(rows - means[cells]).mean() < 0.15
    np.testing.assert_array_equal(cells_of(rows, 1024), np.arange(1000))


@needs_usd
@pytest.mark.parametrize(("ending", "coefficients"), [("usd", 1), ("usda", 4), ("usdc", 1), ("usdz", 4)])
def test_usd_keeps_a_pose(tmp_path: Path, ending: str, coefficients: int) -> None:
    written = some(200, coefficients)
    assert write_usd(tmp_path / f"a.{ending}", [written]) == 1
    expect_near(read_usd(tmp_path / f"a.{ending}"), written, NO_LOSS)


@needs_usd
def test_usd_follows_its_schema(tmp_path: Path) -> None:
    """USD's own checker finds nothing; the stage states frame, unit and time; values are those at each sample."""
    Usd, UsdGeom, UsdValidation, UsdVol = (
        importlib.import_module(f"pxr.{n}") for n in ("Usd", "UsdGeom", "UsdValidation", "UsdVol")
    )
    poses = [some(100, 4, seed) for seed in range(3)]
    for path in (tmp_path / "a.usda", tmp_path / "a.usdz"):
        assert write_usd(path, iter(poses), 25.0) == 3
        stage = Usd.Stage.Open(str(path))
        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        faults = UsdValidation.ValidationContext(validators).Validate(stage)
        assert [fault.GetMessage() for fault in faults] == []
        assert UsdGeom.GetStageUpAxis(stage) == "Y"
        assert UsdGeom.GetStageMetersPerUnit(stage) == 1
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 2, 25)
        assert stage.GetDefaultPrim().GetPath() == "/avatar"
        field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/avatar/gaussians"))
        known = set(field.GetPrim().GetPrimDefinition().GetPropertyNames())
        assert {attribute.GetName() for attribute in field.GetPrim().GetAuthoredProperties()} <= known
        assert field.GetPositionsAttr().GetTimeSamples() == [0, 1, 2]
        assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
        quat = field.GetOrientationsAttr().Get(1)[5]
        expected = torch.nn.functional.normalize(poses[1].quats, dim=-1)[5].tolist()
        np.testing.assert_allclose([quat.GetReal(), *quat.GetImaginary()], expected, atol=1e-6)
        box = field.GetExtentAttr().Get(1)
        assert (np.array(box)[0] <= poses[1].means.amin(0).numpy()).all()
        assert (np.array(box)[1] >= poses[1].means.amax(0).numpy()).all()
        for time, pose in enumerate(poses):
            expect_near(read_usd(path, float(time)), pose, NO_LOSS)
    with pytest.raises(UserError, match="has no Gaussians at time None"):
        read_usd(tmp_path / "a.usda")


@pytest.mark.parametrize("ending", [".spz", ".sog", ".usda"])
def test_numbers_that_are_not_finite_are_refused(tmp_path: Path, ending: str) -> None:
    if ending == ".usda":
        pytest.importorskip("pxr")
    good = some(5, 1)
    bad = good.means.clone()
    bad[3, 1] = math.nan
    with pytest.raises(UserError, match="1 of 5 Gaussians are NaN or infinite"):
        WRITERS[ending](tmp_path / f"a{ending}", replace(good, means=bad))
    assert list(tmp_path.iterdir()) == []


def test_damaged_spz_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write_spz(path, some(50, 4), version=3)
    content = path.read_bytes()
    plain = gzip.decompress(content)
    many = plain[:8] + (2**31).to_bytes(4, "little") + plain[12:]
    for damaged in (b"", b"ply", content[:100], gzip.compress(plain[:-9]), gzip.compress(plain[:10])):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"a\.spz: cannot be read as \.spz"):
            read_spz(path)
    for changed, reason in ((many, "at most 2,000,000 are read"), (plain[:4] + b"\x09" + plain[5:], "another version")):
        path.write_bytes(gzip.compress(changed))
        with pytest.raises(UserError, match=reason):
            read_spz(path)
    with pytest.raises(UserError, match="No such file"):
        read_spz(tmp_path / "gone.spz")


def test_damaged_spz_of_version_4_is_refused(tmp_path: Path) -> None:
    """A table that lies, a stream that unpacks to more than its place, and what is cut off."""
    path = tmp_path / "a.spz"
    write_spz(path, some(50, 4))
    content = path.read_bytes()
    assert struct.unpack_from("<4sII4B", content) == (b"NGSP", 4, 50, 1, content[13], 0, 6)
    many = content[:8] + (2**31).to_bytes(4, "little") + content[12:]
    first = struct.unpack_from("<Q", content, 32)[0]
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 26))
    long = content[:32] + struct.pack("<Q", len(bomb)) + content[40:128] + bomb + content[128 + first :]
    cases = (
        (content[:20], "cannot be read as"),
        (content[:-1], "truncated, or a column has another size"),
        (content[:4] + b"\x05" + content[5:], "of another version"),
        (content[:15] + b"\x05" + content[16:], "its table is damaged"),
        (content[:16] + b"\x10" + content[17:], "its table is damaged"),
        (content[:40] + b"\xff" * 8 + content[48:], "a column has another size"),
        (content[:130] + b"\xff" * 8 + content[138:], "cannot be read as"),
        (many, "at most 2,000,000 are read"),
        (long, "a column has another size"),
    )
    for damaged, reason in cases:
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=reason):
            read_spz(path)


def test_damaged_sog_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    write_sog(path, some(50, 4))
    content = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(members["meta.json"])

    def changed(**parts: object) -> dict[str, bytes]:
        return members | {"meta.json": json.dumps(meta | parts).encode()}

    assert list(members)[0] == "meta.json"
    for damaged in (b"", b"PK", content[:200]):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"a\.sog: cannot be read as \.sog"):
            read_sog(path)
    for parts in (
        {"meta.json": b"{}"},
        {"meta.json": b"[1]"},
        members | {"quats.webp": b"RIFF"},
        members | {"quats.webp": members["sh0.webp"]},
        changed(version=1),
        changed(count=51_000),
        changed(count=-1),
        changed(count="9"),
        changed(means={**meta["means"], "files": ["../a", "b"]}),
        changed(means={**meta["means"], "mins": [1, 2]}),
        changed(scales={**meta["scales"], "codebook": []}),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in parts.items():
                archive.writestr(name, data)
        with pytest.raises(UserError, match=r"a\.sog: cannot be read as \.sog"):
            read_sog(path)


@needs_usd
def test_damaged_usd_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    (tmp_path / "b.usda").write_text("solid cube")
    for name in ("a.usda", "b.usda", "gone.usda"):
        with pytest.raises(UserError, match=f"{name}: is missing, damaged, or has no Gaussians"):
            read_usd(tmp_path / name)


@needs_usd
def test_export_writes_poses_and_sequences(
    tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]
) -> None:
    """All formats have the same head: at the origin, +y up; and USD's samples are the files of a sequence."""
    workspace = str(toy_workspace(made_once))
    for ending in ("ply", "spz", "sog", "usdc"):
        assert main(["export", workspace, "--out", str(tmp_path / f"a.{ending}"), "--set", "drop=1"]) == 0
    pose = read_ply(tmp_path / "a.ply")
    expect_near(read_spz(tmp_path / "a.spz"), pose, SPZ_LOSS)
    expect_near(read_sog(tmp_path / "a.sog"), pose, SOG_LOSS)
    expect_near(read_usd(tmp_path / "a.usdc"), pose, replace(NO_LOSS, opacity=1e-6))
    for ending in ("ply", "sog", "usdz"):
        out = str(tmp_path / f"s.{ending}")
        assert main(["export", workspace, "--out", out, "--series", "clip", "--every", "2"]) == 0
    files = sorted(tmp_path.glob("s_*.ply"))
    assert len(files) > 1
    assert len(sorted(tmp_path.glob("s_*.sog"))) == len(files)
    for index, file in enumerate(files):
        expect_near(read_usd(tmp_path / "s.usdz", float(index)), read_ply(file), replace(NO_LOSS, opacity=1e-6))
    assert f"{len(files)} time samples" in capsys.readouterr().err


def test_missing_usd_core_has_a_remedy(
    tmp_path: Path, made_once: MadeOnce, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = str(toy_workspace(made_once))
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "pxr" else found(name, *rest))
    assert main(["export", workspace, "--out", str(tmp_path / "a.usda")]) == 2
    assert "needs the package usd-core, which is missing; run `pip install 'mien[usd]'`" in capsys.readouterr().err
