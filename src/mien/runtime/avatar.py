"""`load`, `Avatar` and `render`: the whole public interface of the runtime."""

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mien import _native
from mien.machine.threads import asked_threads
from mien.runtime.baked import Camera, PortableAvatar
from mien.runtime.file import read_portable
from mien.runtime.filmed import with_filmed_blinks
from mien.runtime.named import Part, is_gaze, parts_of, presets_for, turned_eyes
from mien.runtime.posing import Face, Gaussians, pose
from mien.runtime.rotation import compose_rigid
from mien.runtime.torso import TORSO, on_still_torso

Vector = Sequence[float | int] | np.ndarray
"""Three numbers."""


class Avatar:
    """An avatar that needs only numpy and the native core."""

    def __init__(self, portable: PortableAvatar):
        self.portable = portable
        """The whole content of the file, as plain arrays."""

    @property
    def expression_names(self) -> tuple[str, ...]:
        """Names of the expressions for `pose`, in the order of expression vectors."""
        return self.portable.expression_names

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints that `pose` can turn. A jaw may follow an expression instead."""
        return self.portable.joint_names

    @property
    def camera(self) -> Camera:
        """The view that the avatar was trained with."""
        return self.portable.camera

    def face(
        self,
        expression: Mapping[str, float | int] | np.ndarray | None = None,
        joints: Mapping[str, Vector] | np.ndarray | None = None,
        head_rotation: Vector | None = None,
        head_translation: Vector | None = None,
    ) -> Face:
        """Face parameters of the person at rest, with the given ones replaced (see `pose`)."""
        rest, looking = self.portable.neutral, self.portable.neutral.joints
        if isinstance(expression, Mapping):
            expression, look = self._coefficients(expression)
            looking = turned_eyes(looking, self.joint_names, look)
        face = Face(
            _with_named(rest.expression, expression, self.expression_names, "expression"),
            _with_named(looking, joints, self.joint_names, "joint"),
            _vector(rest.head_rotation, head_rotation, "head_rotation"),
            _vector(rest.head_translation, head_translation, "head_translation"),
        )
        whole = isinstance(joints, np.ndarray) or (joints is not None and TORSO in joints)
        return face if whole else on_still_torso(self.portable, face)

    def pose(
        self,
        expression: Mapping[str, float | int] | np.ndarray | None = None,
        joints: Mapping[str, Vector] | np.ndarray | None = None,
        head_rotation: Vector | None = None,
        head_translation: Vector | None = None,
    ) -> Gaussians:
        """The Gaussians of a face. Parameters that are not given are those of the person at rest.

        Args:
            expression: Coefficients by name (others stay at rest), or all of them in the order of `expression_names`.
                ARKit's names of gaze, such as eyeLookUpLeft, turn the eyes by up to 30 degrees from where they look at
                rest. Names of preset faces, such as smile, stand for several expressions, within their bounds. A torso,
                if the avatar has one, stands still while the head moves, unless `joints` has it.
            joints: Axis-angle vectors in radians by name, or all of them [j, 3] in the order of `joint_names`.
            head_rotation: Axis-angle vector of the head in world space, in radians.
            head_translation: Position of the head's origin in world space, in metres.

        Raises:
            ValueError: a name is unknown, a shape is wrong, or a number is not finite.
        """
        return pose(self.portable.baked, self.face(expression, joints, head_rotation, head_translation))

    def _coefficients(self, named: Mapping[str, float | int]) -> tuple[dict[str, float], dict[str, float]]:
        """Coefficients of expressions, and those of the gaze, that names of expressions, gaze and presets stand for."""
        names, rest = list(self.expression_names), self.portable.neutral
        bounds = with_filmed_blinks(self.portable.expression_bounds, names, self.portable.filmed)
        shown = presets_for(names, self.joint_names)
        values: dict[str, float] = {}
        look: dict[str, float] = {}
        for name, value in named.items():
            for part in parts_of(name, float(value)) if name in shown else [Part(name, float(value), False)]:
                if is_gaze(part.name, self.joint_names):
                    look[part.name] = part.value
                elif part.is_added:
                    at = names.index(part.name)
                    values[part.name] = float(np.clip(rest.expression[at] + part.value, *bounds[at]))
                else:
                    values[part.name] = part.value
        return values, look

    def render(
        self,
        gaussians: Gaussians | None = None,
        camera: Camera | None = None,
        background: Vector = (1.0, 1.0, 1.0),
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """A picture and its alpha, as from `render`. Defaults: the face at rest, and the camera of the training."""
        gaussians = self.pose() if gaussians is None else gaussians
        return render(gaussians, self.camera if camera is None else camera, background)


def load(path: Path | str) -> Avatar:
    """Load the avatar in a .mien file, as `mien export DIR --out NAME.mien` writes it.

    Example:
        >>> from mien import runtime
        >>> avatar = runtime.load("me.mien")
        >>> gaussians = avatar.pose({"jawOpen": 0.6}, head_rotation=(0, 0.3, 0))
        >>> image, alpha = avatar.render(gaussians, avatar.camera.resized(512, 512))

    Raises:
        UserError: the file is missing, damaged, or of another version, or MIEN_THREADS is not a number of threads.
    """
    asked_threads()
    return Avatar(read_portable(Path(path)))


def render(
    gaussians: Gaussians, camera: Camera, background: Vector = (1.0, 1.0, 1.0)
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """The picture of Gaussians over a background (RGB, 0..1, higher for bright colours), and its alpha (0..1).

    The picture is premultiplied: image = colours times alpha + (1 - alpha) times background. Over black, dividing it by
    alpha gives straight colours. Bright colours may exceed 1 a little, so clip them before they become 8 bits. The
    kernel and its constants are those of `mien.render.rasterize`.

    Raises:
        ValueError: an input holds NaN or infinity.
    """
    image = np.empty((camera.height, camera.width, 3), np.float32)
    alpha = np.empty((camera.height, camera.width), np.float32)
    radii = np.empty(len(gaussians), np.int32)
    pose = gaussians.T_world_local
    viewmat = camera.viewmat if pose is None else compose_rigid(camera.viewmat, pose)
    # The core takes arrays as they lie in memory; the caller's may be transposed, or of another type.
    means, quats, scales, opacities, sh, color, view, K = (
        np.ascontiguousarray(array, np.float32)
        for array in (
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, background, viewmat,
            camera.K,
        )
    )  # fmt: skip
    arrays = _native.GaussianArrays(means, quats, scales, opacities, sh)
    task = _native.RasterizeView(arrays, color, view, K, image, alpha, radii)
    if _native.rasterize_views([task], differentiable=False) == [None]:
        raise ValueError("render: the Gaussians, the camera or the background hold NaN or infinity")
    return image, alpha


def _with_named(
    rest: np.ndarray,
    given: Mapping[str, float | int] | Mapping[str, Vector] | np.ndarray | None,
    names: Sequence[str],
    of: str,
) -> np.ndarray:
    """`rest` with the given rows replaced, by name or all of them."""
    if given is None:
        return rest
    if isinstance(given, Mapping):
        values = rest.copy()
        for name, value in given.items():
            if name not in names:
                near = difflib.get_close_matches(name, names, 3, 0.5)
                meant = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(names)}"
                raise ValueError(f"no {of} {name!r}; {meant}")
            values[list(names).index(name)] = value
    else:
        values = np.asarray(given, np.float32)
        if values.shape != rest.shape:
            raise ValueError(f"{of}s have the shape {values.shape}, expected {rest.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{of}s are not finite: {given}")
    return values


def _vector(rest: np.ndarray, given: Vector | None, name: str) -> np.ndarray:
    if given is None:
        return rest
    values = np.asarray(given, np.float32)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"{name} {given}: give three finite numbers")
    return values
