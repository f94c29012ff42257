"""The studio's server: who may use it, what it takes, its queue across ends and kills, and films from phones."""

import os
import re
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

pytest.importorskip("starlette")

from mien import runtime
from mien.batch.progress import Stage
from mien.cli import main
from mien.disk.files import write_arrays, write_json
from mien.studio import people as people_on_disk
from mien.studio.advice import advice, advice_for
from mien.studio.making import Maker, Pace, Settings
from mien.studio.people import FullError, People
from mien.studio.server import Serving
from mien.studio.taking import TAKINGS
from refusals import complaint, refuses
from studio_case import STUB, asked, give_film, person, studio, told
from web_case import drawn_head, until


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[Serving]:
    with studio(tmp_path / "people") as running:
        yield running


@pytest.fixture(scope="module")
def film(test_data: Path) -> Path:
    return test_data / "cases" / "plain.mp4"


def state_of(serving: Serving, name: str) -> str:
    return told(serving, "GET", person(name))[1]["progress"]["state"]


def test_strangers_are_refused_and_the_server_lives(serving: Serving) -> None:
    own = f"127.0.0.1:{serving.port}"
    for method, path in (("GET", "/"), ("GET", "/api/people"), ("POST", "/api/people"), ("DELETE", person("Ada"))):
        for headers in (
            {"Cookie": ""}, {"Cookie": serving.door.cookie[:-1]}, {"Host": "evil.example", "Origin": "http://evil.example"},
            {"Host": "evil.example", "Origin": ""}, {"Host": "127.0.0.1:80"},
            {"Host": f"127.0.0.1.evil.example:{serving.port}"}, {"Origin": "http://evil.example"}, {"Origin": "null"},
            {"Origin": f"https://{own}"[:-1]}, {"Host": f"localhost:{serving.port}"},
        ):  # fmt: skip
            given: Any = {} if method == "POST" else None
            assert asked(serving, method, path, given, port=0, **headers)[0] == 403, headers
    assert asked(serving, "GET", "/?token=wrong", Cookie="")[0] == 403
    status, headers, _ = asked(serving, "GET", f"/?token={serving.door.token}", Cookie="", Origin="")
    assert (status, "HttpOnly" in headers["set-cookie"]) == (303, True)
    for raw in (
        b"\x00\xff\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"POST /api/people HTTP/1.1\r\nContent-Length: -4\r\n\r\n",
    ):
        with socket.create_connection(("127.0.0.1", serving.port), 10) as stranger:
            stranger.sendall(raw)
    status, headers, page = asked(serving, "GET", "/")
    assert status == 200
    assert b"<title>mien studio</title>" in page
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe-inline" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert not re.findall(rb"(?:src|href)=.?https?:", page), "the page loads nothing from elsewhere"


