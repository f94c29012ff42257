"""Synthetic captures have the same bytes for the same seed, their truth is true, and references are drawn alike."""

import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from exact_guard import exact_guard
from mien import exact
from mien.capture import read_capture
from mien.capture.video import read_video_frames
from mien.errors import UserError
from mien.lab.synthetic import (
    RECIPES,
    REFERENCES,
    Segment,
    SyntheticScene,
    read_truth,
    reference_named,
    synthesize,
    truth_of,
    write_synthetic_capture,
    write_synthetic_video,
)
from mien.lab.synthetic.captures import Pictures, inputs_hash, scene_key
from mien.lab.synthetic.light import studio_lighting
from mien.lab.synthetic.motion import generate_motion
from mien.lab.synthetic.posing import HeadPoser, head_pose, landmark_positions, project
from mien.lab.synthetic.shading import turn_light
from mien.render.mesh import shade, vertex_normals
from mien.rotation import matrix_from_axis_angle
from mien.tracking.neck_line import bottom_vertices
from reference_signatures import drawn_signatures, signature_distance, stored_signatures

SMALL = replace(RECIPES["demo"], width=192, height=192, seconds=0.6, fps=10.0, texture_size=256, noise=0.0)
PLAIN = replace(SMALL, hair="none", glasses=False, brows_and_lashes=False)


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


def test_light_on_a_turned_head_is_that_of_the_room():
    lighting, random = studio_lighting(3), np.random.default_rng(0)
    turn = matrix_from_axis_angle(torch.tensor([0.3, -0.8, 0.1])).numpy()
    normals = random.standard_normal((50, 3))
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    expected = shade(torch.from_numpy(normals @ turn.T), torch.from_numpy(lighting.sh_light)).clamp_min(0)
    np.testing.assert_allclose(turn_light(lighting, turn).irradiance(normals), expected, rtol=0, atol=1e-5)


def test_capture_and_truth_keep_their_contracts_and_recipe_and_seed_decide_every_byte(scene, monkeypatch):
    """Frames come in order for any number of threads, and one that is drawn again is the same."""
    monkeypatch.setenv("MIEN_THREADS", "2")
    capture, truth = synthesize(replace(SMALL), seed=3)
    assert capture.images.shape == (6, 1, 192, 192, 3)
    assert capture.landmarks.shape == (6, 1, 478, 2)
    assert capture.valid.all()
    assert (len(truth.face), len(truth.valid), truth.neck_lines.shape) == (6, 6, (6, 1, 3))
    assert truth.face_model_hash == scene.model.content_hash
    for timestep in (0, 1, 4, 5):
        frame = scene.frame(timestep)
        np.testing.assert_array_equal(capture.images[timestep, 0], frame.image)
        np.testing.assert_array_equal(capture.mattes[timestep, 0], frame.matte)
        # The face model lies inside the matte, and its neck line below the chin.
        pixels = scene.camera.project(scene.vertices(timestep))[0].numpy()
        inside = frame.matte[tuple(np.clip(pixels[:, ::-1].astype(int), 0, 191).T)]
        assert (inside > 0).mean() > 0.99
        line = truth.neck_lines[timestep, 0].numpy()
        assert capture.landmarks[timestep, 0, 152] @ line[:2] + line[2] > 0
    other = SyntheticScene(SMALL, seed=4)
    assert not torch.equal(other.identity, scene.identity)
    assert scene.source["content_hash"] == SyntheticScene(SMALL, seed=3).source["content_hash"]
    assert scene.source["content_hash"] != other.source["content_hash"]


def test_landmarks_are_the_projected_mesh():
    big = SyntheticScene(replace(PLAIN, width=512, height=512), seed=3)
    open_eyed = int((big.face.expression[:, big.model.expression_names.index("eyeBlinkLeft")] < 0.05).nonzero()[0])
    image, vertices = big.frame(open_eyed).image.astype(float), big.vertices(open_eyed)
    marks = big.landmarks()[open_eyed]
    torch.testing.assert_close(vertices, big.model(big.face[open_eyed])[0])

    def patch(pixel: np.ndarray) -> np.ndarray:
        column, row = pixel.astype(int)
        return image[row - 2 : row + 3, column - 2 : column + 3].mean((0, 1))

    for eye, mark in zip(big.subject.eyes, (468, 473), strict=True):
        pupil = big.camera.project(vertices[torch.from_numpy(eye.front)].mean(0)[None])[0][0].numpy()
        assert np.linalg.norm(marks[mark] - pupil) < 6
        assert patch(pupil).mean() < 0.5 * patch(marks[1]).mean(), "it is darker than the tip of the nose"
    lips, cheek = (np.mean([patch(marks[i]) for i in which], axis=0) for which in ((17, 405, 181), (50, 280)))
    assert lips[0] / lips[1] > cheek[0] / cheek[1]


