"""The viewer's door: who gets its page, by token, cookie, host and origin."""

from urllib.parse import urljoin

import pytest

from mien.errors import UserError
from mien.viewer.access import Door, is_loopback


@pytest.mark.parametrize(
    ("host", "is_one"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("example.org", False),
        ("192.168.1.2", False),
    ],
)
def test_loopback(host: str, is_one: bool) -> None:
    assert is_loopback(host) is is_one
    assert Door.of(host).token is not None
    if is_one:
        assert Door.of(host, with_token=False).token is None
    else:
        with pytest.raises(UserError, match=f"--no-token: other machines can reach --host {host}"):
            Door.of(host, with_token=False)


def test_without_a_token_strange_hosts_and_origins_are_refused() -> None:
    door = Door.of("127.0.0.1", with_token=False)
    assert door.answer("/", {"Host": "127.0.0.1:80"}) is None
    assert door.answer("/", {"Host": "localhost:80", "Origin": "http://localhost:80"}) is None
    for headers in (
        {},
        {"Host": "rebound.example:80"},
        {"Host": "127.0.0.1:80", "Origin": "http://evil.example"},
        {"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:81"},
        {"Host": "127.0.0.1:80", "Origin": "null"},
        {"Host": "127.0.0.1:80", "Origin": "http://["},
        {"Host": "127.0.0.1:80", "Origin": "http://[v1.\udc80]"},
        {"Host": "[::1"},
    ):
        answer = door.answer("/", headers)
        assert answer is not None, headers
        assert answer.status == 403
        assert answer.body.isascii() or "\udc80" not in answer.body


def test_a_proxy_with_a_path_of_its_own() -> None:
    """The redirect and the cookie stay below that path, and other hosts are fine with the token."""
    door = Door.of("127.0.0.1")
    there = {"Host": "me.example", "Origin": "https://me.example"}
    first = door.answer(f"/?token={door.token}", there)
    assert first is not None
    assert (
        urljoin("https://me.example/mien/?token=x", first.headers["Location"]) == "https://me.example/mien/index.html"
    )
    assert "Path" not in first.headers["Set-Cookie"]
    assert door.answer("/index.html", {**there, "Cookie": door.cookie}) is None
    lost = door.answer("/", {"Host": "127.0.0.1:80", "Origin": "https://me.example", "Cookie": door.cookie})
    assert lost is not None
    assert "page of https://me.example, and its Host is 127.0.0.1:80" in lost.body
    assert "let the proxy pass on the browser's Host header" in lost.body


def test_a_token_becomes_a_cookie() -> None:
    door = Door.of("0.0.0.0")
    assert door.token is not None
    assert len(door.token) >= 20
    assert door.token != Door.of("0.0.0.0").token
    here = {"Host": "me.example:80"}
    first = door.answer(f"/?token={door.token}", here)
    assert first is not None
    assert (first.status, first.headers["Location"]) == (303, "index.html")
    cookie = first.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    given = cookie.partition(";")[0]
    assert door.answer("/", {**here, "Cookie": f"a=b; {given}"}) is None
    assert door.answer("/", {**here, "cookie": given, "origin": "http://me.example:80"}) is None
    for path, headers in (
        ("/", {}),
        ("/?token=", {}),
        ("/?token=wrong", {"Cookie": given}),
        ("/", {"Cookie": given[:-1]}),
        ("/", {"Cookie": given, "Origin": "http://evil.example"}),
        ("/", {"Cookie": "é=[,"}),
    ):
        answer = door.answer(path, {**here, **headers})
        assert answer is not None, (path, headers)
        assert answer.status == 403
    assert door.address("::1", 7).startswith("http://[::1]:7/?token=")
