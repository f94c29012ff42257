"""From captures to trackings. Current trackings are read back."""

import hashlib
import json
import signal
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

from mien.capture.store import read_capture, read_capture_hash
from mien.datasets.writing import OVERLAY
from mien.disk.files import remove_leftovers
from mien.disk.locks import hold
from mien.disk.reading import remove_tree
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.face.torso import has_torso
from mien.machine.progress import say, show_no_bars
from mien.machine.stops import Put, Terminated
from mien.media.video import count_frames
from mien.pipeline.face_models import face_model_of
from mien.tracking.files import check_tracking_of, read_tracking, write_tracking
from mien.tracking.fitting.sequence import has_enough_faces
from mien.tracking.pipeline.track import track_subject
from mien.tracking.report.overlay import overlay_stride, write_overlay
from mien.tracking.report.page import write_residual_report
from mien.tracking.scoring import make_scoring
from mien.tracking.scoring_files import check_scoring_cut, scoring_exists, write_scoring
from mien.tracking.settings import Cut, ScoringSettings, TrackingSettings
from mien.tracking.tracking import Tracking
from mien.training.run import outdated_sequences

_TRACKING_RECIPE = 12
"""Version of the tracking. It is raised whenever the same captures would be tracked differently, so that old trackings
no longer count as current."""

_DESCENT_RECIPE, _TORSO_RECIPE = "descent 4", "torso 1"
"""The same for what only the schedule `paper` does, and for torsos."""

DEFAULT_SCORING = ScoringSettings()

Overlay = Literal["auto", "all", "none"]
"""Frames that overlay.mp4 shows."""


def run_tracking_stage(
    workspace: Workspace,
    face_model_choice: str,
    settings: TrackingSettings,
    again: bool = False,
    overlay: Overlay = "auto",
    preview: bool = False,
    hold_out: Collection[str] = (),
    scoring: ScoringSettings = DEFAULT_SCORING,
    *,
    show: bool = True,
) -> dict[str, Tracking]:
    """Track all sequences of a workspace together, with one identity; return the trackings by name.

    Current trackings are read back. The face model is a name or a file (`face_model_of`). Writes overlays and, only
    once, the scoring masks. Without `show`, reports and overlays are left to `show_trackings`. Sequences with too few
    faces are left out, unless that would leave none. Held-out sequences have no part in what the sequences share
    (`track_subject`). No other process may write a sequence meanwhile, unless everything is current.
    """
    face_model = face_model_of(face_model_choice)
    names = workspace.sequence_names()
    if not names:
        raise UserError(f"{workspace.root}: no sequences to track; add one with `mien capture VIDEO`")
    _check_apart(names, hold_out)
    cut = scoring.cut_after(settings, torso=has_torso(face_model))
    check_masks(workspace, names, cut)
    with suppress(UserError):  # it is reported when the results are written again
        fingerprint = tracking_fingerprint(workspace, names, face_model, settings, hold_out)
        trackings = None if again else _current_trackings(workspace, names, fingerprint, face_model, tell=False)
        folders = [] if trackings is None else [(workspace.sequence_dir(name), one) for name, one in trackings.items()]
        if trackings is not None and all(
            scoring_exists(folder / "scoring", read_capture_hash(folder / "capture"))
            and (not show or all(_is_shown(folder, tracking, overlay)))
            for folder, tracking in folders
        ):
            say(f"{', '.join(trackings)}: the tracking is current, nothing to do")
            return trackings
    with hold(*(workspace.sequence_dir(name) for name in names)):
        fingerprint = tracking_fingerprint(workspace, names, face_model, settings, hold_out)
        trackings = None if again else _current_trackings(workspace, names, fingerprint, face_model)
        if trackings is None:
            trackings = _track(workspace, names, face_model, settings, fingerprint, preview, hold_out)
        else:
            say(f"{', '.join(trackings)}: the tracking is current, nothing to do")
        for name, tracking in trackings.items():
            _write_masks(workspace.sequence_dir(name), name, tracking, face_model, cut)
        if show:
            for name, tracking in trackings.items():
                show_tracking(workspace.sequence_dir(name), tracking, face_model, overlay)
    return trackings


def show_trackings(workspace: Workspace, names: Collection[str], overlay: Overlay) -> None:
    """Write reports and overlays of some tracked sequences, as far as they are missing or outdated."""
    folders = [workspace.sequence_dir(name) for name in names]
    lacking = [folder for folder in folders if not all(_is_shown(folder, read_tracking(folder / "tracking"), overlay))]
    with hold(*lacking):
        for folder in lacking:
            tracking = read_tracking(folder / "tracking")
            show_tracking(folder, tracking, load_face_model(tracking.face_model), overlay)


