"""The controls beside the picture, in viser's words. All browsers share them."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import viser

from mien import runtime
from mien.errors import UserError
from mien.machine.terminal import printable
from mien.viewer.camera import CameraSwitch
from mien.viewer.drawing import BACKGROUNDS, Surface, View
from mien.viewer.faces import grouped, matches, readable
from mien.viewer.files import Stopped, screenshot, video
from mien.viewer.loop import Worker
from mien.viewer.session import Session, center_of

MAX_ANGLE = 0.5
"""Largest angle of a joint's slider, in radians."""
_STEP = 0.01
_NOTHING, _LOADING = "none", "Loading ..."


class Panel:
    """The controls of one session."""

    def __init__(
        self, server: viser.ViserServer, session: Session, title: str, view_of: Callable[..., View],
        failed: Callable[[Exception], None], camera: CameraSwitch | None = None,
    ) -> None:  # fmt: skip
        """Add the controls to a server.

        `title` names the avatar, for people and for the files that are saved; `view_of` returns the view of a client's
        camera; `failed` takes an exception of slow work.
        """
        self._server, self._session, self._view_of = server, session, view_of
        self._title = printable(Path(title).name) or "avatar"
        self.sliders: dict[str, viser.GuiSliderHandle[float]] = {}
        self._time: viser.GuiSliderHandle[int] | None = None
        self._report: viser.GuiMarkdownHandle | None = None
        self._followed_at, self._stopping = 0.0, False
        self.play_button: viser.GuiButtonHandle | None = None
        self._play_asked = self._loading = False
        """Whether Play was pressed before a motion was there, and whether one is being loaded."""
        self.preset: viser.GuiDropdownHandle[str] | None = None
        self._stills = Worker("mien-stills", failed, most=8)
        self._videos = Worker("mien-videos", failed, most=0)
        self._motions, self._switching = Worker("mien-motions", failed), Worker("mien-camera", failed)
        about = session.avatar.portable.about
        count = len(session.avatar.portable.baked.attributes.opacity_logits)
        server.gui.add_markdown(f"**{_plain(self._title)}**: {count:,} Gaussians, {_plain(about.method)}")
        self._camera = camera
        if camera is not None:
            self._add_camera(camera)
        if session.clip_names:
            self._add_motion()
        self._add_faces()
        self._add_expressions()
        self._add_joints()
        self._add_picture()
        self._add_files()

    def stop(self) -> None:
        """Stop a video that is being written, and drop the work that waits."""
        self._stopping = True
        for worker in (self._stills, self._videos, self._motions, self._switching):
            worker.stop()

    def follow(self) -> None:
        """Move the sliders to the face that is shown, now and then while a motion plays or a camera is followed."""
        now = time.monotonic()
        moves = self._session.playing or (self._camera is not None and self._camera.is_on)
        if moves and now - self._followed_at < 0.25:
            return
        self._followed_at = now
        self._name_play()
        if self._report is not None and self._camera is not None:
            self._report.content = "  \n".join(map(_plain, self._camera.report()))
        if self._time is not None:
            self._time.value = self._session.timestep

    def move_sliders(self) -> None:
        """Move all sliders to the face that is shown."""
        avatar, face = self._session.avatar, self._session.face
        values = dict(zip(avatar.expression_names, face.expression.tolist(), strict=True))
        for name, angles in zip(avatar.joint_names, face.joints.tolist(), strict=True):
            values |= {f"{name}_{'xyz'[axis]}": angle for axis, angle in enumerate(angles)}
        for name, slider in self.sliders.items():
            slider.value = _rounded(values[name], slider.min, slider.max)
        if self._time is not None:
            self._time.value = self._session.timestep
        self._name_play()
        self._name_preset()

    def _name_play(self) -> None:
        """Let the button say what it does: play or pause, or that it waits."""
        label = _LOADING if self._loading else "Pause" if self._session.playing else "Play"
        if self.play_button is not None and self.play_button.label != label:
            self.play_button.label, self.play_button.disabled = label, self._loading

    def _name_preset(self) -> None:
        shown = _NOTHING if self._session.preset is None else readable(self._session.preset)
        if self.preset is not None and self.preset.value != shown:
            self.preset.value = shown

    def _add_camera(self, camera: CameraSwitch) -> None:
        gui, session = self._server.gui, self._session
        with gui.add_folder("Camera"):
            follow = gui.add_checkbox("Follow camera", camera.is_on)
            learn = gui.add_button("This is my face at rest", hint="Look ahead for a second, with a relaxed face")
            inset = gui.add_checkbox("Camera picture in the corner", session.with_camera)
            self._report = gui.add_markdown("")

        def switch(client: viser.ClientHandle | None) -> None:
            try:
                if follow.value:
                    camera.start()
                else:
                    camera.stop()
            except UserError as error:
                self._complain(client, str(error))
                follow.value = False
            self.move_sliders()

        @follow.on_update
        async def _(event: Any) -> None:
            self._switching.ask("camera", lambda: switch(event.client))

        @learn.on_click
        async def _(event: Any) -> None:
            camera.learn_rest()

        self._show_on_update(inset, "with_camera")

    def _add_motion(self) -> None:
        gui, session = self._server.gui, self._session
        with gui.add_folder("Motion"):
            first, clip = session.chosen or _NOTHING, session.clip
            chosen = gui.add_dropdown("Motion", (_NOTHING, *session.clip_names), initial_value=first)
            play = gui.add_button("Pause" if session.playing else "Play")
            last = 1 if clip is None else max(1, len(clip.motion) - 1)
            timeline = self._time = gui.add_slider("Frame", 0, last, 1, 0)
            filmed = gui.add_checkbox("Filmed frame beside it", False)
        self.play_button = play

        def choose(name: str, client: viser.ClientHandle | None) -> None:
            try:
                if name != (session.chosen or _NOTHING):
                    session.choose(None if name == _NOTHING else name)
                if self._play_asked and session.clip is not None:
                    session.play(True, time.monotonic())
                timeline.max = max(1, len(session.clip.motion) - 1) if session.clip else 1
            except (UserError, ImportError) as error:
                if chosen.value == name:
                    chosen.value = session.chosen or _NOTHING
                if isinstance(error, ImportError):
                    raise
                self._complain(client, str(error))
            finally:
                self._play_asked = self._loading = False
                self.move_sliders()

        def load(client: viser.ClientHandle | None) -> None:
            name = chosen.value
            self._loading = name not in (_NOTHING, session.chosen)
            self._name_play()
            self._motions.ask("motion", lambda: choose(name, client))

        @chosen.on_update
        async def _(event: Any) -> None:
            load(event.client)

        @play.on_click
        async def _(event: Any) -> None:
            if session.clip is None:
                # It plays once it is loaded: the motion that was chosen just now, or else the first one.
                self._play_asked = True
                if chosen.value == _NOTHING:
                    chosen.value = session.clip_names[0]
                load(event.client)
                return
            session.play(not session.playing, time.monotonic())
            self.move_sliders()

        @timeline.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                session.seek(timeline.value)

        self._show_on_update(filmed, "side_by_side")

    def _add_faces(self) -> None:
        gui, session = self._server.gui, self._session
        random = np.random.default_rng()
        with gui.add_folder("Face"):
            rest = gui.add_button("At rest")
            anyone = gui.add_button("Random face")
            avatar = session.avatar
            names = {readable(name): name for name in runtime.presets_for(avatar.expression_names, avatar.joint_names)}
            preset = gui.add_dropdown("Preset", (_NOTHING, *names), initial_value=_NOTHING) if names else None
        self.preset = preset

        @rest.on_click
        async def _(event: Any) -> None:
            session.rest()
            self.move_sliders()

        @anyone.on_click
        async def _(event: Any) -> None:
            session.take_random(random)
            self.move_sliders()

        if preset is not None:

            @preset.on_update
            async def _(event: Any) -> None:
                if event.client is not None:
                    session.take_preset(names.get(preset.value))
                    self.move_sliders()

    def _add_expressions(self) -> None:
        gui, session = self._server.gui, self._session
        portable = session.avatar.portable
        bounds = dict(zip(portable.expression_names, portable.expression_bounds, strict=True))
        rest = dict(zip(portable.expression_names, portable.neutral.expression.tolist(), strict=True))
        groups, folders = grouped(portable.expression_names, portable.expression_bounds), {}
        with gui.add_folder("Expressions"):
            search = gui.add_text("Search", "", hint="Part of a name, such as: smile left")
            for title, names in groups.items():
                folders[title] = gui.add_folder(title, expand_by_default=not folders)
                with folders[title]:
                    for name in names:
                        low, high = (float(bound) for bound in bounds[name])
                        self._add_slider(
                            name, readable(name), low, high, rest[name], partial(session.set_expression, name)
                        )

        @search.on_update
        async def _(event: Any) -> None:
            for title, names in groups.items():
                found = [matches(search.value, name) for name in names]
                for name, visible in zip(names, found, strict=True):
                    self.sliders[name].visible = visible
                folders[title].visible = any(found)

    def _add_joints(self) -> None:
        gui, avatar = self._server.gui, self._session.avatar
        if not avatar.joint_names:
            return
        with gui.add_folder("Joints", expand_by_default=False):
            for name, angles in zip(avatar.joint_names, avatar.portable.neutral.joints.tolist(), strict=True):
                for axis, angle in enumerate(angles):
                    label = f"{readable(name)} {('nod', 'turn', 'tilt')[axis]}"
                    turn = partial(self._session.set_joint, name, axis)
                    self._add_slider(f"{name}_{'xyz'[axis]}", label, -MAX_ANGLE, MAX_ANGLE, angle, turn)

    def _add_slider(
        self, name: str, label: str, low: float, high: float, value: float, take: Callable[[float], None]
    ) -> None:
        slider = self._server.gui.add_slider(label, low, high, _STEP, _rounded(value, low, high))
        self.sliders[name] = slider

        # These run in the order of the events. Functions in viser's threads could overtake each other.
        @slider.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                take(slider.value)
                self._name_play()
                self._name_preset()

    def _add_picture(self) -> None:
        gui, session = self._server.gui, self._session
        surfaces = list(get_args(Surface)) if session.mesh is not None else ["avatar"]
        if session.mesh is None or session.mesh.seen is None:
            surfaces = [name for name in surfaces if name != "confidence"]
        with gui.add_folder("Picture"):
            surface = gui.add_dropdown("Show", tuple(surfaces)) if len(surfaces) > 1 else None
            wireframe = gui.add_checkbox("Wireframe", False) if session.mesh is not None else None
            background = gui.add_dropdown("Background", tuple(BACKGROUNDS))
            height = gui.add_slider("Height in pixels", 128, 1080, 8, session.height)
            filmed = gui.add_button("Camera as filmed")
        for handle, name in ((surface, "surface"), (wireframe, "wireframe"), (background, "background")):
            if handle is not None:
                self._show_on_update(handle, name)
        self._show_on_update(height, "height")

        @filmed.on_click
        async def _(event: Any) -> None:
            if event.client is not None:
                position, target, up = filmed_from(session)
                with event.client.atomic():
                    event.client.camera.up_direction = up
                    event.client.camera.position = position
                    event.client.camera.look_at = target

    def _show_on_update(self, handle: Any, name: str) -> None:
        @handle.on_update
        async def _(event: Any) -> None:
            self._session.show(**{name: handle.value})

    def _add_files(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Save", expand_by_default=False):
            still = gui.add_button("Screenshot")
            moving = gui.add_button("Video", hint="The whole motion from here; without a motion, once around the head")

        @still.on_click
        async def _(event: Any) -> None:
            client = event.client
            if client is not None and not self._stills.ask(client.client_id, lambda: self._photograph(client)):
                self._complain(client, "Other pictures are being drawn; try again in a moment.")

        @moving.on_click
        async def _(event: Any) -> None:
            client = event.client
            if client is not None and not self._videos.ask(client.client_id, lambda: self._record(client)):
                self._complain(client, "A video is being written; wait for it.")

    def _photograph(self, client: viser.ClientHandle) -> None:
        content = screenshot(self._session, self._view_of(client.camera))
        client.send_file_download(f"{self._title}.png", content, save_immediately=True)

    def _record(self, client: viser.ClientHandle) -> None:
        def go_on() -> bool:
            return not self._stopping and client.client_id in self._server.get_clients()

        note = client.add_notification("Video", "It is being written ...", loading=True, with_close_button=False)
        try:
            content = video(self._session, self._view_of(client.camera), center_of(self._session.avatar), go_on)
            client.send_file_download(f"{self._title}.mp4", content, save_immediately=True)
        except Stopped:
            pass
        except UserError as error:
            self._complain(client, str(error))
        finally:
            note.remove()

    def _complain(self, client: viser.ClientHandle | None, message: str) -> None:
        if client is not None:
            client.add_notification("mien", printable(message), color="red")


def filmed_from(session: Session) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position of the camera that the avatar was trained with, the point that it looks at, and its upward direction.

    The point is the one on the camera's axis that is nearest to the middle of the head. All are in world space.
    """
    viewmat = session.avatar.camera.viewmat.astype(np.float64)
    position = -viewmat[:3, :3].T @ viewmat[:3, 3]
    ahead, up = viewmat[2, :3], -viewmat[1, :3]
    distance = max(float((center_of(session.avatar) - position) @ ahead), 0.05)
    return position, position + distance * ahead, up


def _rounded(value: float, low: float, high: float) -> float:
    return min(max(round(value / _STEP) * _STEP, low), high)


def _plain(text: str) -> str:
    """A text without characters that Markdown or HTML would read."""
    return "".join(character if character.isalnum() or character in " -._" else " " for character in printable(text))
