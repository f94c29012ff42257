"""The command line: picks the sub-command, loads only what it needs, and turns errors into one line."""

import contextlib
import difflib
import errno
import importlib
import io
import os
import shlex
import sys
import tempfile
import traceback
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import mien
from mien.disk.reading import MAX_SIDE
from mien.errors import UserError
from mien.machine.stops import EXIT_INTERRUPTED, Terminated, orderly_stops
from mien.machine.terminal import drop_output, open_closed_streams, show, tell
from mien.machine.threads import asked_threads, use_one_torch_thread
from mien.plugins import missing_package

GROUPS = {
    "Make an avatar": {
        "demo": "the whole path on a synthetic head, in minutes: start here",
        "studio": "film yourself in a browser, watch the avatar grow, take it away",
        "create": "video -> avatar, page, film and report: all stages in one command",
        "capture": "a video (or a folder of pictures) -> frames, mattes, landmarks",
        "track": "capture -> face parameters, cameras, overlay video",
        "align": "trackings -> sharper ones: every frame fitted to a quick avatar",
        "train": "captures + trackings -> an avatar, by the method of your choice",
        "import": "files of other programs (GaussianAvatars' folder) -> an avatar, or sequences to train on",
        "batch": "a table of captures -> an avatar each, here, on Slurm or on Ray",
    },
    "Use it": {
        "view": "avatar -> a viewer in the browser: turn it, move its face, play a motion",
        "render": "avatar -> a still or a video along a camera path, at any expression",
        "drive": "avatar + the motion of a video, a sequence, a phone or MediaPipe -> video",
        "export": "avatar -> .mien (runs without torch), .html, .glb, Gaussians in a pose, or GaussianAvatars' folder",
        "export-dataset": "capture -> the layout of another laboratory, or the videos of the NeRSemble benchmark",
    },
    "Research": {
        "evaluate": "avatar -> metrics.json and report.html on held-out frames",
        "analyze": "avatar -> the figures of its method's paper, measured: growth, speed, ablations",
        "study": "runs -> a page on which people compare them blind; answers -> percentages",
        "bench": "speed of this machine; quality on reference captures with known truth",
        "face-models": "list the face models and bake them ahead of time",
        "licenses": "what is installed, under which terms, and what that means",
        "plugins": "what other packages add: methods, formats and datasets, and their faults",
        "check": "a .glb file with an avatar -> its mistakes against docs/spec, a line each",
    },
}
"""The sub-commands with their summaries, as `mien --help` lists them.

`mien.commands.NAME` (dashes become underscores) holds the dataclass `Command`. Its `check()` checks options and paths
as far as that is possible without heavy libraries; `run()` then does the work.
"""
COMMANDS = {name: summary for group in GROUPS.values() for name, summary in group.items()}
_ROW = "batch-row"
"""The hidden command that is the process of one row of a batch (`mien.batch.row`): its steps are commands of mien."""

