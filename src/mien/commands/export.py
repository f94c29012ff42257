"""`mien export`: avatars as files for other programs, and captures in the layouts of other laboratories."""

import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from mien.commands.parsing.help_text import Described
from mien.datasets.layouts.layout import Layout, MatteKind
from mien.datasets.layouts.registry import LAYOUTS, find_layout
from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.formats.format import Format, Holds
from mien.formats.registry import endings, find_format, format_of, formats, numbered
from mien.pipeline.driver import name_driver, name_neutral

if TYPE_CHECKING:
    from mien.formats.format import Options

SUBMISSION = "nersemble-benchmark"
"""Name for `--format` of the benchmark's submission folder."""
CaptureSplit = Literal["blocks", "tail", "none", "dataset"]
"""Names of what may be held out of a capture without a run."""
_REFUSED = {
    "webgpu": "only an .html page draws with WebGPU; leave --webgpu out",
    "sh": "only a .ply has a degree to choose; leave --sh out",
    "spz_version": "only a .spz has a version to choose; leave --spz-version out",
    "webcam": "only an .html page has a webcam; leave --webcam out, or write a .html file",
    "microphone": "only an .html page has a microphone; leave --microphone out, or write a .html file",
    "title": "only an .html page has a title; leave --title out",
    "address": "only an .html page has an address; leave --address out",
    "soft_cut": "only .html, .mien and .packed files have a soft cut; leave --sharp-cut out",
    "largest": "only .html and .packed files are made smaller; leave --largest out",
}
"""Messages for options that the format does not take."""


def _about_workspace() -> str:
    return (
        f"Workspace folder. Also a {_any_of(e for f in formats() if f.reads_avatars for e in f.endings)} file, whose "
        "avatar is written as another file, at rest."
    )


def _about_out() -> str:
    held = {holds: [e for f in formats() if f.holds == holds for e in f.endings] for holds in get_args(Holds)}
    return (
        f"The file to write. A whole avatar is {_any_of(held['avatar'])}; Gaussians in a pose are "
        f"{_any_of(held['pose'] + held['sequence'])}. With --series, {_any_of(held['pose'])} files get numbers: "
        f"NAME_000000.ply; {_any_of(held['sequence'])} files have all frames. With --format "
        f"{_any_of([*_folders(), *_layouts()])}, a folder; that of a capture has to be new."
    )


def _about_format() -> str:
    return (
        f"Name of the format of an avatar: {_any_of(each.name for each in formats())} (default: by the ending of "
        "--out). gaussian-avatars is a folder with point_cloud.ply, whose Gaussians are bound to triangles, and "
        "flame_param.npz with all timesteps of the run's training. Or the layout of a capture, which is a tracked "
        f"sequence and not an avatar, for programs that train elsewhere: {_any_of(_layouts())} (docs/datasets.md). Or "
        f"{SUBMISSION}: a folder of videos that the benchmark of that name scores."
    )


def _any_of(words: Iterable[str]) -> str:
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def _folders() -> list[str]:
    return [each.name for each in formats() if each.holds == "folder"]


def _layouts() -> list[str]:
    return [each.name for each in LAYOUTS]


