"""A synthetic clip that can be drawn timestep by timestep, with exact ground truth."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.camera import Camera, look_at
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.lab.synthetic.motion import generate_motion, with_expressions
from mien.lab.synthetic.off_model import bend_off_model
from mien.lab.synthetic.painter import develop, draw, paint_wall, to_uint8
from mien.lab.synthetic.posing import HeadPoser, head_pose, landmark_positions, project
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.subject import Subject, build_subject, pose_subject
from mien.machine import exact
from mien.machine.parallel import stream_in_threads
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.tracking import Tracking


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One picture with its coverage."""

    image: UInt8[np.ndarray, "h w 3"]
    """sRGB pixels."""
    matte: UInt8[np.ndarray, "h w"]
    """Share of samples that hit the person; 255 where only the person is seen."""


class SyntheticScene:
    """A person in motion in front of a camera. Recipe and seeds decide everything."""

    def __init__(
        self, recipe: SyntheticRecipe, seed: int, motion_seed: int | None = None,
        same_person: "SyntheticScene | None" = None, moments: Sequence[int] | None = None,
        faces: Sequence[Mapping[str, float]] | None = None,
    ) -> None:  # fmt: skip
        """Prepare a scene; nothing is drawn yet.

        `seed` decides the person, the light and the room, `motion_seed` the motion; None for `seed`. A scene with the
        `same_person` saves building the person. The scene consists of some `moments` of the recipe; None for all. With
        `faces`, it consists of these expressions, by coefficient, of the head at the first moment.
        """
        self.recipe, self.seed, self.motion_seed = recipe, seed, seed if motion_seed is None else motion_seed
        self._same_person = same_person
        self.model: FaceModel = load_face_model(recipe.face_model)
        count = self.model.identity_basis.shape[0]
        coefficients = np.random.default_rng([seed, 0]).standard_normal(count).astype(np.float32)
        self.identity = torch.from_numpy(recipe.identity_scale * np.clip(coefficients, -2, 2)).float()
        self.moments = None if moments is None else tuple(moments)
        self.faces = None if faces is None else tuple(dict(each) for each in faces)
        motion = generate_motion(self.model, self.identity, recipe, self.motion_seed)
        motion = motion if self.faces is None else with_expressions(self.model, motion[0], self.faces)
        self.face = motion if moments is None else motion[list(moments)]
        self.drawn_model, self._drawn_face = self.model, self.face
        if recipe.off_model > 0:
            bent = bend_off_model(self.model, self.identity, recipe.off_model, seed)
            assert moments is None, "expressions beyond the face model follow time without gaps"
            self.drawn_model, self._drawn_face = bent.model, bent.face(self.face, recipe.fps, seed)
            self.face = replace(self.face, vertex_offsets=bent.offsets)
        self.cameras = _place_cameras(recipe)

    @property
    def timesteps(self) -> int:
        """The number of timesteps that the scene consists of."""
        return len(self.face)

    @property
    def camera(self) -> Camera:
        """The front camera."""
        return self.cameras[0]

    @cached_property
    def subject(self) -> Subject:
        """The person. Building takes some seconds at first access."""
        if self._same_person is not None:
            return self._same_person.subject
        return build_subject(self.drawn_model, self.identity, self.recipe, self.seed)

    @cached_property
    def _poser(self) -> HeadPoser:
        return HeadPoser(self.drawn_model, self.identity)

    @cached_property
    def background(self) -> Float[np.ndarray, "h w 3"]:
        """The empty room in linear colour. It looks the same to every camera."""
        return paint_wall(self.recipe, self.seed)

    def vertices(self, timestep: int) -> Float[torch.Tensor, "v 3"]:
        """Return the true vertices of the head in the face model's topology, in world space, in metres."""
        T = head_pose(self._drawn_face[timestep])
        return torch.from_numpy(exact.rotated(self.head_vertices(timestep).numpy(), T[:3, :3], T[:3, 3]))

    def head_vertices(self, timestep: int) -> Float[torch.Tensor, "v 3"]:
        """Return the true vertices of the head in the head frame, in metres."""
        return torch.from_numpy(self._poser(self._drawn_face[timestep]))

    def frame(self, timestep: int, camera: int = 0) -> SyntheticFrame:
        """Draw one picture, with the same bytes every time. Threads may call this at the same time."""
        return self.timestep_frames(timestep, (camera,))[0]

    def timestep_frames(self, timestep: int, cameras: Sequence[int] | None = None) -> list[SyntheticFrame]:
        """Draw the pictures of some cameras (default: all) at one timestep. The pose is computed once."""
        face = self._drawn_face[timestep]
        posed = pose_subject(self.subject, face, self.camera.position.numpy())
        frames = []
        for index in range(len(self.cameras)) if cameras is None else cameras:
            camera = self.cameras[index].in_frame(torch.from_numpy(head_pose(face)))
            seen = replace(posed, viewpoint=camera.position.numpy())
            colors, coverage = draw(self.subject, seen, camera, self.recipe.supersample)
            image = develop(colors, coverage, self.background)
            random = np.random.default_rng([self.motion_seed, 8, timestep, *([index] if index else [])])
            frames.append(
                SyntheticFrame(to_uint8(image, self.recipe.noise, random), np.rint(coverage * 255).astype(np.uint8))
            )
        return frames

    def frames(self) -> Iterator[SyntheticFrame]:
        """Yield the front camera's pictures in order."""
        for frames in self.all_frames(range(self.timesteps), (0,)):
            yield frames[0]

    def all_frames(
        self, timesteps: Sequence[int], cameras: Sequence[int] | None = None
    ) -> Iterator[list[SyntheticFrame]]:
        """Yield the pictures of some timesteps in order, drawn ahead by up to MIEN_THREADS threads."""
        assert self.subject is not None
        assert self.background is not None
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield from stream_in_threads(partial(self.timestep_frames, cameras=cameras), timesteps)
        finally:
            torch.set_num_threads(before)

    def landmarks(self, camera: int = 0) -> Float[np.ndarray, "t l 2"]:
        """Return MediaPipe's 478 points of each timestep in pixels, also hidden ones, as the face model has them."""
        vertices = [self.vertices(timestep).numpy() for timestep in range(self.timesteps)]
        return np.stack([project(self.cameras[camera], landmark_positions(self.model, one))[0] for one in vertices])

    def tracking(self) -> Tracking:
        """Return the true tracking. With `recipe.off_model` only head pose, cameras and the neutral shape are true."""
        return Tracking(
            face_model=self.model.name,
            face_model_hash=self.model.content_hash,
            face=self.face,
            valid=torch.ones(self.timesteps, dtype=torch.bool),
            cameras=self.cameras,
            neck_lines=fit_neck_lines(self.model, self.face, self.cameras),
            residuals=torch.zeros(self.timesteps, len(self.cameras)),
            settings={
                "kind": "synthetic",
                "seed": self.seed,
                "motion_seed": self.motion_seed,
                "recipe": self.recipe.record,
                **self.extent,
            },
        )

    @property
    def extent(self) -> dict:
        """The moments and faces for keys and records. It is empty for whole recipes."""
        extent: dict = {} if self.moments is None else {"moments": list(self.moments)}
        return extent if self.faces is None else {**extent, "faces": list(self.faces)}

    @property
    def source(self) -> dict:
        """For `Capture.source`: recipe, seeds, and a hash of everything that decides the pictures except the code."""
        marks = self.model.landmarks["mediapipe"]  # they place paint and strands
        embedding = marks.faces.numpy().tobytes() + marks.barycentric.numpy().tobytes()
        content = {
            "recipe": self.recipe.record,
            "seed": self.seed,
            "motion_seed": self.motion_seed,
            "face_model": self.model.content_hash,
            "landmarks": hashlib.sha256(embedding).hexdigest()[:16],
            **self.extent,
        }
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
        return {"kind": "synthetic", "content_hash": digest, **content}


