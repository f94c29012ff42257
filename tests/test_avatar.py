"""GaussianAvatars' formulas, and avatars on disk."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from damage import edit_json
from mien.avatar import GaussianAvatars, GaussianAvatarsConfig, Progress, load_avatar, read_baked, write_avatar
from mien.errors import UserError
from mien.face import FaceModel
from mien.gaussians import rgb_from_sh, world_means
from mien.render import rasterize
from mien.render.rendering import Rendering
from toy_scene import toy_camera, toy_face, toy_face_model


def new_avatar(config: GaussianAvatarsConfig | None = None, face_model: FaceModel | None = None) -> GaussianAvatars:
    torch.manual_seed(0)
    return GaussianAvatars(config or GaussianAvatarsConfig(), face_model or toy_face_model(), toy_face(5))


def rendering_of(radii: torch.Tensor) -> Rendering:
    return Rendering(torch.zeros(4, 4, 3), torch.zeros(4, 4), radii.int(), torch.zeros(len(radii), 2))


def test_starts_with_one_grey_faint_gaussian_a_triangle() -> None:
    avatar = new_avatar()
    face_model = avatar.face_model
    gaussians = avatar.pose(toy_face(5)).gaussians
    assert len(gaussians) == len(face_model.faces)
    centroids = face_model(toy_face(5))[:, face_model.faces].mean(-2)
    torch.testing.assert_close(world_means(gaussians), centroids, atol=1e-6, rtol=0)
    torch.testing.assert_close(gaussians.opacities, torch.full((len(gaussians),), 0.1))
    assert (rgb_from_sh(gaussians.sh) - 0.5).abs().max() < 0.002


def test_losses_are_those_of_the_paper() -> None:
    avatar = new_avatar()
    store, n = avatar.store, len(avatar.store)
    with torch.no_grad():
        store["means"].zero_()
        store["means"][0] = torch.tensor([0.0, 3.0, 4.0])
        store["means"][1] = torch.tensor([0.0, 0.0, 0.9])
        store["means"][2] = torch.tensor([100.0, 0.0, 0.0])
        store["log_scales"].fill_(-3)
        store["log_scales"][0] = torch.tensor([0.6 + 3.0, 0.6 + 4.0, 0.5]).log()
        store["log_scales"][2] = 10
    radii = torch.ones(n)
    radii[2] = 0
    losses = avatar.regularizers(avatar.pose(toy_face(5)[0]), rendering_of(radii), Progress(0, 1))
    # Means over the n - 1 visible Gaussians; the third, which is out of bounds, is not in view.
    assert losses["position"].item() == pytest.approx(0.01 * (5 - 1) / (n - 1), rel=1e-5)
    assert losses["scale"].item() == pytest.approx(1.0 * 5 / (n - 1), rel=1e-5)


def test_losses_are_finite_when_nothing_is_in_view() -> None:
    avatar = new_avatar()
    losses = avatar.regularizers(
        avatar.pose(toy_face(5)[0]), rendering_of(torch.zeros(len(avatar.store))), Progress(0, 1)
    )
    assert [loss.item() for loss in losses.values()] == [0, 0]


def test_sh_degrees_are_switched_on_one_after_the_other() -> None:
    avatar = new_avatar(GaussianAvatarsConfig(sh_degree=3, sh_warmup=0.4))
    counts = [
        avatar.pose(toy_face(5)[0], Progress(step, 100)).gaussians.sh.shape[-2] for step in (0, 9, 10, 20, 31, 99)
    ]
    assert counts == [1, 1, 4, 9, 16, 16]
    assert avatar.pose(toy_face(5)[0]).gaussians.sh.shape[-2] == 16


def test_head_frame_sees_the_same_picture_but_for_the_light() -> None:
    world, head = (new_avatar(GaussianAvatarsConfig(sh_frame=frame)) for frame in ("world", "head"))
    face = toy_face(5)[1]
    pictures = [
        rasterize(a.pose(face).gaussians.timestep(0), toy_camera(32), torch.ones(3)).image for a in (world, head)
    ]
    torch.testing.assert_close(*pictures, atol=2e-4, rtol=0)


def test_subject_keeps_identity_and_offsets() -> None:
    face = replace(toy_face(5), vertex_offsets=torch.full((len(toy_face_model().template), 3), 0.001))
    avatar = GaussianAvatars(GaussianAvatarsConfig(), toy_face_model(), face)
    assert len(avatar.subject) == 1
    assert torch.equal(avatar.subject.identity, face.identity)
    assert avatar.subject.vertex_offsets is not None


def test_round_trip_of_a_run_and_of_an_avatar_folder(tmp_path: Path) -> None:
    avatar = new_avatar(GaussianAvatarsConfig(sh_degree=2, sh_frame="head"))
    avatar.store.append(torch.tensor([5, 6, 7]))
    write_avatar(tmp_path / "avatar", avatar)
    for folder in (tmp_path, tmp_path / "avatar"):
        loaded = load_avatar(folder)
        assert loaded.config == avatar.config
        for name, tensor in avatar.state_dict().items():
            assert torch.equal(tensor, loaded.state_dict()[name]), name
        for name, tensor in avatar.subject.tensors().items():
            assert torch.equal(tensor, loaded.subject.tensors()[name]), name


def test_loading_does_not_disturb_random_numbers(tmp_path: Path) -> None:
    write_avatar(tmp_path, new_avatar())
    torch.manual_seed(9)
    expected = torch.rand(1)
    torch.manual_seed(9)
    load_avatar(tmp_path)
    assert torch.equal(torch.rand(1), expected)


def test_what_cannot_be_loaded_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no trained avatar"):
        load_avatar(tmp_path)
    write_avatar(tmp_path, new_avatar())
    edit_json(tmp_path / "avatar.json", lambda content: None)
    content = (tmp_path / "avatar.json").read_text()
    (tmp_path / "avatar.json").write_text(content.replace('"gaussian_avatars"', '"gaussian_avatar"'))
    with pytest.raises(UserError, match="no method 'gaussian_avatar'"):
        load_avatar(tmp_path)
    (tmp_path / "avatar.json").write_text(content.replace('"sh_degree": 0', '"sh_degree": "zero"'))
    with pytest.raises(UserError, match="sh_degree"):
        load_avatar(tmp_path)
    (tmp_path / "avatar.json").write_text(content.replace('"sh_degree": 0', '"sh_degree": 1'))
    with pytest.raises(UserError, match="does not fit its settings"):
        load_avatar(tmp_path)
    for damage, part in (
        ({"kind": None}, "lacks \\['kind'\\]"),
        ({"kind": 3}, "3 is not"),
        ({"kind": ["gaussian_avatars"]}, "is not"),
        ({"config": "default"}, "config"),
        ({"config": None}, "config"),
        ({"gaussians": "many"}, "gaussians"),
        ({"gaussians": True}, "gaussians"),
        ({"gaussians": -1}, "-1 Gaussians"),
        ({"gaussians": 5}, "does not fit its settings"),
        ({"gaussians": 10**12}, "does not fit its settings"),
        ({"face_model": 7}, "face_model"),
        ({"tensors_sha256": None}, "tensors_sha256"),
        ({"surprise": 1}, "unknown entries \\['surprise'\\]"),
    ):
        damaged = {name: value for name, value in (json.loads(content) | damage).items() if value is not None}
        (tmp_path / "avatar.json").write_text(json.dumps(damaged))
        with pytest.raises(UserError, match=part):
            load_avatar(tmp_path)
    hash_line = toy_face_model().content_hash
    (tmp_path / "avatar.json").write_text(content.replace(hash_line, "0" * 16))
    with pytest.raises(UserError, match="was trained with face model 'toy'"):
        load_avatar(tmp_path)
    (tmp_path / "avatar.json").write_text(content)
    (tmp_path / "avatar.safetensors").write_bytes((tmp_path / "avatar.safetensors").read_bytes()[:500])
    with pytest.raises(UserError, match="damaged"):
        load_avatar(tmp_path)


def test_face_models_that_may_not_be_passed_on_are_not(tmp_path: Path) -> None:
    write_avatar(tmp_path, new_avatar(face_model=replace(toy_face_model(), name="flame", shareable=False)))
    assert not list(tmp_path.glob("face_model*"))
    with pytest.raises(UserError, match="flame"):
        load_avatar(tmp_path)


def test_missing_baked_avatar(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="missing"):
        read_baked(tmp_path / "none.mien")


def test_a_flipped_byte_is_noticed(tmp_path: Path) -> None:
    write_avatar(tmp_path, new_avatar())
    path = tmp_path / "avatar.safetensors"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"avatar\.safetensors: .*differs from what was written"):
        load_avatar(tmp_path)
