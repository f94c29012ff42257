"""The loop that draws for all browsers: the newest request wins, half size while anything moves, full size when still.

It knows neither the avatar nor the browser. It calls `draw`, and hands what that returns to `show` of one client. Slow
work of the controls has threads of its own.
"""

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from mien.viewer.drawing import View

STILL_SECONDS = 0.25
"""Time without a change after which a full picture is drawn, in seconds."""
QUICK_SECONDS, SLOW_SECONDS = 0.02, 0.04
"""Times of a full picture in seconds: from below the first on, pictures have full size while something moves, too, and
from above the second on, half size again. Two times keep the size from changing back and forth."""
_NEVER = float("-inf")


@dataclass
class _Client:
    show: Callable[[Any, bool], None]
    view: View | None = None
    wanted: int = 0
    """Number of requests so far."""
    drawn: int = 0
    """Number of requests that the last picture answered."""
    is_full: bool = True
    """Whether the last picture had full size."""
    changed_at: float = _NEVER
    served_at: float = _NEVER


class DrawingLoop:
    """Draws one picture at a time, for the client that has waited longest."""

    def __init__(
        self, draw: Callable[[View, bool], Any], advance: Callable[[float], float | None] | None = None,
        clock: Callable[[], float] = time.monotonic, failed: Callable[[Exception], None] = lambda error: None,
    ) -> None:  # fmt: skip
        """Make a loop that is not running yet.

        `draw` returns the picture of a view, of half size or full size. `advance` is called before each picture with
        the time: it changes what plays, and returns when it wants to be called again, or None. `failed` is called if a
        picture of one client cannot be drawn or shown; it gets none until something changes.
        """
        self._draw, self._advance, self._clock, self._failed = draw, advance, clock, failed
        self._clients: dict[int, _Client] = {}
        self._changed = threading.Condition()
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._full_seconds: float | None = None
        self._is_quick = False
        self.error: BaseException | None = None
        """What ended the loop, if it was not `stop`: a failure that concerns all clients."""

    def add(self, client: int, show: Callable[[Any, bool], None]) -> None:
        """Draw for one more client. `show` takes a picture and whether it is a full one."""
        with self._changed:
            self._clients[client] = _Client(show)

    def remove(self, client: int) -> None:
        """Draw no more for a client. One that is not there is fine."""
        with self._changed:
            self._clients.pop(client, None)

    def look(self, client: int, view: View) -> None:
        """Ask for a picture of a view. An earlier request that was not drawn yet is dropped."""
        with self._changed:
            if client in self._clients:
                self._clients[client].view = view
                self._ask(self._clients[client])

    def change(self) -> None:
        """Ask for new pictures for all clients, because what they show has changed."""
        with self._changed:
            for client in self._clients.values():
                self._ask(client)
            self._changed.notify_all()

    def _ask(self, client: _Client) -> None:
        client.wanted += 1
        client.changed_at = self._clock()
        self._changed.notify_all()

    def step(self) -> float | None:
        """Draw at most one picture. Return the seconds until the next one is due, 0 for now, or None for no one."""
        wake = self._advance(self._clock()) if self._advance is not None else None
        with self._changed:
            now = self._clock()
            due = self._next(now)
            if due is None:
                return self._rest(now, wake)
            key, client, full = due
            view, wanted = client.view, client.wanted
        assert view is not None
        try:
            self._serve(key, client, view, wanted, full)
        except Exception as error:  # noqa: BLE001
            with self._changed:
                client.drawn, client.is_full = wanted, True
            self._failed(error)
        return 0.0

    def _serve(self, key: int, client: _Client, view: View, wanted: int, full: bool) -> None:
        began = self._clock()
        picture = self._draw(view, full)
        ended = self._clock()
        with self._changed:
            self._time((ended - began) * (1.0 if full else 4.0))  # it has four times the pixels
            client.drawn, client.is_full, client.served_at = wanted, full, ended
            there = self._clients.get(key) is client
        if there:
            client.show(picture, full)

    def _next(self, now: float) -> tuple[int, _Client, bool] | None:
        """The client to draw for, and whether its picture has full size: requests first, then full pictures."""
        seen = [(key, client) for key, client in self._clients.items() if client.view is not None]
        waiting = [(key, client) for key, client in seen if client.drawn < client.wanted]
        if waiting:
            key, client = min(waiting, key=lambda item: item[1].served_at)
            return key, client, self._is_quick or now - client.changed_at >= STILL_SECONDS
        still = [item for item in seen if not item[1].is_full and now - item[1].changed_at >= STILL_SECONDS]
        return (*min(still, key=lambda item: item[1].served_at), True) if still else None

    def _time(self, seconds: float) -> None:
        """Take account of the time that a full picture took, or would have taken."""
        before = seconds if self._full_seconds is None else self._full_seconds
        self._full_seconds = 0.5 * seconds + 0.5 * before
        if self._full_seconds < QUICK_SECONDS:
            self._is_quick = True
        elif self._full_seconds > SLOW_SECONDS:
            self._is_quick = False

    def _rest(self, now: float, wake: float | None) -> float | None:
        times = [client.changed_at + STILL_SECONDS for client in self._clients.values() if not client.is_full]
        times += [] if wake is None else [wake]
        return max(0.001, min(times) - now) if times else None

    def start(self) -> None:
        """Draw in a thread of its own, until `stop`."""
        self._thread = threading.Thread(target=self._run, name="mien-viewer", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the thread draws."""
        return self._thread is not None and self._thread.is_alive()

    def wait(self, seconds: float) -> None:
        """Wait until the thread has ended, at most so long."""
        if self._thread is not None:
            self._thread.join(seconds)

    def stop(self) -> None:
        """End the thread after the picture that it is drawing."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        try:
            while True:
                seconds = self.step()
                with self._changed:
                    if self._stopping:
                        return
                    if seconds != 0.0 and self._next(self._clock()) is None:
                        self._changed.wait(seconds)
        except BaseException as error:  # noqa: BLE001
            self.error = error


class Worker:
    """Does slow work of the controls, one thing at a time: pictures and videos to save, motions to load, the camera.

    viser would run it in a queue without a bound, which the process has to empty before it can end.
    """

    def __init__(self, name: str, failed: Callable[[Exception], None], most: int = 1) -> None:
        """Make a worker. `failed` takes an exception of the work, after which it goes on; `most` works may wait."""
        self._name, self._failed, self._most = name, failed, most
        self._changed = threading.Condition()
        self._waiting: dict[Hashable, Callable[[], None]] = {}
        self._busy = self._stopping = False
        self._thread: threading.Thread | None = None

    def ask(self, key: Hashable, work: Callable[[], None]) -> bool:
        """Do some work soon, in place of work with the same key that still waits. False if too much waits already."""
        with self._changed:
            full = len(self._waiting) >= self._most and (self._busy or bool(self._waiting))
            if self._stopping or (full and key not in self._waiting):
                return False
            self._waiting[key] = work
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
            self._changed.notify()
        return True

    def stop(self) -> None:
        """Drop what waits, and wait a moment for what runs."""
        with self._changed:
            self._stopping = True
            self._waiting.clear()
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(2.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.wait_for(lambda: bool(self._waiting) or self._stopping)
                if self._stopping:
                    return
                work = self._waiting.pop(next(iter(self._waiting)))
                self._busy = True
            try:
                work()
            except Exception as error:  # noqa: BLE001
                self._failed(error)
