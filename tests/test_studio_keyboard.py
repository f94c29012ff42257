"""The studio without a mouse: from the first page to a saved page by keys alone, in Chromium."""

from pathlib import Path

import pytest

pytest.importorskip("starlette")

from mien import runtime
from mien.formats.page import write_page
from studio_case import STUB, person, studio, told
from test_web_webcam import ALLOWED, FAKE
from web_case import browse, drawn_head, until

HOUR = 3600.0


@pytest.mark.slow
def test_the_keyboard_alone_is_enough(tmp_path: Path) -> None:
    """Each step of `tab` sees the focus at every place on its way. A stand-in makes the avatar."""
    root, head = tmp_path / "people", drawn_head(300)
    films = [
        {"tab": "#new"}, {"keys": ["Enter", *"Ada", "Tab", "Space"]}, {"tab": "#add .main"}, {"keys": ["Enter"]},
        {"see": "Half a minute of film is enough."}, {"tab": "#film"}, {"keys": ["Enter"]}, {"see": "Put your face"},
        {"focused": "#record"}, {"keys": ["Enter"]}, {"see": "kB saved"}, {"focused": "#finish"}, {"keys": ["Enter"]},
        {"see": "Film 1"},
    ]  # fmt: skip
    makes = [
        {"tab": "#people button"}, {"keys": ["Enter"]}, {"see": "Film 1"}, {"tab": "#more summary"},
        {"keys": ["Enter"]}, {"tab": "#quality"}, {"keys": ["Home"]}, {"tab": "#shoulders"}, {"keys": ["Space"]},
        {"tab": "#keep"}, {"keys": ["Space"]}, {"back": "#make"}, {"keys": ["Enter"]}, {"focused": "#stop"},
    ]  # fmt: skip
    stops = [
        {"tab": "#people button"}, {"keys": ["Enter"]}, {"see": "The avatar grows"}, {"tab": "#stop"},
        {"keys": ["Enter"]}, {"focused": "#make"}, {"see": "Go on"}, {"keys": ["Enter"]}, {"focused": "#stop"},
    ]  # fmt: skip
    takes = [
        {"tab": "#people button"}, {"keys": ["Enter"]}, {"see": "Take away"}, {"tab": '[aria-label="Save: Page"]'},
        {"keys": ["Enter"]}, {"see": "Preparing"}, {"see": "Page"}, {"tab": "#delete"}, {"keys": ["Enter"]},
        {"see": "Delete Ada?"}, {"tab": "#sure [value=yes]"}, {"keys": ["Enter"]}, {"see": "Nobody is here yet"},
    ]  # fmt: skip
    with studio(root, STUB) as serving:
        options = {"size": (1000, 700), "flags": [FAKE, ALLOWED]}
        done = [browse(serving.address, steps=films, **options)]
        done.append(browse(serving.address, steps=makes, **options))
        # What is stopped before it has begun is as if it had not been asked for.
        until(lambda: (told(serving, "GET", person("Ada"))[1]["progress"]["stage"] or {}).get("percent") == 20, HOUR)
        done.append(browse(serving.address, steps=stops, **options))
        chosen = told(serving, "GET", person("Ada"))[1]["settings"]
        assert (chosen["quality"], chosen["shoulders"], chosen["keep_film"]) == ("draft", True, False)
        until(lambda: told(serving, "GET", person("Ada"))[1]["progress"]["state"] == "making", HOUR)
        (root / ".studio" / "go").touch()
        until(lambda: told(serving, "GET", person("Ada"))[1]["progress"]["state"] == "done", HOUR)
        write_page(root / "Ada" / "me.html", head, None)
        runtime.write_portable(root / "Ada" / "me.mien", head)
        page = (root / "Ada" / "me.html").read_bytes()
        done.append(browse(serving.address, steps=takes, downloads=tmp_path, **options))
        assert [each["messages"] for each in done] == [[], [], [], []]
        assert not (root / "Ada").exists()
    assert (tmp_path / "Ada me.html").read_bytes() == page
