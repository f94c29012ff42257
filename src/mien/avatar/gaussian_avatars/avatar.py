"""GaussianAvatars (Qian et al., CVPR 2024): Gaussians in the frames of a face model's triangles.

Written from the paper and its supplement. Comments note where the published code differs from the paper in a way that
matters. Lengths and scales in the store are in units of the triangle's own scale (`mien.avatar.ops.triangle_frames`).
Changes with the expression beside those of the mesh (`expression_rank`, `appearance`) are not part of the paper.
"""

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.adam import FactoredGradient
from mien.avatar.avatar import Avatar, Extras, ParameterGroup, Posed, store_group
from mien.avatar.baking import as_array, as_log_scales, bake_rig
from mien.avatar.bound_surface import BoundSurface
from mien.avatar.density import GradientDensity
from mien.avatar.gaussian_avatars.changes import APPEARANCE_WEIGHT, FeatureAppearance, feature_tensors
from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig
from mien.avatar.ops.bound_gaussians import pose_bound_gaussians
from mien.avatar.ops.changed_gaussians import BASES, PENALTIES, Changes, mean_squares, pose_changed_gaussians
from mien.avatar.ops.expression_changes import ExpressionActivations
from mien.avatar.ops.triangle_penalties import triangle_penalties
from mien.avatar.settings import TRAINED, Progress, Rate, active_degree
from mien.avatar.store import GaussianStore
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.gaussians import Rendering, stack_timesteps
from mien.runtime.baked import Attributes, ExpressionChanges, MeshBound

_RATES = {
    "log_scales": Rate(0.017),
    "quats": Rate(1e-3),
    "opacity_logits": Rate(0.05),
    "sh_constant": Rate(2.5e-3),
}
"""Learning rates of the paper (its supplement, section B)."""
_HIGHER_DEGREES_RATE = Rate(2.5e-3 / 20)  # of coefficients of higher degrees: a twentieth, as in the published code
_BASIS_RATES = {"color_basis": Rate(1e-3), "opacity_basis": Rate(0.01), "offset_basis": Rate(1e-3, 1e-5)}
"""Learning rates of linear changes with the expression, per unit of an activation."""