def test_matte_is_the_coverage(scene):
    frame = scene.frame(3)
    darker, noisy = (SyntheticScene(replace(SMALL, noise=noise), seed=3) for noise in (0.0, 0.01))
    for other in (darker, noisy):
        other.__dict__["subject"] = scene.subject  # the same person, not built again
    darker.__dict__["background"] = np.zeros_like(scene.background)
    black = darker.frame(3)
    np.testing.assert_array_equal(black.matte, frame.matte)
    assert (black.image[frame.matte == 0] == 0).all()
    np.testing.assert_array_equal(black.image[frame.matte == 255], frame.image[frame.matte == 255])
    assert 0.15 < (frame.matte > 127).mean() < 0.8
    # Hair and glasses cover pixels that the same head without them leaves free.
    plain = SyntheticScene(PLAIN, seed=3)
    assert (frame.matte.astype(int) - plain.frame(3).matte).clip(0).sum() > 255 * 300
    assert torch.equal(scene.vertices(3), plain.vertices(3))
    # Noise is the only difference that noise makes.
    assert 0.006 * 255 < (noisy.frame(3).image.astype(float) - frame.image).std() < 0.014 * 255
    np.testing.assert_array_equal(noisy.frame(3).image, noisy.frame(3).image)


@pytest.mark.unchecked
def test_motion_is_bounded_smooth_and_blinks():
    recipe = replace(RECIPES["demo"], seconds=9.0)
    scene = SyntheticScene(recipe, seed=5)
    face = scene.face
    degrees = torch.rad2deg(face.head_rotation)
    assert 15 < float(degrees[:, 1].abs().max()) < 30
    assert float(degrees[:, 0].abs().max()) < 17
    assert float((degrees[1:] - degrees[:-1]).norm(dim=-1).max()) < 4  # a frame, 40 ms
    bounds = scene.model.expression_bounds
    assert bool(((face.expression >= bounds[:, 0]) & (face.expression <= bounds[:, 1])).all())
    closed = face.expression[:, scene.model.expression_names.index("eyeBlinkLeft")] > 0.8
    blinks = int((closed[1:] & ~closed[:-1]).sum())
    assert 2 <= blinks <= 9
    assert torch.equal(generate_motion(scene.model, scene.identity, recipe, 5).expression, face.expression)


@pytest.mark.unchecked
def test_shoulders_hold_still_while_the_head_turns():
    scene = SyntheticScene(replace(RECIPES["demo"], translation=(0.0, 0.0, 0.0)), seed=2)
    bottom = bottom_vertices(scene.model)
    moved = torch.stack([scene.vertices(timestep)[bottom] for timestep in range(0, 200, 20)])
    middle = moved.mean(1)  # the shoulders turn a little, about the middle of the neck
    assert float((middle - middle.mean(0)).norm(dim=-1).amax()) < 0.006


@pytest.mark.unchecked
def test_video_is_written_frame_by_frame(tmp_path, scene):
    path = tmp_path / "clip.mp4"
    write_synthetic_video(SMALL, path, seed=3)
    frames = [image for _, image in read_video_frames(path)]
    assert len(frames) == SMALL.timesteps
    error = frames[2].astype(float) - scene.frame(2).image
    assert np.sqrt((error**2).mean()) < 6


