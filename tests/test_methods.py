"""Every method keeps the promises of the interface, in one suite on a toy scene."""

import base64
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import (
    METHODS,
    TRAINED,
    Avatar,
    FixedDensity,
    MethodConfig,
    ParameterGroup,
    Progress,
    as_array,
    bake_rig,
    load_avatar,
    make_portable,
    write_avatar,
)
from mien.config import decode, encode
from mien.export import MeshModel, pack, read_glb_avatar, write_glb, write_page
from mien.render import rasterize
from mien.training.checkpoint import resume, write_checkpoint
from mien.training.density_control import density_strategy
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Targets
from mien.training.trainer import TrainingData, start, step
from plain_settings import plain_config, plain_run
from toy_scene import runtime_face, toy_camera, toy_sequence

SIZE = 32
FIRST, LAST = slice(0, 5), slice(-5, None)
SETTINGS = plain_run(steps=50, split="none", background="white", record_every=1, checkpoint_every=1000)
method = pytest.mark.parametrize("method", METHODS)


def config_of(method: str) -> MethodConfig:
    return plain_config(method)


def new_avatar(method: str) -> Avatar:
    face_model, sequence = toy_sequence(5, SIZE)
    torch.manual_seed(0)
    return METHODS[method].avatar(config_of(method), face_model, sequence.tracking.face)


@method
def test_first_fifty_steps_lower_the_loss(method: str) -> None:
    face_model, sequence = toy_sequence(5, SIZE)
    settings = replace(SETTINGS, steps=3000)
    state = start([sequence], face_model, config_of(method), settings)
    data = TrainingData(FrameOrder(training_frames([sequence], settings), 0), (Targets(sequence, 0),))
    for _ in range(50):
        step(state, data, settings)
    # One pass over the frames at the start and one at the end.
    first, last = ({name: sum(curve[part]) / 5 for name, curve in state.curves.items()} for part in (FIRST, LAST))
    assert last["loss"] < 0.8 * first["loss"]
    assert last["psnr"] > first["psnr"] + 1


@method
def test_density_control_keeps_all_tensors_equally_long(method: str) -> None:
    face_model, sequence = toy_sequence(5, SIZE)
    state = start([sequence], face_model, config_of(method), SETTINGS)
    data = TrainingData(FrameOrder(training_frames([sequence], SETTINGS), 0), (Targets(sequence, 0),))
    fixed = isinstance(state.avatar.density(), FixedDensity)
    counts = set()
    while state.step < SETTINGS.steps:
        step(state, data, SETTINGS)
        store = state.avatar.gaussian_store()
        lengths = {len(store[name]) for name in store.names()}
        lengths |= {len(getattr(m, field)) for m in store.moments.values() for field in m.PER_ROW}
        lengths |= {len(tensor) for tensor in state.density.state().values()}
        assert lengths == {len(store)}
        counts.add(len(store))
    assert (len(counts) == 1) == fixed, "density control never changed anything"


@method
def test_saved_avatar_renders_the_same_picture(method: str, tmp_path: Path) -> None:
    avatar = new_avatar(method)
    if not isinstance(avatar.density(), FixedDensity):
        avatar.gaussian_store().append(torch.arange(7))
    write_avatar(tmp_path, avatar)
    loaded = load_avatar(tmp_path)
    avatar.eval()  # as a loaded one is: a method may then pose its baked form
    face = toy_sequence(5, SIZE)[1].tracking.face[2]
    pictures = [
        rasterize(a.pose(face).gaussians.timestep(0), toy_camera(SIZE), torch.ones(3)).image for a in (avatar, loaded)
    ]
    assert torch.equal(*pictures)
    assert loaded.config == avatar.config
    assert loaded.face_model.content_hash == avatar.face_model.content_hash


@method
def test_baked_avatar_poses_as_the_avatar_does(method: str, tmp_path: Path) -> None:
    avatar = new_avatar(method)
    _disturb(avatar)
    face = toy_sequence(5, SIZE)[1].tracking.face
    expected = avatar.pose(face).gaussians
    runtime.write_portable(tmp_path / "toy.mien", make_portable(avatar, toy_camera(SIZE), "toy"))
    portable = runtime.load(tmp_path / "toy.mien")
    for index in range(len(face)):
        found, truth = runtime.pose(portable.portable.baked, runtime_face(face[index])), expected.timestep(index)
        for name in ("means", "scales", "opacities", "sh"):
            ours, theirs = getattr(found, name), getattr(truth, name).detach().numpy()
            np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-4, err_msg=name)
        picture = rasterize(truth, toy_camera(SIZE), torch.ones(3)).image.detach().numpy()
        np.testing.assert_allclose(portable.render(found)[0], picture, atol=1e-3, rtol=0)


