"""What is inside a head explains only what the mesh shows of it, and is closed where nothing shows it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from known import known
from mien.avatar import Avatar
from mien.avatar.methods import METHODS
from mien.face import FaceModel
from mien.gaussians import sh_from_rgb
from mien.render import rasterize
from mien.training import train
from mien.training.footage.frames import Footage, training_frames
from mien.training.footage.hidden import hidden_triangles, inside_triangles
from mien.training.footage.sequence import Sequence, Targets
from mien.training.whole_head.mouth_interior import cover_hidden, covered_reference, fill_interior
from mien.training.whole_head.unseen import unseen_of
from plain_settings import plain_gaussian_avatars, plain_run
from toy_scene import rgb_from_sh, surface_of, toy_face, toy_sequence

pytestmark = pytest.mark.unchecked
SETTINGS = plain_run(steps=120, split="none", inside="covered", checkpoint_every=60, record_every=60)


@pytest.fixture(scope="module")
def toy() -> tuple[FaceModel, Sequence]:
    """A head with another one inside of it, which is its mouth."""
    model, sequence = toy_sequence(timesteps=5, size=48)
    count = len(model.template)
    faces = torch.cat([model.faces, model.faces + count])
    nested = replace(
        model, template=torch.cat([model.template, 0.9 * model.template]), faces=faces, uv=torch.zeros(2 * count, 2),
        uv_faces=faces, region_names=("skin", "mouth"), identity_basis=torch.zeros(2, 2 * count, 3),
        face_regions=torch.arange(2).repeat_interleave(len(model.faces)),
        expression_basis=torch.zeros(2, 2 * count, 3),
        skinning_weights=torch.tensor([[1.0, 0, 0]]).repeat(2 * count, 1),
    )  # fmt: skip
    return nested, replace(sequence, tracking=replace(sequence.tracking, face_model_hash=nested.content_hash))


def facing(model: FaceModel) -> torch.Tensor:
    """The z of each triangle's normal in the head frame: 1 faces the camera."""
    a, b, c = (model.template[model.faces[:, corner]] for corner in range(3))
    return normalize(torch.linalg.cross(b - a, c - a), dim=-1)[:, 2]


def open_mouth(model: FaceModel) -> FaceModel:
    """The nested heads with a hole in front."""
    kept = (model.face_regions == 1) | (facing(model) < 0.9)
    return replace(model, faces=model.faces[kept], uv_faces=model.faces[kept], face_regions=model.face_regions[kept])


def made(toy: tuple[FaceModel, Sequence], degree: int = 0) -> Avatar:
    config = plain_gaussian_avatars(sh_degree=degree)
    return METHODS["gaussian_avatars"].avatar(config, toy[0], toy[1].tracking.face)


def test_what_a_mouth_hides_is_hidden(toy: tuple[FaceModel, Sequence]) -> None:
    """An open one shows its front. A picture does not show what is beside it. Targets say it if they are asked."""
    model, sequence = toy
    inside, camera = inside_triangles(model), sequence.tracking.cameras[0]
    assert torch.equal(inside, model.face_regions == 1)
    assert torch.equal(hidden_triangles(model(toy_face(1))[0], model, inside, camera), inside)
    aside = replace(toy_face(1), head_translation=torch.tensor([[0.6, 0.0, -0.5]]))
    assert hidden_triangles(model(aside)[0], model, torch.ones(len(model.faces), dtype=torch.bool), camera).all()
    opened = open_mouth(model)
    within = inside_triangles(opened)
    hidden = hidden_triangles(opened(toy_face(1))[0], opened, within, camera)
    front = within & (facing(opened) > 0.94)
    assert front.any()
    assert not hidden[front].any()
    assert hidden[within & (opened.template[opened.faces].mean(1)[:, 1].abs() > 0.06)].all()
    assert not hidden[~within].any()
    white = np.full(3, 255, np.uint8)
    asked = Targets(sequence, 0, face_model=model, inside=inside).target(1, 0, white, keep=False)
    assert torch.equal(known(asked.hidden), inside)
    assert asked.to(torch.zeros((), dtype=torch.float64)).hidden is not None
    assert Targets(sequence, 0, face_model=model).target(1, 0, white, keep=False).hidden is None


@pytest.mark.parametrize("opened", [False, True])
def test_a_mouth_that_no_picture_shows_is_a_dark_closed_surface(toy: tuple[FaceModel, Sequence], opened: bool) -> None:
    """What pictures show of it is closed as well before the first step, but it is trained."""
    model, sequence = open_mouth(toy[0]) if opened else toy[0], toy[1]
    avatar = METHODS["gaussian_avatars"].avatar(plain_gaussian_avatars(), model, sequence.tracking.face)
    frames = training_frames([sequence], SETTINGS)
    unseen = unseen_of(avatar, Footage(model, [sequence], [sequence.tracking.face], frames), filled=True)
    prior, inside = unseen.prior, inside_triangles(model)
    assert prior.filled_in is not None
    assert prior.closed is not None
    assert prior.widening is not None
    assert bool(prior.filled_in[inside].all()) != opened
    assert prior.filled_in[inside].any()
    front = inside & (facing(model) > 0.94)
    assert front.any()
    assert bool(prior.filled_in[front].any()) != opened
    assert prior.closed[inside].all()
    assert (prior.widening[inside] > 1).all()
    assert (prior.widening[~inside] == 1).all()
    surface_of(avatar).close(prior)
    store = avatar.store
    own = inside[store["face_index"]]
    assert (store["opacity_logits"].sigmoid()[own] > 0.9).all()
    assert (rgb_from_sh(store["sh_constant"][own][:, 0]) < 0.4).all()


