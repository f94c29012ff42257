"""Every method keeps the promises of the interface on a toy scene, and rows of Gaussians keep their moments."""

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from damage import edit_json
from known import known
from mien import runtime
from mien.avatar import Avatar, load_avatar
from mien.avatar.avatar import ParameterGroup
from mien.avatar.baking import as_array, bake_rig, make_portable
from mien.avatar.files import write_avatar
from mien.avatar.headgas.settings import HeadGasConfig, Variant
from mien.avatar.methods import DEFAULT_METHOD, METHODS
from mien.avatar.settings import GradientSettings, MethodConfig, PerceptualLoss, Photometric, Progress
from mien.avatar.store import GaussianStore, Moments
from mien.face import FaceModel
from mien.formats.glb import MeshModel, read_glb_avatar, write_glb
from mien.formats.page import write_page
from mien.formats.shared.packed import pack
from mien.render import rasterize
from mien.training import TrainSettings
from mien.training.checkpoint import TrainingState, resume, write_checkpoint
from mien.training.trainer import TrainingData, start, step
from plain_settings import plain_config, plain_gaussian_avatars, plain_mono_gaussian_avatar, plain_run
from refusals import refuses
from test_feature_network import product
from toy_scene import moved, runtime_face, toy_camera, toy_data, toy_face, toy_face_model, toy_sequence

SIZE = 32
FIRST, LAST = slice(0, 5), slice(-5, None)
SETTINGS = plain_run(steps=24, split="none", background="white", record_every=1, checkpoint_every=1000)
GROWING = GradientSettings(start=0.2, stop=0.8, rounds=4, grow_gradient=1e-4, opacity_resets=(), max_gaussians=400)
SMALL = HeadGasConfig(
    points=60, features=5, hidden=8, sh_degree=1, sh_warmup=0.0, density=replace(GROWING, grow_gradient=1e-5)
)
CONFIGS: dict[str, MethodConfig] = {method: plain_config(method) for method in METHODS}
CONFIGS |= {f"headgas-{name}": replace(SMALL, variant=name) for name in get_args(Variant) if name != "full"}
CONFIGS["headgas-regions"] = replace(SMALL, activations="regions", sh_degree=0)
CONFIGS["gaussian_avatars-features"] = plain_gaussian_avatars(
    expression_rank=3, appearance="features", appearance_directions=5, appearance_features=6, density=GROWING
)
CONFIGS["gaussian_avatars-perceptual"] = plain_gaussian_avatars(
    photometric=Photometric(perceptual=PerceptualLoss(0.5, 0.1, every=2, crop=16, blocks=1)), density=GROWING
)
CONFIGS["mono_gaussian_avatar-batch"] = plain_mono_gaussian_avatar(
    points=60, max_points=120, epochs=6, attribute_width=32, deformation_width=16, change_width=16, frames_per_step=4,
    points_per_step=240, weight_norm="paper",
)  # fmt: skip
UNBAKED = ("headgas-no_mlp", "headgas-delta", "headgas-change_all")
baked = pytest.mark.parametrize("method", [name for name in CONFIGS if name not in UNBAKED])
each = pytest.mark.parametrize("method", CONFIGS)


def new_avatar(method: str, disturbed: bool = False) -> Avatar:
    """An avatar whose parameters are at the special values that they start with, or moved away from them."""
    face_model, sequence = toy_sequence(5, SIZE)
    torch.manual_seed(0)
    config = replace(CONFIGS[method], photometric=replace(CONFIGS[method].photometric, alpha_weight=0.125))
    avatar = METHODS[method.split("-")[0]].avatar(config, face_model, sequence.tracking.face)
    return moved(avatar, 0.1) if disturbed else avatar


def started(config: MethodConfig, settings: TrainSettings = SETTINGS) -> tuple[TrainingState, TrainingData]:
    face_model, sequence = toy_sequence(5, SIZE)
    return start([sequence], face_model, config, settings), toy_data(sequence, settings)


@pytest.mark.unchecked
@each
def test_first_fifty_steps_lower_the_loss(method: str) -> None:
    config, settings = CONFIGS[method], replace(SETTINGS, steps=3000)
    if isinstance(config, HeadGasConfig):
        config = HeadGasConfig(variant=config.variant, activations=config.activations)
    state, data = started(config, settings)
    for _ in range(50):
        step(state, data, settings)
    # One pass over the frames at the start and one at the end.
    first, last = ({name: sum(curve[part]) / 5 for name, curve in state.curves.items()} for part in (FIRST, LAST))
    assert last["loss"] < 0.8 * first["loss"]
    assert last["psnr"] > first["psnr"] + 1


