"""What all browsers of a viewer share: the face, the motion that plays, and what is drawn.

Methods may be called from any thread.
"""

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Float32, UInt8

from mien import runtime
from mien.errors import UserError
from mien.runtime.filmed import within_filmed_inputs
from mien.runtime.posing import Face
from mien.viewer import drawing
from mien.viewer.faces import random_expression

if TYPE_CHECKING:
    from mien.formats.shared.packed import Motion

DEFAULT_HEIGHT = 512
"""Largest height of a picture in pixels, at first."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A motion that the avatar can play."""

    motion: "Motion"
    pictures: Callable[[int], UInt8[np.ndarray, "_ _ 3"]] | None = None
    """Returns the filmed frame at a timestep. None if there are none."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What a camera saw, from which the face that is shown was made."""

    picture: UInt8[np.ndarray, "_ _ 3"]
    seconds: float
    """Time of the camera's clock at which the frame came."""


class Session:
    """An avatar with its face, its motion, and what is drawn of it."""

    def __init__(
        self, avatar: runtime.Avatar, mesh: drawing.Mesh | None = None,
        clips: Mapping[str, Callable[[], Clip]] | None = None,
    ) -> None:  # fmt: skip
        """Show an avatar at rest. Each of the motions, which have names, is loaded at its first use."""
        self.avatar, self.mesh = avatar, mesh
        self._makers, self._clips = dict(clips or {}), dict[str, Clip]()
        self._lock, self._drawing = threading.RLock(), threading.Lock()
        self.face = avatar.face()
        self._posed: tuple[Face, runtime.Gaussians] | None = None
        self.clip_names = list(self._makers)
        """Names of the motions that can be chosen."""
        self.clip: Clip | None = None
        """The chosen motion."""
        self.chosen: str | None = None
        """Its name."""
        self.preset: str | None = None
        """The preset face that is shown, alone or with a motion. None after any other change of the face."""
        self.timestep = 0
        """The timestep of the motion that is shown."""
        self._playing_since: float | None = None
        """Time at which timestep 0 was due, or None if nothing plays."""
        self._seen: Seen | None = None
        self._drawn: Seen | None = None
        self._last_seen: Seen | None = None
        self.look, self.height, self.side_by_side = drawing.Look(), DEFAULT_HEIGHT, False
        self.with_camera = True
        """Whether pictures show in a corner what the camera saw."""
        self.changed: Callable[[], None] = lambda: None
        """Is called after each change."""

    @property
    def playing(self) -> bool:
        """Whether the motion plays."""
        return self._playing_since is not None

    def replace_avatar(self, avatar: runtime.Avatar) -> None:
        """Show another state of the same person's avatar. The face stays."""
        with self._lock:
            self.avatar, self._posed = avatar, None
            self.changed()

    def set_expression(self, name: str, value: float) -> None:
        """Set one expression, within the bounds of the face model. What plays is paused."""
        _check_finite(name, value)
        index = self.avatar.expression_names.index(name)
        low, high = self.avatar.portable.expression_bounds[index]
        with self._lock:
            expression = self.face.expression.copy()
            expression[index] = np.clip(value, low, high)
            self._take(replace(self.face, expression=expression))

    def set_joint(self, name: str, axis: int, angle: float) -> None:
        """Set one component of a joint's axis-angle vector, in radians. What plays is paused."""
        _check_finite(name, angle)
        with self._lock:
            joints = self.face.joints.copy()
            joints[self.avatar.joint_names.index(name), axis] = np.clip(angle, -math.pi, math.pi)
            self._take(replace(self.face, joints=joints))

    def rest(self) -> None:
        """Show the person at rest."""
        self._take(self.avatar.face())

    def take_preset(self, preset: str | None) -> None:
        """Show a preset face that the avatar has (`mien.runtime.presets_for`), or none.

        A motion that is chosen keeps it, and goes on if it plays.
        """
        with self._lock:
            self.preset = preset
            self.face = self._face_at(self.timestep)
            self.changed()

    def take_random(self, random: np.random.Generator) -> None:
        """Show a random face, softly within what was filmed if that is known."""
        portable = self.avatar.portable
        rest, bounds = portable.neutral.expression, portable.expression_bounds
        expression = random_expression(portable.expression_names, rest, bounds, random)
        if portable.filmed is not None:
            joints = portable.neutral.joints.reshape(-1)
            inputs, start = np.concatenate([expression, joints])[None], np.concatenate([rest, joints])
            expression = within_filmed_inputs(portable.filmed, inputs, start, bounds, portable.expression_names)[
                0, : len(rest)
            ]
        self._take(self.avatar.face(expression))

    def choose(self, name: str | None) -> None:
        """Choose a motion and show its first timestep, or no motion and the person at rest."""
        clip = None
        if name is not None:
            # Loading takes seconds, so nothing waits for it.
            clip = self._clips[name] if name in self._clips else self._makers[name]()
            self._clips[name] = clip
        with self._lock:
            self.clip, self.chosen, self._playing_since = clip, name, None
            self.timestep = 0
            self.take_preset(self.preset)

    def seek(self, timestep: int) -> None:
        """Show a timestep of the motion, and pause."""
        with self._lock:
            if self.clip is not None:
                self.timestep = min(max(int(timestep), 0), len(self.clip.motion) - 1)
                self._playing_since = None
                self.take_preset(self.preset)

    def play(self, playing: bool, now: float) -> None:
        """Play the motion from the timestep that is shown, again and again, or pause it."""
        with self._lock:
            if self.clip is None or not playing:
                self._playing_since = None
            else:
                self.face = self._face_at(self.timestep)
                self._playing_since = now - self.timestep / self.clip.motion.fps
            self.changed()

    def advance(self, now: float) -> float | None:
        """Go on to the timestep of this moment. Return the time at which the next one is due, or None if none plays."""
        with self._lock:
            if self.clip is None or self._playing_since is None:
                return None
            motion = self.clip.motion
            # Half a microsecond keeps a moment that is due from being rounded to the one before it.
            steps = int((now - self._playing_since) * motion.fps + 5e-7 * motion.fps)
            timestep = steps % len(motion)
            if timestep != self.timestep:
                self.timestep, self.face = timestep, self._face_at(timestep)
                self.changed()
            return self._playing_since + (steps + 1) / motion.fps

    def follow(self, face: Face, seen: Seen) -> None:
        """Show the face that a camera saw. A motion that plays is paused."""
        with self._lock:
            self._seen = seen
            self._take(face)

    def stop_following(self) -> None:
        """Show no longer what a camera saw, and the person at rest."""
        with self._lock:
            self._seen = None
            self.rest()

    def taken(self) -> Seen | None:
        """What the camera saw for the last picture of a view. It is returned once for each frame."""
        drawn, self._drawn = self._drawn, None
        return drawn

    def show(self, **changes: Any) -> None:
        """Change `look` (fields of `Look`), `height`, `side_by_side` or `with_camera`."""
        _check_look(changes)
        with self._lock:
            self.height = int(changes.pop("height", self.height))
            self.side_by_side = bool(changes.pop("side_by_side", self.side_by_side))
            self.with_camera = bool(changes.pop("with_camera", self.with_camera))
            self.look = replace(self.look, **changes)
            self.changed()

    def picture(
        self, view: drawing.View, full: bool = True, height: int | None = None, timestep: int | None = None
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of a view, of full size or half of it.

        `height` is the largest height of a full picture in pixels (default: that of the session), and `timestep` one of
        the motion (default: the face that is shown).
        """
        with self._lock:
            face, look, clip, seen = self.face, self.look, self.clip, self._seen
            most, side_by_side = height or self.height, self.side_by_side
            if timestep is None:
                timestep = self.timestep
            else:
                assert clip is not None, "there is no motion"
                face = self._face_at(timestep)
        wide, high = view.sized(most)
        if not full:
            wide, high = max(1, wide // 2), max(1, high // 2)
        filmed = clip.pictures if clip is not None and side_by_side else None
        with self._drawing:
            frame = None if filmed is None else filmed(timestep)
            if frame is None:
                source = self.avatar.camera.width, self.avatar.camera.height
            else:
                source, wide = (frame.shape[1], frame.shape[0]), max(1, wide // 2)
            camera = view.camera(wide, high, drawing.shrunk(*source, wide, high))
            shown = drawing.draw(self._gaussians(face), face, self.mesh, look, camera)
            picture = shown if frame is None else drawing.beside(frame, shown, look.background)
            if seen is not self._last_seen:
                self._drawn = self._last_seen = seen
            return drawing.in_corner(seen.picture, picture) if seen is not None and self.with_camera else picture

    def words(self, view: drawing.View) -> str:
        """One line about whether a view shows a side that was filmed."""
        return drawing.words_about_view(self.avatar.portable.filmed, self.face, view)

    def _gaussians(self, face: Face) -> runtime.Gaussians:
        """The Gaussians of a face. The last ones are kept, because several views show the same face."""
        if self._posed is None or self._posed[0] is not face:
            self._posed = (face, runtime.pose(self.avatar.portable.baked, face))
        return self._posed[1]

    def _take(self, face: Face) -> None:
        with self._lock:
            self._playing_since, self.preset, self.face = None, None, face
            self.changed()

    def _face_at(self, timestep: int) -> Face:
        """The face of the motion at a timestep, or the person at rest, with the preset face added."""
        avatar, face = self.avatar, self.avatar.face() if self.clip is None else self.clip.motion.face(timestep)
        if self.preset is None:
            return face
        rest, posed = avatar.face(), avatar.face({self.preset: 1.0})
        if self.clip is None:
            return posed
        low, high = avatar.portable.expression_bounds.T
        expression = np.clip(face.expression + posed.expression - rest.expression, low, high)
        return replace(face, expression=expression, joints=face.joints + posed.joints - rest.joints)


def _check_finite(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise UserError(f"{name} {value}: is not finite; give a number")


def _check_look(changes: Mapping[str, Any]) -> None:
    for name, known in (("surface", get_args(drawing.Surface)), ("background", tuple(drawing.BACKGROUNDS))):
        if name in changes and changes[name] not in known:
            raise UserError(f"{name} {changes[name]!r}: there is none; give one of {', '.join(known)}")
    if not 1 <= changes.get("height", DEFAULT_HEIGHT) <= drawing.MAX_SIDE:
        raise UserError(f"height {changes['height']}: give 1 to {drawing.MAX_SIDE} pixels")


def center_of(avatar: runtime.Avatar) -> Float32[np.ndarray, " 3"]:
    """The middle of the avatar at rest in world space, in metres: of the box that holds nearly all of its Gaussians."""
    posed = avatar.pose()
    middle = np.quantile(posed.means, (0.02, 0.98), axis=0).mean(0)
    if posed.T_world_local is not None:
        middle = posed.T_world_local[:3, :3] @ middle + posed.T_world_local[:3, 3]
    return middle.astype(np.float32)