@pytest.mark.parametrize("degree", [0, 2])
def test_hidden_gaussians_have_another_color_and_do_not_fade(toy: tuple[FaceModel, Sequence], degree: int) -> None:
    model, sequence = toy
    avatar, hidden = made(toy, degree), model.face_regions == 1
    posed = avatar.pose(sequence.tracking.face[0])
    assert cover_hidden(posed, surface_of(avatar), None, torch.Generator()) is posed
    changed = cover_hidden(posed, surface_of(avatar), hidden, torch.Generator().manual_seed(3))
    color = torch.rand(3, generator=torch.Generator().manual_seed(3))
    colors = rgb_from_sh(changed.gaussians.sh[hidden, 0])
    torch.testing.assert_close(colors, color.expand_as(colors))
    assert not changed.gaussians.sh[hidden, 1:].any()
    assert torch.equal(changed.gaussians.sh[~hidden], posed.gaussians.sh[~hidden])
    assert torch.equal(changed.gaussians.opacities, posed.gaussians.opacities)
    rasterize(changed.gaussians.timestep(0), sequence.tracking.cameras[0], torch.ones(3)).image.sum().backward()
    store = avatar.store
    for name, trained in (("opacity_logits", False), ("sh_constant", False), ("means", True)):
        gradient = store[name].grad
        assert gradient is not None
        assert bool(gradient[hidden].any()) == trained, name
        assert gradient[~hidden].any(), name
    # The fast disguise is the reference, with its gradients.
    sh, opacities = (getattr(posed.gaussians, name).detach().requires_grad_() for name in ("sh", "opacities"))
    posed = replace(posed, gaussians=replace(posed.gaussians, sh=sh, opacities=opacities))
    fast = cover_hidden(posed, surface_of(avatar), hidden, torch.Generator().manual_seed(3)).gaussians
    plain = covered_reference(sh, opacities, hidden, sh_from_rgb(color))
    factors = torch.rand_like(sh), torch.rand_like(opacities)
    found = torch.autograd.grad((fast.sh, fast.opacities), (sh, opacities), factors)
    expected = torch.autograd.grad(plain, (sh, opacities), factors)
    for one, other in zip((fast.sh, fast.opacities, *found), (*plain, *expected), strict=True):
        assert torch.equal(one, other)


def test_open_surface_is_closed_and_the_rest_stays(toy: tuple[FaceModel, Sequence]) -> None:
    avatar, inside = made(toy), toy[0].face_regions == 1
    store, half = avatar.store, inside.nonzero()[: int(inside.sum()) // 2, 0]
    opaque = store["opacity_logits"].detach().clone()
    opaque[half] = 2.0
    store.assign("opacity_logits", opaque)
    before = {name: store[name].detach().clone() for name in store.names()}
    colors = torch.tensor([0.2, 0.1, 0.1]).expand(len(inside), 3)
    fill_interior(surface_of(avatar), toy[0], colors, 59, 120)
    assert all(torch.equal(store[name], tensor) for name, tensor in before.items()), "it is not due"
    fill_interior(surface_of(avatar), toy[0], colors, 60, 120)
    opened = inside.clone()
    opened[half] = False
    for name, tensor in before.items():
        assert torch.equal(store[name][~opened], tensor[~opened]), name
    torch.testing.assert_close(store["opacity_logits"][opened].sigmoid(), torch.full((int(opened.sum()),), 0.97))
    torch.testing.assert_close(store["sh_constant"][opened, 0], sh_from_rgb(colors[opened]))


def test_skin_is_painted_by_skin(toy: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    """A mouth that no picture shows paints a good part of the skin, unless it is covered."""
    model, sequence = toy
    shares = {}
    for inside in ("free", "covered"):
        avatar = train([sequence], model, plain_gaussian_avatars(), replace(SETTINGS, inside=inside), tmp_path / inside)
        own = (model.face_regions[surface_of(avatar).triangles()] == 1).float()[:, None, None].expand(-1, 1, 3)
        with torch.no_grad():
            gaussians = avatar.pose(sequence.tracking.face[0]).gaussians.timestep(0)
            shown = rasterize(replace(gaussians, sh=sh_from_rgb(own)), sequence.tracking.cameras[0], torch.zeros(3))
        shares[inside] = float(shown.image[..., 0].sum() / shown.alpha.sum())
    assert shares["free"] > 0.1
    assert shares["covered"] < 0.5 * shares["free"]


def test_a_run_resumes_exactly(toy: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    """It stops after the step at which the surface is closed, and before it."""
    settings = replace(SETTINGS, inside="filled", steps=6, checkpoint_every=2, record_every=1)
    given = [toy[1]], toy[0], plain_gaussian_avatars(), settings, tmp_path / "cut"
    means = train(*given).store["means"].clone()
    for lost in ("6", "[46]"):
        for path in (tmp_path / "cut/training.json", *(tmp_path / "cut/checkpoints").glob(f"*{lost}.safetensors")):
            path.unlink()
        assert torch.equal(train(*given).store["means"], means)
