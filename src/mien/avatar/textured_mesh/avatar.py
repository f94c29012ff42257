"""A textured mesh: the tracked mesh with trained offsets, albedo, a normal map, and light by spherical harmonics.

It is what a renderer of meshes can do with a tracked head, and the plain baseline of all methods. The mesh is drawn as
flat, opaque surfels that are fixed in its triangles (`mien.avatar.textured_mesh.surfels`), so that all of mien can show
it; nothing of them is trained but albedo and normals. A colour is albedo times the light on the normal: the
interpolated normal of the vertices, bent by the normal map. Light has nine coefficients for each channel, those of the
spherical harmonics up to degree 2, which hold nearly all that a matt surface shows of distant light (Ramamoorthi and
Hanrahan, SIGGRAPH 2001).

Offsets and a part of the albedo belong to vertices and are averaged over neighbours, as a smooth change of variables
whose gradient is smooth as well. Teeth, tongue, eyes and the inside of the mouth have no offsets.

A baked record has no colours that depend on normals, so light is that on the face at rest, in the head's frame.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from mien.avatar.avatar import Avatar, ParameterGroup, Posed, store_group
from mien.avatar.baking import Kept, as_array, bake_rig
from mien.avatar.ops.activation import sigmoid
from mien.avatar.ops.bound_gaussians import pose_bound_gaussians
from mien.avatar.ops.triangle_frames import corners_in_frames, ellipses_of_corners, triangle_frames
from mien.avatar.settings import TRAINED, Progress, Rate
from mien.avatar.store import GaussianStore
from mien.avatar.textured_mesh.settings import TexturedMeshConfig
from mien.avatar.textured_mesh.surfels import Neighbours, Surfels, place_surfels
from mien.face.head_parts import head_parts
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.gaussians import Rendering, sh_from_rgb
from mien.render.mesh import shade, vertex_normals
from mien.runtime.baked import Attributes, MeshBound

_OPACITY = 0.99
"""Opacity of every surfel in its middle. The kernel lets none be 1."""
OVERLAP = 2.5
"""Scales of a surfel, in standard deviations of what it covers. Below about 2.3, what is behind shows through."""
_OFFSET_WEIGHT = 0.02  # of the mean squared distance of offsets from their neighbours' mean, in square millimetres
_ALBEDO_WEIGHT = 0.003  # of that of albedos of surfels and vertices, and of neighbours, as logits
_NORMAL_WEIGHT = 0.01  # of the mean squared slope by which the normal map bends normals
_LIGHT_WEIGHT = 0.01
"""Weight of the mean squared difference from white light. Without it, skin and light can be exchanged."""
_MILLIMETRE = 1e-3


class _AtRest(NamedTuple):
    """The part of a posed mesh that is the same for all faces."""

    offsets: Float[Tensor, "v 3"]
    vertex_albedo: Float[Tensor, "v 3"]
    local: dict[str, Tensor]
    """Raw tensors of the surfels in the frames of their triangles."""
    colors: Float[Tensor, "n 3"]
    """Colours of the face at rest."""


class TexturedMesh(Avatar):
    """Opaque surfels on the triangles of a mesh. Offsets of vertices, albedo, normals and light are trained."""

    config: TexturedMeshConfig

    def __init__(self, config: TexturedMeshConfig, face_model: FaceModel, face: FaceParams):
        super().__init__(config, face_model, face)
        like, faces = face_model.template, face_model.faces
        face_index = place_surfels(face_model.rest_vertices(self.subject), faces, config.surfels)
        n = len(face_index)
        self.store = GaussianStore(
            {"albedo": like.new_zeros(n, 3), "slopes": like.new_zeros(n, 2)}, {"face_index": face_index}
        )
        self.vertex_means = nn.Parameter(torch.zeros_like(like))
        self.vertex_albedo = nn.Parameter(torch.zeros_like(like))
        self.light = nn.Parameter(white_light(like))
        parts = head_parts(face_model)
        outer = ~(parts.interior | torch.stack(parts.eyes).any(0)).to(faces.device)
        movable = like.new_zeros(len(like), 1)
        movable[faces[outer].long().flatten()] = 1
        self.register_buffer("movable", movable, persistent=False)
        self.surfels, self.neighbours = self._surfels(), Neighbours(like, faces)
        # A file may have other numbers of surfels.
        self.register_load_state_dict_post_hook(lambda avatar, _: setattr(avatar, "surfels", avatar._surfels()))
        self._kept = Kept[_AtRest]()

    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The surfels in the head frame, one batch entry per timestep."""
        rest = self._rest()
        own = face.vertex_offsets
        face = replace(face, vertex_offsets=rest.offsets if own is None else own + rest.offsets)
        sh = sh_from_rgb(rest.colors)[:, None]
        gaussians = pose_bound_gaussians(self.face_model, face, rest.local, sh, in_head=True)
        return Posed(gaussians, {"offsets": rest.offsets, "vertex_albedo": rest.vertex_albedo})

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """Penalties of rough offsets, rough albedo, bent normals, and light that is not white from everywhere."""
        store = self.store
        values = torch.cat([posed.aux["offsets"] / _MILLIMETRE, posed.aux["vertex_albedo"]], dim=-1)
        offsets, albedo = (values - self.neighbours.means(values)).square().split(3, dim=-1)
        detail = store["albedo"].square().sum(1).mean()
        return {
            "offsets": _OFFSET_WEIGHT * offsets.sum(1).mean(),
            "albedo": _ALBEDO_WEIGHT * (albedo.sum(1).mean() + detail),
            "normals": _NORMAL_WEIGHT * store["slopes"].square().sum(1).mean(),
            "light": _LIGHT_WEIGHT * (self.light - white_light(self.light)).square().mean(),
        }

    def parameter_groups(self) -> list[ParameterGroup]:
        """Per-surfel tensors, those of the vertices, and the light."""
        albedo_rate = Rate(2e-2, 2e-3)  # of logits
        return [
            store_group(self.store, "albedo", albedo_rate),
            store_group(self.store, "slopes", Rate(1e-2, 1e-3)),
            ParameterGroup("offsets", {"vertex_means": self.vertex_means}, Rate(2e-4, 2e-5)),
            ParameterGroup("vertex_albedo", {"vertex_albedo": self.vertex_albedo}, albedo_rate),
            ParameterGroup("light", {"light": self.light}, Rate(5e-3, 5e-4)),
        ]

    def density(self) -> None:
        """The surfels stay where they are."""

    @torch.no_grad()
    def bake(self) -> MeshBound:
        """The mesh with its offsets, and surfels in constant colours."""
        rest = self._compute_rest()
        local = {name: as_array(value) for name, value in rest.local.items()}
        sh = as_array(sh_from_rgb(rest.colors)[:, None])
        return MeshBound(
            rig=bake_rig(self.face_model, self._moved_subject(rest.offsets)),
            faces=as_array(self.face_model.faces),
            face_index=local["face_index"],
            means=local["means"],
            attributes=Attributes(local["quats"], local["log_scales"], local["opacity_logits"], sh),
            sh_frame="head",
        )

    def _rest(self) -> _AtRest:
        """Return the part that is the same for all faces. Outside of training, it is computed once."""
        if self.training or torch.is_grad_enabled():
            return self._compute_rest()
        return self._kept.of([*self.parameters(), *self.store.buffers()], self._compute_rest)

    def _compute_rest(self) -> _AtRest:
        store, faces, surfels = self.store, self.face_model.faces.long(), self.surfels
        offsets, vertex_albedo = self.averaged()
        vertices = self.face_model.rest_vertices(self._moved_subject(offsets))
        corners = corners_in_frames(vertices, faces)
        means, albedo = surfels.at_corners(torch.cat([corners, vertex_albedo[faces]], dim=-1)).split(3, dim=-1)
        shapes = torch.cat(ellipses_of_corners(corners, OVERLAP), dim=-1)
        quats, log_scales = surfels.at_triangles(shapes).split([4, 3], dim=-1)
        shares = surfels.shares()
        local = {
            "face_index": store["face_index"],
            "means": means,
            "quats": quats,
            "log_scales": log_scales + shares.log()[:, None],
            "opacity_logits": torch.full_like(shares, math.log(_OPACITY / (1 - _OPACITY))),
        }
        albedo = sigmoid(store["albedo"] + albedo)
        return _AtRest(offsets, vertex_albedo, local, albedo * shade(self._normals(vertices), self.light))

    def _surfels(self) -> Surfels:
        return Surfels(self.store["face_index"], len(self.face_model.faces), self.face_model.template)

    def _moved_subject(self, offsets: Float[Tensor, "v 3"]) -> FaceParams:
        own = self.subject.vertex_offsets
        return replace(self.subject, vertex_offsets=offsets if own is None else own + offsets)

    def averaged(self) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "v 3"]]:
        """Offsets in metres and logits of the albedo of the vertices, averaged over neighbours."""
        values = torch.cat([self.vertex_means, self.vertex_albedo], dim=-1)
        for _ in range(self.config.smoothing):
            values = (values + self.neighbours.means(values)) / 2
        offsets, albedo = values.split(3, dim=-1)
        return offsets * self.get_buffer("movable"), albedo

    def _normals(self, vertices: Float[Tensor, "v 3"]) -> Float[Tensor, "n 3"]:
        """Unit normals at the surfels of a mesh, bent by the normal map along the axes of triangles."""
        faces, surfels = self.face_model.faces, self.surfels
        smooth = surfels.at_corners(vertex_normals(vertices, faces)[..., faces.long(), :])
        axes = surfels.at_triangles(triangle_frames(vertices, faces).R[..., ::2].flatten(-2))
        along, across = axes.unflatten(-1, (3, 2)).unbind(-1)
        slopes = self.store["slopes"]
        return normalize(smooth + along * slopes[:, :1] + across * slopes[:, 1:], dim=-1)


def white_light(like: Tensor) -> Float[Tensor, "9 3"]:
    """The coefficients of light that is 1 on every normal."""
    return torch.cat([like.new_full((1, 3), math.sqrt(4 * math.pi)), like.new_zeros(8, 3)])
