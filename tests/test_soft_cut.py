"""The soft cut: opacities fade towards the neck cut, and the head itself stays as it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import GaussianAvatars, make_portable
from mien.cli import main
from mien.commands.stages.exporting import RunContent
from mien.commands.stages.pictures import posed_softly
from mien.export import write_packed
from mien.face import FaceModel, load_face_model
from mien.gaussians import world_means
from mien.runtime import MeshBound
from mien.tracking import NeckParts, fit_neck_cut
from mien.training.whole_head import with_soft_cut
from mien.training.whole_head.constants import WHOLE_HEAD
from mien.training.whole_head.soft_cut import opacity_shares
from mien.workspace import open_workspace
from plain_settings import plain_gaussian_avatars
from toy_scene import toy_camera
from toy_workspace import write_toy_workspace


@pytest.fixture(scope="module")
def model() -> FaceModel:
    return load_face_model("anny")


@pytest.fixture(scope="module")
def avatar(model: FaceModel) -> GaussianAvatars:
    rest = model.neutral()
    return GaussianAvatars(
        plain_gaussian_avatars(), model, replace(rest, head_translation=torch.tensor([[0, 0, -0.9]]))
    )


def opacities(portable: runtime.PortableAvatar) -> np.ndarray:
    assert isinstance(portable.baked, MeshBound)
    return 1 / (1 + np.exp(-portable.baked.attributes.opacity_logits.astype(np.float64)))


def test_what_is_far_from_the_cut_keeps_its_bytes_and_the_end_of_the_neck_is_clear(
    model: FaceModel, avatar: GaussianAvatars
) -> None:
    before = make_portable(avatar, toy_camera(64), "soft")
    after = with_soft_cut(before, avatar)
    assert isinstance(before.baked, MeshBound)
    neck = model.region_mask("neck").numpy()[before.baked.face_index]
    was, now = opacities(before), opacities(after)
    np.testing.assert_array_equal(now[~neck], was[~neck])
    vertices = model(avatar.subject)[0]
    cut = fit_neck_cut(NeckParts.of(model), vertices, torch.tensor([0.0, 1.0, 0.0]))
    margins = cut.margins(world_means(avatar.pose(avatar.subject).gaussians.timestep(0)).detach()).numpy()
    below, between = margins < 0, (margins > 0) & (margins < WHOLE_HEAD.soft_cut_width) & neck
    far = neck & below & (margins < -WHOLE_HEAD.soft_cut_head[1])
    assert far.any()
    assert (now[far] <= 1.01 * WHOLE_HEAD.soft_cut_least).all()
    assert between.any()
    assert (now[between] <= was[between]).all()
    assert (now[between] < 0.9 * was[between]).any()


def test_pictures_end_as_softly_as_files(avatar: GaussianAvatars) -> None:
    soft, sharp = posed_softly(avatar)(avatar.subject), avatar.pose(avatar.subject).gaussians.timestep(0)
    shown = opacities(with_soft_cut(make_portable(avatar, toy_camera(64), "soft"), avatar))
    np.testing.assert_allclose(soft.opacities.numpy(), shown, atol=WHOLE_HEAD.soft_cut_least + 1e-6)
    assert torch.equal(soft.means, sharp.means)
    assert float((soft.opacities / sharp.opacities.detach()).min()) < 0.01


def test_shares_grow_with_the_distance_from_the_cut(model: FaceModel) -> None:
    vertices = model.template
    cut = fit_neck_cut(NeckParts.of(model), vertices, torch.tensor([0.0, 1.0, 0.0]))
    origin, up = (torch.from_numpy(each).float() for each in (cut.origin, cut.axes[2]))
    points = origin + torch.linspace(-0.02, 0.05, 15)[:, None] * up
    far = torch.full((1, 3), 10.0)
    shares = opacity_shares(points, cut, far, points)
    assert (shares.diff() >= 0).all()
    assert (float(shares[0]), float(shares[-1])) == (0.0, 1.0)
    assert ((shares > 0.1) & (shares < 0.9)).any()
    assert (opacity_shares(points, cut, points, points) == 1).all(), "what lies on the head is not cut off"


def test_what_stands_off_the_skin_goes_just_above_the_cut_alone(model: FaceModel) -> None:
    """Shards of a collar go, and hair beside the upper neck stays."""
    cut = fit_neck_cut(NeckParts.of(model), model.template, torch.tensor([0.0, 1.0, 0.0]))
    origin, side, up = (torch.from_numpy(each).float() for each in (cut.origin, cut.axes[0], cut.axes[2]))
    far, gap = torch.full((1, 3), 10.0), WHOLE_HEAD.soft_cut_off_skin[1] + 1e-3
    low, high = WHOLE_HEAD.soft_cut_collar
    skin = origin + torch.tensor([0.95 * low, 1.1 * high])[:, None] * up
    on_skin, off_skin = (opacity_shares(skin + away * side, cut, far, skin) for away in (0.0, gap))
    assert (on_skin > 0.7).all()
    assert off_skin[0] == 0
    assert off_skin[1] == on_skin[1] == 1


@pytest.mark.unchecked
def test_pages_and_files_have_the_soft_cut_unless_it_is_declined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_toy_workspace(tmp_path / "me")
    content = RunContent(open_workspace(tmp_path / "me"), "toy")
    for name, options, soft in (("soft", (), True), ("sharp", ("--sharp-cut",), False)):
        out, direct = tmp_path / f"{name}.packed", tmp_path / f"{name}_direct.packed"
        assert main(["export", str(tmp_path / "me"), "--out", str(out), *options]) == 0
        write_packed(direct, content.portable(confidence=False, soft_cut=soft))
        assert out.read_bytes() == direct.read_bytes()
        # Whatever is made of a file later ends as the file does.
        assert main(["export", str(tmp_path / "me"), "--out", str(tmp_path / f"{name}.mien"), *options]) == 0
        written, expected = (
            each.baked for each in (runtime.load(tmp_path / f"{name}.mien").portable, content.portable(soft_cut=soft))
        )
        assert isinstance(written, MeshBound)
        assert isinstance(expected, MeshBound)
        np.testing.assert_array_equal(written.attributes.opacity_logits, expected.attributes.opacity_logits)
    assert (tmp_path / "soft.packed").read_bytes() != (tmp_path / "sharp.packed").read_bytes()
    capsys.readouterr()
    assert main(["export", str(tmp_path / "me"), "--out", str(tmp_path / "a.ply"), "--sharp-cut"]) == 2
    assert "leave --sharp-cut out" in capsys.readouterr().err
