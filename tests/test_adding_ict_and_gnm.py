"""`mien face-models --add` runs to its end on ICT-FaceKit and on a file in GNM's schema, with the real detector."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from gnm_like import gnm_landmarks, gnm_like, write_gnm
from mien.cli import main
from mien.commands.stages import face_models as stage
from mien.face import load_face_model
from mien.face.cache import cache_folder
from mien.face.checks import check_face_model
from mien.tracking.landmarks import EmbeddingSettings

INNER = slice(17, 68)
"""Those of the 68 points that are not on the outline, which a detector places by the picture and not by the face."""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty cache but for anny, and draw a few pictures only."""
    load_face_model("anny")
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(stage, "EmbeddingSettings", partial(EmbeddingSettings, pictures=10))
    monkeypatch.setattr(stage, "_FIRST_PICTURES", 6)
    return tmp_path


@pytest.mark.slow
def test_ict_is_added(cache: Path, test_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Landmarks lie where the model's own list of the 68 points has them."""
    packed = test_data / "face_models" / "ict_facekit_light_f16.npz"
    assert main(["face-models", "--add", str(packed)]) == 0
    told = capsys.readouterr()
    assert "name: ict  licence: MIT (ICT-FaceKit)  description: added from" in told.out
    assert "ict: landmarks placed with a median error of" in told.err
    model = load_face_model("ict")
    check_face_model(model, "ict", "-")
    assert model.shareable
    assert {"lips", "brows", "eyelids", "nose", "ears", "neck", "scalp"} <= set(model.region_names)
    own = json.loads((test_data / "face_models" / "ict_vertex_indices.json").read_text())["idx_to_landmark_verts"]
    found = model.landmark_positions(model.template, "ibug68").numpy()
    distance = np.linalg.norm(found - model.template.numpy()[own], axis=1)[INNER]
    assert np.median(distance) < 0.005
    assert distance.max() < 0.02


@pytest.mark.slow
def test_gnm_is_added(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    anny = load_face_model("anny")
    path = write_gnm(cache / "gnm_head.npz", gnm_like(anny))
    assert main(["face-models", "--add", str(path)]) == 0
    assert "name: gnm_head  licence: Apache-2.0 (GNM Head)" in capsys.readouterr().out
    model = load_face_model("gnm_head")
    check_face_model(model, "gnm_head", "-")
    assert model.shareable
    exact = gnm_landmarks(anny)["mediapipe"].positions(model.template, model.faces)
    found = model.landmark_positions(model.template, "mediapipe")
    assert (found - exact).norm(dim=1).median() < 0.004
