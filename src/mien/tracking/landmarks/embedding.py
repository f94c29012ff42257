"""MediaPipe's 478 landmarks, placed on a face model (`python benchmarks/landmarks.py NAME`).

This works for any FaceModel. It draws the model with random identities, mild expressions, gazes and views, runs the
landmark detector on the pictures, and takes for each landmark the point of the surface that projects nearest to the
detections. The result ships with mien (src/mien/face/data), so this has to run only after a change of the mesh.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.camera import Camera, camera_from_fov
from mien.capture.person.backend import load_solution, quiet_mediapipe
from mien.capture.person.faces import IBUG68, LANDMARKS
from mien.errors import UserError
from mien.face.model import FaceModel, Landmarks
from mien.face.params import FaceParams
from mien.machine.progress import track_progress
from mien.render.mesh import Headlight, rasterize_mesh, render_mesh
from mien.rotation import rigid_transform
from mien.tracking.landmarks.groups import LEFT_IRIS, RIGHT_IRIS

_SCALP_FRONT = 0.06  # landmarks may lie on the scalp only farther ahead of the head frame's origin than this, in metres
_LEAST_SEEN = 0.25
"""Landmarks may lie on a triangle only if it is seen in at least this share of the pictures. Measured against 0:
landmarks of lids lie up to 0.9 instead of 3.0 mm inside the eyeball (log, "Face model")."""
_CLAMP = 10.0  # errors are clamped to this many pixels, because detections fail now and then
COARSE_VIEWS = 16  # number of views of the coarse search over all triangles
COARSE_SUBDIVISIONS = 3  # number of steps along a triangle's side in the coarse search
_BEST_TRIANGLES = 16  # number of triangles that the coarse search passes on

_FACE_REGIONS = ("skin", "face", "lips", "eyelids", "brows", "nose", "scalp", "ears")
_EYE_REGIONS = ("eyes", "irises")
_WALL = (0.6, 0.6, 0.6)


@dataclass(frozen=True)
class EmbeddingSettings:
    """The pictures that the embedding is fitted to."""

    pictures: int = 240
    """Number of pictures drawn. The detector fails on some of them."""
    size: int = 512
    """Width and height of the pictures, in pixels."""
    seed: int = 0


@dataclass(frozen=True, eq=False)
class DetectedViews:
    """Vertices of one face model and detected landmarks in n pictures."""

    vertices: Float[Tensor, "n v 2"]
    """Projected vertices, in pixels."""
    depth: Float[Tensor, "n v"]
    """Depths of the vertices in metres, for perspective-correct points between them."""
    detected: Float[Tensor, "n l 2"]
    """Detected landmarks, in pixels."""


def embed_landmarks(model: FaceModel, settings: EmbeddingSettings) -> tuple[dict[str, Landmarks], Float[Tensor, " l"]]:
    """The landmark sets `mediapipe` and `ibug68` of a face model, and the median errors of MediaPipe's in pixels."""
    views, seen = _draw_and_detect(model, settings)
    faces, barycentric = torch.empty(LANDMARKS, dtype=torch.long), torch.empty(LANDMARKS, 3)
    errors = torch.empty(LANDMARKS)
    on_eyes, on_face = (_allowed(model, regions, seen) for regions in (_EYE_REGIONS, _FACE_REGIONS))
    for landmark in track_progress(range(LANDMARKS), "Placing landmarks", LANDMARKS):
        allowed = on_eyes if landmark in LEFT_IRIS + RIGHT_IRIS else on_face
        faces[landmark], barycentric[landmark], errors[landmark] = best_point(views, model.faces, allowed, landmark)
    mediapipe = Landmarks(faces, barycentric)
    subset = torch.tensor(IBUG68)
    return {"mediapipe": mediapipe, "ibug68": Landmarks(faces[subset], barycentric[subset])}, errors


