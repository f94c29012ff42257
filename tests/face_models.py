"""Face models of all schemas for one suite: anny, one in FLAME's schema, one in GNM's, and ICT-FaceKit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from flame_like import exact_landmarks, flame_like, write_npz
from gnm_like import gnm_landmarks, gnm_like
from mien.face import FaceModel, load_face_model
from mien.face.model import Landmarks
from mien.face.models.model_files import read_model_file
from mien.tracking.landmarks.regions import with_regions_by_landmarks

NAMES = ("anny", "flame", "gnm", "ict")


def face_model_named(name: str, folder: Path, test_data: Path | None) -> FaceModel:
    """Return a complete face model. `folder` takes its file."""
    anny = load_face_model("anny")
    if name == "anny":
        return anny
    if name == "flame":
        bare = read_model_file(write_npz(folder / "flame.npz", flame_like(anny)), name, shareable=True)
        marks = exact_landmarks(anny)
    elif name == "gnm":
        bare, marks = read_model_file(write_npz(folder / "gnm.npz", gnm_like(anny)), name), gnm_landmarks(anny)
    else:
        assert test_data is not None
        data = test_data / "face_models"
        bare = read_model_file(data / "ict_facekit_light_f16.npz", name)
        own = json.loads((data / "ict_vertex_indices.json").read_text())["idx_to_landmark_verts"]
        marks = _by_registration(anny, bare, np.array(own))
    return with_regions_by_landmarks(replace(bare, landmarks=marks))


def _by_registration(anny: FaceModel, model: FaceModel, own: np.ndarray) -> dict[str, Landmarks]:
    """Return anny's landmarks on a model whose vertices of the 68 points are known: warped, then the nearest vertex."""
    sources = anny.landmark_positions(anny.template, "ibug68").double().numpy()[17:]  # without the jaw's outline
    targets = model.template.double().numpy()[own[17:]]
    distance = np.linalg.norm(sources[:, None] - sources, axis=-1)
    linear = np.concatenate([sources, np.ones((len(sources), 1))], axis=1)
    system = np.block([[distance, linear], [linear.T, np.zeros((4, 4))]])
    solved = np.linalg.solve(system, np.concatenate([targets, np.zeros((4, 3))]))
    points = anny.landmark_positions(anny.template, "mediapipe").double().numpy()
    near = np.linalg.norm(points[:, None] - sources, axis=-1)
    warped = near @ solved[:-4] + np.concatenate([points, np.ones((len(points), 1))], axis=1) @ solved[-4:]
    faces = model.faces.numpy()
    skin = np.unique(faces[model.region_mask("skin").numpy()])
    eyes = np.unique(faces[model.region_mask("eyes", "irises").numpy()])
    vertices, chosen = model.template.double().numpy(), []
    for index, point in enumerate(warped):
        among = eyes if index >= 468 else skin
        chosen.append(among[np.linalg.norm(vertices[among] - point, axis=1).argmin()])
    first = {int(vertex): place for place, vertex in reversed(list(enumerate(faces.ravel())))}
    places = torch.tensor([first[int(vertex)] for vertex in chosen])
    marks = Landmarks(places // 3, torch.eye(3)[places % 3])
    subset = torch.tensor([first[int(vertex)] for vertex in own])
    return {"mediapipe": marks, "ibug68": Landmarks(subset // 3, torch.eye(3)[subset % 3])}