def _place_cameras(recipe: SyntheticRecipe) -> tuple[Camera, ...]:
    """Return one camera per camera_id, all in one world frame.

    The first is at the world's origin and looks along -z at the head, `recipe.distance` away. The others look at the
    same point from the same distance: those of `SIDES`, or a ring, which is spread evenly over 72 degrees to both
    sides, in three rows that alternate.
    """
    focal = recipe.focal * recipe.width
    K = torch.tensor([[focal, 0, recipe.width / 2], [0, focal, recipe.height / 2], [0, 0, 1.0]])
    viewmats = [torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))]
    target = torch.tensor([0.0, 0.0, -recipe.distance])
    for index, name in enumerate(recipe.camera_ids[1:], 1):
        share = (index - 1) / max(len(recipe.camera_ids) - 2, 1)
        around = 72.0 * (2 * share - 1), (0.0, 24.0, -16.0)[index % 3]
        azimuth, elevation = map(math.radians, recipe.angles.get(name, around))
        away = torch.tensor([
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
            math.cos(azimuth) * math.cos(elevation),
        ])  # fmt: skip
        viewmats.append(look_at(target + recipe.distance * away, target, torch.tensor([0.0, 1.0, 0.0])))
    return tuple(Camera(K, viewmat, recipe.width, recipe.height) for viewmat in viewmats)
