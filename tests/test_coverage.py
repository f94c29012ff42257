"""Train only what is seen: coverage of triangles, what training draws, the fill, and what views say about it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.avatar import (
    METHODS,
    Avatar,
    Photometric,
    Progress,
    SurfacePrior,
    load_avatar,
)
from mien.avatar.density import GradientDensity
from mien.errors import UserError
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.render import rasterize
from mien.runtime.baked import Filmed
from mien.training import Sequence, filmed_words, read_coverage, train
from mien.training.density_control import density_strategy
from mien.training.footage.coverage import Coverage, drawn_share, measure_coverage, smoothstep
from mien.training.footage.filmed import FILE, filmed_yaws, view_of_head, with_shown_angles, write_coverage
from mien.training.footage.frames import Frame, training_frames
from mien.training.whole_head.constants import WHOLE_HEAD
from mien.training.whole_head.unseen import Unseen, drawn_at_height, spare_fills, unseen_of
from plain_settings import plain_gaussian_avatars, plain_run
from sh_colors import rgb_from_sh
from toy_scene import surface_of, toy_face, toy_sequence

Toy = tuple[FaceModel, Sequence]
SETTINGS = plain_run(steps=6, split="none", unseen="filled", checkpoint_every=3, record_every=1)


@pytest.fixture(scope="module")
def toy() -> Toy:
    return toy_sequence(timesteps=5, size=48)


def bare_avatar(toy: Toy) -> Avatar:
    model, sequence = toy
    return METHODS["gaussian_avatars"].avatar(plain_gaussian_avatars(), model, sequence.tracking.face)


def covered(toy: Toy) -> Coverage:
    model, sequence = toy
    return measure_coverage(model, [sequence], [sequence.tracking.face], training_frames([sequence], SETTINGS))


def facing(model: FaceModel) -> torch.Tensor:
    """The z of each triangle's normal in the head frame: 1 faces the camera, -1 is the back of the head."""
    vertices = model.head_vertices(toy_face(1))[0]
    a, b, c = (vertices[model.faces[:, corner]] for corner in range(3))
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)[:, 2]


def test_the_front_is_seen_and_the_back_is_not(toy: Toy) -> None:
    model, sequence = toy
    found, front = covered(toy), facing(model)
    assert (found.seen[front > 0.7] > 0.95).all()
    assert not found.seen[front < -0.3].any()
    assert (found.colors[found.seen == 0] == 0.5).all()
    between = (found.seen > 0.02) & (found.seen < 0.98)
    assert between.any(), "confidence fades"
    torch.testing.assert_close(smoothstep(torch.tensor([-1.0, 0, 0.5, 1, 2])), torch.tensor([0.0, 0, 0.5, 1, 1]))
    threaded = measure_coverage(
        model, [sequence], [sequence.tracking.face], [Frame(0, t, 0) for t in range(5)], threads=3
    )
    assert torch.equal(threaded.seen, found.seen)
    gray = replace(sequence, capture=replace(sequence.capture, images=np.full_like(sequence.capture.images, 51)))
    colors = covered((model, gray)).colors[found.seen > 0.5]
    torch.testing.assert_close(colors, torch.full_like(colors, 0.2))


def test_what_the_mask_or_the_neck_line_cuts_off_is_not_seen(toy: Toy) -> None:
    model, sequence = toy
    assert not covered((model, replace(sequence, scoring=np.zeros_like(sequence.scoring)))).seen.any()
    assert (covered(toy).above == 1).all()
    middle = torch.tensor([0.0, -1.0, 24.0]).expand_as(sequence.tracking.neck_lines)
    above = covered((model, replace(sequence, tracking=replace(sequence.tracking, neck_lines=middle)))).above
    heights = model.template[model.faces].mean(1)[:, 1]
    assert (above[heights > 0.04] == 1).all()
    assert (above[heights < -0.04] == 0).all()


def test_a_triangle_behind_another_is_hidden(toy: Toy) -> None:
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


def known(toy: Toy, avatar: Avatar) -> Unseen:
    sequence = toy[1]
    frames = training_frames([sequence], SETTINGS)
    return unseen_of(avatar, [sequence], [sequence.tracking.face], frames, filled=True)