KEYS = {
    "mono-short": "f72145068d96a9f4", "mono-long": "c8c56c81aa8d4929",
    "ring-16": "46344aaf4f9ea965", "ring-16-large": "6b91a62e2ddda422",
    "beard": "d19389ae0850b3f4", "long-hair": "69f32fa0a3632a1e",
    "glasses": "cf70d19c2a6ef102", "off-model": "87621466675cf748",
    "mono-sides": "49c0f1a14644d29e", "mono-sides-long-hair": "67640321020edf29",
}  # fmt: skip
"""Keys of the references. A change means that figures on the capture cannot be compared any more.

Then say so in docs/results.md, and set the new key. A change of the drawing raises `DRAWING`, and with it all keys.
"""
TINY = replace(
    RECIPES["demo"], width=64, height=64, fps=4.0, texture_size=128, supersample=1, hair="none", glasses=False,
    brows_and_lashes=False, script=(Segment("free", 1.0), Segment("still", 1.0)),
)  # fmt: skip
RING = replace(TINY, cameras="ring", ring_size=3, width=128, height=128)


@pytest.mark.exact
def test_key_of_each_reference_is_fixed():
    assert {name: reference.key() for name, reference in REFERENCES.items()} == KEYS
    with pytest.raises(UserError, match="choose one of: mono-short, mono-long, ring-16"):
        reference_named("mono")


def test_keys_follow_recipe_and_seeds():
    scene = SyntheticScene(TINY, 3)
    others = [
        SyntheticScene(TINY, 4, 3), SyntheticScene(TINY, 3, 4), SyntheticScene(replace(TINY, focal=2.36), 3),
        SyntheticScene(replace(TINY, detail=replace(TINY.detail, compression=20)), 3),
    ]  # fmt: skip
    assert scene_key(SyntheticScene(replace(TINY), 3)) == scene_key(scene)
    assert len({scene_key(other) for other in (scene, *others)}) == 5


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
    for path in (ring / "truth").glob("truth.*"):
        os.truncate(path, path.stat().st_size - 1)
    with pytest.raises(UserError, match="damaged"):
        read_truth(ring / "truth")


@pytest.mark.unchecked
def test_an_interrupted_drawing_goes_on(tmp_path):
    scene, store = SyntheticScene(TINY, 3), Pictures(tmp_path / ".drawing", TINY, TINY.timesteps)
    store.resume(inputs_hash(scene))
    for timestep in range(5):
        frame = scene.frame(timestep)
        store.append(timestep, frame.image[None], frame.matte[None])
    store.mark(inputs_hash(scene), 5)
    folders = (tmp_path, tmp_path / "at once")
    for folder in folders:
        write_synthetic_capture(TINY, 3, folder)
    first, second = (json.loads((folder / "synthetic.json").read_text())["content_hash"] for folder in folders)
    assert first == second
    before = (tmp_path / "video.mp4").stat().st_mtime_ns
    write_synthetic_capture(TINY, 3, tmp_path)
    assert (tmp_path / "video.mp4").stat().st_mtime_ns == before


def test_nothing_moves_while_the_script_is_still():
    truth = truth_of(SyntheticScene(replace(TINY, fps=20.0), 3))
    speed = np.abs(np.diff(truth.landmarks[:, 0], axis=0)).max((-1, -2))
    assert speed[-10:].max() == 0
    assert speed[:15].max() > 0.2


def test_off_model_leaves_the_face_models_shapes_and_keeps_the_eyes():
    scene = SyntheticScene(replace(TINY, off_model=1.0), 3)
    truth = truth_of(scene)
    index, own = torch.from_numpy(truth.vertex_index), truth.tracking.face.vertex_offsets
    assert own is not None
    offsets = own[index].reshape(-1)
    basis = torch.cat([scene.model.identity_basis[:, index].flatten(1).T, torch.eye(3).repeat(len(index), 1)], -1)
    best = basis @ torch.linalg.lstsq(basis, offsets[:, None]).solution
    left = (offsets - best[:, 0]).reshape(-1, 3).norm(dim=-1)
    assert 0.0008 < float(left.mean()) < 0.006
    eyes = scene.model.faces[scene.model.region_mask("eyes")].unique()
    assert float(own[eyes].norm(dim=-1).max()) < 0.0008
    # Its expressions differ, too: vertices are not those of the face model's own parameters.
    own = scene.model.head_vertices(truth.tracking.face[3])[0][index].numpy()
    assert 2e-4 < float(np.linalg.norm(own - truth.vertices[3], axis=-1).mean()) < 0.01
