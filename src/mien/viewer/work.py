"""Slow work of the controls, in threads of its own: pictures and videos to save, motions to load, the camera.

viser would run such work in a queue without a bound, which the process has to empty before it can end.
"""

import threading
from collections.abc import Callable, Hashable


class Worker:
    """Does one thing at a time, in a thread that does not keep the process from ending."""

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
