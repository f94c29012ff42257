"""The teeth's triangles: Fig. 1 of the supplement."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import crop_to, psnr
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.analysis.context import Context, Variant, mean_psnr
from mien.lab.analysis.result import PartResult, Picture, Table
from mien.lab.analysis.views import draw_avatar, mouth_box, mouth_camera
from mien.media.pictures import Box, side_by_side, to_uint8
from mien.render import rasterize

_OPEN = 0.7
"""Share of the largest jaw opening that pictures show."""
_JAW_ANGLE = 0.3
"""Angle of a free jaw in pictures, in radians."""
_FRAMES, _SHOWN = 12, 3
"""Number of frames that are compared, and of those that are shown."""
_SIDE = 360
"""Width and height of a picture, in pixels."""
_NO_TEETH = "The face model of this run has no triangles of teeth, so there is nothing to compare."


def teeth(context: Context) -> PartResult:
    """The avatar with an open jaw, with and without the Gaussians that are bound to triangles of teeth."""
    avatar = context.avatar
    bound = _on_teeth(avatar)
    count = int(bound.sum())
    if not bool(avatar.face_model.region_mask("teeth").any()):
        return PartResult({"teeth_triangles": 0}, (_NO_TEETH,))
    face = open_jaw(avatar.subject, avatar.face_model)
    camera = mouth_camera(avatar.face_model, face, context.camera, _SIDE)
    kept = ~bound
    drawn = [
        draw_avatar(avatar, face, context.camera.fitted(_SIDE, _SIDE)),
        draw_avatar(avatar, face, camera),
        draw_avatar(avatar, face, camera, kept),
    ]
    pictures = [
        Picture(
            "teeth",
            side_by_side(drawn),
            "The avatar with an open jaw; its mouth; and its mouth without the Gaussians on the teeth's triangles.",
        )
    ]
    values: dict[str, Any] = {
        "teeth_triangles": int(avatar.face_model.region_mask("teeth").sum()),
        "teeth_gaussians": count,
        "gaussians": len(bound),
    }
    findings = [
        f"{count:,} of {len(bound):,} Gaussians are bound to the {values['teeth_triangles']:,} triangles of teeth."
    ]
    notes = [
        "Taking Gaussians away from a trained avatar overstates what teeth give, because the others were trained "
        "beside them. The part teeth-trained trains both.",
    ]
    try:
        experiment = context.experiment()
    except UserError as error:
        experiment = None
        notes.append(f"No frames were compared: {error}.")
    if experiment is not None:
        frames = _most_open(experiment)
        with_teeth, without = (_mouth_psnr(experiment, frames, avatar.face_model, mask) for mask in (None, kept))
        values |= {"mouth_psnr_with": with_teeth, "mouth_psnr_without": without, "frames": len(frames)}
        findings.append(
            f"On the mouths of the {len(frames)} held-out frames with the most open jaw, PSNR is {with_teeth:.2f} dB "
            f"with them and {without:.2f} dB without."
        )
        pictures += [_beside_truth(experiment, frame, kept, i) for i, frame in enumerate(frames[:_SHOWN])]
    return PartResult(values, tuple(findings), pictures=tuple(pictures), notes=tuple(notes))


def teeth_trained(context: Context) -> PartResult:
    """The same short training with and without the triangles of teeth."""
    model = context.avatar.face_model
    if not bool(model.region_mask("teeth").any()):
        return PartResult({"teeth_triangles": 0}, (_NO_TEETH,))
    if not model.shareable:
        told = f"The licence of the face model {model.name} allows no copy without teeth, so nothing was trained."
        return PartResult({"trained": False}, (told,))
    context.say_how_long("teeth-trained", 2)
    variants = {
        "with teeth": context.train("teeth-on", context.avatar.config),
        "without teeth": context.train("teeth-off", context.avatar.config, without_teeth(model)),
    }
    rows = []
    for name, variant in variants.items():
        experiment = context.experiment(variant.run_dir)
        frames = [] if experiment is None else _most_open(experiment)
        mouth = _mouth_psnr(experiment, frames, model) if experiment is not None else None
        head = mean_psnr(experiment, frames) if experiment is not None else None
        rows.append((name, variant.summary["gaussians"], _rounded(mouth), _rounded(head)))
    face = open_jaw(context.avatar.subject, model)
    camera = mouth_camera(model, face, context.camera, _SIDE)
    drawn = [draw_avatar(variant.avatar, face, camera) for variant in variants.values()]
    names = ("name", "gaussians", "mouth_psnr", "head_psnr")
    values = {"steps": context.options.steps, "rows": [dict(zip(names, row, strict=True)) for row in rows]}
    findings = []
    if rows[0][2] is not None and rows[1][2] is not None:
        findings.append(
            f"After {context.options.steps:,} steps, PSNR on the mouths of the held-out frames with the most open jaw "
            f"is {rows[0][2]:.2f} dB with the teeth's triangles and {rows[1][2]:.2f} dB without."
        )
    return PartResult(
        values,
        tuple(findings),
        (Table(("", "Gaussians", "PSNR of the mouth, dB", "PSNR of the head crop, dB"), tuple(rows)),),
        pictures=(Picture("teeth-trained", side_by_side(drawn), "Trained with the teeth's triangles, and without."),),
        notes=("Both trainings have the same settings, seed and frames.", _held_out_note(variants)),
    )


def without_teeth(model: FaceModel) -> FaceModel:
    """The face model without the triangles of teeth. Its vertices stay."""
    kept = ~model.region_mask("teeth")
    place = torch.cumsum(kept.long(), 0) - 1
    landmarks = {
        name: replace(points, faces=place[points.faces].clamp_min(0)) for name, points in model.landmarks.items()
    }
    return replace(
        model,
        name=f"{model.name}-no-teeth",
        faces=model.faces[kept],
        uv_faces=model.uv_faces[kept],
        face_regions=model.face_regions[kept],
        landmarks=landmarks,
    )


def open_jaw(face: FaceParams, model: FaceModel) -> FaceParams:
    """The face with an open jaw: by the joint, if it is free, or else by the expression that turns it most.

    A face model without a jaw gives the face unchanged.
    """
    if "jaw" not in model.joint_names:
        return face
    if "jaw" in model.free_joint_names:
        joints = face.joints.clone()
        joints[:, model.free_joint_names.index("jaw"), 0] = _JAW_ANGLE
        return replace(face, joints=joints)
    strongest = _jaw_expression(model)
    expression = face.expression.clone()
    expression[:, strongest] = _OPEN * model.expression_bounds[strongest, 1]
    return replace(face, expression=expression)


def jaw_opening(face: FaceParams, model: FaceModel) -> Float[Tensor, " b"]:
    """How far the jaw is open at each timestep, in the units of its joint or expression."""
    if "jaw" in model.free_joint_names:
        return face.joints[:, model.free_joint_names.index("jaw"), 0]
    return face.expression[:, _jaw_expression(model)]


def _jaw_expression(model: FaceModel) -> int:
    jaw = model.joint_names.index("jaw")
    return int(model.joint_rotation_basis[:, jaw].norm(dim=-1).argmax())


def _on_teeth(avatar: Avatar) -> Tensor:
    """Mark the Gaussians that are bound to triangles of teeth, bool [n]."""
    return avatar.face_model.region_mask("teeth")[avatar.gaussian_store()["face_index"].long()]


def _most_open(experiment: Experiment) -> list[Any]:
    """The held-out frames with the most open jaw, widest first, at most one per timestep."""
    model = experiment.avatar.face_model
    by_time = {(frame.sequence, frame.timestep): frame for frame in reversed(experiment.held_out_frames)}
    openings = {key: float(jaw_opening(experiment.face(frame), model)[0]) for key, frame in by_time.items()}
    widest = sorted(openings, key=lambda key: (-openings[key], key))[:_FRAMES]
    return [by_time[key] for key in widest]


@torch.no_grad()
def _image(experiment: Experiment, frame: Any, kept: Tensor | None) -> Tensor:
    if kept is None:
        return avatar_image(experiment, frame)
    gaussians = experiment.avatar.pose(experiment.face(frame)).gaussians.timestep(0).select(kept)
    return rasterize(gaussians, experiment.camera(frame), torch.ones(3)).image.clamp(0, 1)


def _box_of(experiment: Experiment, frame: Any, model: FaceModel) -> Box:
    return mouth_box(model, experiment.face(frame), experiment.camera(frame))


def _mouth_psnr(experiment: Experiment, frames: Sequence[Any], model: FaceModel, kept: Tensor | None = None) -> float:
    """The mean PSNR of the mouth, whose place is that of `model`: one without teeth would have another box."""
    values = [
        psnr(_image(experiment, frame, kept), target_image(experiment, frame), _box_of(experiment, frame, model))
        for frame in frames
    ]
    return round(sum(values) / len(values), 3)


def _beside_truth(experiment: Experiment, frame: Any, kept: Tensor, index: int) -> Picture:
    images = [
        target_image(experiment, frame),
        _image(experiment, frame, None),
        _image(experiment, frame, kept),
    ]
    box = _box_of(experiment, frame, experiment.avatar.face_model)
    cut = [_enlarged(crop_to(image, box)) for image in images]
    name = experiment.sequences[frame.sequence].name
    return Picture(
        f"teeth-frame-{index + 1}",
        side_by_side([to_uint8(image) for image in cut]),
        f"{name}, timestep {frame.timestep}, held out: truth, with, and without the Gaussians on the teeth.",
    )


def _enlarged(image: Tensor) -> Tensor:
    """The picture at the size of the others, without smoothing."""
    rows = torch.arange(_SIDE) * image.shape[0] // _SIDE
    columns = torch.arange(_SIDE) * image.shape[1] // _SIDE
    return image[rows][:, columns]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _held_out_note(variants: dict[str, Variant]) -> str:
    steps = next(iter(variants.values())).summary["steps"]
    return f"{steps:,} steps are a short training; all schedules are shortened with it."
