"""Train only what is seen: coverage of triangles, what training draws, the fill, and what views say about it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.avatar import METHODS, GaussianAvatarsConfig, load_avatar
from mien.avatar.triangle_frames import triangle_ellipses
from mien.errors import UserError
from mien.face import FaceModel
from mien.render import rasterize
from mien.training import Sequence, TrainSettings, filmed_words, read_coverage, train
from mien.training.coverage import Coverage, coverage, drawn_share, smoothstep
from mien.training.filmed import FILE, filmed_yaws, view_of_head, write_coverage
from mien.training.frames import Frame, training_frames
from mien.training.unseen import Unseen, unseen_of
from toy_scene import toy_face, toy_sequence

SETTINGS = TrainSettings(steps=6, split="none", unseen="filled", checkpoint_every=3, record_every=1)


@pytest.fixture(scope="module")
def toy() -> tuple[FaceModel, Sequence]:
    return toy_sequence(timesteps=5, size=48)


def covered(toy: tuple[FaceModel, Sequence]) -> Coverage:
    model, sequence = toy
    return coverage(model, [sequence], [sequence.tracking.face], training_frames([sequence], SETTINGS))


def facing(model: FaceModel) -> torch.Tensor:
    """The z of each triangle's normal in the head frame: 1 faces the camera, -1 is the back of the head."""
    vertices = model.head_vertices(toy_face(1))[0]
    a, b, c = (vertices[model.faces[:, corner]] for corner in range(3))
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)[:, 2]


def test_the_front_is_seen_and_the_back_is_not(toy: tuple[FaceModel, Sequence]) -> None:
    model, sequence = toy
    found, front = covered(toy), facing(model)
    assert (found.seen[front > 0.7] > 0.95).all()
    assert not found.seen[front < -0.3].any()
    assert (found.colors[found.seen == 0] == 0.5).all()
    between = (found.seen > 0.02) & (found.seen < 0.98)
    assert between.any(), "confidence fades"
    threaded = coverage(model, [sequence], [sequence.tracking.face], [Frame(0, t, 0) for t in range(5)], threads=3)
    assert torch.equal(threaded.seen, found.seen)


def test_colours_are_those_of_the_pictures(toy: tuple[FaceModel, Sequence]) -> None:
    model, sequence = toy
    painted = replace(sequence, capture=replace(sequence.capture, images=np.full_like(sequence.capture.images, 51)))
    found = covered((model, painted))
    torch.testing.assert_close(
        found.colors[found.seen > 0.5], torch.tensor(0.2).expand(int((found.seen > 0.5).sum()), 3)
    )


def test_what_the_mask_or_the_neck_line_cuts_off_is_not_seen(toy: tuple[FaceModel, Sequence]) -> None:
    model, sequence = toy
    assert not covered((model, replace(sequence, scoring=np.zeros_like(sequence.scoring)))).seen.any()
    assert (covered(toy).above == 1).all()
    middle = torch.tensor([0.0, -1.0, 24.0]).expand_as(sequence.tracking.neck_lines)
    above = covered((model, replace(sequence, tracking=replace(sequence.tracking, neck_lines=middle)))).above
    heights = model.template[model.faces].mean(1)[:, 1]
    assert (above[heights > 0.04] == 1).all()
    assert (above[heights < -0.04] == 0).all()


def test_a_triangle_behind_another_is_hidden(toy: tuple[FaceModel, Sequence]) -> None:
    """A second head inside of the first faces the camera as well, and is never seen."""
    model, sequence = toy
    count = len(model.template)
    vertices = torch.cat([model.template, 0.7 * model.template])
    twice = replace(
        model,
        template=vertices,
        faces=torch.cat([model.faces, model.faces + count]),
        uv=torch.zeros(2 * count, 2),
        uv_faces=torch.cat([model.faces, model.faces + count]),
        face_regions=model.face_regions.repeat(2),
        identity_basis=torch.zeros(2, 2 * count, 3),
        expression_basis=torch.zeros(2, 2 * count, 3),
        skinning_weights=torch.tensor([[1.0, 0, 0]]).repeat(2 * count, 1),
    )
    seen = covered((twice, sequence)).seen
    half = len(model.faces)
    assert (seen[:half][facing(model) > 0.8] > 0.9).all()
    assert not seen[half:].any()