def test_hostile_names_paths_and_sizes_go_nowhere(serving: Serving, tmp_path: Path, film: Path) -> None:
    add = {"agreed": True}
    for name in ("", "..", ".studio", "../x", "a/b", "a\\b", "-rf", "x" * 61, "a\nb", "{workspace}", "a.", 7, None):
        assert told(serving, "POST", "/api/people", {"name": name, **add})[0] == 400, name
    assert [each.name for each in (tmp_path / "people").iterdir()] == [".studio"]
    assert told(serving, "POST", "/api/people", {"name": "Ada"}) == (
        400, {"error": "the person has to agree before the first recording; ask, and confirm it"}
    )  # fmt: skip
    assert told(serving, "POST", "/api/people", {"name": "Zoë O'Neil-2", **add})[0] == 200
    assert told(serving, "POST", "/api/people", {"name": "zoë o'neil-2", **add})[0] == 400, "the same on some disks"
    zoe, outside = person("Zoë O'Neil-2"), tmp_path / "secret.txt"
    outside.write_text("secret")
    (tmp_path / "people" / "linked").symlink_to(tmp_path)
    for path in (
        "/../secret.txt", "/%2e%2e/secret.txt", f"{zoe}/films/..%2f..%2fsecret.txt", f"{zoe}/take/..%2fsecret",
        f"{zoe}/films/film_1.mp4", person("linked"), person(".studio"), person(".."), "/landmarker/..%2fx", "/nowhere",
    ):  # fmt: skip
        assert asked(serving, "GET", path)[0] in (400, 404), path
    for ending in ("html", "mp4/../../x", "", "exe"):
        assert told(serving, "POST", f"{zoe}/films", {"ending": ending})[0] == 400
    assert asked(serving, "POST", f"{zoe}/films", b'{"ending": "mp4"}', Content_Type="text/plain")[0] == 400
    assert asked(serving, "POST", f"{zoe}/films", b"[" * 9000, Content_Type="application/json")[0] == 400
    assert asked(serving, "POST", f"{zoe}/films", b" " * 20_000, Content_Type="application/json")[0] == 507
    assert told(serving, "POST", f"{zoe}/films", {"ending": "mp4"}) == (200, {"film": "film_1.mp4"})
    part = f"{zoe}/films/film_1.mp4"
    for at, size, status in (("1", 5, 409), ("x", 5, 400), ("-1", 5, 400), ("9" * 16, 5, 400), ("9" * 12, 5, 507)):
        assert told(serving, "PUT", f"{part}?at={at}", b"." * size)[0] == status, at
    assert told(serving, "PUT", f"{part}?at=0", b"." * ((8 << 20) + 1))[0] == 507
    assert told(serving, "PUT", f"{part}?at=0", b"a text") == (200, {"size": 6})
    assert told(serving, "PUT", f"{part}?at=0", b"a text")[0] == 409, "sent twice"
    assert [(each["name"], each["whole"]) for each in told(serving, "GET", zoe)[1]["films"]] == [("film_1.mp4", False)]
    status, answer = told(serving, "POST", part, {})
    assert (status, answer["error"][:20]) == (400, "this is no film that")
    assert told(serving, "GET", zoe)[1]["films"] == [], "a text named .mp4 is removed"
    assert told(serving, "PUT", f"{zoe}/face", b"<svg onload=alert(1)>")[0] == 400
    assert told(serving, "POST", f"{zoe}/making", {})[1]["error"].endswith("there is no film yet; film first")
    for wrong in ({"quality": "paper"}, {"method": "--out"}, {"threads": -1}, {"threads": "2"}, {"out": "/"}):
        assert told(serving, "POST", f"{zoe}/making", wrong)[0] == 400, wrong
    assert outside.read_text() == "secret"
    assert state_of(serving, "Zoë O'Neil-2") == "new"


def test_a_film_arrives_in_pieces_and_a_closed_tab_loses_nothing(serving: Serving, film: Path) -> None:
    content, ada = film.read_bytes(), person("Ada")
    assert told(serving, "POST", "/api/people", {"name": "Ada", "agreed": True})[0] == 200
    _, begun = told(serving, "POST", f"{ada}/films", {"ending": "mp4"})
    _, other = told(serving, "POST", f"{ada}/films", {"ending": "mp4"})
    assert [begun["film"], other["film"]] == ["film_1.mp4", "film_2.mp4"], "two tabs"
    half = len(content) // 2
    for at, piece in ((0, content[:half]), (half, content[half:])):
        assert told(serving, "PUT", f"{ada}/films/film_1.mp4?at={at}", piece)[0] == 200
    assert told(serving, "GET", f"{ada}/films/film_1.mp4")[0] == 404, "it is not whole"
    status, facts = told(serving, "POST", f"{ada}/films/film_1.mp4", {})
    assert (status, facts["width"], facts["height"]) == (200, 320, 320)
    assert told(serving, "POST", f"{ada}/films/film_1.mp4", {})[0] == 404
    status, headers, played = asked(serving, "GET", f"{ada}/films/film_1.mp4", Range="bytes=0-9")
    assert (status, played) == (206, content[:10])
    assert headers["content-security-policy"].startswith("sandbox")
    assert told(serving, "DELETE", f"{ada}/films/film_2.mp4")[0] == 200
    assert [each["whole"] for each in told(serving, "GET", ada)[1]["films"]] == [True]


def test_a_full_disk_is_said_and_leaves_what_came_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    people = People(tmp_path)
    people.add("Ada")
    name = people.begin_film("Ada", "webm")
    people.append("Ada", name, 0, b"before")
    usage = people_on_disk.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(people_on_disk.shutil, "disk_usage", lambda _: usage._replace(free=1 << 30))
    with pytest.raises(FullError, match="the disk is full; free 2 GB"):
        people.append("Ada", name, 6, b"more")
    monkeypatch.undo()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8, hard))
    try:
        refuses("free disk space", people.append, "Ada", name, 6, b"more")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    (film,) = people.films("Ada")
    assert (film.size, film.whole, film.coming) == (6, False, True)
    os.utime(tmp_path / "Ada" / "films" / f".{name}.part", (1, 1))
    assert not people.films("Ada")[0].coming


