"""Another process that holds locks, for tests of two commands at once."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_SCRIPT = """
import json, sys
from pathlib import Path
from mien.disk.locks import hold
for line in sys.stdin:
    with hold(*map(Path, json.loads(line))):
        print("held", flush=True)
        sys.stdin.readline()
    print("free", flush=True)
"""


class Holder:
    """A process that holds the locks that it is given."""

    def __init__(self) -> None:
        command = [sys.executable, "-c", _SCRIPT, "--an-option"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.pid = self.process.pid

    @contextmanager
    def holding(self, *places: Path) -> Iterator[None]:
        self._ask(json.dumps(list(map(str, places))), "held")
        try:
            yield
        finally:
            if self.process.poll() is None:
                self._ask("", "free")

    def _ask(self, line: str, answer: str) -> None:
        assert self.process.stdin
        assert self.process.stdout
        print(line, file=self.process.stdin, flush=True)
        assert self.process.stdout.readline() == f"{answer}\n"

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()
