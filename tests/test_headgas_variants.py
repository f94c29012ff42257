"""The ablations of HeadGaS: each follows its formula, trains, resumes to the bit, and bakes or says why not."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import GradientSettings, HeadGas, HeadGasConfig, Progress, load_avatar, make_portable, write_avatar
from mien.avatar.encoding import positional_encoding
from mien.avatar.headgas.constants import HEADGAS
from mien.avatar.headgas.settings import Variant
from mien.avatar.headgas.variants import MOVED, VARIANTS, averaging_weights
from mien.config import decode, encode
from mien.errors import UserError
from mien.face import FaceParams
from mien.render import rasterize
from mien.rotation import matrix_from_quaternion
from mien.training import TrainSettings
from mien.training.checkpoint import TrainingState, resume, write_checkpoint
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Targets
from mien.training.trainer import TrainingData, start, step
from plain_settings import plain_run
from toy_scene import runtime_face, toy_camera, toy_face, toy_face_model, toy_sequence

ABLATIONS = [name for name in get_args(Variant) if name != "full"]
DENSITY = GradientSettings(start=0.2, stop=0.8, rounds=4, grow_gradient=1e-5, opacity_resets=(), max_gaussians=120)
SMALL = HeadGasConfig(points=40, features=5, hidden=8, sh_degree=1, sh_warmup=0.0, density=DENSITY)
SETTINGS = plain_run(steps=24, split="none", background="white", record_every=1, checkpoint_every=1000)
ablation = pytest.mark.parametrize("variant", ABLATIONS)
every = pytest.mark.parametrize("variant", get_args(Variant))


def new_avatar(variant: Variant, disturbed: bool = True) -> HeadGas:
    torch.manual_seed(0)
    avatar = HeadGas(replace(SMALL, variant=variant), toy_face_model(), toy_face(5))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in avatar.named_parameters():
            if disturbed and not name.endswith("means"):
                parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return avatar


def inputs_of(avatar: HeadGas, face: FaceParams) -> torch.Tensor:
    inputs = torch.cat([face.expression, face.joints.reshape(len(face), -1)], dim=-1)
    return (inputs - avatar.rest) @ avatar.directions


def encoding_of(avatar: HeadGas) -> torch.Tensor:
    points = avatar.store["means"].detach() / SMALL.encoding_length
    return positional_encoding(points, SMALL.encoding_bands)


def features_of(avatar: HeadGas, e: torch.Tensor) -> torch.Tensor:
    return avatar.store["neutral_features"] + torch.einsum("nkf,k->nf", avatar.store["bases"], e)


def test_every_variant_has_parts() -> None:
    assert set(VARIANTS) == set(get_args(Variant))
    assert HeadGasConfig().variant == "full"


@ablation
def test_starts_faint_gray_and_still(variant: Variant) -> None:
    avatar, face = new_avatar(variant, disturbed=False), toy_face(5)
    gaussians = avatar.pose(face).gaussians
    assert (gaussians.opacities - 0.1).abs().max() < 0.1
    assert gaussians.sh.abs().max() < 1
    torch.testing.assert_close(gaussians.means.expand(5, 40, 3), avatar.store["means"].expand(5, 40, 3))


def test_delta_moves_and_turns_by_the_network_and_paints_nothing() -> None:
    """Eq. 1 to 4 of the supplement, where the rotation comes before that of the Gaussian itself."""
    avatar, face = new_avatar("delta"), toy_face(5)
    posed = avatar.pose(face)
    values = torch.cat([features_of(avatar, inputs_of(avatar, face)[2]), encoding_of(avatar)], dim=-1)
    moved = avatar.network(values)
    assert moved.shape == (40, MOVED)
    store, found = avatar.store, posed.gaussians.timestep(2)
    torch.testing.assert_close(found.means, store["means"] + HEADGAS.shift_length * moved[:, :3])
    turn = matrix_from_quaternion(moved[:, 3:] + torch.tensor([1.0, 0, 0, 0]))
    expected = turn @ matrix_from_quaternion(store["quats"])
    torch.testing.assert_close(matrix_from_quaternion(found.quats), expected)
    torch.testing.assert_close(found.opacities, store["opacity_logits"].sigmoid())
    torch.testing.assert_close(found.sh[:, 0], store["sh"][:, 0])
    torch.testing.assert_close(found.sh[:, 1:], SMALL.sh_higher_share * store["sh"][:, 1:])
    rendering = rasterize(found, toy_camera(32), torch.ones(3))
    shifts = (posed.gaussians.means - store["means"]).detach()
    assert float(shifts.abs().max()) > 1e-4
    losses = avatar.regularizers(posed, rendering, Progress(1, 2))
    torch.testing.assert_close(losses["shift"], SMALL.shift_weight * shifts.abs().mean(), atol=1e-7, rtol=1e-4)


def test_change_all_paints_too() -> None:
    avatar, face = new_avatar("change_all"), toy_face(5)
    posed = avatar.pose(face)
    values = torch.cat([features_of(avatar, inputs_of(avatar, face)[2]), encoding_of(avatar)], dim=-1)
    outputs, found = avatar.network(values), posed.gaussians.timestep(2)
    assert outputs.shape == (40, 12 + MOVED + 1)
    torch.testing.assert_close(found.sh[:, 0], outputs[:, :3])
    torch.testing.assert_close(found.means, avatar.store["means"] + HEADGAS.shift_length * outputs[:, 12:15])
    torch.testing.assert_close(found.opacities, outputs[:, -1].sigmoid())
    assert set(avatar.regularizers(posed, rasterize(found, toy_camera(32), torch.ones(3)), Progress(1, 2))) == {"shift"}


def test_no_mlp_averages_colors_and_opacities() -> None:
    avatar, face = new_avatar("no_mlp"), toy_face(5)
    e = inputs_of(avatar, face)[2]
    total = 1 + e.abs().sum()
    average = (avatar.store["neutral_features"] + torch.einsum("nko,k->no", avatar.store["bases"], e)) / total
    found = avatar.pose(face).gaussians.timestep(2)
    torch.testing.assert_close(found.sh[:, 0], average[:, :3])
    logits = torch.logit(torch.tensor(0.1)) + 20 * average[:, -1]
    torch.testing.assert_close(found.opacities, logits.sigmoid())
    assert len(list(avatar.network.parameters())) == 0
    weights, rest = averaging_weights(torch.tensor([3.0, -4.0]))
    torch.testing.assert_close(torch.cat([weights, rest[None]]), torch.tensor([0.375, -0.5, 0.125]))


def test_no_blending_gives_the_expression_to_five_layers() -> None:
    avatar, face = new_avatar("no_blending"), toy_face(5)
    e = inputs_of(avatar, face)[2]
    outputs = avatar.network(torch.cat([e.expand(40, -1), encoding_of(avatar)], dim=-1))
    found = avatar.pose(face).gaussians.timestep(2)
    torch.testing.assert_close(found.sh[:, 0], outputs[:, :3])
    torch.testing.assert_close(found.opacities, outputs[:, -1].sigmoid())
    assert sum(isinstance(layer, torch.nn.Linear) for layer in avatar.network) == 5
    assert set(avatar.store.names()) == {"means", "quats", "log_scales"}


@ablation
def test_opacities_are_judged_as_they_are_drawn(variant: Variant) -> None:
    avatar, face = new_avatar(variant), toy_face(5)
    expected = avatar.pose(face).gaussians.opacities.expand(5, 40).amax(0)
    found = avatar.density().judged_opacities(avatar.store, torch.zeros(40))
    torch.testing.assert_close(found, expected.detach())


def training(variant: Variant, settings: TrainSettings = SETTINGS) -> tuple[TrainingState, TrainingData]:
    face_model, sequence = toy_sequence(5, 32)
    config = replace(SMALL, points=60, variant=variant)
    state = start([sequence], face_model, config if settings is SETTINGS else HeadGasConfig(variant=variant), settings)
    return state, TrainingData(FrameOrder(training_frames([sequence], SETTINGS), 0), (Targets(sequence, 0),))


@ablation
def test_first_fifty_steps_lower_the_loss(variant: Variant) -> None:
    settings = replace(SETTINGS, steps=3000)
    state, data = training(variant, settings)
    for _ in range(50):
        step(state, data, settings)
    loss = state.curves["loss"]
    assert sum(loss[-5:]) < 0.8 * sum(loss[:5])


@ablation
def test_trains_and_goes_on_from_a_checkpoint_as_if_never_stopped(variant: Variant, tmp_path: Path) -> None:
    state, data = training(variant)
    while state.step < SETTINGS.steps:
        step(state, data, SETTINGS)
        if state.step == 11:
            write_checkpoint(tmp_path, state)
    assert len(state.avatar.gaussian_store()) != 60
    resumed, data = training(variant)
    resume(tmp_path, resumed, first_record=1)
    assert resumed.step == 11
    while resumed.step < SETTINGS.steps:
        step(resumed, data, SETTINGS)
    expected = state.avatar.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in resumed.avatar.state_dict().items())
    assert resumed.curves["loss"] == state.curves["loss"]


@ablation
def test_gradients_reach_everything_that_is_trained(variant: Variant) -> None:
    avatar, face = new_avatar(variant), toy_face(5)[1]
    posed = avatar.pose(face, Progress(25, 50))
    rendering = rasterize(posed.gaussians.timestep(0), toy_camera(32), torch.ones(3))
    losses = avatar.regularizers(posed, rendering, Progress(25, 50))
    ((rendering.image - 0.3).square().mean() + sum(losses.values())).backward()
    names = set()
    for group in avatar.parameter_groups():
        found = [tensor.grad for name, tensor in group.tensors.items() if name not in group.factored]
        found += [rows for gradient in group.factored.values() for rows, _ in gradient.terms]
        assert found
        assert all(one is not None and bool(one.isfinite().all()) for one in found), group.name
        assert any(bool((one != 0).any()) for one in found if one is not None), group.name
        names |= {id(tensor) for tensor in group.tensors.values()}
    assert names == {id(parameter) for parameter in avatar.parameters()}


@every
def test_saved_avatar_draws_the_same_picture(variant: Variant, tmp_path: Path) -> None:
    avatar, face = new_avatar(variant), toy_face(5)[2]
    avatar.store.append(torch.arange(7))
    avatar.eval()  # as a loaded one is: a variant may then pose its baked form
    write_avatar(tmp_path, avatar)
    loaded = load_avatar(tmp_path)
    assert loaded.config == avatar.config == decode(HeadGasConfig, encode(avatar.config))
    first, second = (
        rasterize(one.pose(face).gaussians.timestep(0), toy_camera(32), torch.ones(3)).image for one in (avatar, loaded)
    )
    assert torch.equal(first, second)


def test_no_blending_bakes_exactly(tmp_path: Path) -> None:
    avatar, face = new_avatar("no_blending"), toy_face(5)
    runtime.write_portable(tmp_path / "toy.mien", make_portable(avatar, toy_camera(32), "toy"))
    portable, expected = runtime.load(tmp_path / "toy.mien"), avatar.pose(face).gaussians
    for index in range(5):
        found, truth = runtime.pose(portable.portable.baked, runtime_face(face[index])), expected.timestep(index)
        for name in ("means", "scales", "opacities", "sh"):
            ours, theirs = getattr(found, name), getattr(truth, name).detach().numpy()
            np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-4, err_msg=name)


@pytest.mark.parametrize("variant", ["no_mlp", "delta", "change_all"])
def test_what_cannot_be_baked_says_so_in_one_line(variant: Variant) -> None:
    avatar = new_avatar(variant)
    with pytest.raises(UserError, match=rf"^the variant {variant} of headgas: .*export a \.ply") as caught:
        make_portable(avatar, toy_camera(32), "toy")
    assert "\n" not in str(caught.value)
    assert new_avatar("full").extras.unbaked is None