def test_a_film_of_two_gigabytes_is_taken_and_one_of_five_is_not(tmp_path: Path, film: Path) -> None:
    people = People(tmp_path)
    people.add("Ada")
    name, size = people.begin_film("Ada", "mp4"), 2 << 30
    people.append("Ada", name, 0, film.read_bytes())
    os.truncate(tmp_path / "Ada" / "films" / f".{name}.part", size)  # it takes no room on most disks
    assert people.append("Ada", name, size, b"\0") == size + 1
    assert people.finish_film("Ada", name)["width"] == 320
    other = people.begin_film("Ada", "mp4")
    refuses("is larger than 4 GB", people.append, "Ada", other, 4 << 30, b"more")


STRANGE = (
    "..", "%2e%2e", "../..", "..\\..", ".studio", "/etc/passwd", "Ada/../../x", "Ada\0", "A" * 4000,
    "\N{FOX FACE}" * 80, "Ada\u202e", "-rf", "linked", "{workspace}", " ", "film_1.mp4/..", ".film_1.mp4.part",
    "film_1.exe", "nobody",
)  # fmt: skip
BODIES = (b"", b"{", b"[" * 9000, b"\xff\xfe", b'{"name": 7}', b'{"out": "/"}', b" " * 20_000, b'["name"]', b"null")


def test_two_hundred_hostile_requests_are_refused_and_change_nothing(serving: Serving, tmp_path: Path) -> None:
    people, random, own = serving.maker.people, Random(7), person("Ada")
    people.add("Ada")
    people.append("Ada", people.begin_film("Ada", "mp4"), 0, b"begun")
    (people.root / "linked").symlink_to(tmp_path)

    def on_disk() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    before, token = on_disk(), serving.door.cookie
    for number in range(200):
        name = quote(random.choice(STRANGE), safe=random.choice(("", "/")))
        film, method = f"{own}/films/film_1.mp4", random.choice(("GET", "PUT", "POST", "DELETE", "PATCH", "TRACE"))
        path = random.choice(
            (f"/api/people/{name}", f"{own}/films/{name}", f"{own}/take/{name}", f"/landmarker/{name}")
        )
        body: bytes = random.choice(BODIES)
        headers: dict[str, Any] = {"Content_Type": "application/json"}
        if number % 4 == 1:  # without the token
            path, method = random.choice(("/", "/api/people", own, film)), random.choice(("GET", "POST", "DELETE"))
            headers["Cookie"] = random.choice(("", token[:-1], f"{token}x", "mien_=", token.partition("=")[0] + "="))
        elif number % 4 == 2:  # from a page of another site, or under another name
            path, method = random.choice(("/", "/api/people", own, film)), random.choice(("GET", "POST", "DELETE"))
            host = random.choice(
                ("evil.example", f"127.0.0.1.evil.example:{serving.port}", f"127.0.0.1:{serving.port}")
            )
            headers |= {"Host": host, "Origin": random.choice(("null", "http://evil.example", "https://127.0.0.1"))}
        elif number % 4 == 3:  # wrong pieces and words
            at = random.choice(("", "-1", "1e9", "4", "6", "9" * 14, "5&at=0", "0x5"))
            path, method = random.choice(
                (("/api/people", "POST"), (f"{film}?at={at}", "PUT"), (f"{own}/films", "POST"))
            )
            body = body or b"more"
        status = asked(serving, method, path, body, **headers)[0]
        assert 400 <= status < 500 or status == 507, (status, method, path[:80], headers)
    assert on_disk() == before
    assert asked(serving, "GET", "/")[0] == 200


