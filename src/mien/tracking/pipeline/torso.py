"""Place torsos below tracked heads: from trackings with a head-only model to those with the model that has its head."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.capture.person.body import BodyReader
from mien.face.model import FaceModel
from mien.face.params import FaceParams, most_frontal_camera
from mien.face.torso import build_directions
from mien.machine.progress import say, track_progress
from mien.rotation import axis_angle_from_matrix, invert_rigid, matrix_from_axis_angle
from mien.runtime.torso import TORSO
from mien.tracking.fitting.sequence import FACING
from mien.tracking.landmarks.clothes import follow_clothes
from mien.tracking.landmarks.torso import SHOULDERS, fit_torso
from mien.tracking.tracking import Appearance, Tracking

_LEAST_SEEN = 0.1  # least share of frames that show both shoulders, of those in which a torso is looked for
_LEAST_VISIBILITY = 0.5  # from which the network counts a shoulder as seen


@dataclass(frozen=True, eq=False)
class _Bodies:
    """The points of a body in the pictures of the camera that the head looks at most."""

    points: Float[Tensor, "t 33 4"]
    camera: int

    @property
    def seen(self) -> bool:
        """Whether enough frames show both shoulders."""
        return float((self.points[:, SHOULDERS, 3] > _LEAST_VISIBILITY).all(1).float().mean()) > _LEAST_SEEN


def place_torsos(
    model: FaceModel, head: FaceModel, captures: Sequence[Capture], trackings: Sequence[Tracking], shaping: int
) -> list[Tracking]:
    """Return trackings by a model with a torso, from those of the head-only model whose head it has.

    The first `shaping` sequences decide the build: the one with most frames that shows shoulders. A torso without
    shoulders in pictures moves with the head.
    """
    found = [_find_bodies(capture, tracking) for capture, tracking in zip(captures, trackings, strict=True)]
    faces = [_on_bust(model, head, tracking.face) for tracking in trackings]
    order = sorted(range(shaping), key=lambda index: -len(faces[index]))
    build, first = None, next((index for index in order if found[index].seen), None)
    if first is not None:
        build = _fit(model, faces[first], captures[first], trackings[first], found[first], None).identity
        build = build[build_directions(model)]
    placed = []
    for face, capture, tracking, bodies in zip(faces, captures, trackings, found, strict=True):
        if build is not None and bodies.seen:
            face = _fit(model, face, capture, tracking, bodies, build)
        else:
            say(f"{capture.name}: its pictures show no shoulders, so the torso moves with the head")
            own = pad(face.identity[: build_directions(model).start], (0, len(model.identity_basis)))
            own = own[: len(model.identity_basis)]
            if build is not None:
                own[build_directions(model)] = build
            face = replace(face, identity=own)
        appearance = None if tracking.appearance is None else _on_atlas(model, head, tracking.appearance)
        names = {"face_model": model.name, "face_model_hash": model.content_hash}
        placed.append(replace(tracking, **names, face=face, appearance=appearance))
    return placed


def _find_bodies(capture: Capture, tracking: Tracking) -> _Bodies:
    """Find the body in the stored frames of a capture."""
    camera = most_frontal_camera(tracking.cameras, tracking.face[tracking.valid])
    frames = track_progress(range(capture.timesteps), f"Shoulders of {capture.name}", capture.timesteps)
    with BodyReader() as reader:
        points = np.stack([reader.read(np.ascontiguousarray(capture.images[frame, camera])) for frame in frames])
    return _Bodies(torch.from_numpy(points), camera)


def _on_bust(model: FaceModel, head: FaceModel, face: FaceParams) -> FaceParams:
    """Return the same heads as parameters of the model with a torso, which rests."""
    more = len(model.template) - len(head.template)
    offsets = face.vertex_offsets
    if offsets is not None:
        # The torso's share of the neck keeps its shape, so that no step shows where it begins.
        share = 1 - model.skinning_weights[: len(offsets), model.joint_names.index(TORSO)]
        offsets = pad(offsets * share[:, None], (0, 0, 0, more))
    joints = face.joints.new_zeros(len(face), len(model.free_joint_names), 3)
    for row, name in enumerate(head.free_joint_names):
        if name != "neck":
            joints[:, model.free_joint_names.index(name)] = face.joints[:, row]
    return replace(
        face,
        identity=pad(face.identity, (0, len(model.identity_basis) - len(face.identity))),
        expression=pad(face.expression, (0, len(model.expression_names) - face.expression.shape[1])),
        joints=joints,
        vertex_offsets=offsets,
    )


def _fit(
    model: FaceModel, face: FaceParams, capture: Capture, tracking: Tracking, bodies: _Bodies, build: Tensor | None
) -> FaceParams:
    """Fit the torsos of a sequence, in a world in which a head that looks into the camera has no rotation."""
    camera = tracking.cameras[bodies.camera]
    facing = FACING.to(camera.viewmat)
    T_facing_world = facing @ camera.viewmat
    R, origin = T_facing_world[:3, :3], T_facing_world[:3, 3]
    turned = axis_angle_from_matrix(R @ matrix_from_axis_angle(face.head_rotation))
    there = replace(face, head_rotation=turned, head_translation=face.head_translation @ R.T + origin)
    view = Camera(camera.K, invert_rigid(facing), camera.width, camera.height)
    times = torch.from_numpy(np.asarray(capture.timestamps))
    fitted = fit_torso(model, there, view, bodies.points, times, build)
    images, mattes = (frames[:, bodies.camera] for frames in (capture.images, capture.mattes))
    clothes = follow_clothes(images, mattes, model, fitted, view)
    if len(clothes.point):
        fitted = fit_torso(model, there, view, bodies.points, times, build, clothes)
    return replace(face, identity=fitted.identity, expression=fitted.expression, joints=fitted.joints)


def _on_atlas(model: FaceModel, head: FaceModel, appearance: Appearance) -> Appearance:
    """Return the same texture in the texture coordinates of the model whose head it is; unknown on the torso."""
    theirs, ours = head.uv[head.uv_faces].reshape(-1, 2), model.uv[model.uv_faces[: len(head.uv_faces)]].reshape(-1, 2)
    scale = float((ours.amax(0) - ours.amin(0)).max() / (theirs.amax(0) - theirs.amin(0)).max())
    offset = (ours - scale * theirs).median(0).values
    side = round(len(appearance.texture) / scale)
    steps = (torch.arange(side) + 0.5) / side
    v, u = torch.meshgrid(1 - steps, steps, indexing="ij")
    place = (torch.stack([u, v], -1) - offset) / scale
    grid = torch.stack([2 * place[..., 0] - 1, 1 - 2 * place[..., 1]], -1)[None]

    def moved(values: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
        return grid_sample(values.permute(2, 0, 1)[None], grid, align_corners=False)[0].permute(1, 2, 0).contiguous()

    trust = moved(appearance.trust[..., None])[..., 0]
    return replace(appearance, texture=moved(appearance.texture), trust=trust * (trust > 0.5))
