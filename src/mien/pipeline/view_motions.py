"""The parts of a viewer that need torch: avatars of workspaces, motions, and following a camera."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mien import runtime
from mien.avatar.baking import as_array, bake_rig, make_portable
from mien.avatar.files import load_avatar
from mien.capture.settings import CaptureSettings
from mien.disk.workspace import open_workspace
from mien.driving.follower import Follower, FollowOptions
from mien.driving.rest import facing, rest_of
from mien.driving.transfer import drive, keep_to_filmed, place_torso
from mien.errors import UserError
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.formats.shared.packed import Motion
from mien.machine.progress import say
from mien.media.camera_names import CameraName, camera_named
from mien.media.live_camera import LiveCamera
from mien.pipeline.drive import open_driver
from mien.pipeline.view import Viewed, mesh_of
from mien.runtime.baked import PortableAvatar
from mien.training.footage.filmed import read_coverage
from mien.training.run import filmed_range, run_camera
from mien.training.whole_head.soft_cut import with_soft_cut
from mien.viewer.camera import CameraSwitch
from mien.viewer.drawing import Mesh
from mien.viewer.session import Clip, Session


def of_workspace(root: Path, run: str | None) -> Viewed:
    """Open a run of a workspace."""
    workspace = open_workspace(root)
    run_dir = workspace.run_dir(workspace.pick_run(run))
    avatar = load_avatar(run_dir)
    model = avatar.face_model
    portable = make_portable(avatar, run_camera(run_dir), root.resolve().name, to_share=False)
    portable = replace(with_soft_cut(portable, avatar), filmed=filmed_range(run_dir, avatar))
    mesh = mesh_of(portable) or Mesh(bake_rig(model, avatar.subject), as_array(model.faces))
    coverage = read_coverage(run_dir, model)
    if coverage is not None and len(coverage.seen) == len(mesh.faces):
        mesh = replace(mesh, seen=as_array(coverage.seen))
    return Viewed(portable, mesh, workspace.tracked_names(), lambda: (model, avatar.subject))


def person_of(path: Path, portable: PortableAvatar) -> tuple[FaceModel, FaceParams]:
    """The face model of an avatar that comes from a file, and the person at rest."""
    about, rest = portable.about, portable.neutral
    model = load_face_model(about.face_model)
    if model.content_hash != about.face_model_hash:
        raise UserError(
            f"{path}: was made with another version of the face model {about.face_model!r}, so no motion can be "
            "played; export it again from its workspace"
        )
    fields = ("expression", "joints", "head_rotation", "head_translation")
    given = {name: torch.from_numpy(getattr(rest, name).copy())[None] for name in fields}
    return model, replace(model.neutral(), **given)


def clip_of(
    viewed: Viewed,
    by: Path,
    sequence: str | None,
    neutral: str | None = None,
    capture: CaptureSettings | None = None,
) -> Callable[[], Clip]:
    """Return a function that loads a motion, made for the avatar and softly within what was filmed."""

    def load() -> Clip:
        model, subject = viewed.person()
        driver, portable = open_driver(by, sequence, model, None, neutral, capture), viewed.portable
        person = rest_of(subject, model, facing(torch.from_numpy(portable.camera.viewmat))).face
        face = drive(driver.face, driver.at_rest, person, model.expression_bounds, True, str(by))
        if portable.filmed is not None:
            eye = _position(portable.camera)
            face = keep_to_filmed(face, portable.filmed, subject, model, eye)[0]
        face = place_torso(model, face, subject)
        fields = (face.expression, face.joints, face.head_rotation, face.head_translation)
        return Clip(Motion(*map(as_array, fields), fps=driver.fps), driver.pictures)

    return load


def switch_of(
    session: Session,
    viewed: Viewed,
    name: CameraName | None = None,
    follow: FollowOptions | None = None,
    again: bool = True,
) -> CameraSwitch:
    """Return a switch that lets the avatar of a session follow a camera, by default the first of this machine.

    With `again`, a file plays again and again.
    """
    camera = name or camera_named("camera", None)

    def make() -> Follower:
        model, person = viewed.person()
        eye = as_array(_position(viewed.portable.camera))
        return Follower(model, person, viewed.portable.filmed, eye, follow or FollowOptions())

    return CameraSwitch(session, lambda: LiveCamera(camera, again, say), make)


def _position(camera: runtime.Camera) -> torch.Tensor:
    """The camera's centre in world space, in metres."""
    return torch.from_numpy((-camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]).astype(np.float32))
