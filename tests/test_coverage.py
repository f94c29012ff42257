"""Train only what is seen: coverage of triangles, what training draws, the fill, and what views say about it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from known import known
from mien.avatar import Avatar
from mien.avatar.bound_surface import SurfacePrior
from mien.avatar.density import GradientDensity
from mien.avatar.methods import METHODS
from mien.avatar.ops import surface_limits
from mien.avatar.settings import Photometric, Progress
from mien.face import FaceModel, load_face_model
from mien.face.head_parts import head_parts
from mien.render import rasterize
from mien.runtime.baked import Filmed
from mien.training import train
from mien.training.footage import filmed as films
from mien.training.footage.coverage import Coverage, drawn_share, measure_coverage, smoothstep
from mien.training.footage.frames import Footage, training_frames
from mien.training.footage.sequence import Sequence
from mien.training.trainer import density_strategy
from mien.training.whole_head.head import prepare_whole_head
from mien.training.whole_head.unseen import UNSEEN_CONFIDENCE, Unseen, drawn_at_height, spare_fills, unseen_of
from plain_settings import plain_gaussian_avatars, plain_run
from refusals import refuses
from toy_scene import rgb_from_sh, surface_of, toy_face, toy_sequence

Toy = tuple[FaceModel, Sequence]
SETTINGS = plain_run(steps=6, split="none", unseen="filled", checkpoint_every=3, record_every=1)


toy = pytest.fixture(scope="module")(lambda: toy_sequence(timesteps=5, size=48))


def bare_avatar(toy: Toy) -> Avatar:
    model, sequence = toy
    return METHODS["gaussian_avatars"].avatar(plain_gaussian_avatars(), model, sequence.tracking.face)


def footage_of(model: FaceModel, sequence: Sequence) -> Footage:
    return Footage(model, [sequence], [sequence.tracking.face], training_frames([sequence], SETTINGS))


def covered(toy: Toy) -> Coverage:
    model, sequence = toy
    return measure_coverage(footage_of(model, sequence))


def facing(model: FaceModel) -> torch.Tensor:
    """The z of each triangle's normal in the head frame: 1 faces the camera, -1 is the back of the head."""
    vertices = model.head_vertices(toy_face(1))[0]
    a, b, c = (vertices[model.faces[:, corner]] for corner in range(3))
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)[:, 2]


def test_the_front_is_seen_and_not_the_back_nor_what_is_cut_off(toy: Toy) -> None:
    model, sequence = toy
    found, front = covered(toy), facing(model)
    assert (found.seen[front > 0.7] > 0.95).all()
    assert not found.seen[front < -0.3].any()
    assert (found.colors[found.seen == 0] == 0.5).all()
    assert ((found.seen > 0.02) & (found.seen < 0.98)).any(), "confidence fades"
    torch.testing.assert_close(smoothstep(torch.tensor([-1.0, 0, 0.5, 1, 2])), torch.tensor([0.0, 0, 0.5, 1, 1]))
    frames = training_frames([sequence], SETTINGS)
    threaded = measure_coverage(Footage(model, [sequence], [sequence.tracking.face], frames), threads=3)
    assert torch.equal(threaded.seen, found.seen)
    gray = replace(sequence, capture=replace(sequence.capture, images=np.full_like(sequence.capture.images, 51)))
    colors = covered((model, gray)).colors[found.seen > 0.5]
    torch.testing.assert_close(colors, torch.full_like(colors, 0.2))
    regions = (torch.arange(len(model.faces)) % 2).to(model.face_regions)
    mouth = replace(model, region_names=("skin", "mouth"), face_regions=regions)
    drawn = torch.where(regions == 1, 1.0, found.seen)
    assert torch.equal(drawn_share(mouth, found), drawn), "the inside of the mouth is always drawn"
    model, sequence = toy
    assert not covered((model, replace(sequence, scoring=np.zeros_like(sequence.scoring)))).seen.any()
    assert (covered(toy).above == 1).all()
    middle = torch.tensor([0.0, -1.0, 24.0]).expand_as(sequence.tracking.neck_lines)
    above = covered((model, replace(sequence, tracking=replace(sequence.tracking, neck_lines=middle)))).above
    heights = model.template[model.faces].mean(1)[:, 1]
    assert (above[heights > 0.04] == 1).all()
    assert (above[heights < -0.04] == 0).all()