class GaussianAvatars(Avatar):
    """Bound Gaussians, one per triangle at first. They follow their triangles, so expression and pose move them."""

    config: GaussianAvatarsConfig

    def __init__(self, config: GaussianAvatarsConfig, face_model: FaceModel, face: FaceParams):
        surface = BoundSurface(
            lambda: self.store,
            lambda: (self.face_model.head_vertices(self.subject)[0], self.face_model.faces),
            limited=config.surface_limits,
            first_colors=config.first_colors == "pictures",
            bases=("feature_bases", *BASES),
            penalties=lambda changes: mean_squares(changes, (config.expression_weight, APPEARANCE_WEIGHT)),
        )
        extras = Extras(surface=surface, frames_per_step=config.frames_at, apart=True)
        super().__init__(config, face_model, face, extras)
        like, n = face_model.template, face_model.faces.shape[0]
        trained = {
            "means": like.new_zeros(n, 3),
            "quats": like.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            "log_scales": like.new_zeros(n, 3),
            "opacity_logits": torch.logit(like.new_full((n,), 0.1)),
            # Almost mid grey: like the paper's code, use small random colours as the SH coefficients themselves.
            "sh_constant": torch.rand(n, 1, 3).to(like) / 255,
        }
        if config.sh_degree > 0:
            trained["sh_rest"] = like.new_zeros(n, (config.sh_degree + 1) ** 2 - 1, 3)
        trained |= {name: like.new_zeros(n, *shape) for name, shape in self._basis_shapes().items()}
        self.appearance = None
        if config.appearance == "features":
            trained |= feature_tensors(trained["means"], self._activation_count, config.appearance_features)
            self.appearance = FeatureAppearance(like[:, 0], config.appearance_features)
        if self._changes:
            self.activations = ExpressionActivations(face_model, face, self.subject, self._activation_count)
        self.store = GaussianStore(trained, {"face_index": torch.arange(n, device=like.device)})

    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians in world space, or in the head frame (`_sh_frame`), with one batch entry per timestep."""
        sh, in_head = self._active_sh(progress), self._sh_frame == "head"
        if self._changes and len(face) > 0:
            return self._pose_with_changes(face, sh, in_head)
        return Posed(pose_bound_gaussians(self.face_model, face, self.store, sh, in_head), {})

    def _pose_with_changes(self, face: FaceParams, sh: Float[Tensor, "n k 3"], in_head: bool) -> Posed:
        """The same with the changes of the expression, which are also returned by name."""
        if len(face) > 1:
            each = [self._pose_with_changes(face[timestep], sh, in_head) for timestep in range(len(face))]
            aux = {name: torch.stack([posed.aux[name] for posed in each]) for name in each[0].aux}
            return Posed(stack_timesteps([posed.gaussians for posed in each]), aux)
        layers = None if self.appearance is None else self.appearance.layers()
        gradient = FactoredGradient() if self.appearance is None else self.appearance.gradient
        weights = (self.config.expression_weight, APPEARANCE_WEIGHT)
        changes = Changes(self.activations(face), tuple(self._basis_shapes()), layers, gradient, weights)
        return Posed(*pose_changed_gaussians(self.face_model, face, self.store, sh, in_head, changes))

    def _basis_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of a Gaussian's bases of changes with the expression, by name: those that the settings ask for."""
        rank, kinds = self.config.expression_rank, self.config.expression_changes
        wanted = [name for name in BASES if rank > 0 and name.removesuffix("_basis") in kinds]
        return {name: (rank,) if name == "opacity_basis" else (3, rank) for name in wanted}

    @property
    def _changes(self) -> bool:
        return bool(self._basis_shapes()) or self.config.appearance == "features"

    @property
    def _activation_count(self) -> int:
        config = self.config
        return config.appearance_directions if config.appearance == "features" else config.expression_rank

    @property
    def _opacity_changes(self) -> bool:
        return "opacity_basis" in self._basis_shapes() or self.config.appearance == "features"

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """Section 3.4: how far visible Gaussians exceed the thresholds of distance and scale, in triangle units.

        With `expression_rank` or features, also the mean squared changes with the expression, over all Gaussians.
        """
        config = self.config
        position, scale = triangle_penalties(
            self.store["means"],
            self.store["log_scales"],
            rendering.radii if rendering.radii.ndim == 1 else rendering.radii.amax(0),
            thresholds=(1.0, config.scale_threshold),
            weights=(config.position_weight, 1.0),
        )
        found = {name: posed.aux[name] for name in PENALTIES if name in posed.aux}
        changes = {name: own.mean() if own.ndim else own for name, own in found.items()}
        return {"position": position, "scale": scale, **changes}

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group per tensor."""
        config = self.config
        rates = {"means": config.means_rate, **_RATES}
        if config.sh_degree > 0:
            rates["sh_rest"] = _HIGHER_DEGREES_RATE
        rates |= {name: _BASIS_RATES[name] for name in self._basis_shapes()}
        extent = {"means": config.means_times_extent}
        groups = [
            store_group(self.store, name, rate, times_extent=extent.get(name, False)) for name, rate in rates.items()
        ]
        if self.appearance is not None:
            groups += self.appearance.parameter_groups(self.store)
        return [replace(group, times_root_frames=True) for group in groups]

    def density(self) -> GradientDensity:
        """Gradient-based control. Children stay on their parent's triangle; no triangle loses its last Gaussian."""
        return GradientDensity(
            self.config.density,
            opacity_logits="opacity_logits",
            judged_opacities=None if self._opacity_changes else resting_opacities,
            may_prune=never_empty_a_triangle,
        )

    def bake(self) -> MeshBound:
        """The mesh of this subject and the raw values of all Gaussians."""
        store = self.store.arrays()
        sh = as_array(self._active_sh(TRAINED))
        return MeshBound(
            rig=bake_rig(self.face_model, self.subject),
            faces=as_array(self.face_model.faces),
            face_index=store["face_index"],
            means=store["means"],
            attributes=Attributes(store["quats"], as_log_scales(store["log_scales"]), store["opacity_logits"], sh),
            sh_frame=self._sh_frame,
            changes=self._bake_changes(),
        )

    def _bake_changes(self) -> ExpressionChanges | None:
        if not self._changes:
            return None
        features = None if self.appearance is None else self.appearance.bake(self.store)
        means, color, opacity_logits = (
            as_array(self.store[name]) if name in self._basis_shapes() else None for name in BASES
        )
        rank = self.config.expression_rank
        return replace(
            self.activations.record(),
            color=color,
            opacity_logits=opacity_logits,
            means=means,
            features=features,
            basis_columns=rank if self._basis_shapes() and rank < self._activation_count else None,
        )

    @property
    def _sh_frame(self) -> Literal["world", "head"]:
        """The frame in which the Gaussians are given.

        Colours that do not depend on the view look the same in either frame. In the head frame, coordinates of a
        decimetre keep three more bits than coordinates of a metre from the camera. Triangles with edges of a millimetre
        need these bits: in world space, float32 turns them by 1e-4.
        """
        return "head" if self.config.sh_degree == 0 else self.config.sh_frame

    def _active_sh(self, progress: Progress) -> Float[Tensor, "n k 3"]:
        degree = self.config.sh_degree
        if degree == 0:
            return self.store["sh_constant"]
        active = active_degree(degree, self.config.sh_warmup, progress)
        rest = self.store["sh_rest"][:, : (active + 1) ** 2 - 1]
        return torch.cat([self.store["sh_constant"], rest], dim=1)


def resting_opacities(store: GaussianStore, seen: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The opacities by which Gaussians are pruned if they do not depend on the face."""
    return store["opacity_logits"].detach().sigmoid()


def never_empty_a_triangle(store: GaussianStore, prune: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Allow no prunes on a triangle that would otherwise lose all its Gaussians (section 3.3)."""
    face_index = store["face_index"]
    # Triangles get the numbers of their order, which are below that of Gaussians: nothing is read from a GPU.
    ordered, order = face_index.sort()
    numbers = (ordered != ordered.roll(1)).cumsum(0).sub_(1).clamp_min_(0)
    own = torch.empty_like(order).scatter_(0, order, numbers)
    kept = torch.zeros_like(own).index_add_(0, own, (~prune).to(own.dtype))
    return prune & (kept[own] > 0)