def test_only_what_is_seen_is_trained(toy: Toy) -> None:
    """Fills have no gradients but those that move them along their normal."""
    sequence = toy[1]
    avatar = bare_avatar(toy)
    unseen = known(toy, avatar)
    surface_of(avatar).close(unseen.prior)
    filled_in = unseen.filled_in(avatar)
    assert filled_in is not None
    assert filled_in.any()
    assert not filled_in.all()
    assert unseen.weights(Photometric(alpha_weight=0.0)).alpha_weight > 0
    behind = replace(sequence.tracking.face[0], head_rotation=torch.tensor([[0.0, 3.0, 0.0]]))
    rendering = rasterize(avatar.pose(behind).gaussians.timestep(0), sequence.tracking.cameras[0], torch.ones(3))
    rendering.image[:, :24].sum().backward()
    store = avatar.gaussian_store()
    before = {name: gradient.clone() for name in store.trained if (gradient := store[name].grad) is not None}
    assert before["sh_constant"][filled_in].any()
    unseen.mask_gradients(avatar, rendering)
    for name, gradient in before.items():
        guarded = store[name].grad
        assert guarded is not None
        assert torch.equal(guarded[~filled_in], gradient[~filled_in])
        if name != "means":
            assert not guarded[filled_in].any()
    moved = store["means"].grad
    assert moved is not None
    assert moved[filled_in][:, 1].any()
    assert not moved[filled_in][:, [0, 2]].any()


def test_features_of_fills_are_not_trained(toy: Toy) -> None:
    """Their bases have a gradient of their own kind, which is masked like the others."""
    model, sequence = toy
    config = plain_gaussian_avatars(appearance="features", appearance_directions=2, appearance_features=3)
    avatar = METHODS["gaussian_avatars"].avatar(config, model, sequence.tracking.face)
    with torch.no_grad():
        avatar.gaussian_store()["feature_bases"].normal_()
        (network,) = (group for group in avatar.parameter_groups() if group.name == "appearance")
        for tensor in network.tensors.values():
            tensor.normal_()
    unseen = known(toy, avatar)
    filled_in = unseen.filled_in(avatar)
    assert filled_in is not None
    gaussians = avatar.pose(sequence.tracking.face[0]).gaussians
    (gaussians.sh.sum() + gaussians.opacities.sum()).backward()
    (factored,) = (one for group in avatar.parameter_groups() for one in group.factored.values())
    rows = factored.terms[0][0]
    before = rows.clone()
    assert before[filled_in].any()
    unseen.mask_gradients(avatar)
    assert not rows[filled_in].any()
    assert torch.equal(rows[~filled_in], before[~filled_in])


