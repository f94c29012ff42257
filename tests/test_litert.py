"""The detector on ai-edge-litert: like mediapipe's, on drawn and real faces, near and far; and who chooses it."""

import itertools
from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from mien.capture import backend
from mien.capture.faces import FaceFinder, LandmarkDetector, MeshReader
from mien.capture.from_video import open_job
from mien.capture.litert.mesh import Mesh
from mien.capture.matte import Segmenter
from mien.capture.settings import CaptureSettings
from mien.capture.video import read_video_frames
from mien.lab.synthetic import SyntheticRecipe, SyntheticScene
from mien.picture_files import write_png

pytest.importorskip("ai_edge_litert", reason="could not import ai_edge_litert")


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    recipe = SyntheticRecipe(width=256, height=256, seconds=0.2, fps=10.0, supersample=1, texture_size=256)
    return SyntheticScene(recipe, 2).frame(0).image


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean distance of landmarks, in distances between the eyes' outer corners."""
    eyes = np.linalg.norm(one[33] - one[263])
    return float(np.linalg.norm(one - other, axis=-1).mean() / eyes)


def test_landmarks_and_mattes_are_those_of_mediapipe_on_a_drawn_face(drawn):
    with LandmarkDetector(False, "mediapipe") as own, LandmarkDetector(False, "litert") as other:
        assert apart(own.detect(drawn)[0], other.detect(drawn)[0]) < 0.03
    with MeshReader(1, False, "mediapipe") as own, MeshReader(1, False, "litert") as other:
        deep, also = own.read(drawn)[0, :, 2], other.read(drawn)[0, :, 2]
    assert np.corrcoef(deep, also)[0, 1] > 0.98
    with Segmenter("mediapipe") as own, Segmenter("litert") as other:
        assert np.abs(own.segment(drawn) - other.segment(drawn)).mean() < 0.01


@pytest.mark.parametrize("clip", ["d3", "d6", "d9", "d14", "d18", "s18", "wojtek"])
def test_landmarks_are_those_of_mediapipe_on_real_clips(test_data, clip):
    frames = [image for _, image in itertools.islice(read_video_frames(test_data / "footage" / f"{clip}.mp4"), 4)]
    with LandmarkDetector(False, "mediapipe") as own, LandmarkDetector(False, "litert") as other:
        pairs = [(own.detect(image), other.detect(image)) for image in frames]
    assert all(len(one) == len(two) == 1 for one, two in pairs)
    assert np.mean([apart(one[0], two[0]) for one, two in pairs[2:]]) < 0.03


@pytest.mark.parametrize("side", [256, 96])
def test_boxes_are_those_of_mediapipe_near_and_far(drawn, side):
    """A face that is a small part of the picture is found by the network for far faces alone."""
    wide = np.full((360, 640, 3), 150, np.uint8)
    wide[40 : 40 + side, 60 : 60 + side] = cv2.resize(drawn, (side, side), interpolation=cv2.INTER_AREA)
    with FaceFinder("mediapipe") as own, FaceFinder("litert") as other:
        one, two = own.find(wide), other.find(wide)
        assert len(one) == len(two) == 1
        assert np.abs(one - two).max() < 0.05 * (one[0, 2] - one[0, 0])
        assert own.surest(wide) == pytest.approx(other.surest(wide), abs=0.05)


def test_two_faces_are_followed_none_is_found_in_nothing_and_landmarks_turn_with_the_picture(drawn):
    beside = np.concatenate([drawn, drawn[:, ::-1]], axis=1)
    mesh = Mesh(4, follows=True)
    found = [mesh.find(np.ascontiguousarray(beside)) for _ in range(3)][-1]
    assert sorted(found[:, 1, 0] > 256) == [False, True]
    found = [mesh.find(np.zeros((100, 80, 3), np.uint8)) for _ in range(2)][-1]
    assert found.shape == (0, 478, 3)
    # The square that the network sees follows the face, also when the head lies on a shoulder.
    turned = np.ascontiguousarray(np.rot90(drawn))
    with LandmarkDetector(False, "litert") as upright, LandmarkDetector(False, "litert") as lying:
        one, two = [(upright.detect(drawn), lying.detect(turned)) for _ in range(3)][-1]
    assert apart(one[0], np.column_stack([256 - two[0, :, 1], two[0, :, 0]])) < 0.02


def test_litert_serves_where_mediapipe_is_missing_and_its_captures_are_others(drawn, tmp_path, monkeypatch):
    """Keys of captures by mediapipe are those from before the setting; by litert they differ."""
    write_png(tmp_path / "0.png", drawn)
    jobs = {
        choice: open_job(tmp_path, CaptureSettings(detector=choice), None, False)
        for choice in ("auto", "mediapipe", "litert")
    }
    assert jobs["auto"].key == jobs["mediapipe"].key != jobs["litert"].key
    entries = [backend.detector_of(backend.detector_entry(job.detector)) for job in jobs.values()]
    assert entries == ["mediapipe", "mediapipe", "litert"]
    assert backend.choose_detector() == "mediapipe"
    monkeypatch.setattr(backend, "find_spec", lambda name: None if name == "mediapipe" else find_spec(name))
    assert backend.choose_detector() == "litert"
    with pytest.raises(ModuleNotFoundError, match="mediapipe"):
        backend.choose_detector("mediapipe")
