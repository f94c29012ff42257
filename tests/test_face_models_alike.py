"""One suite over face models of all schemas: mesh, regions, joints, landmarks, tracking, driving.

`make test` tracks the model in FLAME's schema alone: its bases have no names, its jaw is a joint, and its landmarks and
regions are embedded, so that most can break there. `test_face_models_alike` trains an avatar on it."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from face_models import NAMES, face_model_named
from flame_like import exact_landmarks, flame_like, write_npz
from gnm_like import gnm_landmarks, gnm_like, write_gnm
from mien.avatar import load_avatar
from mien.camera import Camera
from mien.capture import write_capture
from mien.capture.capture import Capture
from mien.cli import main
from mien.disk.files import file_digest, write_json
from mien.driving import drive
from mien.driving.expression_map import fit_expression_map
from mien.driving.motion import ARKIT_NAMES, Motion, gaze_of
from mien.driving.transfer import face_of_motion
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.cache import cache_folder
from mien.face.chart import find_outside
from mien.face.checks import check_face_model
from mien.face.listing import available_face_models
from mien.face.model import Landmarks
from mien.lab.synthetic import synthesize
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.pipeline import face_models as stage
from mien.render.mesh import render_mesh
from mien.runtime import load as load_portable
from mien.tracking import read_tracking, track
from mien.tracking.landmarks import embedding
from mien.tracking.landmarks.detector_response import OFFSET_SIGMA, read_response
from mien.tracking.landmarks.embedding import EmbeddingSettings
from mien.tracking.landmarks.groups import LEFT_IRIS, RIGHT_IRIS
from mien.tracking.settings import PaperSettings, PhotometricSettings, TrackingSettings
from refusals import complaint, refuses

pytestmark = pytest.mark.unchecked

COSTLY = ["flame", *(pytest.param(name, marks=pytest.mark.long) for name in NAMES if name != "flame")]
UPPER_LIP, LOWER_LIP, CHIN, NOSE, CORNER_LEFT, CORNER_RIGHT = 13, 14, 152, 4, 291, 61
LIDS = {"Left": (386, 374), "Right": (159, 145)}


@pytest.fixture(scope="module", params=NAMES)
def model(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> FaceModel:
    data = request.getfixturevalue("test_data") if request.param == "ict" else None
    return face_model_named(request.param, tmp_path_factory.mktemp(request.param), data)


def _marks(model: FaceModel, face: FaceParams) -> Tensor:
    return model.landmark_positions(model.head_vertices(face), "mediapipe")


def test_the_mesh_is_a_head_whose_joints_move_their_parts_alone(model: FaceModel) -> None:
    """Arrays fit each other; the outside faces outwards; eyes, regions and landmarks are where every head has them."""
    check_face_model(model, model.name, "-")
    faces = model.faces.numpy()
    assert (faces[:, :2] != faces[:, 1:]).all()
    assert find_outside(model.template.numpy(), faces).sum() > 1500
    x, y, z = model.template[model.faces[model.region_mask("irises")]].mean((0, 1)).tolist()
    assert abs(x) < 0.001
    assert abs(y) < 0.005
    assert 0.085 < z < 0.11
    assert 0.18 < float(model.template[:, 1].amax() - model.template[:, 1].amin()) < 0.4
    middle = model.template[model.faces].mean(1)
    masks = {name: model.region_mask(name) for name in ("neck", "lips", "nose", "scalp", "brows", "irises", "mouth")}
    assert min(int(mask.sum()) for mask in masks.values()) > 8
    at = {name: middle[mask].mean(0) for name, mask in masks.items()}
    assert at["neck"][1] < at["lips"][1] - 0.03 < at["nose"][1] - 0.03
    assert at["scalp"][2] < at["brows"][2]
    assert at["brows"][1] > at["irises"][1] > at["nose"][1] > at["lips"][1]
    assert at["mouth"][2] < at["lips"][2]
    assert middle[model.region_mask("ears"), 0].abs().mean() > 0.06
    assert middle[model.region_mask("eyes", "irises"), 0].abs().max() < 0.055
    marks = _marks(model, model.neutral())[0]
    assert marks.shape == (478, 3)
    assert marks[list(LEFT_IRIS), 0].min() > 0.02 > -0.02 > marks[list(RIGHT_IRIS), 0].max()
    assert marks[CHIN, 1] < marks[LOWER_LIP, 1] <= marks[UPPER_LIP, 1] < marks[NOSE, 1] < marks[10, 1]
    assert marks[NOSE, 2] > marks[:, 2].max() - 0.004
    assert marks[CORNER_LEFT, 0] > 0.015 > -0.015 > marks[CORNER_RIGHT, 0]
    assert model.landmarks["ibug68"].faces.shape == (68,)
    rest = model.neutral()
    for name in ("left_eye", "right_eye", "neck"):
        joints = rest.joints.clone()
        joints[0, model.free_joint_names.index(name), 1] = 0.3
        moved = (model.head_vertices(replace(rest, joints=joints)) - model.head_vertices(rest))[0]
        size, x = moved.norm(dim=1), model.template[:, 0]
        if name == "neck":
            assert size[model.template[:, 1] > -0.06].max() < 1e-3
            assert size[model.faces[model.region_mask("neck")].unique()].max() > 0.01
            continue
        side = 1 if name == "left_eye" else -1
        ball = model.faces[model.region_mask("irises")].unique()
        looked = ball[x[ball] * side > 0]
        assert (moved[looked, 0] > 0.002).all(), "a positive angle about y looks to the subject's left"
        assert size[x * side < 0].max() < 1e-3


def _faces_of(coefficients: np.ndarray, model: FaceModel) -> tuple[FaceParams, FaceParams]:
    """Return the faces of ARKit's coefficients [t, 52] on a head that stands still, and the face at rest."""
    still = np.zeros((len(coefficients), 3), np.float32)
    return face_of_motion(Motion(25.0, coefficients, gaze_of(coefficients), still, still, 0), model)