def test_one_is_made_at_a_time_and_a_stop_stops(serving: Serving, film: Path) -> None:
    people = serving.maker.people
    for name in ("Ada", "Bob", "Bad"):
        give_film(people, name, film)
    for name in ("Ada", "Bob"):
        chosen = {"quality": "draft", "threads": 1, "method": "headgas", "shoulders": True, "keep_film": name == "Bob"}
        assert told(serving, "POST", f"{person(name)}/making", chosen)[0] == 200
    assert told(serving, "POST", f"{person('Bob')}/making", {})[0] == 400, "it waits already"
    until(lambda: (told(serving, "GET", person("Ada"))[1]["progress"]["stage"] or {}).get("percent") == 20)
    shown = told(serving, "GET", person("Ada"))[1]
    assert shown["progress"]["stage"] == {"name": "training", "number": 4, "of": 5, "percent": 20}
    assert state_of(serving, "Bob") == "waiting"
    assert told(serving, "DELETE", f"{person('Ada')}/making")[0] == 200
    assert state_of(serving, "Ada") == "stopped"
    until(lambda: state_of(serving, "Bob") == "making")
    assert told(serving, "POST", f"{person('Ada')}/making", shown["settings"])[0] == 200
    log = (people.root / ".studio" / "logs" / "Ada.log").read_text()
    for words in (
        "'--preset', 'draft'",
        "'--method', 'headgas'",
        "'--run', 'draft_headgas_1_shoulders'",
        "anny-bust",
        "film_1.mp4",
    ):
        assert words in log
    (people.root / ".studio" / "go").touch()
    until(lambda: state_of(serving, "Ada") == "done")
    assert state_of(serving, "Bob") == "done"
    assert [len(people.films(name)) for name in ("Ada", "Bob")] == [0, 1], "the film stays if it is to be kept"
    assert told(serving, "POST", f"{person('Bad')}/making", {})[0] == 200
    until(lambda: state_of(serving, "Bad") == "failed")
    assert "no face is found" in told(serving, "GET", person("Bad"))[1]["progress"]["error"]
    assert told(serving, "DELETE", person("Bob"))[0] == 200
    assert told(serving, "GET", person("Bob"))[0] == 404
    assert not [path for path in people.root.rglob("*") if "Bob" in path.name]


def test_time_left_counts_from_the_first_stage() -> None:
    """A process that has not said its stage has done nothing."""
    pace = Pace("draft", None, (0.0, 0.0))
    assert pace.seconds_left(Stage("", 0, 0, None), 1.0) is None
    assert pace.seconds_left(Stage("capture", 1, 5, 100), 29.0) is None
    assert pace.seconds_left(Stage("training", 4, 5, 50), 100.0) == pytest.approx(47, abs=3)
    # It does not go back where a stage has a second bar.
    assert pace.seconds_left(Stage("training", 4, 5, 10), 100.0) == pytest.approx(47, abs=3)


KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from studio_case import studio
with studio(Path({root!r})) as serving:
    time.sleep(600)