def test_only_what_is_seen_is_drawn_and_trained(toy: tuple[FaceModel, Sequence]) -> None:
    model, sequence = toy
    avatar = METHODS["gaussian_avatars"].avatar(GaussianAvatarsConfig(), model, sequence.tracking.face)
    unseen = unseen_of(avatar, [sequence], [sequence.tracking.face], training_frames([sequence], SETTINGS))
    posed = avatar.pose(sequence.tracking.face[0])
    hidden = unseen.hide(posed, avatar)
    torch.testing.assert_close(hidden.gaussians.opacities, posed.gaussians.opacities * unseen.share)
    rasterize(hidden.gaussians.timestep(0), sequence.tracking.cameras[0], torch.ones(3)).image.sum().backward()
    gradient = avatar.gaussian_store()["opacity_logits"].grad
    assert gradient is not None
    assert gradient[unseen.share > 0.5].any()
    assert not gradient[unseen.share == 0].any()


def test_other_methods_train_on_everything(toy: tuple[FaceModel, Sequence]) -> None:
    model, sequence = toy
    avatar = METHODS["headgas"].avatar(METHODS["headgas"].config(), model, sequence.tracking.face)
    zero = torch.zeros(len(model.faces))
    unseen = Unseen(Coverage(zero, torch.zeros(len(zero), 3), zero), zero)
    posed = avatar.pose(sequence.tracking.face[0])
    before = len(avatar.gaussian_store())
    unseen.fill(avatar)
    assert unseen.hide(posed, avatar) is posed
    assert len(avatar.gaussian_store()) == before


def test_the_fill_closes_the_head(toy: tuple[FaceModel, Sequence]) -> None:
    """From behind, where nothing was seen, the head is opaque and has the colours of the fill."""
    model, sequence = toy
    avatar = METHODS["gaussian_avatars"].avatar(GaussianAvatarsConfig(), model, sequence.tracking.face)
    share = (facing(model) > 0).float()
    colors = torch.tensor([0.2, 0.4, 0.6]).expand(len(share), 3)
    avatar.fill(share, 0.97 * (1 - share), colors)
    assert len(avatar.gaussian_store()) == len(share)
    vertices = model.head_vertices(avatar.subject)[0]
    camera = view_of_head(vertices, 180)
    turned = replace(avatar.subject, head_rotation=torch.zeros(1, 3), head_translation=torch.zeros(1, 3))
    rendering = rasterize(avatar.pose(turned).gaussians.timestep(0), camera, torch.ones(3))
    middle = slice(56, 72)
    assert rendering.alpha[middle, middle].min() > 0.95
    color = rendering.image[middle, middle].reshape(-1, 3).mean(0)
    torch.testing.assert_close(color, colors[0], atol=0.03, rtol=0)


def test_a_fill_of_nothing_removes_what_was_not_drawn(toy: tuple[FaceModel, Sequence]) -> None:
    model, sequence = toy
    avatar = METHODS["gaussian_avatars"].avatar(GaussianAvatarsConfig(sh_degree=1), model, sequence.tracking.face)
    share = torch.linspace(0, 1, len(model.faces))
    avatar.fill(share, torch.zeros_like(share), torch.zeros(len(share), 3))
    left = avatar.gaussian_store()["face_index"]
    assert len(left) < len(share)
    assert (share[left] > 0.03).all()
    torch.testing.assert_close(avatar.gaussian_store()["opacity_logits"].sigmoid(), 0.1 * share[left])