def _moving(model: FaceModel, timesteps: int) -> FaceParams:
    """Return a person who turns, opens the mouth and looks around, in front of the camera."""
    time = torch.linspace(0, 1, timesteps)
    coefficients = np.zeros((timesteps, 52), np.float32)
    coefficients[:, ARKIT_NAMES.index("jawOpen")] = 0.3 * (1 - np.cos(9 * time.numpy()))
    for side in ("Left", "Right"):
        coefficients[:, ARKIT_NAMES.index(f"mouthSmile{side}")] = 0.25 * (1 + np.sin(5 * time.numpy()))
    face, _ = _faces_of(coefficients, model)
    random = torch.Generator().manual_seed(5)
    return replace(
        face, identity=0.4 * torch.randn(face.identity.shape, generator=random),
        head_rotation=torch.stack([0.1 * (5 * time).sin(), 0.3 * (4 * time).cos(), 0.05 * time], 1),
        head_translation=torch.tensor([0.0, 0.0, -0.9]).expand(timesteps, 3),
    )  # fmt: skip


def _as_detected(model: FaceModel, face: FaceParams) -> Tensor:
    """Landmarks in the world, with the offsets that the detector was measured to have on this model.
    Only anny was measured. Its fit takes these offsets away, so landmarks without them are not those of a picture."""
    response, double = read_response(model, OFFSET_SIGMA), face.to(torch.zeros((), dtype=torch.float64))
    offsets = response.mean + response.of_turns(double.head_rotation)
    offsets = offsets + torch.einsum("be,elc->blc", double.expression, response.by_expression)
    pose = double.T_world_head
    return (_marks(model, face).double() + offsets) @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]


@pytest.mark.parametrize("model", COSTLY, indirect=True)
def test_a_small_capture_is_tracked(model: FaceModel) -> None:
    """Pictures of 256 pixels and their landmarks give back turns, the opening of the mouth and the size of the head."""
    face = _moving(model, 8)
    K = torch.tensor([[390.0, 0, 128], [0, 390, 128], [0, 0, 1]])
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1, -1, 1])), 256, 256)
    colors = torch.tensor([0.8, 0.5, 0.4]) * (0.6 + 4 * model.template[:, 1:2].abs())
    drawn = [render_mesh(v, model.faces, camera, colors, background=(0.3, 0.4, 0.6)) for v in model(face)]
    images, mattes = (
        np.stack([(255 * each[part].clamp(0, 1)).byte().numpy() for each in drawn])[:, None] for part in range(2)
    )
    capture = Capture(
        name="clip", camera_ids=("0",), fps=25.0, timestamps=np.arange(8) / 25.0, images=images, mattes=mattes,
        landmarks=camera.project(_as_detected(model, face).float())[0].numpy()[:, None], valid=np.ones((8, 1), bool),
        principal_point=np.full((1, 2), 128, np.float32), source={},
    )  # fmt: skip
    pixel_fit = PhotometricSettings(sizes=(128,), texture_size=64, shared_steps=1, keyframes=4)
    tracking = track(capture, model, TrackingSettings(focal=390.0, keyframes=8, photometric=pixel_fit))
    assert tracking.pixel_residuals is not None
    assert tracking.residuals.nanmedian() < 0.5
    turn = torch.stack([tracking.face.head_rotation[:, 1], face.head_rotation[:, 1]]).double()
    assert torch.corrcoef(turn)[0, 1] > 0.995
    found, wanted = _marks(model, tracking.face), _marks(model, face)
    opened = torch.stack([(m[:, UPPER_LIP] - m[:, LOWER_LIP]).norm(dim=1) for m in (found, wanted)])
    assert torch.corrcoef(opened)[0, 1] > 0.97
    assert float((opened[0] - opened[1]).abs().mean()) < 0.003