@contextmanager
def showing_meanwhile(workspace: Workspace, names: Collection[str], overlay: Overlay) -> Iterator[None]:
    """Run `show_trackings` on a thread beside the block, which ends when both have ended. A stop ends both."""
    stop = Put()

    def advance(amount: int = 1, status: str = "") -> None:
        stop.follow()

    with ThreadPoolExecutor(1, "mien-reports", show_no_bars, (advance,)) as pool:
        shown = pool.submit(show_trackings, workspace, names, overlay)
        try:
            yield
        except (KeyboardInterrupt, Terminated):
            stop.ask(signal.SIGINT)
            raise
    shown.result()


def _check_apart(names: Collection[str], hold_out: Collection[str]) -> None:
    """Check that the sequences to track apart exist, and that others remain."""
    unknown = [name for name in hold_out if name not in names]
    if unknown:
        raise UserError(f"--hold-out {unknown[0]}: no such sequence; there are: {', '.join(names)}")
    if set(names) <= set(hold_out):
        raise UserError(f"--hold-out {' '.join(hold_out)}: leaves no sequence that could show the person's shape")


def check_masks(workspace: Workspace, names: Collection[str], cut: Cut) -> None:
    """Check that existing scoring masks have a cut (`check_scoring_cut`)."""
    for name in names:
        folder = workspace.sequence_dir(name)
        try:
            capture_hash = read_capture_hash(folder / "capture")
        except UserError:  # reported when it is read as a whole
            continue
        check_scoring_cut(folder / "scoring", cut, capture_hash)


def _write_masks(folder: Path, name: str, tracking: Tracking, face_model: FaceModel, cut: Cut) -> None:
    """Write the scoring masks of a sequence, if they are missing or outdated."""
    capture_hash = read_capture_hash(folder / "capture")
    if scoring_exists(folder / "scoring", capture_hash):
        return
    if scoring_exists(folder / "scoring"):
        say(f"{name}: the pictures changed, so the scoring mask is made again")
    capture = read_capture(folder / "capture")
    check_tracking_of(capture, tracking, folder / "tracking")
    write_scoring(folder / "scoring", make_scoring(capture, tracking, face_model, folder, cut), capture_hash)


def tracking_fingerprint(
    workspace: Workspace,
    names: list[str],
    face_model: FaceModel,
    settings: TrackingSettings,
    hold_out: Collection[str] = (),
) -> str:
    """Return what trackings of these sequences depend on, as a short text that a tracking holds."""
    captures = [(name, read_capture_hash(workspace.sequence_dir(name) / "capture")) for name in names]
    content = [_TRACKING_RECIPE, captures, face_model.name, face_model.content_hash, asdict(settings.in_effect())]
    content += [sorted(set(hold_out))] if hold_out else []
    content += [_DESCENT_RECIPE] if settings.schedule == "paper" else []
    content += [_TORSO_RECIPE] if has_torso(face_model) else []
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _current_trackings(
    workspace: Workspace, names: list[str], fingerprint: str, face_model: FaceModel, tell: bool = True
) -> dict[str, Tracking] | None:
    """The existing trackings, if they fit these captures and settings. If not, `tell` reports why."""
    found, missing = {}, []
    for name in names:
        folder = workspace.sequence_dir(name) / "tracking"
        if not (folder / "tracking.json").is_file():
            missing.append(name)
            continue
        try:
            found[name] = read_tracking(folder)
            if found[name].face_model_hash == face_model.content_hash:
                check_face_params(face_model, found[name].face, str(folder), "tracking again")
        except UserError as error:
            if tell:
                say(f"{str(error).split('; ')[0]}; tracking again")
            return None
    together = {member for tracking in found.values() for member in tracking.settings.get("tracked_together", [])}
    if not found:
        return None
    if all(tracking.settings.get("fingerprint") == fingerprint for tracking in found.values()):
        # Sequences without a tracking had too few faces, or tracking was stopped before theirs were written.
        return None if set(missing) & together else found
    if not tell:
        return None
    imported = [name for name, tracking in found.items() if "imported" in tracking.settings]
    if imported:
        say(f"{', '.join(imported)}: came with a tracking of its dataset; mien's own takes its place")
        return None
    added = [name for name in missing if name not in together]
    reason = f"{', '.join(added)} added" if added else "captures or settings changed"
    say(f"{reason}: all {len(names)} sequences are tracked again, so that they share one identity" if len(names) > 1
        else "Captures or settings changed since the sequence was tracked: tracking again")  # fmt: skip
    return None