@dataclass(frozen=True)
class Command:
    """Write an avatar: .mien (all of it), .html and .packed (for pages), .glb and .vrm (for engines), a pose, a folder.

    With --format insta, imavatar, nerface or nersemble, write a tracked capture instead, for programs that train
    elsewhere. With --format nersemble-benchmark, write the videos that the NeRSemble benchmark asks for.
    """

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR"), Described(_about_workspace)]
    out: Annotated[Path, Described(_about_out)]
    format: Annotated[str | None, Described(_about_format)] = None
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one). For a capture: hold out what this run holds out."""
    set: tuple[str, ...] = ()
    """Expressions and whole faces by name, and joint angles in radians, for example --set smile=0.6 jawOpen=0.3
    eyeLookUpLeft=0.5 left_eye_y=0.2 (default: the person's neutral). An unknown name lists all of them."""
    series: str | None = None
    """A motion: the name of a sequence of the workspace, or anything that `mien drive --by` takes. A page plays it. For
    Gaussians in a pose, every frame becomes a file, or a time sample of the file; the head stays at the origin."""
    neutral: str | None = None
    """With --series, the driver's face at rest, as for `mien drive`: first, calm, model, or a video, recording,
    workspace or sequence folder of the driver at rest."""
    every: int = 1
    """With --series, take only every n-th frame."""
    sh: Literal[0, 1, 2, 3] | None = None
    """For .ply: degree of the spherical harmonics in the file. Coefficients that the avatar lacks are zeros, for
    programs that expect those of degree 3: 248 bytes for each Gaussian (default: the avatar's own degree)."""
    spz_version: Literal[3, 4] | None = None
    """For .spz: version of the format. PlayCanvas reads only 4, and older programs only 3 (default: 4)."""
    webgpu: bool = False
    """For .html: the page draws with WebGPU where the browser has it on a GPU, and with WebGL2 elsewhere. The page
    becomes 22 kB larger."""
    webcam: bool = False
    """For .html: a button with which the viewer's own face drives the avatar. The page becomes 9 MB larger; nothing of
    the camera leaves it."""
    webcam_model: Path | None = None
    """With --webcam, another face_landmarker.task than that of mien (default: the file that MIEN_FACE_LANDMARKER names,
    or mien's)."""
    microphone: bool = False
    """For .html: a button after which the lips follow the viewer's voice. The page becomes 4 kB larger; no sound leaves
    it."""
    title: str | None = None
    """For .html: the title of the page (default: the avatar's name)."""
    address: str | None = None
    """For .html: the address at which you will publish the page, such as https://example.org/me.html. Messengers then
    show a picture of the avatar, which is written beside the page."""
    sharp_cut: bool = False
    """For .html, .mien and .packed: the head ends sharply at the neck, as in training (default: it fades over 3 cm)."""
    largest: float | None = None
    """For .html and .packed: largest size of the file in MB. Gaussians that add least to pictures are left out until it
    fits (default: all stay)."""
    sequence: str | None = None
    """For a capture: the sequence that is written (default: the only one)."""
    split: CaptureSplit | None = None
    """For a capture without --run: the split, as for `mien train` (default: that of the dataset that it was imported
    from, or blocks)."""
    benchmark: Path | None = None
    """For --format nersemble-benchmark: the person's folder of the NeRSemble benchmark, whose name is a number. --out
    is the submission folder, and takes the people one after the other."""
    mattes: MatteKind | None = None
    """For a capture: mattes of the head above the cut at the neck, which mien trains on and scores, or of the whole
    person (default: head)."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.disk.files import check_writable

        if self.format == SUBMISSION:
            self._check_submission()
            return
        if self.benchmark is not None:
            raise UserError(
                f"--benchmark {self.benchmark}: is for --format {SUBMISSION}; give that too, or leave it out"
            )
        layout = find_layout(self.format)
        if layout is not None:
            self._check_capture(layout)
            return
        kind = self._kind()
        for option, value in (("sequence", self.sequence), ("split", self.split), ("mattes", self.mattes)):
            if value is not None:
                raise UserError(
                    f"--{option} {value}: is for captures (--format {_any_of(_layouts())}), and {kind.name} holds an "
                    "avatar; leave it out"
                )
        self._check_options(kind)
        if self._is_file():
            self._check_file(kind)
            return
        workspace = open_workspace(self.workspace)
        workspace.pick_run(self.run_name)
        for option, given in (("set", self.set), ("series", self.series), ("every", self.every != 1)):
            if given and option in kind.refusals:
                raise UserError(f"{self.out}: {kind.refusals[option]}")
        if self.every < 1 or (self.every > 1 and self.series is None):
            remedy = "give 1 or more" if self.every < 1 else "is for a series; give one with --series, or leave it out"
            raise UserError(f"--every {self.every}: {remedy}")
        if self.neutral is not None and self.series is None:
            raise UserError(f"--neutral {self.neutral}: is for motions; give it together with --series")
        name_neutral(self.neutral)
        if self.series is not None and self.series not in (names := workspace.sequence_names()):
            if not Path(self.series).exists():
                raise UserError(
                    f"--series {self.series}: no such sequence, file or folder; {self.workspace} has the sequences "
                    f"{', '.join(names) or '(none)'}; or give a workspace, a video, a recording or a sound file"
                )
            name_driver(Path(self.series), None)
        check_writable(self._first_path(kind), folder=kind.holds == "folder")

    def run(self) -> None:
        """Pose the avatar and write the files, or write the capture."""
        if self.format == SUBMISSION:
            from mien.pipeline.export_dataset import export_submission

            workspace = open_workspace(self.workspace)
            assert self.benchmark is not None
            export_submission(workspace, workspace.pick_run(self.run_name), self.benchmark, self.out)
            return
        layout = find_layout(self.format)
        if layout is not None:
            self._export_capture(layout)
            return
        kind = self._kind()
        if self._is_file():
            from mien.pipeline.convert import convert

            convert(self.workspace, self.out, kind, self._options())
            return
        from mien.pipeline.export import RunContent, Series, export

        workspace = open_workspace(self.workspace)
        series = None if self.series is None else Series(self.series, self.neutral, self.every)
        content = RunContent(workspace, workspace.pick_run(self.run_name), self.set, series)
        export(content, self.out, kind, self._options())

    def _check_capture(self, layout: Layout) -> None:
        """Check the options and paths of a capture."""
        from mien.datasets.layouts.layout import check_new_folder

        other = self._option_of_avatars()
        if other is not None:
            raise UserError(f"{other}: is for avatars, and --format {layout.name} writes a capture; leave {other} out")
        if self.run_name is not None and self.split is not None:
            raise UserError(f"--split {self.split}: --run {self.run_name} has a split of its own; give only one")
        if self._is_file():
            raise UserError(f"{self.workspace}: holds an avatar, and --format {layout.name} writes a capture; give the "
                            "folder of a workspace")  # fmt: skip
        workspace = open_workspace(self.workspace)
        if self.run_name is not None:
            workspace.pick_run(self.run_name)
        name = workspace.pick_sequence(self.sequence)
        if name not in workspace.tracked_names():
            raise UserError(
                f"{self.workspace}: the sequence {name} is not tracked, and a capture is written with its tracking; "
                f"run {shlex.join(['mien', 'track', str(self.workspace)])}"
            )
        check_new_folder(self.out)

    def _check_submission(self) -> None:
        """Check the options and paths of a submission to the benchmark."""
        from mien.disk.files import check_writable

        given = {"--sequence": self.sequence, "--split": self.split, "--mattes": self.mattes}
        other = self._option_of_avatars() or next((option for option, value in given.items() if value), None)
        if other is not None:
            raise UserError(
                f"{other}: is not for --format {SUBMISSION}, which renders what the benchmark asks for; leave "
                f"{other} out"
            )
        if self.benchmark is None:
            raise UserError(
                f"--format {SUBMISSION}: needs the person's folder of the benchmark; give it with --benchmark"
            )
        if not (self.benchmark / "calibration" / "camera_params.json").is_file():
            raise UserError(
                f"--benchmark {self.benchmark}: has no calibration/camera_params.json; give the folder of a person of "
                "the benchmark"
            )
        name = self.benchmark.resolve().name
        if not (name.isascii() and name.isdigit() and len(name) <= 3):
            raise UserError(
                f"--benchmark {self.benchmark}: its name is not the number of a person, such as 393; give the folder "
                "under that name"
            )
        if self._is_file():
            raise UserError(
                f"{self.workspace}: holds an avatar, and --format {SUBMISSION} needs its run; give the folder of a "
                "workspace"
            )
        open_workspace(self.workspace).pick_run(self.run_name)
        check_writable(self.out, folder=True)
        if (self.out / name.zfill(3)).exists():
            raise UserError(f"{self.out / name.zfill(3)}: is there already; delete it, or give another --out")

    def _option_of_avatars(self) -> str | None:
        """The first option that is given, and is only for files of avatars."""
        given = {
            "--set": self.set, "--series": self.series, "--neutral": self.neutral, "--every": self.every != 1,
            "--sh": self.sh is not None, "--spz-version": self.spz_version, "--webgpu": self.webgpu,
            "--webcam": self.webcam, "--webcam-model": self.webcam_model,
            "--microphone": self.microphone, "--title": self.title,
            "--address": self.address, "--sharp-cut": self.sharp_cut, "--largest": self.largest is not None,
        }  # fmt: skip
        return next((option for option, value in given.items() if value), None)

    def _export_capture(self, layout: Layout) -> None:
        from mien.pipeline.export_dataset import export_capture, settings_of

        workspace = open_workspace(self.workspace)
        sequence = workspace.pick_sequence(self.sequence)
        settings = settings_of(workspace, sequence, self.run_name, self.split)
        export_capture(workspace, sequence, layout, self.out, settings, self.mattes or "head")

    def _is_file(self) -> bool:
        """Whether the avatar comes from a file."""
        kind = format_of(self.workspace)
        return kind is not None and kind.reads_avatars and not self.workspace.is_dir()

    def _kind(self) -> Format:
        """The format that is written."""
        if self.format is None:
            kind = format_of(self.out)
            if kind is None:
                raise self._unknown_ending()
            return kind
        kind = find_format(self.format)
        if kind is None:
            names = ", ".join(each.name for each in formats())
            raise UserError(
                f"--format {self.format}: there is no such format; choose one of {names} for an avatar, or "
                f"{_any_of(_layouts())} for a capture"
            )
        if kind.holds == "folder":
            if format_of(self.out) is not None:
                raise UserError(f"{self.out}: --format {kind.name} writes a folder; give a name without an ending")
        else:
            asked = kind.endings if self.format == kind.name else (f".{self.format}",)
            if self.out.suffix.lower() not in asked:
                use = " or ".join(asked)
                raise UserError(f"{self.out}: does not end in {use}, as --format {self.format} asks; rename it")
        return kind

    def _unknown_ending(self) -> UserError:
        folder = "" if self._is_file() else f", or --format {_any_of(_folders())} for a folder"
        ending = self.out.suffix.lower() or "a file without ending"
        use = _any_of(endings(only_from_files=self._is_file()))
        if self._is_file() and ending in endings():
            return UserError(f"{self.out}: cannot write {ending} from a file; export the workspace, or use {use}")
        return UserError(f"{self.out}: cannot write {ending}; use {use}{folder}")

    def _check_options(self, kind: Format) -> None:
        from mien.formats.shared.webcam import find_webcam_files

        given = {"webgpu": self.webgpu, "sh": self.sh is not None, "webcam": self.webcam, "microphone": self.microphone}
        given |= {"spz_version": self.spz_version is not None}
        given |= {"title": self.title is not None, "address": self.address is not None}
        given |= {"soft_cut": self.sharp_cut, "largest": self.largest is not None}
        for option, is_given in given.items():
            if is_given and option not in kind.options:
                raise UserError(f"{self.out}: {_REFUSED[option]}")
        if self.largest is not None and not self.largest > 0:
            raise UserError(f"--largest {self.largest:g}: give a number of MB above 0")
        if self.address is not None:
            from mien.formats.page import check_address

            check_address(self.address)
        if self.webcam_model is not None and not self.webcam:
            raise UserError(f"--webcam-model {self.webcam_model}: give it together with --webcam")
        if self.webcam:
            find_webcam_files(self.webcam_model)
        kind.check(self.out)

    def _options(self) -> "Options":
        from mien.formats.format import Options
        from mien.formats.shared.webcam import find_webcam_files

        webcam = find_webcam_files(self.webcam_model) if self.webcam else None
        version = self.spz_version or 4
        named = {"soft_cut": not self.sharp_cut, "microphone": self.microphone, "largest": self.largest}
        return Options(self.sh, self.webgpu, webcam, version, self.title, self.address, **named)

    def _check_file(self, kind: Format) -> None:
        from mien.disk.files import check_writable

        if not self.workspace.is_file():
            raise UserError(f"{self.workspace}: no such file; give a workspace, or a file that `mien export` wrote")
        if self.run_name or self.set or self.series or self.neutral or self.every != 1:
            raise UserError(
                f"{self.workspace}: a file holds one avatar at rest; leave --run, --set, --series, --neutral and "
                "--every out, or give its workspace"
            )
        if not kind.from_files and kind.holds == "folder":
            raise UserError(f"{self.workspace}: a file has no training, which a folder holds; give its workspace")
        if not kind.from_files:
            raise self._unknown_ending()
        if self.out.exists() and self.out.samefile(self.workspace):
            raise UserError(f"{self.out}: is the file that is read; choose another name")
        check_writable(self.out)

    def _first_path(self, kind: Format) -> Path:
        """The file that is written first."""
        return self.out if self.series is None or kind.holds != "pose" else numbered(self.out, 0)
