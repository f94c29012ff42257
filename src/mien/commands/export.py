"""`mien export`: avatars as files for other programs. Each format has options of its own (`mien.formats`)."""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.disk.files import check_writable
from mien.disk.workspace import Workspace, open_workspace
from mien.errors import UserError
from mien.formats.format import Format, MotionOptions, NoOptions, PoseOptions
from mien.formats.registry import find_format, format_of, formats, numbered
from mien.pipeline.names import check_driver, check_neutral


def any_of(words: Iterable[str]) -> str:
    """Return a choice in words: a, b or c."""
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def _endings(kinds: Iterable[Format]) -> str:
    return any_of(ending for each in kinds for ending in each.endings)


def _about_out() -> str:
    return (
        f"The file to write: {_endings(formats())}. With --series, "
        f"{_endings(each for each in formats() if each.holds == 'pose')} files get numbers: NAME_000000.ply. Each "
        "ending has options of its own: `mien export --out me.html --help` shows those of .html."
    )


@dataclass(frozen=True)
class Command:
    """Write an avatar: .mien (all of it), .html and .packed (for pages), .glb and .vrm (for engines), or a pose."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder. Also a .mien or .glb file, whose avatar is written as another file, at rest."""
    out: Annotated[Path, _about_out]
    format: str | None = None
    """Name of the format (default: by the ending of --out). gaussian-avatars is a folder with point_cloud.ply, whose
    Gaussians are bound to triangles, and flame_param.npz with all timesteps of the run's training."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    options: Annotated[NoOptions, tyro.conf.arg(name="")] = field(default_factory=NoOptions)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        kind, options = _kind(self.out, self.format), self.options
        kind.check(self.out, options)
        series = options.series if isinstance(options, MotionOptions) else None
        if self._is_file():
            self._check_file(options)
        else:
            workspace = open_workspace(self.workspace)
            workspace.pick_run(self.run_name)
            if isinstance(options, MotionOptions):
                _check_motion(workspace, options)
        first = numbered(self.out, 0) if series is not None and kind.holds == "pose" else self.out
        check_writable(first, folder=kind.holds == "folder")

    def run(self) -> None:
        """Pose the avatar and write the files."""
        from mien.pipeline.export import FileContent, export

        kind = _kind(self.out, self.format)
        if self._is_file():
            export(FileContent(self.workspace), self.out, kind, self.options)
            return
        from mien.machine.progress import say
        from mien.pipeline.export_run import RunContent

        say(f"{self.out}: reads the run and writes the file, which takes up to half a minute")
        workspace = open_workspace(self.workspace)
        export(RunContent(workspace, workspace.pick_run(self.run_name), self.options), self.out, kind, self.options)

    def _is_file(self) -> bool:
        """Whether the avatar comes from a file."""
        kind = format_of(self.workspace)
        return kind is not None and kind.read is not None and not self.workspace.is_dir()

    def _check_file(self, options: NoOptions) -> None:
        if not self.workspace.is_file():
            raise UserError(f"{self.workspace}: no such file; give a workspace, or a file that `mien export` wrote")
        moves = isinstance(options, MotionOptions) and options.series is not None
        if self.run_name is not None or moves or (isinstance(options, PoseOptions) and options.set):
            raise UserError(
                f"{self.workspace}: a file holds one avatar at rest; leave --run, --set and --series out, or give its "
                "workspace"
            )
        if self.out.exists() and self.out.samefile(self.workspace):
            raise UserError(f"{self.out}: is the file that is read; choose another name")


def task_of(arguments: Sequence[str]) -> type[Command]:
    """The command with the options of the format that the arguments ask for."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--out", nargs="?")
    parser.add_argument("--format", nargs="?")
    typed = parser.parse_known_args(list(arguments))[0]
    if typed.out is None:
        return Command
    kind = _kind(Path(typed.out), typed.format)
    _refuse_options_of_others(arguments, kind, typed.out)
    options = type(kind.options())
    own = ("options", Annotated[options, tyro.conf.arg(name="")], field(default_factory=options))
    return make_dataclass("Command", [own], bases=(Command,), frozen=True, namespace={"__doc__": Command.__doc__})


def _refuse_options_of_others(arguments: Sequence[str], kind: Format, out: str) -> None:
    """Name the formats that have an option which `kind` lacks."""

    def options(of: Format) -> set[str]:
        return {f"--{each.name.replace('_', '-')}" for each in fields(of.options())}

    typed = {each.partition("=")[0].replace("_", "-") for each in arguments if each.startswith("--")}
    for option in sorted(typed - {"--out", "--format", "--run", "--help", "--help-all"} - options(kind)):
        others = [each.name for each in formats() if option in options(each)]
        if others:
            raise UserError(f"{out}: {option} is an option of {any_of(others)}, not of {kind.name}; leave it out")


def _kind(out: Path, name: str | None) -> Format:
    """The format that is written: by its name, or by the ending of the file."""
    if name is None:
        kind = format_of(out)
        if kind is None:
            ending, use = out.suffix.lower() or "a file without ending", _endings(formats())
            raise UserError(f"{out}: cannot write {ending}; use {use}, or --format gaussian-avatars for a folder")
        return kind
    kind = find_format(name)
    if kind is None:
        names = any_of(each.name for each in formats())
        raise UserError(
            f"--format {name}: there is no such format; choose one of {names}; `mien export-dataset` writes captures"
        )
    asked = kind.endings if name == kind.name else (f".{name}",)
    if asked and out.suffix.lower() not in asked:
        raise UserError(f"{out}: does not end in {any_of(asked)}, as --format {name} asks; rename it")
    if not asked and format_of(out) is not None:
        raise UserError(f"{out}: --format {name} writes a folder; give a name without an ending")
    return kind


def _check_motion(workspace: Workspace, options: MotionOptions) -> None:
    check_neutral(options.neutral)
    names = workspace.sequence_names()
    if options.series is None or options.series in names:
        return
    if not Path(options.series).exists():
        raise UserError(
            f"--series {options.series}: no such sequence, file or folder; {workspace.root} has the sequences "
            f"{', '.join(names) or '(none)'}; or give a workspace, a video, a recording or a sound file"
        )
    check_driver(Path(options.series), None)
