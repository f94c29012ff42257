"""The end of `mien create`: a page and a film of the avatar, and the next commands."""

import shlex
import shutil
from dataclasses import replace

from mien.avatar.files import load_avatar
from mien.disk.files import write_atomically
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.evaluation.living import FILM, living, write_film
from mien.formats.format import MotionOptions
from mien.formats.page import write_page
from mien.machine.progress import say
from mien.pages.pages import LIVING_PAGE
from mien.pipeline.export_run import RunContent
from mien.training.footage.filmed import read_coverage
from mien.training.run import read_run_config, run_camera

_SECONDS = 8.0
"""Length of the filmed motion that the page plays, in seconds."""


def show_film(workspace: Workspace, run: str) -> None:
    """Write DIR/me.mp4 of a run."""
    root, run_dir = workspace.root, workspace.run_dir(run)
    try:
        film = run_dir / FILM
        if not film.is_file():
            avatar = load_avatar(run_dir)
            coverage = read_coverage(run_dir, avatar.face_model)
            alive = living(avatar, run_camera(run_dir), root.resolve().name, coverage)
            if alive is not None:
                write_film(film, alive)
        if film.is_file():
            write_atomically(root / "me.mp4", lambda aside: shutil.copyfile(film, aside))
            say(f"{root / 'me.mp4'}: five seconds of the avatar")
    except UserError as error:
        say(f"no film: {error}")


def show_page(workspace: Workspace, run: str) -> None:
    """Write DIR/me.html of a run. The report links it, so it comes first.

    An avatar that may not be passed on, or that pages cannot draw, gets no page, with a message.
    """
    root, run_dir = workspace.root, workspace.run_dir(run)
    try:
        content = RunContent(workspace, run, MotionOptions(read_run_config(run_dir)["data"][0]["sequence"]))
        motion = content.motion()
        if motion is not None:
            count, names = max(1, round(_SECONDS * motion.fps)), ("expression", "joints", "head_rotation")
            first = {name: getattr(motion, name)[:count] for name in (*names, "head_translation")}
            motion = replace(motion, **first)
        page = write_page(root / LIVING_PAGE, content.portable(confidence=False, soft_cut=True), motion)
        say(f"{root / LIVING_PAGE}: the living avatar, {page.size / 1e6:.1f} MB; open it in a browser, or send it")
    except UserError as error:
        say(f"no page: {error}")


def name_next_commands(workspace: Workspace, run: str) -> None:
    """Name what can be done with the avatar of a run."""
    root, which = workspace.root, ["--run", run] if len(workspace.run_names()) > 1 else []
    for command, does in (
        (["view", str(root), *which], "turn it, and move its face"),
        (["drive", str(root), *which, "--by", "camera"], "your own face drives it"),
        (["export", str(root), *which, "--webcam", "--out", "be_me.html"], "a page that the viewer's face drives"),
        (["export", str(root), *which, "--out", "me.glb"], "for Blender and engines"),
    ):
        say(f"Next: {shlex.join(['mien', *command])}   # {does}")
