"""Run command lines in forks of a process that has imported everything, so that they start at once.

A request is a line of json. The server forks, and answers with the process's number and then with its exit. The child
returns to the bottom of this file, so that it ends as any Python program does, with its output flushed.
"""

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import gc
import json
import resource
import signal
import sys
from pathlib import Path
from typing import Any

from forked import end_after


def apply_limits(request: dict[str, Any]) -> None:
    """Set the limits and streams of a request in the process that will run it."""
    os.setpgid(0, 0)
    os.chdir(request["folder"])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for name, limit in (("largest_file", resource.RLIMIT_FSIZE), ("open_files", resource.RLIMIT_NOFILE)):
        if name in request:
            resource.setrlimit(limit, (request[name], request[name]))
    if "memory" in request:
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + request["memory"], size + request["memory"]))
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        where = request[name]
        if where == "closed":
            os.close(number)
        else:
            os.dup2(
                os.open(where, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), number
            )


def _broken_pipe() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    os.dup2(writing, 1)


def prepare(request: dict[str, Any]) -> None:
    """Turn this process into the one that a request asks for."""
    os.environ.clear()
    os.environ.update(request["env"])
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell starts in the background
    broken = request["stdout"] == "broken"
    apply_limits({**request, "stdout": os.devnull if broken else request["stdout"]})
    if broken:
        _broken_pipe()
    sys.argv = ["mien", *request["words"]]


def _serve() -> bool:
    """Answer requests. Return True in a child, which has become the requested process."""
    requests, answers = os.fdopen(os.dup(0), "rb"), os.dup(1)
    while line := requests.readline():
        child = os.fork()
        if child == 0:
            requests.close()
            os.close(answers)
            prepare(json.loads(line))
            return True
        os.write(answers, f"{child}\n".encode())
        _, status, usage = os.wait4(child, 0)
        os.write(answers, f"{json.dumps([os.waitstatus_to_exitcode(status), usage.ru_maxrss // 1024])}\n".encode())
    return False


def _import_everything() -> None:
    import tempfile

    import fuzzing.uses  # noqa: F401
    import mien.commands.stages.driving
    import mien.commands.stages.evaluating
    import mien.commands.stages.pictures  # noqa: F401

    tempfile.tempdir = None


if __name__ == "__main__":
    _import_everything()
    gc.freeze()
    if _serve():
        from mien.cli import main

        end_after(main)
