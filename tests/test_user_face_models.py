"""A user's face model is added once, then tracked, trained and exported by its name."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from flame_like import exact_landmarks, flame_like, write_npz
from gnm_like import gnm_landmarks, gnm_like, write_gnm
from mien.avatar import load_avatar
from mien.capture import Capture, write_capture
from mien.cli import main
from mien.commands.stages import face_models as stage
from mien.face import FaceModel, Landmarks, available_face_models, load_face_model
from mien.face.cache import cache_folder
from mien.face.checks import check_face_model
from mien.lab.synthetic import SyntheticRecipe, synthesize
from mien.runtime import load as load_portable
from mien.storage import file_digest, write_json
from mien.tracking import TrackingSettings, read_tracking, track
from mien.tracking.landmarks import EmbeddingSettings, embedding
from mien.tracking.settings import PaperSettings, PhotometricSettings
from refusals import refuses

pytestmark = pytest.mark.unchecked


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
        ("flame", r"there is no face model 'flame'; choose one of: anny, my_head, or give the path"),
        (tmp_path / "none.npz", "no such file"),
        (tmp_path, "neither the name"),
        (other, r"another file has the name 'my_head', .*My Head\.npz; .* --name NAME"),
        (own, "one of mien's own"),
        (bare, "has no 'v_template'"),
    ):
        refuses(message, stage.face_model_of, str(choice))
    refuses("letters, digits", stage.add_face_model_file, path, "../up")
    assert main(["face-models", "--name", "x"]) != 0
    assert "--add FILE" in capsys.readouterr().err
    assert main(["face-models", "--add", str(tmp_path)]) == 2
    assert f"{tmp_path}: is a folder, and not ICT-FaceKit's FaceXModel; give a file in it: " in capsys.readouterr().err


# Tracking -------------------------------------------------------------------------------------------------------------


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
    paper = PaperSettings(first_steps=4, steps=1, epochs=1, texture_size=64)
    pixels = PhotometricSettings(sizes=(64,), texture_size=64, shared_steps=1, keyframes=4)
    settings = TrackingSettings(schedule="paper", paper=paper, keyframes=4, photometric=pixels)
    tracking = track(capture, load_face_model("my_head"), settings)
    assert tracking.face.vertex_offsets is not None
    assert tracking.residuals.nanmedian() < 1.0


# By the real detector -------------------------------------------------------------------------------------------------


@pytest.mark.unchecked
def test_a_head_of_gnm_gets_landmarks_and_regions_by_the_detector(tmp_path, monkeypatch, capsys) -> None:
    anny = load_face_model("anny")
    path = write_gnm(tmp_path / "gnm.npz", gnm_like(anny))
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    # The usual 320 pictures of 512 pixels, and the search over all triangles in 16 of them, take minutes.
    monkeypatch.setattr(stage, "FIRST_PICTURES", 10)
    monkeypatch.setattr(stage, "EmbeddingSettings", partial(EmbeddingSettings, pictures=14, size=320))
    few = replace(embedding.TRACKING.embedding, coarse_views=4, coarse_subdivisions=1)
    monkeypatch.setattr(embedding, "TRACKING", replace(embedding.TRACKING, embedding=few))
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