def random_face(model: FaceModel, generator: torch.Generator) -> FaceParams:
    """One timestep of a random person with a mild expression, turned a little, at the world's origin.

    Half of the people open the mouth and a third close the eyes. From closed lips or open lids alone, a point of the
    upper one cannot be told from its neighbour on the lower one.
    """

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    neutral = model.neutral()
    active = torch.rand(neutral.expression.shape, generator=generator) < 0.12
    strength = 0.35 * torch.rand(neutral.expression.shape, generator=generator)
    if model.expression_sigmas is not None:
        strength = 2 * strength * model.expression_sigmas * uniform(*neutral.expression.shape).sign()
    expression = active * strength
    opening, blink = _sometimes(0.5, generator), _sometimes(0.35, generator)
    for index, name in enumerate(model.expression_names):
        if name == "jawOpen":
            expression[:, index] = 0.6 * opening
        elif name.startswith("eyeBlink"):
            expression[:, index] = blink
    expression = expression.clamp(model.expression_bounds[:, 0], model.expression_bounds[:, 1])
    joints = neutral.joints.clone()
    gaze = 0.2 * uniform(3) * torch.tensor([0.6, 1.0, 0.0])
    for index, name in enumerate(model.free_joint_names):
        if name in ("left_eye", "right_eye"):
            joints[:, index] = gaze
        elif name == "jaw":
            joints[:, index, 0] = 0.25 * opening
    return replace(
        neutral,
        identity=0.8 * torch.randn(neutral.identity.shape, generator=generator),
        expression=expression,
        joints=joints,
        head_rotation=uniform(1, 3) * torch.tensor([0.2, 0.45, 0.1]),
    )


def _sometimes(share: float, generator: torch.Generator) -> float:
    """A random number up to 1 in a share of the cases, otherwise 0."""
    chance, amount = torch.rand(2, generator=generator).tolist()
    return amount if chance < share else 0.0


def paint(model: FaceModel, generator: torch.Generator) -> Float[Tensor, "f 3 3"]:
    """An albedo for the corners of every triangle: one colour per region, with a random skin tone."""
    skin = torch.tensor([0.85, 0.65, 0.55]) * (0.55 + 0.45 * torch.rand(1, generator=generator))
    tones = {
        "lips": skin * torch.tensor([0.95, 0.6, 0.62]),
        "brows": skin * 0.3,
        "eyes": torch.tensor([0.92, 0.92, 0.92]),
        "irises": torch.tensor([0.22, 0.15, 0.10]),
        "teeth": torch.tensor([0.9, 0.9, 0.9]),
        "tongue": torch.tensor([0.6, 0.25, 0.25]),
        "mouth": torch.tensor([0.25, 0.08, 0.08]),
        "eyelids": skin * 0.8,
        "scalp": skin * 0.35,
    }
    by_region = torch.stack([tones.get(name, skin) for name in model.region_names])
    return by_region[model.face_regions][:, None].expand(-1, 3, 3).contiguous()


def _draw_and_detect(model: FaceModel, settings: EmbeddingSettings) -> tuple[DetectedViews, Float[Tensor, " f"]]:
    """Draw the pictures and detect landmarks. Also returns the share of the pictures in which each triangle is seen."""
    seen = torch.zeros(len(model.faces))
    generator = torch.Generator().manual_seed(settings.seed)
    views: list[tuple[Tensor, Tensor, Tensor]] = []
    module = load_solution("face_mesh")
    with quiet_mediapipe(), module.FaceMesh(static_image_mode=True, max_num_faces=1, refine_landmarks=True) as mesh:
        mesh.process(np.zeros((64, 64, 3), np.uint8))
        for _ in track_progress(range(settings.pictures), "Drawing and detecting", settings.pictures):
            vertices = model(random_face(model, generator))[0]
            camera = _random_camera(settings.size, generator)
            side, up = torch.rand(2, generator=generator).tolist()
            lamp = Headlight(direction=(side - 0.5, -0.3 - 0.5 * up, -1.0), ambient=0.45)
            picture, _ = render_mesh(
                vertices, model.faces, camera, paint(model, generator), light=lamp, background=_WALL, supersample=2
            )
            faces = mesh.process((255 * picture.clamp(0, 1)).to(torch.uint8).numpy()).multi_face_landmarks
            if faces:
                points = torch.tensor([(point.x, point.y) for point in faces[0].landmark]) * settings.size
                pixels, depth = camera.project(vertices)
                views.append((pixels, depth, points))
                drawn = rasterize_mesh(vertices, model.faces, camera.resized(2 * camera.width, 2 * camera.height))
                seen[drawn.face_index[drawn.face_index >= 0].unique().long()] += 1
    if len(views) < settings.pictures // 2:
        raise UserError(
            f"the landmark detector found a face in {len(views)} of {settings.pictures} pictures of {model.name}: "
            "check the regions and the head frame of the model"
        )
    return DetectedViews(*(torch.stack(parts) for parts in zip(*views, strict=True))), seen / len(views)


