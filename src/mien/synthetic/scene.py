"""A synthetic clip that can be drawn timestep by timestep, with its exact truth."""

import hashlib
import json
import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.camera import Camera
from mien.face import FaceModel, load_face_model
from mien.synthetic.motion import head_motion
from mien.synthetic.painter import develop, draw, to_uint8, wall
from mien.synthetic.recipe import SyntheticRecipe
from mien.synthetic.subject import Subject, build_subject, pose_subject
from mien.tracking import Tracking
from mien.tracking.neck_line import fit_neck_lines

_AHEAD = 2  # frames drawn beyond those that are asked for, a thread


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One picture with its coverage."""

    image: UInt8[np.ndarray, "h w 3"]
    """sRGB."""
    matte: UInt8[np.ndarray, "h w"]
    """255 where only the person is seen: the share of samples that hit the person."""


class SyntheticScene:
    """A person in motion before a camera; everything follows from the recipe and the seed."""

    def __init__(self, recipe: SyntheticRecipe, seed: int) -> None:
        self.recipe, self.seed = recipe, seed
        self.model: FaceModel = load_face_model(recipe.face_model)
        count = self.model.identity_basis.shape[0]
        coefficients = np.random.default_rng([seed, 0]).standard_normal(count).astype(np.float32)
        self.identity = torch.from_numpy(recipe.identity_scale * np.clip(coefficients, -2, 2)).float()
        self.face = head_motion(self.model, self.identity, recipe, seed)
        focal = recipe.focal * recipe.width
        K = torch.tensor([[focal, 0, recipe.width / 2], [0, focal, recipe.height / 2], [0, 0, 1.0]])
        self.camera = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])), recipe.width, recipe.height)

    @cached_property
    def subject(self) -> Subject:
        """The person; takes some seconds when first asked for."""
        return build_subject(self.model, self.identity, self.recipe, self.seed)

    @cached_property
    def background(self) -> Float[np.ndarray, "h w 3"]:
        """The empty room, linear."""
        return wall(self.recipe, self.seed)

    def vertices(self, timestep: int) -> Float[torch.Tensor, "v 3"]:
        """True vertices of the face model, world space, metres."""
        return self.model(self.face[timestep])[0]

    def frame(self, timestep: int) -> SyntheticFrame:
        """The picture of one timestep; the same bytes every time. Safe to call from several threads at once."""
        face = self.face[timestep]
        posed = pose_subject(self.subject, face, self.camera.position.numpy())
        colors, coverage = draw(
            self.subject, posed, self.camera.in_frame(face.T_world_head[0]), self.recipe.supersample
        )
        image = develop(colors, coverage, self.background)
        random = np.random.default_rng([self.seed, 8, timestep])
        return SyntheticFrame(to_uint8(image, self.recipe.noise, random), np.rint(coverage * 255).astype(np.uint8))

    def frames(self) -> Iterator[SyntheticFrame]:
        """All pictures in order, drawn by up to MIEN_THREADS threads, a few of them ahead of what was asked for."""
        assert self.subject is not None
        threads = int(os.environ.get("MIEN_THREADS", 0)) or os.cpu_count() or 1
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
                pending: list[Future[SyntheticFrame]] = []
                for timestep in range(self.recipe.timesteps):
                    pending.append(pool.submit(self.frame, timestep))
                    if len(pending) > threads * _AHEAD:
                        yield pending.pop(0).result()
                for future in pending:
                    yield future.result()
        finally:
            torch.set_num_threads(before)

    def landmarks(self) -> Float[np.ndarray, "t l 2"]:
        """MediaPipe's 478 points of every timestep in pixels, by the face model's embedding."""
        projected = []
        for timestep in range(self.recipe.timesteps):
            points = self.model.landmark_positions(self.vertices(timestep), "mediapipe")
            projected.append(self.camera.project(points)[0])
        return torch.stack(projected).numpy()

    def tracking(self) -> Tracking:
        """The truth."""
        timesteps = self.recipe.timesteps
        return Tracking(
            face_model=self.model.name,
            face_model_hash=self.model.content_hash,
            face=self.face,
            valid=torch.ones(timesteps, dtype=torch.bool),
            cameras=(self.camera,),
            neck_lines=fit_neck_lines(self.model, self.face, (self.camera,)),
            residuals=torch.zeros(timesteps, 1),
            settings={"kind": "synthetic", "seed": self.seed, "recipe": asdict(self.recipe)},
        )

    @property
    def source(self) -> dict:
        """For `Capture.source`: names recipe and seed, and a hash of all that decides the pictures but the code."""
        marks = self.model.landmarks["mediapipe"]  # paint and strands are placed by them
        embedding = marks.faces.numpy().tobytes() + marks.barycentric.numpy().tobytes()
        content = {
            "recipe": asdict(self.recipe),
            "seed": self.seed,
            "face_model": self.model.content_hash,
            "landmarks": hashlib.sha256(embedding).hexdigest()[:16],
        }
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
        return {"kind": "synthetic", "content_hash": digest, **content}