def test_ellipses_have_the_moments_of_their_triangles() -> None:
    torch.manual_seed(0)
    vertices, faces = torch.randn(9, 3), torch.arange(9).view(3, 3)
    from mien.avatar.triangle_frames import bind_to_world
    from mien.rotation import matrix_from_quaternion

    quats, log_scales = triangle_ellipses(vertices, faces)
    _, world, scales = bind_to_world(vertices[None], faces, torch.arange(3), torch.zeros(3, 3), quats, log_scales)
    rotation = matrix_from_quaternion(world[0])
    found = rotation @ torch.diag_embed(scales[0] ** 2) @ rotation.mT
    corners = vertices[faces] - vertices[faces].mean(1, keepdim=True)
    expected = 2.5**2 / 12 * torch.einsum("fci,fcj->fij", corners, corners)
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / normal.norm(dim=-1, keepdim=True)
    thin = torch.einsum("f,fi,fj->fij", scales[0].amin(-1) ** 2, normal, normal)
    torch.testing.assert_close(found, expected + thin, atol=1e-4, rtol=1e-3)


def test_a_run_keeps_its_coverage_and_resumes_exactly(toy: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    model, sequence = toy
    config = GaussianAvatarsConfig()
    whole = train([sequence], model, config, SETTINGS, tmp_path / "whole")
    kept = read_coverage(tmp_path / "whole", model)
    assert kept is not None
    assert torch.equal(kept.seen, covered(toy).seen)
    loaded = load_avatar(tmp_path / "whole")
    assert torch.equal(loaded.gaussian_store()["opacity_logits"], whole.gaussian_store()["opacity_logits"])
    train([sequence], model, config, SETTINGS, tmp_path / "cut")
    for path in (tmp_path / "cut" / "training.json", *(tmp_path / "cut" / "checkpoints").glob("*6.safetensors")):
        path.unlink()
    again = train([sequence], model, config, SETTINGS, tmp_path / "cut")
    assert torch.equal(again.gaussian_store()["means"], whole.gaussian_store()["means"])
    plain = train([sequence], model, config, replace(SETTINGS, unseen="trained"), tmp_path / "plain")
    assert read_coverage(tmp_path / "plain", model) is None
    assert len(plain.gaussian_store()["face_index"].unique()) == len(model.faces)


def test_damaged_coverage_is_named(toy: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    model = toy[0]
    found = covered(toy)
    write_coverage(tmp_path, found)
    known = read_coverage(tmp_path, model)
    assert known is not None
    assert torch.equal(known.colors, found.colors)
    write_coverage(tmp_path, replace(found, seen=found.seen + 1))
    with pytest.raises(UserError, match=FILE):
        read_coverage(tmp_path, model)


def test_words_say_which_sides_were_filmed(toy: tuple[FaceModel, Sequence]) -> None:
    model = toy[0]
    vertices, ones = model.head_vertices(toy_face(1))[0], torch.ones(len(model.faces))
    colors = torch.zeros(len(ones), 3)
    assert filmed_yaws(model, vertices, Coverage(ones, colors, ones)) == (180, 180)
    middle = model.template[model.faces].mean(1)
    front_and_left = Coverage(((middle[:, 2] > 0) | (middle[:, 0] > 0)).float(), colors, ones)
    right, left = filmed_yaws(model, vertices, front_and_left) or (0, 0)
    assert 5 <= right < 60 < left < 180
    assert f"{right} degrees on the person's right to {left} on the left" in filmed_words(
        model, vertices, front_and_left
    )
    assert "made up" in filmed_words(model, vertices, Coverage(0 * ones, colors, ones))


def test_smoothstep_is_flat_at_both_ends() -> None:
    torch.testing.assert_close(smoothstep(torch.tensor([-1.0, 0, 0.5, 1, 2])), torch.tensor([0.0, 0, 0.5, 1, 1]))


def test_the_inside_of_the_mouth_is_always_drawn(toy: tuple[FaceModel, Sequence]) -> None:
    model = toy[0]
    regions = (torch.arange(len(model.faces)) % 2).to(model.face_regions)
    mouth = replace(model, region_names=("skin", "mouth"), face_regions=regions)
    share = drawn_share(mouth, covered(toy))
    assert (share[regions == 1] == 1).all()
    assert torch.equal(share[regions == 0], covered(toy).seen[regions == 0])