@pytest.mark.unchecked
@each
def test_training_goes_on_from_a_checkpoint_as_if_it_had_never_stopped(method: str, tmp_path: Path) -> None:
    undisturbed, data = started(CONFIGS[method])
    store, written = undisturbed.avatar.store, 0
    counts = {len(store)}
    while undisturbed.step < SETTINGS.steps:
        step(undisturbed, data, SETTINGS)
        if undisturbed.step >= 11 and not written:
            write_checkpoint(tmp_path, undisturbed)
            written = undisturbed.step
        lengths = {len(store[name]) for name in store.names()}
        lengths |= {len(getattr(m, field)) for m in store.moments.values() for field in m.PER_ROW}
        lengths |= {len(tensor) for tensor in undisturbed.density.state().values()} if undisturbed.density else set()
        assert lengths == {len(store)}
        counts.add(len(store))
    assert (len(counts) == 1) == (undisturbed.avatar.density() is None)
    resumed, _ = started(CONFIGS[method])
    resume(tmp_path, resumed)
    assert resumed.step == written
    while resumed.step < SETTINGS.steps:
        step(resumed, data, SETTINGS)
    expected = undisturbed.avatar.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in resumed.avatar.state_dict().items())
    assert resumed.curves["loss"] == undisturbed.curves["loss"]


@each
def test_saved_avatar_renders_the_same_picture(method: str, tmp_path: Path) -> None:
    avatar = new_avatar(method, disturbed=True)
    if avatar.density() is not None:
        avatar.store.append(torch.arange(7))
    write_avatar(tmp_path / "avatar", avatar)
    avatar.eval()  # as a loaded one is: a method may then pose its baked form
    for folder in (tmp_path, tmp_path / "avatar"):
        loaded = load_avatar(folder)
        drawn = (one.pose(toy_face(5)[2]).gaussians.timestep(0) for one in (avatar, loaded))
        assert torch.equal(*(rasterize(gaussians, toy_camera(SIZE), torch.ones(3)).image for gaussians in drawn))
        assert loaded.config == avatar.config
        assert loaded.face_model.content_hash == avatar.face_model.content_hash
        ours, theirs = (one.state_dict() | one.subject.tensors() for one in (avatar, loaded))
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(tensor, theirs[name]) for name, tensor in ours.items())


@baked
def test_baked_avatar_poses_as_the_avatar_does(method: str, tmp_path: Path) -> None:
    avatar, face = new_avatar(method, disturbed=True), toy_face(5)
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


@pytest.mark.unchecked
@pytest.mark.parametrize("method", METHODS)
def test_an_avatar_becomes_a_file_a_page_and_a_mesh(method: str, tmp_path: Path) -> None:
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


@each
def test_gradients_are_finite_and_reach_everything_that_is_trained(method: str) -> None:
    avatar, progress = new_avatar(method, disturbed=True), Progress(25, 50)
    posed = avatar.pose(toy_face(5)[1], progress)
    rendering = rasterize(posed.gaussians.timestep(0), toy_camera(SIZE), torch.ones(3))
    losses = avatar.regularizers(posed, rendering, progress)
    ((rendering.image - 0.3).square().mean() + sum(losses.values())).backward()
    assert rendering.means2d_offset.grad is not None
    for group in avatar.parameter_groups():
        gradients = {name: known(_gradient_of(group, name)) for name in group.tensors}
        for name, gradient in gradients.items():
            assert gradient.shape == group.tensors[name].shape
            assert gradient.isfinite().all(), f"{group.name}/{name}"
        felt = [bool((gradient != 0).any()) for gradient in gradients.values()]
        assert any(felt) or not felt, f"{group.name} has no effect"
    trained = {id(tensor) for group in avatar.parameter_groups() for tensor in group.tensors.values()}
    assert trained == {id(parameter) for parameter in avatar.parameters()}


def _gradient_of(group: ParameterGroup, name: str) -> torch.Tensor | None:
    """The gradient of a tensor; one of factors is multiplied out."""
    if name not in group.factored:
        return group.tensors[name].grad
    products = [product(*term) for term in group.factored[name].terms]
    return torch.stack(products).sum(0) if products else None


