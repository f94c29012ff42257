"""Start command lines as forks of a process that has imported everything."""

import json
import os
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

TESTS = str(Path(__file__).parent.parent)


class Server:
    """Client of `fuzzing.command_server`."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fuzzing.command_server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, "PYTHONPATH": TESTS},
        )

    def start(self, request: dict[str, Any]) -> int:
        """Start a command, and return the number of its process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        return int(self._process.stdout.readline())

    def ended(self, seconds: float) -> bool:
        """Wait at most so long for the command that was started last; return whether it has ended."""
        assert self._process.stdout is not None
        return bool(select.select([self._process.stdout], [], [], seconds)[0])

    def result(self) -> tuple[int, int]:
        """Return the exit code of the command that has ended, and the most megabytes that it took."""
        assert self._process.stdout is not None
        code, megabytes = json.loads(self._process.stdout.readline())
        return code, megabytes

    def close(self) -> None:
        """Stop the server."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
