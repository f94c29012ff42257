"""`mien create`: from videos to an avatar."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from mien.capture.settings import CaptureSettings
from mien.commands.train_options import Elsewhere, TrainOptions
from mien.disk.files import check_writable
from mien.disk.workspace import Workspace, check_new_workspace
from mien.errors import UserError
from mien.machine.progress import say, stages
from mien.pipeline.names import check_sources, check_viewer, doubled_videos, run_name, sequence_names
from mien.tracking.settings import (
    PaperSettings,
    PhotometricSettings,
    ScoringSettings,
    SmoothnessSettings,
    TrackingSettings,
)
from mien.training.settings import PRESETS, AlignmentSettings, check_held_out
from mien.training.settings.splits import SPLITS


@dataclass(frozen=True)
class _Tracking(TrackingSettings):
    """Settings of the tracking. `mien track` has more of them."""

    smoothness: Elsewhere = SmoothnessSettings()
    photometric: Elsewhere = PhotometricSettings()
    paper: Elsewhere = PaperSettings()


@dataclass(frozen=True)
class _Alignment(AlignmentSettings):
    """Whether frames are aligned. `mien align` has the settings."""

    template_steps: Elsewhere = AlignmentSettings.template_steps
    template_gaussians: Elsewhere = AlignmentSettings.template_gaussians
    resolution: Elsewhere = AlignmentSettings.resolution
    iterations: Elsewhere = AlignmentSettings.iterations


@dataclass(frozen=True)
class Command:
    """Make an avatar, a page, a film and a report from videos of one person. A stopped command continues.

    Each video is captured separately. All sequences of the workspace are tracked together, with one identity. The
    avatar is trained on the videos given here.
    """

    remedies: ClassVar[dict[str, str]] = {
        "--tracking.": "`mien track` has all options of tracking", "--alignment.": "`mien align` has all of alignment",
    }  # fmt: skip
    videos: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH [PATH ...]")]
    """Video files, or folders of pictures in order."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Workspace folder, new or existing."""
    name: tuple[str, ...] = ()
    """Names of the sequences, one per video (default: the videos' names)."""
    calibration: Path | None = None
    """Calibrated cameras as json (docs/using.md). The videos then form one sequence, filmed at once."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the method's name)."""
    face_model: str = "anny"
    """Name of a face model (see `mien face-models`), or a .npz or .pkl file in FLAME's schema."""
    track_apart: bool = False
    """Hold the sequences of --hold-out out of the tracking as well (docs/using.md)."""
    preview: bool = False
    """Show the fit of the face while it runs, in DIR/tracking_preview.html (for a browser)."""
    overlay: Literal["auto", "all", "none"] = "auto"
    """Frames in overlay.mp4: all, every n-th, at most 120 (auto), or none."""
    view: bool = False
    """Show the avatar in a browser while it trains."""
    growing: Path | None = None
    """A .mien file to write the avatar to from time to time while it trains. `mien view FILE --follow` shows it."""
    options: Annotated[TrainOptions, tyro.conf.arg(name="")] = field(default_factory=TrainOptions.of)
    capture: CaptureSettings = field(default_factory=CaptureSettings)
    tracking: _Tracking = field(default_factory=_Tracking)
    alignment: _Alignment = field(default_factory=_Alignment)
    scoring: ScoringSettings = field(default_factory=ScoringSettings)

    def check(self) -> None:
        """Check options, names and paths without heavy libraries."""
        self.options.check()
        if self.view:
            check_viewer()
        if self.growing is not None:
            check_writable(self.growing)
        if needs := SPLITS[split := self.options.settings().split].needs:
            raise UserError(
                f"--split {split}: needs {needs}, and this command makes one sequence; use `mien capture` for each or "
                f"`mien import`, then `mien track` and `mien train --split {split}`"
            )
        if self.track_apart and not self.options.hold_out:
            raise UserError("--track-apart: needs the sequences to track apart; add --hold-out NAME")
        run_name(self.run_name or self.options.method)
        self.capture.check()
        self.tracking.check()
        check_new_workspace(self.out)
        check_sources(self.videos, self.name, self.calibration)

    def run(self) -> None:
        """Run all stages and skip those whose results are current. All possible checks come before any work."""
        from mien.evaluation.protocols import EvaluationSettings
        from mien.pipeline.align import is_trained_on, one_camera, run_alignment_stage
        from mien.pipeline.capture import run_capture_stage
        from mien.pipeline.create import name_next_commands, show_film, show_page
        from mien.pipeline.evaluate import run_evaluation_stage
        from mien.pipeline.stage_times import FILE_NAME, StageTimes
        from mien.pipeline.track import run_tracking_stage, showing_meanwhile
        from mien.pipeline.train import run_training_stage

        began = time.monotonic()
        method, settings = self.options.method_config(), self.options.settings()
        workspace, run = Workspace(self.out), run_name(self.run_name or self.options.method)
        self._check_files(workspace, run)
        times = StageTimes(workspace.root / FILE_NAME)
        named = ("capture", "tracking", "alignment", "training", *["scoring"] * settings.holds_out)
        with stages(*named) as tell, times.one_by_one(tell) as begin:
            begin("capture")
            captured = run_capture_stage(workspace, self.videos, self.name, self.calibration, self.capture)
            check_held_out(captured, settings)
            begin("tracking")
            apart = settings.held_out_sequences if self.track_apart else ()
            trackings = run_tracking_stage(
                workspace, self.face_model, self.tracking, overlay=self.overlay, preview=self.preview, hold_out=apart,
                scoring=self.scoring, show=False,
            )  # fmt: skip
            names = [name for name in captured if name in trackings]
            begin("alignment")
            one, least = one_camera(workspace, names), self.alignment.template_steps
            if one and self.alignment.when == "auto" and settings.steps < least:
                say(
                    f"frames are not aligned to a quick avatar, as --steps {settings.steps} is below its own "
                    f"{least:,}; `--alignment.when always` aligns them"
                )
            # A run that goes on keeps its tracking.
            if self.aligns(not one) and not is_trained_on(workspace, run, names):
                run_alignment_stage(workspace, names, self.alignment, settings, keep=True)
            begin("training")
            published = PRESETS[self.options.preset].published
            with showing_meanwhile(workspace, list(trackings), self.overlay):
                run_training_stage(workspace, names, run, method, settings, self.view, published, self.growing)
                show_page(workspace, run)
            if settings.holds_out:
                begin("scoring")
                # `mien evaluate` judges the baselines by ST-LPIPS, too, which takes longer than all other scoring.
                run_evaluation_stage(
                    workspace, run, EvaluationSettings(perceptual_of="avatar", device=settings.device), again=False
                )
        show_film(workspace, run)
        say(f"Done in {time.monotonic() - began:.0f} s. Stages: {times.told()}.")
        name_next_commands(workspace, run)

    def aligns(self, several_cameras: bool) -> bool:
        """Whether new trackings are aligned."""
        auto = not several_cameras and not PRESETS[self.options.preset].published
        auto = auto and self.options.steps >= self.alignment.template_steps  # else the quick avatar is no quicker
        return self.alignment.when == "always" or (self.alignment.when == "auto" and auto)

    def _check_files(self, workspace: Workspace, run: str) -> None:
        """Check what needs heavy libraries: the run, the cameras, the face model, the masks and the videos."""
        from mien.face.torso import has_torso
        from mien.pipeline.capture import check_camera_ids, check_captured
        from mien.pipeline.face_models import face_model_of
        from mien.pipeline.track import check_masks
        from mien.training.run import check_run, check_untouched, check_videos, is_part_of

        run_dir, settings = workspace.run_dir(run), self.options.settings()
        check_run(run_dir, self.options.method_config(), settings)
        if self.calibration is not None:
            check_camera_ids(self.calibration, settings.held_out_cameras)
        check_untouched(run_dir)
        self.options.say_what_is_ignored()
        torso = has_torso(face_model_of(self.face_model))
        check_masks(workspace, workspace.sequence_names(), self.scoring.cut_after(self.tracking, torso=torso))
        if self.calibration is None:
            names = sequence_names(self.videos, self.name)
            check_videos(run_dir, names, workspace.sequence_names())
            check_captured(workspace, run, self.videos, names, self.capture)
            for held in settings.held_out_sequences:
                if not any(is_part_of(held, name) for name in names):
                    raise UserError(f"--hold-out {held}: no such sequence; there will be: {', '.join(names)}")
            for warning in doubled_videos(self.videos, names, settings.held_out_sequences):
                say(f"warning: {warning}")
