"""`mien face-models --add` runs to its end with the real detector, on few and small pictures."""

import shutil
from dataclasses import replace
from functools import partial

import pytest
import torch

from gnm_like import gnm_landmarks, gnm_like, write_gnm
from mien.cli import main
from mien.commands.stages import face_models as stage
from mien.face import load_face_model
from mien.face.cache import cache_folder
from mien.face.checks import check_face_model
from mien.tracking.landmarks import EmbeddingSettings, embedding


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
