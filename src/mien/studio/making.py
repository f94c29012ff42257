"""The queue of a studio: avatars are made one at a time, each by `mien create` in a process of its own.

It is a batch of one row for each person (`mien.batch`), in DIR/.studio. A row's process stops when the studio ends,
however that ends, and the commands of a row continue where they stopped. So the next studio goes on with the queue.
"""

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mien.avatar.methods import DEFAULT_METHOD, has_method, method_names
from mien.batch.plan import Batch, Options, Row, State, with_fingerprint
from mien.batch.progress import Stage, stage_of
from mien.batch.row import attempt, stop_attempts
from mien.disk.config import decode
from mien.disk.reading import remove_tree
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.studio.people import People

QUALITIES = ("draft", "standard", "fine")
"""The presets that a page offers; those of papers take days."""
_SHARES = {"capture": 18, "tracking": 80, "alignment": 83, "training": 290, "scoring": 28, "": 8}
"""Seconds of each stage of `standard` on 400 frames, two cores (docs/results.md); "" is film and file at the end."""
_TRAININGS = {"draft": 190, "fine": 560}
"""The same for the trainings of other presets."""
_KNOWN_SHARE, _KNOWN_SECONDS = 0.04, 30.0
"""How much of the work, and how long, this attempt must have taken before its own pace says how long the rest takes."""
_MOST_THREADS = 256
_SHOULDERS = ("--face-model", "anny-bust")


@dataclass(frozen=True)
class Settings:
    """What a person may choose for an avatar."""

    quality: str = "standard"
    method: str = DEFAULT_METHOD
    shoulders: bool = False
    threads: int = 0
    """Threads of the computation; 0 takes all."""
    keep_film: bool = True
    """Whether the film and its frames stay after the avatar is made."""

    @staticmethod
    def of(content: Mapping[str, Any]) -> "Settings":
        """The settings that a page or a note has. What is missing has its default."""
        return decode(Settings, {**asdict(Settings()), **content}, "settings", "choose again")

    def check(self) -> None:
        """Check that all values are possible."""
        if self.quality not in QUALITIES:
            raise UserError(f"quality {self.quality!r:.40}: give one of {', '.join(QUALITIES)}")
        if not has_method(self.method):
            raise UserError(f"method {self.method!r:.40}: give one of {', '.join(method_names())}")
        if not 0 <= self.threads <= _MOST_THREADS:
            raise UserError(f"threads {self.threads}: give 0 to {_MOST_THREADS}")


@dataclass(frozen=True)
class Progress:
    """How far an avatar is."""

    state: str
    """new, waiting, making, stopped, failed or done."""
    stage: Stage | None = None
    seconds_left: int | None = None
    """None if it is not known yet."""
    error: str = ""
    before: int = 0
    """How many others are made first."""


class Pace:
    """How fast the work of an attempt goes."""

    def __init__(self, quality: str, usual: float | None, began: tuple[float, float] | None) -> None:
        """Begin an attempt. `usual` has the seconds of all work; `began` when it began, and the share done by then."""
        self._usual = usual
        self._shares = {**_SHARES, "training": _TRAININGS.get(quality, _SHARES["training"])}
        self._began = began
        self._done = 0.0

    def seconds_left(self, stage: Stage | None, now: float) -> int | None:
        """Seconds until the end; None if that is not known yet. What was done in earlier attempts says nothing."""
        whole, names = sum(self._shares.values()), list(self._shares)
        if stage is not None and stage.name and stage.name in names:
            before = sum(self._shares[name] for name in names[: names.index(stage.name)])
            now_done = before + self._shares[stage.name] * (stage.percent or 0) / 100
            # A stage has several bars, so its percentage goes back to 0.
            self._done = max(self._done, now_done / whole)
        if self._began is None:
            self._began = (now, self._done)
        began, first = self._began
        if self._done - first >= _KNOWN_SHARE and now - began >= _KNOWN_SECONDS:
            return round((1 - self._done) / (self._done - first) * (now - began))
        return None if self._usual is None else round((1 - self._done) * self._usual)


