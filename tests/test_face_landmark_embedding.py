"""Landmarks are placed exactly if the answer is known, and repeatably if a detector finds them."""

import json
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mien.camera import camera_from_fov
from mien.face import load_face_model, loading
from mien.rotation import matrix_from_axis_angle, rigid_transform
from mien.tracking.landmarks import LEFT_EYELIDS, RIGHT_EYELIDS, EmbeddingSettings, embed_landmarks, embedding
from mien.tracking.landmarks.embedding import DetectedViews, best_point
from mien.tracking.landmarks.groups import IBUG68
from small_face_model import make_small_face_model


def test_a_point_on_the_surface_is_found_again():
    model = make_small_face_model()
    random = torch.Generator().manual_seed(0)
    front = (model.template[model.faces].mean(1)[:, 2] > 0.05).nonzero()[:, 0]
    allowed = torch.zeros(len(model.faces), dtype=torch.bool)
    allowed[front] = True
    truth = front[torch.randint(len(front), (6,), generator=random)]
    weights = torch.tensor([6.0, 4.0, 2.0]) / 12
    points = (model.template[model.faces[truth]] * weights[:, None]).sum(1)
    pixels, depths, targets = [], [], []
    for _ in range(12):
        turn = matrix_from_axis_angle(0.4 * (2 * torch.rand(3, generator=random) - 1))
        pose = rigid_transform(torch.diag(torch.tensor([1.0, -1.0, -1.0])) @ turn, torch.tensor([0.0, 0.0, 0.7]))
        camera = camera_from_fov(0.5, 512, 512, pose)
        projected, depth = camera.project(model.template)
        pixels.append(projected)
        depths.append(depth)
        targets.append(camera.project(points)[0])
    # One detection in twelve is far off.
    targets[5] = targets[5] + 200
    views = DetectedViews(torch.stack(pixels), torch.stack(depths), torch.stack(targets))
    for landmark in range(len(truth)):
        triangle, barycentric, error = best_point(views, model.faces, allowed, landmark, clamp=10.0)
        found = barycentric @ model.template[model.faces[triangle]]
        torch.testing.assert_close(found, points[landmark], atol=1e-6, rtol=0)
        assert error < 1e-2


assert len(IBUG68) == len(set(IBUG68)) == 68
assert (IBUG68[36], IBUG68[45]) == (33, 263), "the subject's right comes first: 33 is the outer corner of that eye"
PLACED = sorted({*LEFT_EYELIDS, *RIGHT_EYELIDS, *IBUG68[::4], *range(0, 478, 12)})
"""Landmarks that are placed. Each takes a search of its own, so some of them tell as much as all."""


@pytest.fixture(scope="module")
def few():
    model, place = load_face_model("anny"), embedding.best_point
    shipped = model.landmarks["mediapipe"]

    def place_some(views: DetectedViews, faces: Tensor, allowed: Tensor, landmark: int, clamp: float) -> tuple:
        if landmark in PLACED:
            return place(views, faces, allowed, landmark, clamp)
        return shipped.faces[landmark], shipped.barycentric[landmark], torch.tensor(0.0)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(embedding, "best_point", place_some)
        return model, *embed_landmarks(model, EmbeddingSettings(pictures=8, seed=3))


@pytest.mark.unchecked
def test_few_pictures_agree_with_the_shipped_landmarks(few, tmp_path, monkeypatch):
    model, landmarks, errors = few
    # 512 pixels show 0.34 m: 3 px are 2 mm.
    assert errors[PLACED].median() < 3.5
    points = landmarks["mediapipe"].positions(model.template, model.faces)
    distance = (model.landmark_positions(model.template, "mediapipe") - points).norm(dim=1)[PLACED]
    assert distance.median() < 0.0015
    assert distance.quantile(0.95) < 0.005
    # Landmarks of lids are not inside the eyeballs, which a picture cannot tell, since a hidden point looks as near.
    for name, lids in (("left_eye", LEFT_EYELIDS), ("right_eye", RIGHT_EYELIDS)):
        center = model.joint_template[model.joint_names.index(name)]
        ball = model.faces[model.region_mask("eyes", "irises")].unique()
        ball = ball[model.template[ball, 0] * center[0] > 0]
        radius = (model.template[ball] - center).norm(dim=1).median()
        assert ((points[list(lids)] - center).norm(dim=1) - radius).min() > -0.0015
    # What is written is read by the loader.
    (tmp_path / "data").mkdir()
    path = tmp_path / "data" / "anny_landmarks.json"
    loading.write_landmarks(path, replace(model, landmarks=landmarks), "a command", 2.5)
    assert path.stat().st_size < 100_000
    assert json.loads(path.read_text())["topology_hash"] == model.topology_hash
    monkeypatch.setattr(loading.resources, "files", lambda package: tmp_path)
    read = loading.read_landmarks("anny", model)
    for name, marks in landmarks.items():
        assert torch.equal(read[name].faces, marks.faces)
        torch.testing.assert_close(read[name].barycentric, marks.barycentric, atol=1e-4, rtol=0)