EXIT_USER_ERROR = 2
EXIT_CLOSED_PIPE = 141
"""Exit code of a program that the system ends because nobody reads its output any more (`mien ... | head -1`)."""
_USERS_ERRNOS = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ENAMETOOLONG}
)
"""Errors that mien cannot prevent: the disk is full, read-only, protected or broken."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one sub-command and return the exit code.

    The code is 0 on success, 2 after a user's mistake, 1 after a bug in mien, 130 after Ctrl-C, 143 after SIGTERM, 129
    if the terminal was closed, and 141 if nobody reads the output any more.
    """
    open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # help and file names have characters that its encoding may lack
    try:
        try:
            return _main(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        return EXIT_CLOSED_PIPE
    except OSError as error:
        with contextlib.suppress(OSError):
            _complain(f"standard output: cannot be written ({error.strerror}); correct that and run the command again")
        return EXIT_USER_ERROR
    finally:
        drop_output()


def _main(arguments: list[str]) -> int:
    try:
        return _dispatch(arguments)
    except UserError as error:
        return _complain(str(error))
    except (KeyboardInterrupt, Terminated) as stop:
        tell("mien: stopped; the same command continues where it stopped, or starts again")
        return int(str(stop.code)) if isinstance(stop, Terminated) else EXIT_INTERRUPTED
    except BrokenPipeError:
        raise
    except MemoryError as error:
        cause = f" ({error})" if str(error) else ""
        return _complain(f"not enough memory{cause}; close other programs, or ask for a smaller size")
    except OSError as error:
        if error.errno not in _USERS_ERRNOS:
            return _crash()
        return _complain(f"{error.filename or 'a file'}: {error.strerror}; correct that and run the same command again")
    except ImportError as error:
        words = missing_package(error, *arguments[:1])
        return _crash() if words is None else _complain(words)
    except Exception:
        return _crash()


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        show(_overview())
        return 0 if arguments else EXIT_USER_ERROR
    if arguments[0] == "--version":
        show(f"mien {mien.__version__}")
        return 0
    name, rest = arguments[0], arguments[1:]
    if name == _ROW:
        if {"-h", "--help"} & {*rest}:
            show(f"usage: mien {_ROW} DIR\n\nRun the row that standard input holds. `mien batch` starts this.")
            return 0
        if len(rest) != 1 or rest[0].startswith("-"):
            raise UserError(f"`mien {_ROW}` is the process of a row, which `mien batch` starts; start that")
        from mien.batch.row import do_steps, row_process

        return row_process(Path(rest[0]), sys.stdin, partial(do_steps, main))
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, [*COMMANDS, "--help", "--version"], 1)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(COMMANDS)}"
        raise UserError(f"no sub-command {name!r}; {hint}")
    if "" in rest:
        # As a path, an empty text is the current folder: an unset shell variable must not fill it with pictures.
        raise UserError(f"argument {rest.index('') + 1} after {name} is empty (an unset variable?); give it a value")
    for argument in rest:
        if argument.startswith("--") and argument.endswith("="):
            raise UserError(f"{argument} is empty (an unset variable?); give it a value")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_SIDE**2))  # OpenCV reads it when it is imported
    modules = ("parsing", name.replace("-", "_"))
    parsing, module = (importlib.import_module(f"mien.commands.{each}") for each in modules)
    command = parsing.parse(module, name, rest)
    asked_threads()
    if hasattr(command, "check"):
        command.check()
    with orderly_stops():
        use_one_torch_thread()
        from mien import _native

        try:
            _native.rasterize_isa()
        except ValueError as error:  # this machine lacks the instruction set that MIEN_ISA asks for
            raise UserError(f"{error}; give one of these, or unset it") from None
        command.run()
    return 0


def _crash() -> int:
    """Report that it is a bug, and write the traceback to a file."""
    log = _write_crash_log()
    tell(f"mien: this is a bug in mien, not your mistake: {traceback.format_exc().splitlines()[-1]}")
    tell(f"mien: the traceback is in {log}; please report it with the command")
    return 1


def _overview() -> str:
    width = max(len(name) for name in COMMANDS)
    rows = "\n\n".join(
        "\n".join([f"{title}:", *(f"  {name:<{width}}  {summary}" for name, summary in commands.items())])
        for title, commands in GROUPS.items()
    )
    return (
        f"mien {mien.__version__}: video of a head in, an animatable avatar of 3D Gaussians out.\n\n"
        f"usage: mien COMMAND [options]      mien COMMAND --help\n\n{rows}\n\n"
        "First steps:  mien demo    |    mien create my_video.mp4 --out my_avatar"
    )


def _complain(message: str) -> int:
    tell(f"mien: {message}")
    return EXIT_USER_ERROR


def _write_crash_log() -> Path:
    handle, name = tempfile.mkstemp(prefix="mien-crash-", suffix=".log")
    # File names may hold bytes that are not text.
    with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as log:
        log.write(f"mien {mien.__version__}\n{shlex.join(sys.argv)}\n\n{traceback.format_exc()}")
    return Path(name)


if __name__ == "__main__":
    sys.exit(main())
