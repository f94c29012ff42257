"""Features on Gaussians that follow a mesh: formulas, files and refusals. tests/test_methods.py trains them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import GaussianAvatars, GaussianAvatarsConfig, Progress, Rate, make_portable
from mien.avatar.ops.feature_network import Layers, feature_network_reference
from mien.errors import UserError
from mien.export.gaussian_avatars_folder import write_gaussian_avatars_folder
from mien.export.packed import pack
from mien.runtime.checks import baked_fault
from mono_avatars import pictured
from plain_settings import plain_gaussian_avatars
from toy_scene import runtime_face, toy_camera, toy_face, toy_face_model

RANK, DIRECTIONS = 3, 5
CONFIG = plain_gaussian_avatars(
    expression_rank=RANK,
    expression_color_rate=Rate(0.0),
    appearance="features",
    appearance_directions=DIRECTIONS,
    appearance_features=6,
)
PARTS = ("means", "quats", "scales", "opacities", "sh")


def new_avatar(config: GaussianAvatarsConfig = CONFIG, *, filled: bool = True) -> GaussianAvatars:
    """Return an avatar whose features and network are random, as after training, or as before it."""
    torch.manual_seed(0)
    avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
    if filled:
        torch.manual_seed(1)
        for name in set(avatar.store.names()) & {"feature_bases", "neutral_features", "offset_basis", "opacity_basis"}:
            avatar.store.assign(name, 0.3 * torch.randn(avatar.store[name].shape))
        with torch.no_grad():
            assert avatar.appearance is not None
            avatar.appearance.last.weight.normal_(0, 0.3)
    return avatar


def test_starts_as_without_features() -> None:
    plain = plain_gaussian_avatars(expression_rank=RANK, expression_color_rate=Rate(0.0))
    torch.manual_seed(0)
    static = GaussianAvatars(plain, toy_face_model(), toy_face(5))
    ours, theirs = (avatar.pose(toy_face(5)).gaussians for avatar in (new_avatar(filled=False), static))
    assert all(torch.equal(getattr(ours, part), getattr(theirs, part)) for part in PARTS)


def test_color_and_opacity_change_by_the_network() -> None:
    """By the plain formula from the activations and the features, in float64."""
    avatar, face = new_avatar(), toy_face(5)[2]
    assert avatar.appearance is not None
    store, (activations,) = avatar.store, avatar.activations(face)
    layers = avatar.appearance.layers()
    exact = Layers(*(tensor.double() for tensor in layers))
    bases, neutral = store["feature_bases"].double(), store["neutral_features"].double()
    nothing = neutral.new_zeros(len(neutral), 0)
    color, opacity = feature_network_reference(bases, activations.double(), neutral, nothing, exact)
    posed, still = avatar.pose(face).gaussians, replace(CONFIG, expression_rank=RANK, appearance="static")
    static = GaussianAvatars(still, toy_face_model(), toy_face(5))
    static.store.load_state_dict({name: store.state_dict()[name] for name in static.store.state_dict()})
    plain = static.pose(face).gaussians
    logits = store["opacity_logits"] + opacity + store["opacity_basis"] @ activations[:RANK]
    torch.testing.assert_close(posed.sh.view(-1, 3).double(), store["sh_constant"][:, 0] + color, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(posed.opacities.view(-1).double(), logits.sigmoid(), atol=1e-6, rtol=1e-5)
    assert color.abs().max() > 0.1
    for part in ("means", "quats", "scales"):
        assert torch.equal(getattr(posed, part), getattr(plain, part))


@pytest.mark.parametrize("settings", [{}, {"expression_offset_rate": Rate(0.0), "expression_opacity_rate": Rate(0.0)}])
def test_baked_avatars_pose_alike_far_from_what_was_filmed(settings: dict[str, Rate], tmp_path: Path) -> None:
    avatar, face = new_avatar(replace(CONFIG, **settings)), toy_face(5)
    face = replace(face, expression=30.0 * face.expression)
    runtime.write_portable(tmp_path / "a.mien", make_portable(avatar, toy_camera(64), "toy"))
    baked, expected = runtime.load(tmp_path / "a.mien").portable.baked, avatar.pose(face).gaussians
    for index in range(len(face)):
        found = runtime.pose(baked, runtime_face(face[index]))
        truth = expected.timestep(index)
        for part in PARTS:
            np.testing.assert_allclose(
                getattr(found, part), getattr(truth, part).detach().numpy(), atol=1e-5, rtol=1e-4, err_msg=part
            )


def test_a_gaussian_without_features_never_changes() -> None:
    avatar = new_avatar()
    for name in ("feature_bases", "neutral_features"):
        values = avatar.store[name].detach().clone()
        values[0] = 0
        avatar.store.assign(name, values)
    changes = avatar.pose(toy_face(5)).aux
    for name in ("feature_color", "feature_opacity"):
        assert not changes[name][:, 0].any()
        assert changes[name][:, 1].any()


def test_changes_have_a_penalty_of_their_own() -> None:
    avatar = new_avatar(replace(CONFIG, appearance_weight=0.5))
    posed, count = avatar.pose(toy_face(5)[1]), len(avatar.store)
    losses = avatar.regularizers(posed, pictured(count), Progress(0, 1))
    squares = sum(posed.aux[name].square().mean() for name in ("feature_color", "feature_opacity"))
    torch.testing.assert_close(losses["appearance"], 0.5 * squares)


def test_features_have_their_own_number_of_activations() -> None:
    """Bases take the first activations."""
    avatar = new_avatar()
    assert avatar.store["feature_bases"].shape[1] == DIRECTIONS
    assert avatar.store["offset_basis"].shape[-1] == RANK
    changes = avatar.bake().changes
    assert changes is not None
    assert changes.basis_columns == RANK
    for columns in (0, RANK + 1, 99):
        fault = baked_fault(replace(avatar.bake(), changes=replace(changes, basis_columns=columns)))
        assert fault is not None
    alone = replace(CONFIG, expression_rank=0)
    alone.check()
    assert baked_fault(new_avatar(alone).bake()) is None


def test_formats_that_hold_no_features_say_so(tmp_path: Path) -> None:
    avatar = new_avatar()
    assert pack(make_portable(avatar, toy_camera(64), "toy"))  # A page holds them.
    with pytest.raises(UserError, match="cannot hold Gaussians that change with the expression"):
        write_gaussian_avatars_folder(tmp_path / "folder", avatar, toy_face(2))


def test_features_that_do_not_fit_are_refused() -> None:
    baked = new_avatar().bake()
    assert baked.changes is not None
    features = baked.changes.features
    assert features is not None
    rows = {name: getattr(features, name)[:-1] for name in ("neutral", "basis", "own")}
    biases = (features.biases[0], features.biases[1][:3])
    for change, part in (
        (rows, "features"),
        ({"basis": features.basis[:, :-1]}, "features"),
        ({"biases": biases}, "layers of its features"),
    ):
        fault = baked_fault(replace(baked, changes=replace(baked.changes, features=replace(features, **change))))
        assert fault is not None
        assert part in fault


def test_there_are_as_many_activations_as_ranks() -> None:
    config = replace(GaussianAvatarsConfig(), appearance_directions=3, expression_rank=4)
    with pytest.raises(UserError, match=r"--method.appearance-directions 3: .* --method.expression-rank 4"):
        config.check()
    replace(config, appearance_directions=4).check()
