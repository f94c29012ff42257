"""`mien face-models --add` on ICT-FaceKit and on a file in GNM's schema, with landmarks that a detector needs minutes
to find."""

import shutil
from pathlib import Path

import pytest
import torch

from face_models import face_model_named
from mien.cli import main
from mien.commands.stages import face_models as stage
from mien.face import FaceModel, Landmarks, load_face_model
from mien.face.cache import cache_folder
from mien.face.checks import check_face_model

LICENCES = {"gnm": "Apache-2.0 (GNM Head)", "ict": "MIT (ICT-FaceKit)"}


@pytest.mark.slow
@pytest.mark.parametrize("name", LICENCES)
def test_it_is_added_listed_with_its_licence_and_loaded(
    name: str, tmp_path: Path, test_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    known = face_model_named(name, tmp_path, test_data)
    path = tmp_path / "gnm.npz" if name == "gnm" else test_data / "face_models" / "ict_facekit_light_f16.npz"
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))

    def embed(model: FaceModel, settings: object) -> tuple[dict[str, Landmarks], torch.Tensor]:
        return known.landmarks, torch.ones(478)

    monkeypatch.setattr(stage, "embed_landmarks", embed)
    assert main(["face-models", "--add", str(path)]) == 0
    told = capsys.readouterr()
    assert f"name: {name}  licence: {LICENCES[name]}  description: added from" in told.out
    assert f"{name}: landmarks placed with a median error of 1.00 pixels" in told.err
    model = load_face_model(name)
    check_face_model(model, name, "-")
    assert model.shareable
    assert {"lips", "brows", "eyelids", "nose", "ears", "neck", "scalp"} <= set(model.region_names)