@pytest.mark.unchecked
def test_what_is_beside_shown_triangles_is_trained(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hair above a band beside what pictures show is on their outline, so pictures train it. Fills begin behind it."""
    model, avatar = toy[0], bare_avatar(toy)
    middles, found = model.head_vertices(avatar.subject)[0][model.faces].mean(1), covered(toy)
    apart = torch.cdist(middles, middles[found.seen > WHOLE_HEAD.unseen_confidence]).amin(1)
    filled = {}
    drawn = torch.zeros(len(model.faces), dtype=torch.bool)
    monkeypatch.setattr("mien.training.whole_head.unseen.drawn_at_height", lambda *given: drawn)
    for band in (0.0, 0.03):
        monkeypatch.setattr("mien.training.whole_head.unseen.WHOLE_HEAD", replace(WHOLE_HEAD, outline_band=band))
        prior = known(toy, avatar).prior
        assert prior.filled_in is not None
        filled[band] = prior.filled_in & ~head_parts(model).interior
    assert filled[0.03].equal(filled[0.0] & (apart > 0.03))
    assert filled[0.03].any()
    assert (filled[0.0] & ~filled[0.03]).any()
    drawn |= filled[0.03] & (torch.arange(len(drawn)) == filled[0.03].nonzero()[0])
    further = known(toy, avatar).prior.filled_in
    assert further is not None
    assert not further[drawn].any(), "hair that the mesh shows at its height is trained, and so is a band around it"
    assert (further & ~head_parts(model).interior & ~filled[0.03]).logical_not().all()


def test_high_hair_is_drawn_where_the_mesh_is_not(toy: Toy) -> None:
    """High hair on the back of a head stands out beside the face. Nothing is drawn outside of the head's mask."""
    model, sequence = toy
    behind = facing(model) < -0.2

    def drawn(height: float, given: Sequence) -> torch.Tensor:
        above = torch.where(behind, height, 0.0)
        return drawn_at_height(model, above, [given], [given.tracking.face], training_frames([given], SETTINGS))

    assert drawn(0.0, sequence)[facing(model) > 0.7].all()
    assert not drawn(0.0, sequence)[behind].any()
    assert drawn(0.05, sequence)[behind].any()
    assert not drawn(0.05, replace(sequence, scoring=np.zeros_like(sequence.scoring))).any()


def test_fills_keep_their_opacity_at_resets(toy: Toy) -> None:
    sequence = toy[1]
    avatar = bare_avatar(toy)
    unseen = known(toy, avatar)
    surface_of(avatar).close(unseen.prior)
    before = avatar.gaussian_store()["opacity_logits"].sigmoid()
    control, fills = spare_fills(avatar, avatar.density(), unseen), unseen.filled_in(avatar)
    assert isinstance(control, GradientDensity)
    assert fills is not None
    assert control.settings.max_gaussians == plain_gaussian_avatars().density.max_gaussians + int(fills.sum())
    density = density_strategy(control, avatar.gaussian_store())
    posed = avatar.pose(sequence.tracking.face[0])
    density.adapt(avatar.gaussian_store(), posed, Progress(39, 100, 0, 1.0), lambda: torch.Generator())
    opacities, filled_in = avatar.gaussian_store()["opacity_logits"].sigmoid(), unseen.filled_in(avatar)
    assert filled_in is not None
    assert opacities[filled_in].equal(before[filled_in])
    assert (opacities[filled_in] > 0.69).all(), "fills have 0.97, and strands 0.7"
    assert (opacities[~filled_in] < 0.011).all()


def test_other_methods_train_on_everything(toy: Toy) -> None:
    model, sequence = toy
    avatar = METHODS["headgas"].avatar(METHODS["headgas"].config(), model, sequence.tracking.face)
    unseen = known(toy, avatar)
    assert unseen.coverage is not None
    assert unseen.filled_in(avatar) is None
    weights = Photometric(alpha_weight=0.0)
    assert unseen.weights(weights) == weights
    density = avatar.density()
    assert type(spare_fills(avatar, avatar.density(), unseen)) is type(density)
    assert avatar.surface() is None


def test_fills_close_the_head(toy: Toy) -> None:
    """From behind, where nothing was seen, the head is opaque and has the colours of the fill."""
    model = toy[0]
    avatar = bare_avatar(toy)
    filled_in = facing(model) <= 0
    colors = torch.tensor([0.2, 0.4, 0.6]).expand(len(filled_in), 3)
    surface_of(avatar).close(SurfacePrior(torch.zeros(len(filled_in)), None, colors, filled_in.float(), filled_in))
    assert len(avatar.gaussian_store()) == len(filled_in)
    vertices = model.head_vertices(avatar.subject)[0]
    camera = view_of_head(vertices, 180)
    turned = replace(avatar.subject, head_rotation=torch.zeros(1, 3), head_translation=torch.zeros(1, 3))
    rendering = rasterize(avatar.pose(turned).gaussians.timestep(0), camera, torch.ones(3))
    middle = slice(56, 72)
    assert rendering.alpha[middle, middle].min() > 0.95
    color = rendering.image[middle, middle].reshape(-1, 3).mean(0)
    torch.testing.assert_close(color, colors[0], atol=0.03, rtol=0)
    hair = SurfacePrior(torch.full((len(filled_in),), 0.02), None, colors, filled_in.float(), filled_in)
    surface_of(avatar).close(hair)
    assert (avatar.gaussian_store()["means"][:, 1] > 0).all()


def test_colors_are_pulled_where_nothing_shows_them(toy: Toy) -> None:
    model = toy[0]
    avatar = bare_avatar(toy)
    doubt = (facing(model) <= 0).float()
    before = avatar.gaussian_store()["sh_constant"].detach().clone()
    prior = SurfacePrior(0 * doubt, None, torch.ones(len(doubt), 3), doubt)
    for _ in range(200):
        surface_of(avatar).keep_to(replace(prior, filled_in=doubt > 0))
    assert torch.equal(avatar.gaussian_store()["sh_constant"], before), "what is made up keeps its colours"
    for _ in range(200):
        surface_of(avatar).keep_to(prior)
    colors = avatar.gaussian_store()["sh_constant"].detach()
    assert torch.equal(colors[doubt == 0], before[doubt == 0])
    torch.testing.assert_close(rgb_from_sh(colors[doubt > 0][:, 0]), torch.ones(int(doubt.sum()), 3), atol=1e-3, rtol=0)


def test_hanging_hair_may_stand_out_from_the_surface(toy: Toy) -> None:
    """Fills have limits to the surface, and hair that hangs beside a triangle widens them there alone."""
    model = toy[0]
    avatar = bare_avatar(toy)
    count = len(model.faces)
    hanging = 0.05 * (torch.arange(count) % 2).float()
    with torch.no_grad():
        avatar.gaussian_store()["means"][:, 1] = 1e3
    surface_of(avatar).keep_to(
        SurfacePrior(torch.zeros(count), hanging, None, None, torch.zeros(count, dtype=torch.bool))
    )
    bound, limits = avatar.gaussian_store()["face_index"], plain_gaussian_avatars().surface
    height = avatar.gaussian_store()["means"][:, 1] * surface_of(avatar).sizes[bound]
    torch.testing.assert_close(height, limits.depth + limits.hair_share * hanging[bound])


@pytest.mark.unchecked
def test_a_run_keeps_its_coverage(toy: Toy, tmp_path: Path) -> None:
    """tests/test_hair_surface.py resumes such a run."""
    model, sequence = toy
    config = plain_gaussian_avatars()
    whole = train([sequence], model, config, SETTINGS, tmp_path / "whole")
    kept = read_coverage(tmp_path / "whole", model)
    assert kept is not None
    assert torch.equal(kept.seen, covered(toy).seen)
    loaded = load_avatar(tmp_path / "whole")
    assert torch.equal(loaded.gaussian_store()["opacity_logits"], whole.gaussian_store()["opacity_logits"])
    filled_in = known(toy, whole).filled_in(whole)
    assert filled_in is not None
    assert filled_in.any()
    assert (whole.pose(sequence.tracking.face[0]).gaussians.opacities[filled_in] > 0.69).all()
    plain = train([sequence], model, config, replace(SETTINGS, unseen="trained"), tmp_path / "plain")
    of_plain = read_coverage(tmp_path / "plain", model)
    assert of_plain is not None, "each run knows what was filmed"
    assert torch.equal(of_plain.seen, kept.seen)
    assert len(plain.gaussian_store()["face_index"].unique()) == len(model.faces)


def test_damaged_coverage_is_named(toy: Toy, tmp_path: Path) -> None:
    model = toy[0]
    found = covered(toy)
    write_coverage(tmp_path, found)
    known = read_coverage(tmp_path, model)
    assert known is not None
    assert torch.equal(known.colors, found.colors)
    write_coverage(tmp_path, replace(found, seen=found.seen + 1))
    with pytest.raises(UserError, match=FILE):
        read_coverage(tmp_path, model)


def test_words_and_angles_say_which_sides_were_filmed(toy: Toy) -> None:
    """The angles grow to the side that was filmed, here the person's left, and never shrink."""
    model = toy[0]
    vertices, ones = model.head_vertices(toy_face(1))[0], torch.ones(len(model.faces))
    colors, middle = torch.zeros(len(ones), 3), model.template[model.faces].mean(1)
    front_and_left, left, everything, nothing = (
        Coverage(shown, colors, ones)
        for shown in (((middle[:, 2] > 0) | (middle[:, 0] > 0)).float(), (middle[:, 0] > 0).float(), ones, 0 * ones)
    )
    assert filmed_yaws(model, vertices, everything) == (180, 180)
    right, far = filmed_yaws(model, vertices, front_and_left) or (0, 0)
    assert 5 <= right < 60 < far < 180
    words = filmed_words(model, vertices, front_and_left)
    assert f"{right} degrees on the person's right to {far} on the left" in words
    assert "made up" in filmed_words(model, vertices, nothing)
    zeros = np.zeros(1, np.float32)
    known = Filmed(zeros, zeros, zeros[:, None], zeros, np.array([[-0.3, 0.1], [-0.2, 0.2]], np.float32))
    (low, high), (down, up) = with_shown_angles(known, model, vertices, left).head_angles
    assert low == np.float32(-0.3)
    assert high == pytest.approx(np.radians(60))
    assert down <= np.float32(-0.2)
    assert up >= np.float32(0.2)
    angles = with_shown_angles(known, model, vertices, everything).head_angles
    np.testing.assert_allclose(np.degrees(angles), [[-60, 60], [-30, 30]], atol=1e-4)
    unchanged = with_shown_angles(known, model, vertices, nothing).head_angles
    np.testing.assert_array_equal(unchanged, known.head_angles)


def test_the_inside_of_the_mouth_is_always_drawn(toy: Toy) -> None:
    model = toy[0]
    regions = (torch.arange(len(model.faces)) % 2).to(model.face_regions)
    mouth = replace(model, region_names=("skin", "mouth"), face_regions=regions)
    share = drawn_share(mouth, covered(toy))
    assert (share[regions == 1] == 1).all()
    assert torch.equal(share[regions == 0], covered(toy).seen[regions == 0])
