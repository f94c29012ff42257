"""Runs command lines in processes that are forked off one that has imported everything: as real ones, but at once.

Reads a request as a line of json, forks, and answers with the process's number, then with how it ended. The child
comes back to the bottom of this file, so that it ends as any Python program does: with what is flushed at the end.
"""

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import json
import resource
import sys
from pathlib import Path
from typing import Any


def apply_limits(request: dict[str, Any]) -> None:
    """Limits and streams of a request, in the process that is to run it."""
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
    """Become the process that a request asks for."""
    os.environ.clear()
    os.environ.update(request["env"])
    broken = request["stdout"] == "broken"
    apply_limits({**request, "stdout": os.devnull if broken else request["stdout"]})
    if broken:
        _broken_pipe()
    sys.argv = ["mien", *request["words"]]


def _serve() -> bool:
    """Answer requests; true in a child, which has become what was asked for."""
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
    if _serve():
        from mien.cli import main

        sys.exit(main())