@method
def test_an_avatar_becomes_a_file_a_page_and_a_mesh(method: str, tmp_path: Path) -> None:
    """The whole avatar is in a .mien and in a .glb file, and a page loses nothing that can be seen."""
    avatar = new_avatar(method)
    portable, model = make_portable(avatar, toy_camera(64), "toy"), avatar.face_model
    runtime.write_portable(tmp_path / "a.mien", portable)
    mesh = MeshModel(bake_rig(model, avatar.subject), *map(as_array, (model.faces, model.uv, model.uv_faces)))
    write_glb(tmp_path / "a.glb", runtime.read_portable(tmp_path / "a.mien"), mesh, 32)
    read = read_glb_avatar(tmp_path / "a.glb")
    assert read.about.method == method
    runtime.write_portable(tmp_path / "b.mien", read)
    assert (tmp_path / "b.mien").read_bytes() == (tmp_path / "a.mien").read_bytes()
    assert write_page(tmp_path / "a.html", read).psnr >= 45
    assert base64.b64encode(pack(portable)).decode() in (tmp_path / "a.html").read_text(encoding="utf-8")


@method
def test_gradients_are_finite_and_reach_everything_that_is_trained(method: str) -> None:
    avatar = new_avatar(method)
    _disturb(avatar)
    face = toy_sequence(5, SIZE)[1].tracking.face[1]
    progress = Progress(25, 50)
    posed = avatar.pose(face, progress)
    rendering = rasterize(posed.gaussians.timestep(0), toy_camera(SIZE), torch.ones(3))
    losses = avatar.regularizers(posed, rendering, progress)
    ((rendering.image - 0.3).square().mean() + sum(losses.values())).backward()
    assert rendering.means2d_offset.grad is not None
    for group in avatar.parameter_groups():
        gradients = {name: _gradient_of(group, name) for name in group.tensors}
        for name, gradient in gradients.items():
            assert gradient is not None, f"{group.name}/{name} has no gradient"
            assert gradient.shape == group.tensors[name].shape
            assert gradient.isfinite().all(), f"{group.name}/{name}"
        assert any(bool((gradient != 0).any()) for gradient in gradients.values()), f"{group.name} has no effect"


@method
def test_pose_depends_on_its_arguments_only(method: str) -> None:
    avatar = new_avatar(method)
    face = toy_sequence(5, SIZE)[1].tracking.face
    first = avatar.pose(face[1]).gaussians.means
    avatar.pose(face[3], Progress(1, 50))
    assert torch.equal(first, avatar.pose(face[1]).gaussians.means)
    together = avatar.pose(face, TRAINED).gaussians.timestep(1).means
    torch.testing.assert_close(together, avatar.pose(face[1]).gaussians.timestep(0).means, atol=1e-6, rtol=1e-5)


@method
def test_training_goes_on_from_a_checkpoint_as_if_it_had_never_stopped(method: str, tmp_path: Path) -> None:
    face_model, sequence = toy_sequence(5, SIZE)
    settings = replace(SETTINGS, steps=24)
    data = TrainingData(FrameOrder(training_frames([sequence], settings), 0), (Targets(sequence, 0),))
    undisturbed = start([sequence], face_model, config_of(method), settings)
    for _ in range(settings.steps):
        step(undisturbed, data, settings)
        if undisturbed.step == 11:
            write_checkpoint(tmp_path, undisturbed)
    resumed = start([sequence], face_model, config_of(method), settings)
    resume(tmp_path, resumed, first_record=1)
    assert resumed.step == 11
    while resumed.step < settings.steps:
        step(resumed, data, settings)
    expected = undisturbed.avatar.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in resumed.avatar.state_dict().items())
    assert resumed.curves["loss"] == undisturbed.curves["loss"]


@method
def test_config_survives_json(method: str) -> None:
    config = replace(config_of(method), photometric=replace(config_of(method).photometric, alpha_weight=0.125))
    assert decode(METHODS[method].config, encode(config)) == config


@method
def test_density_description_is_one_that_the_trainer_knows(method: str) -> None:
    avatar = new_avatar(method)
    strategy = density_strategy(avatar.density(), avatar.gaussian_store())
    assert all(len(tensor) == len(avatar.gaussian_store()) for tensor in strategy.state().values())


def _gradient_of(group: ParameterGroup, name: str) -> torch.Tensor | None:
    """The gradient of a tensor; one of factors is multiplied out."""
    if name not in group.factored:
        return group.tensors[name].grad
    products = [rows[:, None] * columns[:, None] for rows, columns in group.factored[name].terms]
    return torch.stack(products).sum(0) if products else None


def _disturb(avatar: Avatar) -> None:
    """Move all parameters away from the special values that they start with."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
