"""Synthetic captures have the same bytes for the same seed, their truth is true, and references are drawn alike."""

import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from exact_guard import exact_guard
from mien.capture import read_capture
from mien.lab.synthetic import RECIPES, synthesize
from mien.lab.synthetic.captures import Pictures, inputs_hash, write_synthetic_capture
from mien.lab.synthetic.posing import HeadPoser, head_pose, landmark_positions, project
from mien.lab.synthetic.recipe import Segment
from mien.lab.synthetic.references import REFERENCES, reference_named
from mien.lab.synthetic.scene import SyntheticScene
from mien.lab.synthetic.truth import read_truth
from mien.machine import exact
from mien.render.mesh import vertex_normals
from reference_signatures import drawn_signatures, signature_distance, stored_signatures
from refusals import refuses

SMALL = replace(RECIPES["demo"], width=192, height=192, seconds=0.6, fps=10.0, texture_size=256, noise=0.0)


scene = pytest.fixture(scope="module")(lambda: SyntheticScene(SMALL, seed=3))


def test_heads_are_posed_as_the_face_model_poses_them(scene):
    face = replace(scene.face[3], joints=scene.face[3].joints + 0.2)
    found = HeadPoser(scene.model, scene.identity)(face)
    for expected in (scene.model.head_vertices(face)[0], scene.model.head_vertices_reference(face)[0]):
        np.testing.assert_allclose(found, expected.numpy(), rtol=0, atol=1e-6)
    normals = exact.vertex_normals(found, scene.model.faces.numpy())
    np.testing.assert_allclose(normals, vertex_normals(torch.from_numpy(found), scene.model.faces), rtol=0, atol=1e-5)
    marks = scene.model.landmark_positions(torch.from_numpy(found), "mediapipe")
    np.testing.assert_allclose(landmark_positions(scene.model, found), marks, rtol=0, atol=1e-6)
    np.testing.assert_allclose(head_pose(face), face.T_world_head[0], rtol=0, atol=1e-6)
    pixels, depths = (tensor.numpy() for tensor in scene.camera.project(marks - torch.tensor([0.0, 0.0, 1.0])))
    found_pixels, found_depths = project(scene.camera, marks.numpy() - np.array([0, 0, 1], np.float32))
    np.testing.assert_allclose(found_pixels, pixels, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found_depths, depths, rtol=0, atol=1e-6)


def test_capture_and_truth_keep_their_contracts_and_recipe_and_seed_decide_every_byte(scene, monkeypatch):
    """Frames come in order for any number of threads, and one that is drawn again is the same."""
    monkeypatch.setenv("MIEN_THREADS", "2")
    capture, truth = synthesize(replace(SMALL), seed=3)
    assert (capture.images.shape, capture.landmarks.shape) == ((6, 1, 192, 192, 3), (6, 1, 478, 2))
    assert capture.valid.all()
    assert (len(truth.face), len(truth.valid), truth.neck_lines.shape) == (6, 6, (6, 1, 3))
    assert truth.face_model_hash == scene.model.content_hash
    for timestep in (0, 1, 4, 5):
        frame = scene.frame(timestep)
        np.testing.assert_array_equal(capture.images[timestep, 0], frame.image)
        np.testing.assert_array_equal(capture.mattes[timestep, 0], frame.matte)
        # The neck line lies below the chin.
        line = truth.neck_lines[timestep, 0].numpy()
        assert capture.landmarks[timestep, 0, 152] @ line[:2] + line[2] > 0
    other = SyntheticScene(SMALL, seed=4)
    assert not torch.equal(other.identity, scene.identity)
    assert scene.source["content_hash"] == SyntheticScene(SMALL, seed=3).source["content_hash"]
    assert scene.source["content_hash"] != other.source["content_hash"]