def test_names_of_arkit_drive_it(model: FaceModel) -> None:
    """Each name moves what it names, on its own side."""
    names = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "eyeBlinkLeft", "eyeBlinkRight", "browInnerUp")
    coefficients = np.zeros((len(names) + 1, 52), np.float32)
    for row, name in enumerate(names):
        coefficients[row + 1, ARKIT_NAMES.index(name)] = 0.9
    face, rest = _faces_of(coefficients, model)
    marks = _marks(model, drive(face, rest, model.neutral(), model.expression_bounds))
    moved: dict[str, Tensor] = dict(zip(names, marks[1:] - marks[0], strict=True))
    assert float(moved["jawOpen"][UPPER_LIP, 1] - moved["jawOpen"][LOWER_LIP, 1]) > 0.012
    assert moved["jawOpen"][NOSE].norm() < 0.003
    for side, corner, other in (("Left", CORNER_LEFT, CORNER_RIGHT), ("Right", CORNER_RIGHT, CORNER_LEFT)):
        smile = moved[f"mouthSmile{side}"]
        assert smile[corner, 1] > 0.004
        assert smile[corner].norm() > 2 * smile[other].norm()
        upper, lower = LIDS[side]
        blink = moved[f"eyeBlink{side}"]
        assert float(blink[lower, 1] - blink[upper, 1]) > 0.004
        away = LIDS["Right" if side == "Left" else "Left"]
        assert blink[list(away)].norm(dim=1).max() < 0.3 * blink[upper].norm()
    # Principal directions that were kept of the generated models hold a third of it.
    assert moved["browInnerUp"][9, 1] > 0.0008
    assert moved["browInnerUp"][CHIN].norm() < 0.0005


RETURNED = {"anny": 1e-5, "flame": 1.4e-4, "gnm": 7.2e-5, "ict": 1e-5}
"""Largest mean distance of a landmark in metres, after a face of anny went to a model and back.

It is 1.5 times what was measured; anny and ICT have all of ARKit's names, so that nothing is lost there."""


def test_there_and_back(model: FaceModel, anny: FaceModel) -> None:
    """A face of anny, which moves by two millimetres on average, comes back from the model as the same face."""
    face = _moving(anny, 6)
    returned = fit_expression_map(model, anny)(fit_expression_map(anny, model)(face))
    plain = replace(face, identity=torch.zeros_like(face.identity))
    wanted, found = _marks(anny, plain), _marks(anny, returned)
    moved = (wanted - _marks(anny, anny.neutral())).norm(dim=-1)
    assert float(moved.amax()) > 0.015
    assert float(moved.mean()) > 0.0015
    assert torch.equal(returned.head_rotation, face.head_rotation)
    assert torch.equal(returned.head_translation, face.head_translation)
    assert float((wanted - found).norm(dim=-1).mean()) < RETURNED[model.name]


