"""A studio for tests: its server, requests of a browser, and a stand-in for the process that makes an avatar."""

import http.client
import json
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mien.batch.plan import Batch, Row
from mien.batch.row import RowFailedError, do_steps, row_process
from mien.cli import main
from mien.studio.making import Maker
from mien.studio.people import People
from mien.studio.server import Serving

STUB = (sys.executable, str(Path(__file__).resolve()))
SHORT = (*STUB, "short")
"""The program that makes an avatar by `mien create` itself, in few steps."""


@contextmanager
def studio(root: Path, program: Sequence[str] | None = STUB, **more: Any) -> Iterator[Serving]:
    """Serve a folder. Avatars are made by `make_stub`, in processes of their own, or by mien if `program` is None."""
    root.mkdir(exist_ok=True)
    serving = Serving(root, maker=None if program is None else Maker(People(root), program), **more)
    try:
        yield serving
    finally:
        serving.stop()


def asked(
    serving: Serving, method: str, path: str, body: Any = None, *, port: int = 0, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """Send a request as the studio's page does. `headers` replace its own; those with an empty text are left out."""
    to = port or serving.port
    given = {"Host": f"127.0.0.1:{to}", "Cookie": serving.door.cookie, "Origin": f"http://127.0.0.1:{to}"}
    if isinstance(body, dict | list):
        body, given["Content-Type"] = json.dumps(body).encode(), "application/json"
    given |= {name.replace("_", "-"): value for name, value in headers.items()}
    host = "127.0.0.1" if not port or serving.phones is None else serving.phones.address.split("//")[1].split(":")[0]
    connection = http.client.HTTPConnection(host, to, timeout=120)
    connection.request(method, path, body, {name: value for name, value in given.items() if value})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}, content


def told(serving: Serving, method: str, path: str, body: Any = None, **more: Any) -> tuple[int, Any]:
    status, _, content = asked(serving, method, path, body, **more)
    return status, json.loads(content)


def person(name: str, *more: str) -> str:
    return "/".join(("/api/people", quote(name, safe=""), *more))


def give_film(people: People, name: str, film: Path) -> None:
    """Add a person who has a film."""
    if name not in people.names():
        people.add(name)
    begun = people.begin_film(name, film.suffix[1:])
    people.append(name, begun, 0, film.read_bytes())
    people.finish_film(name, begun)


def make_stub(batch: Batch, row: Row) -> tuple[tuple[dict[str, Any], ...], dict[str, float]]:
    """Stand in for `mien create`: say a stage, and wait for the file `go` beside the queue. Bad's film fails."""
    create, _ = row.steps
    print(f"stage 4 of 5 (training)\ntraining: 1200/6000 in 30 s, ETA 90 s\n{create}", flush=True)
    grown = batch.root / "grown.mien"
    if grown.is_file():
        shutil.copyfile(grown, create[create.index("--growing") + 1])
    if row.name == "Bad":
        raise RowFailedError("film_1.mp4: no face is found in any frame; give a video that shows a face clearly")
    while not (batch.root / "go").exists():
        time.sleep(0.05)
    run = Path(create[create.index("--out") + 1]) / "runs" / create[create.index("--run") + 1]
    (run / "avatar").mkdir(parents=True, exist_ok=True)
    for name in ("config.json", "training.json"):
        (run / name).write_text("{}")
    return (), {}


def make_short(batch: Batch, row: Row) -> tuple[tuple[dict[str, Any], ...], dict[str, float]]:
    """Make an avatar by the commands of a row, in few steps."""
    create, export = row.steps
    few = ("--steps", "60", "--alignment.when", "always")
    return do_steps(main, batch, replace(row, steps=((*create, *few), export)))


if __name__ == "__main__":
    makes = make_short if "short" in sys.argv else make_stub
    sys.exit(row_process(Path(sys.argv[-1]), sys.stdin, makes))
