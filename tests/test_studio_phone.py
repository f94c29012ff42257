"""Films from phones: what a phone may do, a film in pieces, and phones that go away in the middle of one."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette")

from mien.studio import server
from mien.studio.people import People
from mien.studio.server import Serving
from studio_case import asked, person, studio, told
from web_case import browse, until, violations

PHONES = person("Ada", "phone")
"""The path at which a phone is invited."""
PHONE: dict[str, Any] = {"size": (390, 844), "device": ("touch", "mobile")}


@pytest.fixture(scope="module")
def film(test_data: Path) -> Path:
    return test_data / "cases" / "plain.mp4"


@pytest.fixture
def serving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Serving]:
    """Serve a studio that phones reach, with one person."""
    monkeypatch.setattr(server, "address_on_network", lambda: "127.0.0.2")
    with studio(tmp_path / "people", lan=True) as running:
        running.maker.people.add("Ada")
        yield running


def invited(serving: Serving) -> tuple[str, dict]:
    """Return the path of the page that a phone gets, and how `asked` reaches it."""
    found = re.fullmatch(r"http://(127\.0\.0\.2:(\d+))(/[\w-]{20,})/", told(serving, "POST", PHONES, {})[1]["url"])
    assert found is not None
    return found[3], {"port": int(found[2]), "Host": found[1], "Origin": f"http://{found[1]}", "Cookie": ""}


def test_a_phone_sends_one_film_and_reaches_nothing_else(serving: Serving, film: Path) -> None:
    base, there = invited(serving)
    for path in ("/", "/api/people", "/index.html", f"{base[:-1]}/", person("Ada")):
        assert asked(serving, "GET", path, **there)[0] == 404, path
    for strange in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        assert asked(serving, "GET", f"{base}/", **{**there, **strange})[0] == 403
    assert b"Film yourself with this phone" in asked(serving, "GET", f"{base}/", **there)[2]
    assert asked(serving, "PUT", f"{base}/piece?at=0", b"x", **there)[0] == 400
    for size in ("1", 7):  # another film takes the place of the first one
        assert asked(serving, "POST", f"{base}/begin", {"ending": "mp4", "size": size}, **there)[0] == 200
    assert asked(serving, "PUT", f"{base}/piece?at=0", film.read_bytes(), **there)[0] == 200
    shown = told(serving, "GET", person("Ada"))[1]
    assert shown["phone"] == {"film": "film_2.mp4", "size": 7, "done": False}
    assert len(shown["films"]) == 1
    assert asked(serving, "POST", f"{base}/done", {}, **there)[0] == 200
    assert asked(serving, "GET", f"{base}/", **there)[0] == 404, "the token ends with the film"
    shown = told(serving, "GET", person("Ada"))[1]
    assert ([each["whole"] for each in shown["films"]], shown["phone"]["done"]) == ([True], True)
    assert invited(serving)[0] != base


def test_a_file_and_a_phone_send_films(
    serving: Serving, film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The phone's page is on a phone's screen. Its film comes in three pieces, between which its network is lost."""
    large = tmp_path / "large.mp4"
    large.write_bytes(film.read_bytes() + bytes(9 << 20))
    given = [{"give": ["#file", film]}, {"see": "Turn your head further"}]
    told_by_page = browse(serving.address, steps=given, fragment="Ada")
    address = told(serving, "POST", PHONES, {})[1]["url"]
    pieces: list[int] = []
    append = serving.maker.people.append
    monkeypatch.setattr(People, "append", lambda self, *more: pieces.append(len(more[-1])) or append(*more))
    steps = [
        {"see": "Film yourself with this phone"}, {"give": ["#file", large]}, {"see": "The computer does not answer"},
        {"click": "Go on sending"}, {"see": "The film has arrived"},
    ]  # fmt: skip
    told_by_phone = browse(address, steps=steps, opening=LOST, **PHONE)
    assert [each["messages"] for each in (told_by_page, told_by_phone)] == [[], []]
    assert [request for request in told_by_phone["requests"] if not request.startswith((address, "data:"))] == []
    assert [size >> 20 for size in pieces] == [4, 4, 1], "no piece comes twice"
    assert violations(told(serving, "POST", PHONES, {})[1]["url"], (390, 844), ("touch",)) == []
    films = told(serving, "GET", person("Ada"))[1]["films"]
    assert [(each["whole"], each["facts"]["width"]) for each in films] == [(True, 320), (True, 320)]


LOST = """
  const real = fetch;
  let pieces = 0;
  const isLost = ({ method }) => method === "PUT" && ++pieces === 2;
  fetch = (path, more) => (isLost(more) ? Promise.reject(new TypeError()) : real(path, more));
"""
"""Loses the second piece."""


def test_a_phone_that_goes_away_for_good_leaves_what_can_go_on_or_be_removed(serving: Serving, film: Path) -> None:
    content, (base, there) = film.read_bytes(), invited(serving)
    half, begin = len(content) // 2, {"ending": "mp4", "size": len(content)}
    assert told(serving, "POST", f"{base}/begin", begin, **there) == (200, {"at": 0})
    assert told(serving, "PUT", f"{base}/piece?at=0", content[:half], **there)[0] == 200
    part = serving.maker.people.folder("Ada") / "films" / ".film_1.mp4.part"
    os.utime(part, (1, 1))  # it went long ago
    keep = [{"press": '[aria-label="Keep film 1"]'}, {"see": "Film_1.mp4: its end has not come"}]
    told_by_page = browse(
        serving.address, fragment="Ada",
        steps=[
            {"see": "The phone has stopped sending."}, {"press": "#from-phone"}, {"see": "Scan the code"},
            {"see": "The phone has stopped sending. 49 % of it is here."}, {"press": "#no-phone"}, *keep,
        ],
    )  # fmt: skip
    assert told_by_page["messages"] == []
    assert part.read_bytes() == content[:half], "nothing is lost"
    assert invited(serving)[0] == base, "the same code goes on"
    assert told(serving, "POST", f"{base}/begin", begin, **there) == (200, {"at": half})
    assert told(serving, "PUT", f"{base}/piece?at={half}", content[half:], **there)[0] == 200
    assert asked(serving, "POST", f"{base}/done", {}, **there)[0] == 200
    assert (part.parent / "film_1.mp4").read_bytes() == content
    base, there = invited(serving)
    assert told(serving, "POST", f"{base}/begin", begin, **there) == (200, {"at": 0})
    remove = [{"press": '[aria-label="Remove film 2"]'}, {"press": "#sure [value=yes]"}]
    os.utime(part.with_name(".film_2.mp4.part"), (1, 1))
    browse(serving.address, steps=[*remove, {"see": "Film more"}], fragment="Ada")
    until(lambda: len(told(serving, "GET", person("Ada"))[1]["films"]) == 1)
    status, answer = told(serving, "POST", f"{base}/begin", begin, **there)
    assert (status, answer["error"]) == (404, "this address has ended; ask for a new code in the studio")
