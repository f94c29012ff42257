"""Train only what is seen: coverage of triangles, what training draws, the fill, and what views say about it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien import runtime
from mien.avatar import (
    METHODS,
    Avatar,
    Photometric,
    Progress,
    SurfacePrior,
    load_avatar,
    make_portable,
)
from mien.avatar.density import GradientDensity
from mien.errors import UserError
from mien.export import MeshModel, read_glb, read_ply, write_glb, write_page, write_ply
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

SETTINGS = plain_run(steps=6, split="none", unseen="filled", checkpoint_every=3, record_every=1)


@pytest.fixture(scope="module")
def toy() -> tuple[FaceModel, Sequence]:
    return toy_sequence(timesteps=5, size=48)


def bare_avatar(toy: tuple[FaceModel, Sequence]) -> Avatar:
    model, sequence = toy
    return METHODS["gaussian_avatars"].avatar(plain_gaussian_avatars(), model, sequence.tracking.face)


def covered(toy: tuple[FaceModel, Sequence]) -> Coverage:
    model, sequence = toy
    return measure_coverage(model, [sequence], [sequence.tracking.face], training_frames([sequence], SETTINGS))


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
    threaded = measure_coverage(
        model, [sequence], [sequence.tracking.face], [Frame(0, t, 0) for t in range(5)], threads=3
    )
    assert torch.equal(threaded.seen, found.seen)


def test_colors_are_those_of_the_pictures(toy: tuple[FaceModel, Sequence]) -> None:
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


def known(toy: tuple[FaceModel, Sequence], avatar: Avatar) -> Unseen:
    sequence = toy[1]
    frames = training_frames([sequence], SETTINGS)
    return unseen_of(avatar, [sequence], [sequence.tracking.face], frames, filled=True)


def test_only_what_is_seen_is_trained(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_features_of_fills_are_not_trained(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_what_is_beside_shown_triangles_is_trained(
    toy: tuple[FaceModel, Sequence], monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_high_hair_is_drawn_where_the_mesh_is_not(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_fills_keep_their_opacity_at_resets(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_other_methods_train_on_everything(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_fills_close_the_head(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_colors_are_pulled_where_nothing_shows_them(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_hanging_hair_may_stand_out_from_the_surface(toy: tuple[FaceModel, Sequence]) -> None:
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


def test_a_run_keeps_its_coverage_and_resumes_exactly(toy: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    model, sequence = toy
    config = plain_gaussian_avatars()
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
    of_plain = read_coverage(tmp_path / "plain", model)
    assert of_plain is not None, "each run knows what was filmed"
    assert torch.equal(of_plain.seen, kept.seen)
    assert len(plain.gaussian_store()["face_index"].unique()) == len(model.faces)


def test_a_filled_avatar_is_exported_as_it_is_posed(toy: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    """Fills are Gaussians like all others in each format: .mien, .ply, .glb and .html."""
    model, sequence = toy
    avatar = train([sequence], model, plain_gaussian_avatars(), SETTINGS, tmp_path / "run")
    filled_in = known(toy, avatar).filled_in(avatar)
    assert filled_in is not None
    assert filled_in.any()
    portable = make_portable(avatar, sequence.tracking.cameras[0], "filled")
    runtime.write_portable(tmp_path / "a.mien", portable)
    carried = runtime.load(tmp_path / "a.mien")
    face = replace(avatar.subject, expression=torch.full_like(avatar.subject.expression, 0.3))
    posed = avatar.pose(face).gaussians.detach().timestep(0)
    ours = carried.pose(face.expression[0].numpy())
    write_ply(tmp_path / "a.ply", posed)
    ply = read_ply(tmp_path / "a.ply")
    for name in ("means", "scales", "opacities", "sh"):
        expected = getattr(posed, name)
        torch.testing.assert_close(torch.from_numpy(getattr(ours, name)), expected, atol=1e-6, rtol=1e-4)
        torch.testing.assert_close(getattr(ply, name), expected, atol=1e-6, rtol=1e-4)
    assert (posed.opacities[filled_in] > 0.69).all()
    baked = portable.baked
    assert isinstance(baked, runtime.MeshBound)
    unwrapped = MeshModel(baked.rig, baked.faces, model.uv.numpy(), model.uv_faces.numpy())
    write_glb(tmp_path / "a.glb", portable, unwrapped, 64)
    glb = read_glb(tmp_path / "a.glb")
    attributes = glb.content["meshes"][1]["primitives"][0]["attributes"]
    np.testing.assert_array_equal(glb.array(attributes["_TRIANGLE"]), avatar.gaussian_store()["face_index"].numpy())
    opacities = glb.array(attributes["KHR_gaussian_splatting:OPACITY"])
    np.testing.assert_allclose(opacities, posed.opacities.numpy(), atol=1e-6)
    assert write_page(tmp_path / "a.html", portable).psnr > 40


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


def test_a_filled_head_may_turn_where_half_of_it_was_filmed(toy: tuple[FaceModel, Sequence]) -> None:
    """The angles grow to the side that was filmed, to the person's left, and never shrink."""
    model = toy[0]
    vertices, ones = model.head_vertices(toy_face(1))[0], torch.ones(len(model.faces))
    colors, middle = torch.zeros(len(ones), 3), model.template[model.faces].mean(1)
    zeros = np.zeros(1, np.float32)
    known = Filmed(zeros, zeros, zeros[:, None], zeros, np.array([[-0.3, 0.1], [-0.2, 0.2]], np.float32))
    left = Coverage((middle[:, 0] > 0).float(), colors, ones)
    (low, high), (down, up) = with_shown_angles(known, model, vertices, left).head_angles
    assert low == np.float32(-0.3)
    assert high == pytest.approx(np.radians(60))
    assert down <= np.float32(-0.2)
    assert up >= np.float32(0.2)
    everything = with_shown_angles(known, model, vertices, Coverage(ones, colors, ones)).head_angles
    np.testing.assert_allclose(np.degrees(everything), [[-60, 60], [-30, 30]], atol=1e-4)
    nothing = with_shown_angles(known, model, vertices, Coverage(0 * ones, colors, ones)).head_angles
    np.testing.assert_array_equal(nothing, known.head_angles)


def test_smoothstep_is_flat_at_both_ends() -> None:
    torch.testing.assert_close(smoothstep(torch.tensor([-1.0, 0, 0.5, 1, 2])), torch.tensor([0.0, 0, 0.5, 1, 1]))


def test_the_inside_of_the_mouth_is_always_drawn(toy: tuple[FaceModel, Sequence]) -> None:
    model = toy[0]
    regions = (torch.arange(len(model.faces)) % 2).to(model.face_regions)
    mouth = replace(model, region_names=("skin", "mouth"), face_regions=regions)
    share = drawn_share(mouth, covered(toy))
    assert (share[regions == 1] == 1).all()
    assert torch.equal(share[regions == 0], covered(toy).seen[regions == 0])