KEYS = {
    "mono-short": "f72145068d96a9f4", "mono-long": "c8c56c81aa8d4929",
    "ring-16": "46344aaf4f9ea965", "ring-16-large": "6b91a62e2ddda422",
    "beard": "d19389ae0850b3f4", "long-hair": "69f32fa0a3632a1e",
    "glasses": "cf70d19c2a6ef102", "off-model": "87621466675cf748",
    "mono-sides": "49c0f1a14644d29e", "mono-sides-long-hair": "67640321020edf29",
    "unfilmed-1": "e7c74fc905ce6dcd", "unfilmed-2": "3e545f881b0723f4", "unfilmed-3": "1b567b42cec879ce",
    "unfilmed-4": "4b4f809ef2aa33b9", "unfilmed-5": "2965327d86c9a2bd", "unfilmed-6": "739d318670618e73",
}  # fmt: skip
"""Keys of the references. A change means that figures on the capture cannot be compared any more.

Then say so in docs/results.md, and set the new key. A change of the drawing raises `DRAWING`, and with it all keys."""
TINY = replace(
    RECIPES["demo"], width=64, height=64, fps=4.0, texture_size=128, supersample=1, hair="none", glasses=False,
    brows_and_lashes=False, script=(Segment("free", 1.0), Segment("still", 1.0)),
)  # fmt: skip
RING = replace(TINY, cameras="ring", ring_size=3, width=128, height=128)


@pytest.mark.exact
def test_key_of_each_reference_is_fixed():
    assert {name: reference.key() for name, reference in REFERENCES.items()} == KEYS
    refuses("choose one of: mono-short, mono-long, ring-16", reference_named, "mono")


@pytest.mark.unchecked
@pytest.mark.exact
@pytest.mark.parametrize("name", REFERENCES)
def test_each_reference_is_drawn_as_everywhere(name):
    with exact_guard():
        drawn = drawn_signatures(REFERENCES[name])
    stored = stored_signatures()[name]
    assert drawn.keys() == stored.keys()
    for sequence, signature in drawn.items():
        distance = signature_distance(signature, stored[sequence])
        assert max(distance.values()) <= 1, f"{sequence}: {distance}; who meant it raises DRAWING"


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ring")
    write_synthetic_capture(RING, 3, folder)
    return folder


def test_a_ring_is_a_calibrated_capture_whose_truth_is_what_the_face_model_says(ring):
    capture, truth = read_capture(ring / "capture"), read_truth(ring / "truth")
    assert capture.images.shape == (8, 3, 128, 128, 3)
    assert capture.calibration is not None
    assert not (ring / ".drawing").exists()
    scene = SyntheticScene(RING, 3)
    np.testing.assert_array_equal(capture.images[2, 1], scene.frame(2, 1).image)
    for camera, calibrated in enumerate(capture.calibration):
        torch.testing.assert_close(calibrated.K, truth.tracking.cameras[camera].K)
        pixels, _ = calibrated.project(torch.from_numpy(truth.vertices_world[4].astype(np.float32)))
        columns, rows = np.clip(pixels.numpy().astype(int), 0, 127).T
        around = cv2.dilate(capture.mattes[4, camera], np.ones((3, 3), np.uint8))
        assert (around[rows, columns] > 0).mean() > 0.99
    found = capture.valid[:, 0]
    assert found.sum() >= 4
    assert np.median(np.linalg.norm(capture.landmarks[found, 0] - truth.landmarks[found, 0], axis=-1)) < 3
    expected = scene.model(truth.tracking.face[5])[0][torch.from_numpy(truth.vertex_index)]
    np.testing.assert_allclose(truth.vertices_world[5], expected.numpy(), atol=2e-5)
    np.testing.assert_allclose(truth.landmarks[5, 2], scene.landmarks(2)[5], atol=0.04)
    for path in (ring / "truth").glob("truth.*"):
        os.truncate(path, path.stat().st_size - 1)
    refuses("damaged", read_truth, ring / "truth")


@pytest.mark.unchecked
def test_an_interrupted_drawing_goes_on(tmp_path):
    scene = SyntheticScene(TINY, 3)
    store = Pictures(tmp_path / ".drawing", scene)
    assert store.resume(inputs_hash(scene)) == 0
    for timestep in range(5):
        store.write(timestep, [scene.frame(timestep)])
    assert store.resume(inputs_hash(scene)) == 5
    folders = (tmp_path, tmp_path / "at once")
    for folder in folders:
        write_synthetic_capture(TINY, 3, folder)
    first, second = (json.loads((folder / "synthetic.json").read_text())["content_hash"] for folder in folders)
    assert first == second
    before = (tmp_path / "video.mp4").stat().st_mtime_ns
    write_synthetic_capture(TINY, 3, tmp_path)
    assert (tmp_path / "video.mp4").stat().st_mtime_ns == before