def test_what_is_behind_is_hidden_and_high_hair_is_drawn_where_the_mesh_is_not(toy: Toy) -> None:
    """A second head inside of the first faces the camera as well, and is never seen."""
    model, sequence = toy
    v, half = len(model.template), len(model.faces)
    faces = torch.cat([model.faces, model.faces + v])
    twice = replace(
        model, template=torch.cat([model.template, 0.7 * model.template]), faces=faces, uv=torch.zeros(2 * v, 2),
        uv_faces=faces, face_regions=model.face_regions.repeat(2), identity_basis=torch.zeros(2, 2 * v, 3),
        expression_basis=torch.zeros(2, 2 * v, 3), skinning_weights=torch.eye(3)[:1].repeat(2 * v, 1),
    )  # fmt: skip
    seen = covered((twice, sequence)).seen
    assert (seen[:half][facing(model) > 0.8] > 0.9).all()
    assert not seen[half:].any()
    # High hair on the back of a head stands out beside the face. Nothing is drawn outside of the head's mask.
    model, sequence = toy
    behind = facing(model) < -0.2

    def drawn(height: float, given: Sequence) -> torch.Tensor:
        above = torch.where(behind, height, 0.0)
        return drawn_at_height(footage_of(model, given), above)

    assert drawn(0.0, sequence)[facing(model) > 0.7].all()
    assert not drawn(0.0, sequence)[behind].any()
    assert drawn(0.05, sequence)[behind].any()
    assert not drawn(0.05, replace(sequence, scoring=np.zeros_like(sequence.scoring))).any()


def measured(toy: Toy, avatar: Avatar) -> Unseen:
    return unseen_of(avatar, footage_of(avatar.face_model, toy[1]), filled=True)


def test_only_what_is_seen_is_trained_and_so_are_features(toy: Toy) -> None:
    """Fills have no gradients but those that move them along their normal."""
    sequence, avatar = toy[1], bare_avatar(toy)
    unseen, store = measured(toy, avatar), avatar.store
    surface_of(avatar).close(unseen.prior)
    filled_in = known(unseen.filled_in(surface_of(avatar)))
    assert 0 < int(filled_in.sum()) < len(filled_in)
    assert unseen.weights(Photometric(alpha_weight=0.0)).alpha_weight > 0
    behind = replace(sequence.tracking.face[0], head_rotation=torch.tensor([[0.0, 3.0, 0.0]]))
    rendering = rasterize(avatar.pose(behind).gaussians.timestep(0), sequence.tracking.cameras[0], torch.ones(3))
    rendering.image[:, :24].sum().backward()
    before = {name: gradient.clone() for name in store.trained if (gradient := store[name].grad) is not None}
    assert before["sh_constant"][filled_in].any()
    unseen.mask_gradients(avatar, surface_of(avatar), rendering)
    for name, gradient in before.items():
        guarded = known(store[name].grad)
        assert torch.equal(guarded[~filled_in], gradient[~filled_in])
        assert name == "means" or not guarded[filled_in].any()
    moved = known(store["means"].grad)[filled_in]
    assert moved[:, 1].any()
    assert not moved[:, [0, 2]].any()
    # Their bases have a gradient of their own kind, which is masked like the others.
    model, sequence = toy
    config = plain_gaussian_avatars(appearance="features", appearance_directions=2, appearance_features=3)
    avatar = METHODS["gaussian_avatars"].avatar(config, model, sequence.tracking.face)
    with torch.no_grad():
        avatar.store["feature_bases"].normal_()
        (network,) = (group for group in avatar.parameter_groups() if group.name == "appearance")
        for tensor in network.tensors.values():
            tensor.normal_()
    unseen = measured(toy, avatar)
    filled_in = known(unseen.filled_in(surface_of(avatar)))
    gaussians = avatar.pose(sequence.tracking.face[0]).gaussians
    (gaussians.sh.sum() + gaussians.opacities.sum()).backward()
    (factored,) = (one for group in avatar.parameter_groups() for one in group.factored.values())
    rows = factored.terms[0].rows
    expected = torch.where(filled_in[:, None], 0, rows)
    assert not rows.equal(expected)
    unseen.mask_gradients(avatar, surface_of(avatar))
    assert rows.equal(expected)


