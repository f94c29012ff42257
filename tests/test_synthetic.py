"""Synthetic captures have the same bytes for the same seed, and their truth is true."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien import exact
from mien.capture.video import read_video_frames
from mien.lab.synthetic import RECIPES, SyntheticScene, synthesize, write_synthetic_video
from mien.lab.synthetic.light import studio_lighting
from mien.lab.synthetic.motion import generate_motion
from mien.lab.synthetic.posing import HeadPoser, head_pose, landmark_positions, project
from mien.lab.synthetic.shading import turn_light
from mien.render.mesh import shade, vertex_normals
from mien.rotation import matrix_from_axis_angle
from mien.tracking.neck_line import bottom_vertices

SMALL = replace(RECIPES["demo"], width=192, height=192, seconds=0.6, fps=10.0, texture_size=256, noise=0.0)
PLAIN = replace(SMALL, hair="none", glasses=False, brows_and_lashes=False)


@pytest.fixture(scope="module")
def scene():
    return SyntheticScene(SMALL, seed=3)


@pytest.fixture(scope="module")
def plain():
    return SyntheticScene(PLAIN, seed=3)


def test_heads_are_posed_as_the_face_model_poses_them(scene):
    """Heads are posed as the face model poses them: vertices, normals and landmarks agree to a micrometre."""
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


def test_noise_is_the_only_difference_that_noise_makes(scene):
    noisy = SyntheticScene(replace(SMALL, noise=0.01), seed=3)
    noisy.__dict__["subject"] = scene.subject
    difference = noisy.frame(2).image.astype(float) - scene.frame(2).image
    assert 0.006 * 255 < difference.std() < 0.014 * 255
    np.testing.assert_array_equal(noisy.frame(2).image, noisy.frame(2).image)


def test_capture_and_truth_keep_their_contracts_and_recipe_and_seed_decide_every_byte(scene, monkeypatch):
    """Frames come in order for any number of threads, and one that is drawn again is the same."""
    monkeypatch.setenv("MIEN_THREADS", "2")
    capture, truth = synthesize(replace(SMALL), seed=3)
    assert capture.images.shape == (6, 1, 192, 192, 3)
    assert capture.mattes.shape == (6, 1, 192, 192)
    assert capture.landmarks.shape == (6, 1, 478, 2)
    assert capture.valid.all()
    assert (len(truth.face), len(truth.valid), truth.neck_lines.shape) == (6, 6, (6, 1, 3))
    assert truth.face_model_hash == scene.model.content_hash
    for timestep in (0, 1, 4, 5):
        np.testing.assert_array_equal(capture.images[timestep, 0], scene.frame(timestep).image)
        np.testing.assert_array_equal(capture.mattes[timestep, 0], scene.frame(timestep).matte)
    other = SyntheticScene(SMALL, seed=4)
    assert not torch.equal(other.identity, scene.identity)
    assert scene.source["content_hash"] == SyntheticScene(SMALL, seed=3).source["content_hash"]
    assert scene.source["content_hash"] != other.source["content_hash"]


def test_landmarks_are_the_projected_mesh(plain):
    """Landmarks are those of the projected mesh: irises are dark or coloured at the true place, beside white."""
    open_eyed = int((plain.face.expression[:, plain.model.expression_names.index("eyeBlinkLeft")] < 0.05).nonzero()[0])
    big = SyntheticScene(replace(PLAIN, width=512, height=512), seed=3)
    image, marks = big.frame(open_eyed).image.astype(float), big.landmarks()[open_eyed]
    vertices = big.vertices(open_eyed)
    torch.testing.assert_close(vertices, big.model(big.face[open_eyed])[0])
    for eye, mark in zip(big.subject.eyes, (468, 473), strict=True):
        iris = vertices[torch.from_numpy(eye.front)].mean(0)
        pixel = big.camera.project(iris[None])[0][0].numpy()
        assert np.linalg.norm(marks[mark] - pixel) < 6
        brightness = [_brightness(image, pixel), _brightness(image, marks[1])]  # pupil, tip of the nose
        assert brightness[0] < 0.5 * brightness[1]
    lips = np.mean([_patch(image, marks[index]) for index in (17, 405, 181)], axis=0)
    cheek = np.mean([_patch(image, marks[index]) for index in (50, 280)], axis=0)
    assert lips[0] / lips[1] > cheek[0] / cheek[1]


def test_matte_is_the_coverage(scene):
    """The matte is the coverage: the wall is unchanged where it is 0, and invisible where it is 255."""
    frame = scene.frame(3)
    darker = SyntheticScene(SMALL, seed=3)
    darker.__dict__["subject"] = scene.subject  # the same person, not built again
    darker.__dict__["background"] = np.zeros_like(scene.background)
    black = darker.frame(3)
    np.testing.assert_array_equal(black.matte, frame.matte)
    assert (black.image[frame.matte == 0] == 0).all()
    np.testing.assert_array_equal(black.image[frame.matte == 255], frame.image[frame.matte == 255])
    assert 0.15 < (frame.matte > 127).mean() < 0.8


def test_the_face_model_lies_inside_the_matte(scene):
    for timestep in (0, 5):
        pixels = scene.camera.project(scene.vertices(timestep))[0].numpy()
        matte = scene.frame(timestep).matte
        inside = matte[tuple(np.clip(pixels[:, ::-1].astype(int), 0, 191).T)]
        assert (inside > 0).mean() > 0.99


def test_hair_and_glasses_are_not_the_face_models(scene, plain):
    """Hair and glasses cover pixels that the same head without them leaves free."""
    assert (scene.frame(0).matte.astype(int) - plain.frame(0).matte).clip(0).sum() > 255 * 300
    assert torch.equal(scene.vertices(0), plain.vertices(0))


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


def test_neck_lines_cut_below_the_chin(scene):
    chin = scene.landmarks()[:, 152]
    lines = scene.tracking().neck_lines[:, 0].numpy()
    assert ((chin * lines[:, :2]).sum(-1) + lines[:, 2] > 0).all()


@pytest.mark.unchecked
def test_video_is_written_frame_by_frame(tmp_path, scene):
    path = tmp_path / "clip.mp4"
    write_synthetic_video(SMALL, path, seed=3)
    frames = [image for _, image in read_video_frames(path)]
    assert len(frames) == SMALL.timesteps
    error = frames[2].astype(float) - scene.frame(2).image
    assert np.sqrt((error**2).mean()) < 6


@pytest.mark.unchecked
def test_a_detector_finds_the_face():
    """MediaPipe, which was trained on people, finds the head in every frame, and its landmarks near the truth."""
    mediapipe = pytest.importorskip("mediapipe")
    clip = SyntheticScene(replace(RECIPES["demo"], width=384, height=384, fps=1.0, texture_size=128), seed=1)
    truth = clip.landmarks()
    with mediapipe.solutions.face_mesh.FaceMesh(static_image_mode=True, refine_landmarks=True) as detector:
        for timestep, frame in enumerate(clip.frames()):
            found = detector.process(frame.image).multi_face_landmarks
            assert found, f"no face at timestep {timestep}"
            points = np.array([[p.x, p.y] for p in found[0].landmark]) * 384
            assert np.median(np.linalg.norm(points - truth[timestep], axis=-1)) < 5


def _patch(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    column, row = pixel.astype(int)
    return image[row - 2 : row + 3, column - 2 : column + 3].mean((0, 1))


def _brightness(image: np.ndarray, pixel: np.ndarray) -> float:
    return float(_patch(image, pixel).mean())