def _track(
    workspace: Workspace,
    names: list[str],
    face_model: FaceModel,
    settings: TrackingSettings,
    fingerprint: str,
    preview: bool,
    hold_out: Collection[str],
) -> dict[str, Tracking]:
    captures = {name: read_capture(workspace.sequence_dir(name) / "capture") for name in names}
    usable = {name: capture for name, capture in captures.items() if has_enough_faces(capture)} or captures
    for name in captures.keys() - usable.keys():
        say(f"{name}: left out, because too few of its frames show a face")
    apart = {name: capture for name, capture in usable.items() if name in hold_out}
    shaping = {name: capture for name, capture in usable.items() if name not in hold_out}
    _check_apart(list(usable), list(apart))
    keep = workspace.root / "sequences" / f".tracking-{fingerprint}"
    for other in workspace.root.glob("sequences/.tracking-*"):
        if other != keep and other.is_dir():
            remove_tree(other)  # kept for other captures or settings
    page = workspace.root / "tracking_preview.html" if preview else None
    if page is not None:
        say(f"Open {page} in a browser to watch the fit")
    if apart:
        say(f"{', '.join(apart)}: tracked apart; the person's shape, texture and light come from {', '.join(shaping)}")
    tracked = track_subject(list(shaping.values()), face_model, settings, keep, page, list(apart.values()))
    by_name, trackings = dict(zip([*shaping, *apart], tracked, strict=True)), {}
    for name, tracking in ((name, by_name[name]) for name in usable):
        made_from: dict[str, object] = {"fingerprint": fingerprint, "tracked_together": list(usable)}
        made_from |= {"held_out": list(apart)} if apart else {}
        trackings[name] = replace(tracking, settings={**tracking.settings, **made_from})
        folder = workspace.sequence_dir(name)
        write_tracking(folder / "tracking", trackings[name])
        (folder / OVERLAY).unlink(missing_ok=True)  # an import's, which shows another tracking
        say(f"{name}: tracked with a median landmark residual of {tracking.residuals.nanmedian():.2f} pixels")
    tell_outdated_runs(workspace, trackings, "the previous tracking")
    return trackings


def tell_outdated_runs(workspace: Workspace, trackings: Mapping[str, Tracking], before: str) -> None:
    """Name the runs that were trained on other trackings of these sequences, those of `before`."""
    outdated = []
    for run in workspace.run_names():
        # A damaged run is reported when it is used.
        with suppress(UserError):
            if outdated_sequences(workspace.run_dir(run), trackings):
                outdated.append(run)
    if outdated:
        say(
            f"Trained on {before}: {', '.join(outdated)}. Such a run can still be rendered, but neither "
            "resumed nor scored; train again under another name (--run NAME), or delete its folder first"
        )


def show_tracking(folder: Path, tracking: Tracking, face_model: FaceModel, overlay: Overlay) -> None:
    """Write the residual report and overlay.mp4, unless they are newer than the tracking."""
    reported, shown = _is_shown(folder, tracking, overlay)
    if reported and shown:
        return
    place, capture = folder / "tracking", read_capture(folder / "capture")
    check_tracking_of(capture, tracking, place)
    if not reported:
        findings = write_residual_report(place, capture, tracking, face_model)
        say(f"{capture.name}: {findings} See {place / 'report.html'}")
    if not shown:
        count, every = len(tracking.valid), _stride(tracking, overlay)
        if every > 1:
            say(f"{capture.name}: the overlay shows one frame in {every} of {count}; `--overlay all` shows them all")
        remove_leftovers(place / "overlay.mp4")
        write_overlay(place / "overlay.mp4", capture, tracking, face_model, every)


def _is_shown(folder: Path, tracking: Tracking, overlay: Overlay) -> tuple[bool, bool]:
    """Whether the residual report and the chosen overlay exist and are newer than the tracking."""
    video, report, written = (folder / "tracking" / name for name in ("overlay.mp4", "report.html", "tracking.json"))
    reported, newer = (path.is_file() and path.stat().st_mtime >= written.stat().st_mtime for path in (report, video))
    frames = len(range(0, len(tracking.valid), _stride(tracking, overlay)))
    return reported, overlay == "none" or (newer and count_frames(video) == frames)


def _stride(tracking: Tracking, overlay: Overlay) -> int:
    """The n for which the overlay shows every n-th frame."""
    return overlay_stride(len(tracking.valid)) if overlay == "auto" else 1