def plain_avatar(method: str = DEFAULT_METHOD, face_model: FaceModel | None = None) -> Avatar:
    torch.manual_seed(0)
    return METHODS[method].avatar(plain_config(method), face_model or toy_face_model(), toy_face(5))


def test_what_cannot_be_loaded_is_told_in_one_line(tmp_path: Path) -> None:
    refuses("holds no trained avatar \\(no avatar.json\\)", load_avatar, tmp_path)
    write_avatar(tmp_path, plain_avatar())
    description, tensors = tmp_path / "avatar.json", tmp_path / "avatar.safetensors"
    edit_json(description, lambda content: None)
    content, whole = description.read_text(), tensors.read_bytes()
    for old, new, words in (
        (f'"{DEFAULT_METHOD}"', '"nerf"', "no method 'nerf'"),
        ('"sh_degree": 0', '"sh_degree": "zero"', "sh_degree"),
        ('"sh_degree": 0', '"sh_degree": 1', "incomplete or damaged"),
        (toy_face_model().content_hash, "0" * 16, "was trained with face model 'toy'"),
    ):
        description.write_text(content.replace(old, new))
        refuses(words, load_avatar, tmp_path)
    for damage, words in (
        ({"kind": None}, "lacks \\['kind'\\]"), ({"config": "default"}, "config"), ({"gaussians": -1}, "-1 Gaussians"),
        ({"gaussians": 10**12}, "incomplete or damaged"), ({"face_model": 7}, "face_model"),
        ({"surprise": 1}, "unknown entries \\['surprise'\\]"),
    ):  # fmt: skip
        damaged = {name: value for name, value in (json.loads(content) | damage).items() if value is not None}
        description.write_text(json.dumps(damaged))
        refuses(words, load_avatar, tmp_path)
    description.write_text(content)
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 0xFF]) + whole[middle + 1 :]
    for damaged, words in ((whole[:500], "damaged"), (flipped, r"\.safetensors: .*differs from what was written")):
        tensors.write_bytes(damaged)
        refuses(words, load_avatar, tmp_path)


def test_face_models_that_may_not_be_passed_on_are_not(tmp_path: Path) -> None:
    """Loading does not disturb random numbers."""
    write_avatar(tmp_path / "free", plain_avatar())
    torch.manual_seed(9)
    expected = torch.rand(1)
    torch.manual_seed(9)
    load_avatar(tmp_path / "free")
    assert torch.equal(torch.rand(1), expected)
    write_avatar(tmp_path / "own", plain_avatar(face_model=replace(toy_face_model(), name="flame", shareable=False)))
    assert not list((tmp_path / "own").glob("face_model*"))
    refuses("flame", load_avatar, tmp_path / "own")


def make_store(n: int = 6) -> GaussianStore:
    store = GaussianStore(
        {"means": torch.arange(3.0 * n).reshape(n, 3), "opacity_logits": torch.arange(n) / 10.0},
        {"face_index": torch.arange(n) * 100},
    )
    for name in ("means", "opacity_logits"):
        values = store[name].detach()
        store.moments[name] = Moments(values + 1, torch.full_like(values, 2), torch.tensor(7.0))
    return store


def moments_of(store: GaussianStore, name: str) -> Moments:
    moments = store.moments[name]
    assert isinstance(moments, Moments)
    return moments


def test_rows_stay_together_with_their_moments_and_new_ones_have_none() -> None:
    store = make_store()
    store.select(torch.tensor([True, False, False, True, False, True]))
    assert store["face_index"].tolist() == [0, 300, 500]
    assert store["means"][:, 0].tolist() == [0, 9, 15]
    assert torch.equal(moments_of(store, "means").first, store["means"].detach() + 1)
    assert moments_of(store, "means").step == 7
    assert isinstance(store["means"], torch.nn.Parameter)
    assert store["means"].is_leaf
    store.append(torch.tensor([2, 1]), {"means": torch.full((2, 3), -1.0)})
    assert store["face_index"].tolist() == [0, 300, 500, 500, 300]
    assert store["means"][3:].eq(-1).all()
    torch.testing.assert_close(store["opacity_logits"][3:], torch.tensor([0.5, 0.3]))
    assert moments_of(store, "means").first[:3].ne(0).all()
    assert not moments_of(store, "means").first[3:].any()
    assert not moments_of(store, "opacity_logits").second[3:].any()
    store.assign("opacity_logits", torch.zeros(5))
    assert not store["opacity_logits"].any()
    assert not moments_of(store, "opacity_logits").first.any()
    assert moments_of(store, "means").first.any()
