"""Reference captures have keys, are drawn alike everywhere, are true to the micrometre, and can be drawn in pieces."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from exact_guard import exact_guard
from mien.capture import read_capture
from mien.errors import UserError
from mien.lab.synthetic import (
    RECIPES,
    REFERENCES,
    Segment,
    SyntheticScene,
    read_truth,
    reference_named,
    truth_of,
    write_synthetic_capture,
)
from mien.lab.synthetic.captures import Pictures, inputs_hash, scene_key
from reference_signatures import TOLERANCES, drawn_signatures, signature_distance, signature_of, stored_signatures

KEYS = {
    "mono-short": "f72145068d96a9f4",
    "mono-long": "c8c56c81aa8d4929",
    "ring-16": "46344aaf4f9ea965",
    "ring-16-large": "6b91a62e2ddda422",
    "beard": "d19389ae0850b3f4",
    "long-hair": "69f32fa0a3632a1e",
    "glasses": "cf70d19c2a6ef102",
    "off-model": "87621466675cf748",
    "mono-sides": "49c0f1a14644d29e",
    "mono-sides-long-hair": "67640321020edf29",
}
"""Keys of the references. A change means that figures on the capture cannot be compared any more.

Then say so in docs/results.md, and set the new key. A change of the drawing raises `DRAWING`, and with it all keys.
"""
SMALL = replace(
    RECIPES["demo"], width=64, height=64, fps=4.0, texture_size=128, supersample=1, hair="none", glasses=False,
    brows_and_lashes=False, script=(Segment("free", 1.0), Segment("still", 1.0)),
)  # fmt: skip
RING = replace(SMALL, cameras="ring", ring_size=3, width=128, height=128)


@pytest.mark.exact
def test_key_of_each_reference_is_fixed():
    assert {name: reference.key() for name, reference in REFERENCES.items()} == KEYS


def test_keys_follow_recipe_and_seeds():
    scene = SyntheticScene(SMALL, 3)
    others = [
        SyntheticScene(SMALL, 4, 3), SyntheticScene(SMALL, 3, 4), SyntheticScene(replace(SMALL, focal=2.36), 3),
        SyntheticScene(replace(SMALL, detail=replace(SMALL.detail, compression=20)), 3),
    ]  # fmt: skip
    assert scene_key(SyntheticScene(replace(SMALL), 3)) == scene_key(scene)
    assert len({scene_key(other) for other in (scene, *others)}) == 5


@pytest.mark.unchecked
@pytest.mark.exact
@pytest.mark.parametrize("name", REFERENCES)
def test_each_reference_is_drawn_as_everywhere(name):
    """Each reference is drawn as everywhere: without a library's matrix product, and with the stored signature."""
    with exact_guard():
        drawn = drawn_signatures(REFERENCES[name])
    stored = stored_signatures()[name]
    assert drawn.keys() == stored.keys()
    for sequence, signature in drawn.items():
        distance = signature_distance(signature, stored[sequence])
        assert max(distance.values()) <= 1, f"{sequence}: {distance}; who meant it raises DRAWING"


@pytest.mark.unchecked
def test_another_recipe_has_another_signature():
    scene = SyntheticScene(SMALL, 3)
    own = signature_of(scene)
    assert signature_distance(own, own) == dict.fromkeys(TOLERANCES, 0.0)
    slightly = {"noise": 0.005, "focal": 2.36, "rotation": (25.5, 12.0, 8.0)}
    for field, value in slightly.items():
        other = SyntheticScene(replace(SMALL, **{field: value}), 3)
        other.__dict__["subject"] = scene.subject  # the same person, not built again
        assert max(signature_distance(own, signature_of(other)).values()) > 1, field


def test_an_unknown_reference_names_those_there_are():
    with pytest.raises(UserError, match="choose one of: mono-short, mono-long, ring-16"):
        reference_named("mono")


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ring")
    write_synthetic_capture(RING, 3, folder)
    return folder


def test_ring_is_a_calibrated_capture_with_its_truth(ring):
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


def test_truth_is_what_the_face_model_says(ring):
    truth, scene = read_truth(ring / "truth"), SyntheticScene(RING, 3)
    expected = scene.model(truth.tracking.face[5])[0][torch.from_numpy(truth.vertex_index)]
    np.testing.assert_allclose(truth.vertices_world[5], expected.numpy(), atol=2e-5)
    np.testing.assert_allclose(truth.landmarks[5, 2], scene.landmarks(2)[5], atol=0.04)


def test_damaged_truth_is_refused(ring, tmp_path):
    (tmp_path / "truth").mkdir()
    for path in (ring / "truth").glob("truth.*"):
        (tmp_path / "truth" / path.name).write_bytes(path.read_bytes()[:-1])
    with pytest.raises(UserError, match="damaged"):
        read_truth(tmp_path / "truth")


@pytest.mark.unchecked
def test_an_interrupted_drawing_goes_on(tmp_path):
    scene = SyntheticScene(SMALL, 3)
    store = Pictures(tmp_path / ".drawing", SMALL, SMALL.timesteps)
    store.resume(inputs_hash(scene))
    for timestep in range(5):
        frame = scene.frame(timestep)
        store.append(timestep, frame.image[None], frame.matte[None])
    store.mark(inputs_hash(scene), 5)
    write_synthetic_capture(SMALL, 3, tmp_path)
    write_synthetic_capture(SMALL, 3, tmp_path / "at once")
    whole = json.loads((tmp_path / "at once" / "synthetic.json").read_text())
    assert json.loads((tmp_path / "synthetic.json").read_text())["content_hash"] == whole["content_hash"]
    before = (tmp_path / "video.mp4").stat().st_mtime_ns
    write_synthetic_capture(SMALL, 3, tmp_path)
    assert (tmp_path / "video.mp4").stat().st_mtime_ns == before


def test_nothing_moves_while_the_script_is_still():
    truth = truth_of(SyntheticScene(replace(SMALL, fps=20.0), 3))
    speed = np.abs(np.diff(truth.landmarks[:, 0], axis=0)).max((-1, -2))
    assert speed[-10:].max() == 0
    assert speed[:15].max() > 0.2


def test_off_model_leaves_the_face_models_shapes_and_keeps_the_eyes():
    scene = SyntheticScene(replace(SMALL, off_model=1.0), 3)
    truth = truth_of(scene)
    index = torch.from_numpy(truth.vertex_index)
    assert truth.tracking.face.vertex_offsets is not None
    offsets = truth.tracking.face.vertex_offsets[index].reshape(-1)
    basis = scene.model.identity_basis[:, index].flatten(1).T
    rigid = torch.stack([torch.eye(3)[axis].repeat(len(index)) for axis in range(3)], -1)
    basis = torch.cat([basis, rigid], -1)
    best = basis @ torch.linalg.lstsq(basis, offsets[:, None]).solution
    left = (offsets - best[:, 0]).reshape(-1, 3).norm(dim=-1)
    assert 0.0008 < float(left.mean()) < 0.006
    eyes = scene.model.faces[scene.model.region_mask("eyes")].unique()
    assert float(truth.tracking.face.vertex_offsets[eyes].norm(dim=-1).max()) < 0.0008
    # Its expressions differ, too: vertices are not those of the face model's own parameters.
    own = scene.model.head_vertices(truth.tracking.face[3])[0][index].numpy()
    assert 2e-4 < float(np.linalg.norm(own - truth.vertices[3], axis=-1).mean()) < 0.01