class Maker:
    """Makes the avatars of the queue, one after the other, in a thread of its own."""

    def __init__(self, people: People, program: Sequence[str] = Options().words_of_program()) -> None:
        """Take the queue of a folder. `program` is the command of a row's process."""
        self.people, self._program = people, program
        self.batch = Batch(people.root / ".studio")
        self._change, self._wake = threading.Lock(), threading.Event()
        self._running: str | None = None
        self._printed = 0  # bytes of the log before this attempt
        self._pace: Pace | None = None
        self._faults: dict[str, str] = {}
        self._ended = False
        if not (self.batch.root / "plan.json").is_file():
            self.batch.write_plan([])
        self._queue = [row for row in self.batch.read_plan() if row.name in people.names()]
        self._thread = threading.Thread(target=self._work, daemon=True)

    def start(self) -> None:
        """Go on with the queue."""
        self._thread.start()

    def end(self) -> None:
        """Stop what runs; the queue stays for the next studio."""
        self._ended = True
        self._wake.set()
        while self._thread.is_alive():
            stop_attempts()
            self._thread.join(0.2)

    def add(self, name: str, settings: Settings) -> None:
        """Put a person at the end of the queue. What was stopped goes on."""
        settings.check()
        films = [film.name for film in self.people.films(name) if film.whole]
        if not films:
            raise UserError(f"{name}: there is no film yet; film first")
        row = self._row(name, films, settings)
        if Settings.of(self.people.read(name).get("settings", {})).shoulders != settings.shoulders:
            for masks in self.people.folder(name).glob("sequences/*/scoring"):
                remove_tree(masks)  # An avatar with shoulders is scored on other pixels.
        self.people.write(name, settings=asdict(settings))
        self._faults.pop(name, None)
        with self._change:
            if any(each.name == name for each in self._queue):
                raise UserError(f"{name}: is being made, or waits for it; stop that first")
            self._queue.append(row)
            self.batch.write_plan(self._queue)
        self._wake.set()

    def drop(self, name: str) -> None:
        """Take a person out of the queue, and stop the work on them. Returns when it has stopped."""
        with self._change:
            self._queue = [row for row in self._queue if row.name != name]
            self.batch.write_plan(self._queue)
        while self._running == name:  # a row's process ends by force after ten seconds
            stop_attempts()
            time.sleep(0.05)

    def forget(self, name: str) -> None:
        """Remove what the queue knows of a person. They are not in it any more."""
        for path in (self.batch.state_file(name), self.batch.log_file(name), self.growing(name)):
            path.unlink(missing_ok=True)

    def growing(self, name: str) -> Path:
        """The file of the avatar while it trains."""
        return self.batch.place("growing", f"{name}.mien")

    def progress(self, name: str) -> Progress:
        """How far the avatar of a person is."""
        with self._change:
            queue = [row.name for row in self._queue]
        if name in queue and name == self._running:
            stage, pace = stage_of(self.batch.log_file(name), self._printed), self._pace
            return Progress("making", stage, pace.seconds_left(stage, time.monotonic()) if pace else None)
        if name in queue:
            return Progress("waiting", before=queue.index(name))
        state = self.batch.read_state(name)
        if name in self._faults:
            return Progress("failed", error=self._faults[name])
        if state is None:
            return Progress("done" if self.run_of(name) else "new")
        stage = stage_of(self.batch.log_file(name)) if state.status != "done" else None
        words = {"running": "stopped", "failed": "failed", "done": "done"}
        return Progress(words[state.status], stage, error=state.error)

    def run_of(self, name: str) -> str | None:
        """The name of the run whose avatar was written last; None if there is none."""
        workspace = Workspace(self.people.folder(name))
        folders = [workspace.run_dir(run) / "avatar" for run in workspace.run_names()]
        whole = [folder for folder in folders if folder.is_dir() and (folder.parent / "training.json").is_file()]
        return max(whole, key=lambda folder: folder.stat().st_mtime).parent.name if whole else None

    def _row(self, name: str, films: Sequence[str], settings: Settings) -> Row:
        folder = self.people.folder(name).resolve()
        paths = [folder / "films" / film for film in films]
        # A run keeps its settings and sequences, so others make another run.
        numbers = "_".join(film[5:].partition(".")[0] for film in films)
        run = f"{settings.quality}_{settings.method}_{numbers}{'_shoulders' * settings.shoulders}"
        choices = ("--preset", settings.quality, "--method", settings.method, "--run", run)
        create = ("create", *map(str, paths), "--out", str(folder), *choices)
        create += ("--growing", str(self.growing(name).resolve()), "--preview", *_SHOULDERS * settings.shoulders)
        export = ("export", str(folder), "--run", run, "--out", str(folder / "me.mien"))
        return with_fingerprint(Row(name, (create, export), {"quality": settings.quality}), paths)

    def _work(self) -> None:
        while not self._ended:
            with self._change:
                row = self._queue[0] if self._queue else None
                self._running = None if row is None else row.name
            if row is None:
                self._wake.wait()
                self._wake.clear()
                continue
            try:
                self._make(row)
            except Exception as error:  # the disk is full, or the folder is gone; the others are made all the same
                self._faults[row.name] = f"{error}"
                self._conclude(row, None)
            finally:
                self._running = None

    def _make(self, row: Row) -> None:
        log = self.batch.log_file(row.name)
        self._printed = log.stat().st_size if log.is_file() else 0
        settings = Settings.of(self.people.read(row.name).get("settings", {}))
        self.growing(row.name).parent.mkdir(exist_ok=True)
        self.growing(row.name).unlink(missing_ok=True)
        began = None if self._printed else (time.monotonic(), 0.0)  # an earlier attempt has done a part
        self._pace = Pace(settings.quality, self._usual(settings.quality), began)
        state = attempt(self.batch.root, self._program, settings.threads or None, row)
        if self._ended or not any(each is row for each in self._queue):
            return  # stopped by the end of the studio, or by a person
        if state is None:
            time.sleep(1.0)  # the process of a studio that was killed is about to end
            return
        if state.status == "done" and not settings.keep_film:
            self.people.drop_footage(row.name)
        self._conclude(row, state)

    def _conclude(self, row: Row, state: State | None) -> None:
        """Take a row that has ended out of the queue."""
        with self._change:
            self._queue = [each for each in self._queue if each is not row]
            with suppress(UserError, OSError):
                self.batch.write_plan(self._queue)
        if state is not None and state.status == "done":
            with suppress(UserError, OSError):
                self.people.write(row.name, took={row.labels["quality"]: round(state.seconds)})

    def _usual(self, quality: str) -> float | None:
        """How many seconds an avatar of that quality took here at the most; None if there is none."""
        took = (self.people.read(name).get("took", {}).get(quality) for name in self.people.names())
        return max((float(seconds) for seconds in took if seconds is not None), default=None)
