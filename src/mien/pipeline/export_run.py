"""The content that `mien export` writes of a run: its avatar, poses and motions."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path

import torch

from mien.avatar.avatar import Avatar
from mien.avatar.baking import as_array, bake_rig, make_portable
from mien.avatar.files import load_avatar
from mien.disk.workspace import Workspace
from mien.driving.rest import facing, rest_of
from mien.driving.transfer import drive, place_torso
from mien.face.params import FaceParams
from mien.formats.format import Content, MotionOptions, NoOptions, PoseOptions
from mien.formats.glb import MeshModel
from mien.formats.shared.packed import Motion
from mien.formats.shared.world_space import in_world
from mien.gaussians import Gaussians
from mien.machine.progress import track_progress
from mien.pipeline.drive import open_driver
from mien.pipeline.expression import with_expression
from mien.runtime.baked import PortableAvatar
from mien.runtime.still import follows_mesh
from mien.training.footage.filmed import read_coverage
from mien.training.run import read_face_track, run_camera
from mien.training.whole_head.soft_cut import with_soft_cut


class RunContent(Content):
    """The avatar of a run."""

    def __init__(self, workspace: Workspace, run: str, options: NoOptions | None = None):
        """Load the avatar. The options name its pose, and what moves it."""
        self._workspace, self._run_dir = workspace, workspace.run_dir(run)
        self._expression = options.set if isinstance(options, PoseOptions) else ()
        self._motion = options if isinstance(options, MotionOptions) and options.series is not None else None
        self._avatar = load_avatar(self._run_dir)
        self._still: Gaussians | None = None

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self._avatar.store)

    def portable(self, confidence: bool = True, soft_cut: bool = False) -> PortableAvatar:
        """Return the whole avatar, with everything that the run knows of it."""
        name = self._workspace.root.resolve().name
        portable = make_portable(self._avatar, run_camera(self._run_dir), name)
        if soft_cut:
            portable = with_soft_cut(portable, self._avatar)
        covered = read_coverage(self._run_dir, self._avatar.face_model) if confidence else None
        return portable if covered is None else replace(portable, confidence=as_array(covered.seen))

    def mesh(self) -> MeshModel:
        """Return the mesh that the Gaussians are bound to, or else the person's, with its texture coordinates."""
        model, baked = self._avatar.face_model, self._avatar.bake()
        rig = baked.rig if follows_mesh(baked) else bake_rig(model, self._avatar.subject)
        return MeshModel(rig, *map(as_array, (model.faces, model.uv, model.uv_faces)))

    def pose(self) -> Gaussians:
        """Return the Gaussians with the expression that was asked for, or of the frame."""
        if self._still is not None:
            return self._still
        return self._posed(
            with_expression(self._avatar.subject, self._avatar.face_model, self._expression, self._avatar.filmed)
        )

    def poses(self) -> "tuple[Iterator[RunContent], float] | None":
        """Return the content in the pose of every frame of the motion, and frames per second."""
        if self._motion is None:
            return None
        driven, fps = self._driven(self._motion, with_head_pose=False)
        indices = track_progress(range(len(driven)), "Exporting", len(driven))
        return (self._in(self._posed(driven[index])) for index in indices), fps

    def motion(self) -> Motion | None:
        """Return the motion as face parameters with head poses."""
        if self._motion is None:
            return None
        driven, fps = self._driven(self._motion, with_head_pose=True)
        fields = (driven.expression, driven.joints, driven.head_rotation, driven.head_translation)
        return Motion(*(tensor.detach().float().numpy() for tensor in fields), fps=fps)

    def trained(self) -> tuple[Avatar, FaceParams]:
        """Return the trained avatar, and the person at all timesteps of its training."""
        face, subject = read_face_track(self._run_dir, self._avatar.face_model), self._avatar.subject
        return self._avatar, replace(face, identity=subject.identity, vertex_offsets=subject.vertex_offsets)

    def _driven(self, motion: MotionOptions, with_head_pose: bool) -> tuple[FaceParams, float]:
        """The face parameters of the motion for this avatar, and frames per second."""
        assert motion.series is not None
        model, subject = self._avatar.face_model, self._avatar.subject
        own = motion.series in self._workspace.sequence_names()
        by = self._workspace.root if own else Path(motion.series)
        driver = open_driver(by, motion.series if own else None, model, neutral=motion.neutral)
        person = rest_of(subject, model, facing(run_camera(self._run_dir).viewmat)).face
        driven = drive(driver.face, driver.at_rest, person, model.expression_bounds, with_head_pose, motion.series)
        driven = place_torso(model, driven, subject)
        face = with_expression(driven[:: motion.every], model, self._expression, self._avatar.filmed)
        return face, driver.fps / motion.every

    def _posed(self, face: FaceParams) -> Gaussians:
        """The Gaussians of one timestep in the world. The head is at the origin, +y up, +z out of the face."""
        origin = torch.zeros_like(face.head_rotation)
        posed = self._avatar.pose(replace(face, head_rotation=origin, head_translation=origin))
        return in_world(posed.gaussians.detach().timestep(0))

    def _in(self, pose: Gaussians) -> "RunContent":
        """The content in another pose."""
        content = copy(self)
        content._still = pose
        return content