@pytest.mark.unchecked
def test_what_is_beside_shown_triangles_is_trained(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hair above a band beside what pictures show is on their outline, so pictures train it. Fills begin behind it."""
    model, avatar = toy[0], bare_avatar(toy)
    middles, found = model.head_vertices(avatar.subject)[0][model.faces].mean(1), covered(toy)
    apart = torch.cdist(middles, middles[found.seen > UNSEEN_CONFIDENCE]).amin(1)
    drawn = torch.zeros(len(model.faces), dtype=torch.bool)
    monkeypatch.setattr("mien.training.whole_head.unseen.drawn_at_height", lambda *given: drawn)

    def filled(band: float) -> torch.Tensor:
        monkeypatch.setattr("mien.training.whole_head.unseen.OUTLINE_BAND", band)
        return known(measured(toy, avatar).prior.filled_in) & ~head_parts(model).interior

    every, behind = filled(0.0), filled(0.03)
    assert behind.equal(every & (apart > 0.03))
    assert 0 < int(behind.sum()) < int(every.sum())
    drawn[behind.nonzero()[0]] = True
    further = filled(0.03)
    assert not further[drawn].any(), "hair that the mesh shows at its height is trained, and so is a band around it"
    assert not further[~behind].any()


def test_fills_keep_their_opacity_at_resets(toy: Toy) -> None:
    avatar = bare_avatar(toy)
    unseen, store = measured(toy, avatar), avatar.store
    surface_of(avatar).close(unseen.prior)
    before, fills = store["opacity_logits"].sigmoid(), known(unseen.filled_in(surface_of(avatar)))
    control = spare_fills(surface_of(avatar), avatar.density(), unseen, int(fills.sum()))
    assert isinstance(control, GradientDensity)
    assert control.settings.max_gaussians == plain_gaussian_avatars().density.max_gaussians + int(fills.sum())
    posed = avatar.pose(toy[1].tracking.face[0])
    strategy = density_strategy(control, store)
    assert strategy is not None
    strategy.adapt(store, posed, Progress(39, 100, 0, 1.0), lambda: torch.Generator())
    opacities, filled_in = store["opacity_logits"].sigmoid(), known(unseen.filled_in(surface_of(avatar)))
    assert opacities[filled_in].equal(before[filled_in])
    assert (opacities[filled_in] > 0.69).all(), "fills have 0.97, and strands 0.7"
    assert (opacities[~filled_in] < 0.011).all()


def test_other_methods_have_no_surface(toy: Toy) -> None:
    model, sequence = toy
    avatar = METHODS["headgas"].avatar(METHODS["headgas"].config(), model, sequence.tracking.face)
    assert prepare_whole_head(avatar, footage_of(model, sequence), replace(SETTINGS, unseen="filled")) is None


def test_fills_close_the_head(toy: Toy) -> None:
    """From behind, where nothing was seen, the head is opaque and has the colours of the fill."""
    model, avatar = toy[0], bare_avatar(toy)
    filled_in = facing(model) <= 0
    color = torch.tensor([0.2, 0.4, 0.6])
    hair = torch.zeros(len(filled_in))
    prior = SurfacePrior(hair, None, color.expand(len(filled_in), 3), filled_in.float(), filled_in)
    surface_of(avatar).close(prior)
    assert len(avatar.store) == len(filled_in)
    camera = films.view_of_head(model.head_vertices(avatar.subject)[0], 180)
    turned = replace(avatar.subject, head_rotation=torch.zeros(1, 3), head_translation=torch.zeros(1, 3))
    rendering = rasterize(avatar.pose(turned).gaussians.timestep(0), camera, torch.ones(3))
    assert rendering.alpha[56:72, 56:72].min() > 0.95
    torch.testing.assert_close(rendering.image[56:72, 56:72].mean((0, 1)), color, atol=0.03, rtol=0)
    surface_of(avatar).close(replace(prior, hair=hair + 0.02))
    assert (avatar.store["means"][:, 1] > 0).all()


def test_colors_are_pulled_where_nothing_shows_them(toy: Toy) -> None:
    avatar, doubt = bare_avatar(toy), (facing(toy[0]) <= 0).float()
    before = avatar.store["sh_constant"].detach().clone()
    prior = SurfacePrior(0 * doubt, None, torch.ones(len(doubt), 3), doubt)
    for filled_in, pulled in ((doubt > 0, doubt > 1), (None, doubt > 0)):  # what is made up keeps its colours
        for _ in range(200):
            surface_of(avatar).keep_to(replace(prior, filled_in=filled_in))
        colors = avatar.store["sh_constant"].detach()
        assert torch.equal(colors[~pulled], before[~pulled])
        torch.testing.assert_close(rgb_from_sh(colors[pulled]), torch.ones_like(colors[pulled]), atol=1e-3, rtol=0)


def test_hanging_hair_may_stand_out_from_the_surface(toy: Toy) -> None:
    """Fills have limits to the surface, and hair that hangs beside a triangle widens them there alone."""
    avatar, none = bare_avatar(toy), torch.zeros(len(toy[0].faces))
    hanging = 0.05 * (torch.arange(len(none)) % 2).float()
    store = avatar.store
    with torch.no_grad():
        store["means"][:, 1] = 1e3
    surface_of(avatar).keep_to(SurfacePrior(none, hanging, None, None, none.bool()))
    bound = store["face_index"]
    height = store["means"][:, 1] * surface_of(avatar).sizes[bound]
    torch.testing.assert_close(height, surface_limits.DEPTH + surface_limits.HAIR_SHARE * hanging[bound])


@pytest.mark.unchecked
def test_a_run_keeps_its_coverage(toy: Toy, tmp_path: Path) -> None:
    model, sequence = toy
    config, seen = plain_gaussian_avatars(), covered(toy).seen
    whole = train([sequence], model, config, SETTINGS, tmp_path / "whole")
    filled_in = known(measured(toy, whole).filled_in(surface_of(whole)))
    assert filled_in.any()
    assert (whole.pose(sequence.tracking.face[0]).gaussians.opacities[filled_in] > 0.69).all()
    plain = train([sequence], model, config, replace(SETTINGS, unseen="trained"), tmp_path / "plain")
    assert len(plain.store["face_index"].unique()) == len(model.faces)
    for name in ("whole", "plain"):  # each run knows what was filmed
        assert torch.equal(known(films.read_coverage(tmp_path / name, model)).seen, seen)


def test_coverage_of_another_face_model_is_refused(toy: Toy, tmp_path: Path) -> None:
    found = covered(toy)
    films.write_coverage(tmp_path, found)
    assert torch.equal(known(films.read_coverage(tmp_path, toy[0])).colors, found.colors)
    refuses(films.FILE, films.read_coverage, tmp_path, load_face_model("anny"))


def test_words_and_angles_say_which_sides_were_filmed(toy: Toy) -> None:
    """The angles grow to the side that was filmed, here the person's left, and never shrink."""
    model = toy[0]
    vertices, ones = model.head_vertices(toy_face(1))[0], torch.ones(len(model.faces))
    colors, middle = torch.zeros(len(ones), 3), model.template[model.faces].mean(1)
    sides = (middle[:, 2] > 0) | (middle[:, 0] > 0), middle[:, 0] > 0, middle[:, 1] < 0
    front_and_left, left, lower, everything, nothing = (
        Coverage(shown, colors, ones) for shown in (*(side.float() for side in sides), ones, 0 * ones)
    )
    assert films.filmed_yaws(model, vertices, everything) == (180, 180)
    right, far = films.filmed_yaws(model, vertices, front_and_left) or (0, 0)
    assert 5 <= right < 60 < far < 180
    words = films.filmed_words(model, vertices, front_and_left)
    assert f"{right} degrees on the person's right to {far} on the left" in words
    assert "made up" in films.filmed_words(model, vertices, nothing)
    zeros, angles = np.zeros(1, np.float32), np.array([[-0.3, 0.1], [-0.2, 0.2]], np.float32)
    filmed, degrees = Filmed(zeros, zeros, angles), np.degrees(angles)
    for coverage, expected in (
        (left, [[degrees[0, 0], 60], [-30, 30]]), (everything, [[-60, 60], [-30, 30]]), (nothing, degrees),
        (lower, [[-60, 60], [-30, degrees[1, 1]]]),
    ):  # fmt: skip
        found = np.degrees(films.with_shown_angles(filmed, model, vertices, coverage).head_angles)
        np.testing.assert_allclose(found, expected, atol=1e-4)