@pytest.fixture(scope="module")
def fresh(anny: FaceModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a cache that holds the anny model, and the file of the user's model."""
    folder = tmp_path_factory.mktemp("fresh")
    shutil.copytree(cache_folder() / "face_models", folder / "cache" / "face_models")
    write_npz(folder / "My Head.npz", flame_like(anny))
    return folder


@pytest.fixture
def added(fresh: Path, anny: FaceModel, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[int]]:
    """Run `mien face-models --add FILE`, with the landmarks that a detector would need minutes to find."""
    monkeypatch.setenv("MIEN_CACHE", str(fresh / "cache"))
    calls: list[int] = []

    def embed(model: FaceModel, settings: Any) -> tuple[dict[str, Landmarks], torch.Tensor]:
        calls.append(settings.pictures)
        return exact_landmarks(anny), torch.ones(478)

    monkeypatch.setattr(stage, "embed_landmarks", embed)
    stage.add_face_model_file(fresh / "My Head.npz")
    return fresh / "My Head.npz", calls


def test_it_is_added_once_and_then_goes_by_its_name(added, capsys):
    path, calls = added
    calls.clear()
    model = load_face_model("my_head")
    assert {"mediapipe", "ibug68"} == model.landmarks.keys()
    assert {"lips", "neck", "irises", "mouth"} <= set(model.region_names)
    for choice in (str(path), "my_head"):
        assert stage.face_model_of(choice).content_hash == model.content_hash
    assert not calls
    assert str(path) in {info.name: info.description for info in available_face_models()}["my_head"]
    # Models that are not there are told with their commands.
    assert main(["face-models"]) == 0
    told = capsys.readouterr().out
    for command in ("generic_model\n", "flame2023 --teeth\n", "flame2023_open --shareable\n", "ict\n"):
        assert f"add it with mien face-models --add FILE --name {command}" in told
    # One of another recipe is not there, and is added again.
    source = cache_folder() / "face_models/added/my_head.source.json"
    write_json(source, "mien.face_model_source", 1, {"path": str(path), "sha256": file_digest(path), "recipe": 1})
    assert "my_head" not in [info.name for info in available_face_models()]
    refuses("there is no face model 'my_head'", load_face_model, "my_head")
    for _ in range(2):
        assert main(["face-models", "--add", str(path)]) == 0
        assert "my_head" in [info.name for info in available_face_models()]
    assert len(calls) == 2, "coarse and fine: it is added once"


def test_choices_that_lead_nowhere(added, tmp_path, capsys):
    path, _ = added
    other, own, bare = (tmp_path / name for name in ("my_head.npz", "anny.npz", "x.npz"))
    for file in (other, own, bare):
        write_npz(file, {"weights": np.zeros(3)})
    for choice, message in (
        ("flame", r"there is no face model 'flame'; choose one of: anny, anny-bust, my_head, or give the path"),
        (tmp_path / "none.npz", "no such file"), (tmp_path, "neither the name"),
        (other, r"another file has the name 'my_head', .*My Head\.npz; .* --name NAME"),
        (own, "one of mien's own"), (bare, "has no 'v_template'"),
    ):  # fmt: skip
        refuses(message, stage.face_model_of, str(choice))
    refuses("letters, digits", stage.add_face_model_file, path, "../up")
    assert main(["face-models", "--name", "x"]) != 0
    assert "--add FILE" in capsys.readouterr().err
    told = complaint(capsys, "face-models", "--add", tmp_path)
    assert f"{tmp_path}: is a folder, and not ICT-FaceKit's FaceXModel; give a file in it: " in told


QUICKLY = (
    "--tracking.keyframes", "4", "--tracking.photometric.keyframes", "4", "--tracking.photometric.sizes", "64",
    "--tracking.photometric.texture-size", "64", "--tracking.photometric.shared-steps", "1",
)  # fmt: skip
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""


@pytest.fixture(scope="module")
def capture() -> Capture:
    """Return six small pictures of a head that is drawn with another model, anny."""
    recipe = SyntheticRecipe(
        name="clip", width=96, height=96, seconds=0.24, hair="none", glasses=False, brows_and_lashes=False,
        clothes=False, texture_size=256,
    )  # fmt: skip
    return synthesize(recipe, seed=2)[0]


@pytest.mark.usefixtures("short_films")
def test_from_pixels_to_an_avatar_that_is_not_passed_on(added, capture, tmp_path, capsys):
    (path, _), workspace, root = added, tmp_path, str(tmp_path)
    write_capture(tmp_path / "sequences" / "clip" / "capture", capture)
    assert main(["track", root, "--face-model", str(path), *QUICKLY]) == 0
    tracking = read_tracking(workspace / "sequences" / "clip" / "tracking")
    assert tracking.face_model == "my_head"
    assert tracking.pixel_residuals is not None
    assert main(["train", root, "--steps", "6", "--run", "a", "--preset", "draft", *PLAIN]) == 0
    assert main(["evaluate", root, "--run", "a", "--no-perceptual"]) == 0
    picture = workspace / "a.png"
    assert main(["render", root, "--run", "a", "--set", "expression_000=1", "jaw_x=0.2", "--out", str(picture)]) == 0
    assert main(["drive", root, "--run", "a", "--by", root, "--out", str(workspace / "a.mp4"), "--size", "64"]) == 0
    recording = workspace / "talk.json"
    recording.write_text('[{"time": 0, "blendshapes": {"jawOpen": 0}}, {"time": 0.04, "blendshapes": {"jawOpen": 1}}]')
    out = str(workspace / "talk_%06d.png")
    assert main(["drive", root, "--run", "a", "--by", str(recording), "--out", out, "--size", "32"]) == 0
    assert len(list(workspace.glob("talk_*.png"))) == 2
    assert main(["export", root, "--run", "a", "--out", str(workspace / "a.ply")]) == 0
    avatar = load_avatar(workspace / "runs" / "a")
    assert not list((workspace / "runs" / "a").rglob("face_model*"))
    # The licence is unknown until the user says that copies are allowed.
    capsys.readouterr()
    assert main(["export", root, "--run", "a", "--out", str(workspace / "a.mien")]) != 0
    told = capsys.readouterr().err
    assert all(words in told for words in ("my_head", ".ply", "--face-model", "--shareable"))
    assert main(["face-models", "--add", str(path), "--shareable"]) == 0
    assert main(["export", root, "--run", "a", "--out", str(workspace / "a.mien")]) == 0
    # The avatar's mesh is drawn into the mattes, the tracked one is not.
    face = replace(tracking.face[[3]], vertex_offsets=avatar.subject.vertex_offsets)
    posed = load_portable(workspace / "a.mien").pose(
        *(tensor[0].numpy() for tensor in (face.expression, face.joints, face.head_rotation, face.head_translation))
    )
    with torch.no_grad():
        expected = avatar.pose(face).gaussians.timestep(0)
    np.testing.assert_allclose(posed.means, expected.means.numpy(), atol=2e-6)
    # The paper's schedule takes the model too.
    paper = PaperSettings("fast", first_steps=4, steps=1, epochs=1, texture_size=64)
    pixels = PhotometricSettings(sizes=(64,), texture_size=64, shared_steps=1, keyframes=4)
    settings = TrackingSettings(schedule="paper", paper=paper, keyframes=4, photometric=pixels)
    tracking = track(capture, load_face_model("my_head"), settings)
    assert tracking.face.vertex_offsets is not None
    assert tracking.residuals.nanmedian() < 1.0


@pytest.mark.unchecked
def test_a_head_of_gnm_gets_landmarks_and_regions_by_the_detector(tmp_path, monkeypatch, capsys) -> None:
    anny = load_face_model("anny")
    path = write_gnm(tmp_path / "gnm.npz", gnm_like(anny))
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    # The usual 320 pictures of 512 pixels, and the search over all triangles in 16 of them, take minutes.
    monkeypatch.setattr(stage, "FIRST_PICTURES", 10)
    monkeypatch.setattr(stage, "EmbeddingSettings", partial(EmbeddingSettings, pictures=14, size=320))
    monkeypatch.setattr(embedding, "COARSE_VIEWS", 4)
    monkeypatch.setattr(embedding, "COARSE_SUBDIVISIONS", 1)
    assert main(["face-models", "--add", str(path)]) == 0
    told = capsys.readouterr()
    assert "licence: Apache-2.0 (GNM Head)" in told.out
    assert "gnm: landmarks placed with a median error of " in told.err
    model = load_face_model("gnm")
    check_face_model(model, "gnm", "-")
    assert {"lips", "brows", "eyelids", "nose", "ears", "neck", "scalp"} <= set(model.region_names)
    known = replace(model, landmarks=gnm_landmarks(anny))
    placed, wanted = (each.landmark_positions(each.template, "mediapipe") for each in (model, known))
    apart = (placed - wanted).norm(dim=1)
    assert float(apart.median()) < 0.005
    inner = torch.tensor([4, 33, 263, 61, 291, 13, 14])  # nose, corners of eyes and mouth, lips
    assert float(apart[inner].max()) < 0.012
