"""Commands in processes of their own that start at once: forks of a server that has imported torch and the commands.

For tests about processes: signals, kills, two commands at the same time. A process has no checks of types, as at users.
Start-up, missing packages and other interpreters need a process that Python starts anew."""

import atexit
import gc
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any


class Forked:
    """A process with its output in files, which behaves as `subprocess.Popen` where tests need it."""

    def __init__(self, pid: int, folder: Path):
        self.pid, self._folder = pid, folder

    @property
    def stdout(self) -> str:
        """The text that the process has printed until now."""
        return (self._folder / "stdout").read_text(encoding="utf-8", errors="replace")

    @property
    def stderr(self) -> str:
        """The text that the process has written to standard error until now."""
        return (self._folder / "stderr").read_text(encoding="utf-8", errors="replace")

    def poll(self) -> int | None:
        """Return the exit code, or minus the number of the signal that ended the process; None while it runs."""
        ended = self._folder / "ended"
        return int(ended.read_text()) if ended.exists() else None

    def wait(self, timeout: float = 600) -> int:
        """Wait for the end, and return what `poll` does. A process that runs for `timeout` seconds is killed."""
        for _ in range(round(100 * timeout)):
            if (code := self.poll()) is not None:
                return code
            time.sleep(0.01)
        self.kill()
        raise TimeoutError(f"process {self.pid} has not ended:\n{self.stdout}\n{self.stderr}")

    def send_signal(self, number: int) -> None:
        """Send a signal, if the process still runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """A server for one worker. `with ForkServer() as server: server.mien("train", "out").wait()`."""

    def __enter__(self) -> "ForkServer":
        self._folder = Path(tempfile.mkdtemp(prefix="mien-forks-"))
        places = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
        self._server = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self._count = 0
        return self

    def __exit__(self, *_: object) -> None:
        self._server.kill()
        self._server.communicate()
        shutil.rmtree(self._folder, ignore_errors=True)

    def mien(self, *words: object, **options: Any) -> Forked:
        """Start `mien WORDS`; options are those of `call`."""
        return self.call("mien.cli:main", list(map(str, words)), exits=True, **options)

    def call(
        self, function: str, *arguments: Any, cwd: Path | None = None, env: dict[str, str] | None = None,
        path: Sequence[Path] = (), exits: bool = False,
    ) -> Forked:  # fmt: skip
        """Start a process that calls a function, as in "module:name", with arguments that json can carry.
        Modules of tests are found, and those in the folders of `path`. Without `cwd`, its folder is that of the tests,
        and the variables of `env` are set on top of today's. `exits` says that what it returns is the exit code."""
        self._count += 1
        folder = self._folder / str(self._count)
        folder.mkdir()
        for stream in ("stdout", "stderr"):
            (folder / stream).touch()
        request = {"function": function, "arguments": arguments, "cwd": str(cwd or Path.cwd()), "exits": exits}
        request |= {"env": {**os.environ, **(env or {})}, "folder": str(folder), "path": list(map(str, path))}
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        print(json.dumps(request), file=self._server.stdin, flush=True)
        return Forked(int(self._server.stdout.readline()), folder)


def run_forked(server: ForkServer, *words: object, **options: Any) -> "subprocess.CompletedProcess[str]":
    """Run `mien WORDS` to its end, and return its exit code and output."""
    process = server.mien(*words, **options)
    code = process.wait()
    return subprocess.CompletedProcess(list(map(str, words)), code, process.stdout, process.stderr)


def _serve() -> None:
    """Fork a process for each line of json on stdin, and answer with its number."""
    folders: dict[int, Path] = {}

    def reap(*_: object) -> None:
        while folders:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            aside = folders[pid] / "ending"
            aside.write_text(str(os.waitstatus_to_exitcode(status)))
            aside.rename(folders.pop(pid) / "ended")

    signal.signal(signal.SIGCHLD, reap)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.dup(1)
    while line := sys.stdin.readline():
        request = json.loads(line)
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])
        pid = os.fork()
        if pid == 0:
            os.close(answers)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup lets the server ignore it
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
            _become(request)
        folders[pid] = Path(request["folder"])
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
        os.write(answers, f"{pid}\n".encode())


def _become(request: dict[str, Any]) -> None:
    """Turn this fork into the requested process, and end it as Python ends."""
    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["cwd"])
    sys.path[:0] = request["path"]
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(Path(request["folder"]) / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), number)
    sys.argv = ["mien", *map(str, request["arguments"][0])] if request["exits"] else [request["function"]]
    module, name = request["function"].split(":")
    try:
        result = getattr(importlib.import_module(module), name)(*request["arguments"])
        _end(result if request["exits"] else 0)
    except SystemExit as stop:
        _end(stop.code)
    except KeyboardInterrupt:
        traceback.print_exc()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:
        traceback.print_exc()
        _end(1)


def _end(code: object) -> None:
    """End as Python does, but without the removal of all objects, which takes a second."""
    if not isinstance(code, int | None):
        print(code, file=sys.stderr)
        code = 1
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            code = 120
    os._exit(code or 0)


if __name__ == "__main__":
    for each in ("drive", "evaluate", "export", "draw", "train"):
        importlib.import_module(f"mien.pipeline.{each}")
    for each in ("mien.cli", "mien.avatar.gaussian_avatars.avatar", "tyro"):
        importlib.import_module(each)
    tempfile.tempdir = None
    gc.freeze()
    _serve()