"""


def test_a_killed_studio_takes_its_work_along_and_the_next_one_goes_on(tmp_path: Path, film: Path) -> None:
    people = People(tmp_path)
    give_film(people, "Ada", film)
    maker = Maker(people, STUB)
    maker.add("Ada", Settings())
    script = KILLED.format(tests=str(Path(__file__).parent), root=str(tmp_path))
    first = subprocess.Popen([sys.executable, "-c", script])
    state = tmp_path / ".studio" / "states" / "Ada.json"
    try:
        until(state.is_file)
        until(lambda: "process" in state.read_text())
        worker = int(re.findall(r"process (\d+)", state.read_text())[0])
        refuses("is being written by another command", Serving, tmp_path)
    finally:
        first.kill()
        first.wait()
    until(lambda: not Path(f"/proc/{worker}").exists() or "zombie" in Path(f"/proc/{worker}/status").read_text())
    with studio(tmp_path) as serving:
        until(lambda: state_of(serving, "Ada") == "making")
        (tmp_path / ".studio" / "go").touch()
        until(lambda: state_of(serving, "Ada") == "done")


def test_what_is_asked_for_again_is_what_was_seen_least(tmp_path: Path) -> None:
    head = drawn_head(10)
    names, size = head.expression_names, len(head.neutral.expression) + head.neutral.joints.size
    rest = np.zeros(size, np.float32)
    rest[: len(names)] = head.neutral.expression
    most = rest + 1
    most[names.index("jawOpen")] = rest[names.index("jawOpen")] + 0.2
    angles = np.radians([[-40, 5], [-20, 20]]).astype(np.float32)
    seen = replace(head, filmed=runtime.Filmed(rest, most, angles))
    assert advice(seen) == ["Turn your head further to the right", "Say a long A, with your mouth wide open"]
    assert advice(replace(head, filmed=None)) == []
    path = tmp_path / "me.mien"
    runtime.write_portable(path, seen)
    assert advice_for(path, "one") == advice(seen)
    for run, worse, words in (("two", 4.0, [AGAIN]), ("three", 1.0, [])):
        write_scores(tmp_path, head, run, worse)
        assert advice_for(path, run) == [*advice(seen), *words]
    (tmp_path / "runs" / "three" / "metrics.json").write_text("{}")
    path.touch()
    assert advice_for(path, "three") == advice(seen)
    path.write_bytes(b"damaged")
    assert advice_for(path, "two") == []


AGAIN = "Lower your chin, and look down, once more and slowly: the avatar is least like you there"


def write_scores(workspace: Path, head: runtime.PortableAvatar, run: str, worse: float) -> None:
    """Write figures of twenty held-out frames. In half of them the chin is lowered, and in some the mouth is open."""
    count, names = 20, head.expression_names
    expression = np.tile(head.neutral.expression, (count, 1))
    expression[::3, names.index("jawOpen")] += 1
    rotation = np.zeros((count, 3), np.float32)
    rotation[::2, 0] = np.radians(12)  # the camera sees the head from above
    view = np.diag([1.0, -1, -1, 1]).astype(np.float32)
    view[2, 3] = 1.0
    tracked = {
        "expression": expression, "head_rotation": rotation, "head_translation": np.zeros((count, 3), np.float32),
        "camera_viewmats": view[None],
    }  # fmt: skip
    write_arrays(workspace / "sequences" / "film_1" / "tracking" / "tracking.safetensors", tracked)
    psnr = np.full(count, 30.0)
    psnr[::2] -= worse
    mouth = [None, *np.full(count - 1, 30.0)]
    figures = {"head_psnr": psnr.tolist(), "eyes_psnr": [30.0] * count, "mouth_psnr": mouth}
    frames = {"sequence": ["film_1"] * count, "timestep": list(range(count)), **figures}
    write_json(
        workspace / "runs" / run / "metrics.json", "mien.metrics", 1, {"protocols": {"self": {"per_frame": frames}}}
    )


def test_takings_are_written_by_export_and_old_ones_are_not_given(serving: Serving, film: Path) -> None:
    people = serving.maker.people
    give_film(people, "Ada", film)
    folder, taking = people.folder("Ada"), f"{person('Ada')}/take"
    assert told(serving, "POST", f"{taking}/glb", {})[0] == 404, "nothing is made yet"
    run = folder / "runs" / "one"
    (run / "avatar").mkdir(parents=True)
    for name in ("config.json", "training.json"):
        (run / name).write_text("{}")
    shown = told(serving, "GET", person("Ada"))[1]
    assert {each["kind"] for each in shown["takings"]} == {
        kind for kind, each in TAKINGS.items() if each.options is not None
    }
    status, answer = told(serving, "POST", f"{taking}/mien", {})
    assert status == 400
    assert "holds no trained avatar" in answer["error"], "the words of `mien export`"
    (folder / "me.html").write_text("<p>alive</p>")
    status, headers, page = asked(serving, "GET", f"{taking}/page?save")
    assert (status, page) == (200, b"<p>alive</p>")
    assert "allow-same-origin" not in headers["content-security-policy"]
    assert headers["content-security-policy"].startswith("sandbox")
    assert "attachment" in headers["content-disposition"]
    os.utime(folder / "me.html", (1, 1))
    assert asked(serving, "GET", f"{taking}/page")[0] == 404, "older than the avatar"


def test_the_command_says_what_is_wrong_and_opens_the_page(tmp_path: Path, capsys, monkeypatch) -> None:
    (tmp_path / "one" / "runs").mkdir(parents=True)
    (tmp_path / "file").write_text("")
    assert "is the workspace of one person" in complaint(capsys, "studio", tmp_path / "one")
    assert "is a file" in complaint(capsys, "studio", tmp_path / "file")
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)

    def interrupt(self: Serving) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Serving, "wait", interrupt)
    assert main(["studio", str(tmp_path / "people")]) == 0
    assert opened[0].startswith("http://127.0.0.1:")
    assert "?token=" in opened[0]
    assert "the next one goes on" in capsys.readouterr().err
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install 'mien[studio,create]'" in complaint(capsys, "studio", tmp_path / "people")