def _random_camera(size: int, generator: torch.Generator) -> Camera:
    """A camera in front of the head, which fills half of the picture."""
    distance = 0.6 + 0.6 * float(torch.rand((), generator=generator))
    turned = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    viewmat = rigid_transform(turned, torch.tensor([0.0, -0.01, distance]))
    return camera_from_fov(2 * float(np.arctan(0.17 / (distance - 0.08))), size, size, viewmat)


def _allowed(model: FaceModel, regions: Sequence[str], seen: Float[Tensor, " f"]) -> Bool[Tensor, " f"]:
    mask = model.region_mask(*regions)
    assert mask.any(), f"{model.name} has none of the regions {', '.join(regions)}"
    mask &= ~model.region_mask("scalp") | (model.template[model.faces].mean(1)[:, 2] > _SCALP_FRONT)
    # Hidden triangles, such as the inner side of a lid, may project nearer in every picture and still be wrong.
    return mask & (seen >= _LEAST_SEEN)


def best_point(
    views: DetectedViews, faces: Int[Tensor, "f 3"], allowed: Bool[Tensor, " f"], landmark: int
) -> tuple[Tensor, Float[Tensor, " 3"], Tensor]:
    """Triangle, barycentric weights and median error of the point with the least sum of clamped pixel errors."""
    # First try few points of all triangles in some of the views, then all points of the best triangles in all views.
    some = DetectedViews(
        *(part[:: max(1, len(part) // COARSE_VIEWS)] for part in (views.vertices, views.depth, views.detected))
    )
    everywhere = allowed.nonzero()[:, 0]
    rough = _errors(some, faces[everywhere], _triangle_grid(COARSE_SUBDIVISIONS), landmark)
    scores = rough.clamp_max(4 * _CLAMP).sum(0).amin(1)
    triangles = everywhere[scores.topk(min(_BEST_TRIANGLES, len(scores)), largest=False).indices]
    weights = _triangle_grid(12)  # number of steps along a triangle's side between the points that are tried
    error = _errors(views, faces[triangles], weights, landmark)
    best = int(error.clamp_max(_CLAMP).sum(0).argmin())
    triangle, point = divmod(best, len(weights))
    return triangles[triangle], weights[point], error[:, triangle, point].median()


def _errors(
    views: DetectedViews, corners: Int[Tensor, "t 3"], weights: Float[Tensor, "p 3"], landmark: int
) -> Float[Tensor, "n t p"]:
    """Distances in pixels of points of triangles from the detected landmark in each view."""
    # The pixel of a point on a triangle is the mean of its corners' pixels, weighted by barycentrics times depth.
    scaled = weights * views.depth[:, corners][:, :, None]
    scaled = scaled / scaled.sum(-1, keepdim=True)
    points = scaled @ views.vertices[:, corners]
    return (points - views.detected[:, landmark, None, None]).norm(dim=-1)


def _triangle_grid(subdivisions: int) -> Float[Tensor, "p 3"]:
    """Barycentric weights of points spread evenly over a triangle."""
    steps = [(i, j, subdivisions - i - j) for i in range(subdivisions + 1) for j in range(subdivisions + 1 - i)]
    return torch.tensor(steps, dtype=torch.float32) / subdivisions
