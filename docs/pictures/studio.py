"""Walk through the studio and take its pictures: `python docs/pictures/studio.py --film FILE --out out/studio`.

`mien studio` runs as people have it, and Chromium's fake camera plays the film. The walk adds a person, films, makes an
avatar of the preset `draft`, lets the film drive it, saves the page, and deletes the person. Each step is shown on a
desktop and a phone, upright and lying, in light and dark. Numbered pictures, a sheet of all, and the seconds of each
step go into the folder of --out. A page that writes an error, or asks for anything outside of the studio, ends the
walk. It needs `npm ci` in web/ and Chromium.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from first_minute import SCREENS, Walk, WalkError, expect, node, write_camera, write_sheet

LOOKS = (("desktop", "light"), ("desktop", "dark"), ("phone", "light"), ("landscape", "dark"))
NAME = "Ada"
HOURS = 3600.0
FIND = "http://127.0.0.1"


class Studio:
    """A studio that runs, and the browsers that look at it."""

    def __init__(self, made: Walk, address: str, camera: Path) -> None:
        """Look at an address, with a camera that plays a file."""
        self.made, self.address = made, address
        self._flags = ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]
        self._flags.append(f"--use-file-for-fake-video-capture={camera}")

    def look(self, steps: Sequence[Any], screen: str = "desktop", theme: str = "light", of: str = "", **more: Any):
        """Do steps in a browser. A step that is a word takes a picture of that name.

        Raises:
            WalkError: a step fails, or the page asks for anything outside of the studio, or writes an error.
        """
        width, height, scale = SCREENS[screen]
        shots = [
            {"screenshot": self.made.picture(f"{step}_{screen}_{theme}")} if isinstance(step, str) else step
            for step in steps
        ]
        given = {"width": width, "height": height, "scale": scale, "flags": self._flags, "dark": theme == "dark"}
        given |= {"touch": screen != "desktop", "mobile": screen != "desktop", "steps": shots}
        told = node(self.address + (f"#{of}" if of else ""), given | more)
        here = self.address.partition("?")[0]
        outside = [url for url in told["requests"] if not url.startswith((here, "blob:", "data:"))]
        expect(not outside, f"{screen}, {theme}: asks for {outside}")
        expect(not told["messages"], f"{screen}, {theme}: says {told['messages']}")

    def show(self, *steps: Any, of: str = NAME) -> None:
        """Do steps on each screen, in each theme."""
        for screen, theme in LOOKS:
            self.look(steps, screen, theme, of)


@contextmanager
def studio(folder: Path) -> Iterator[str]:
    """Run `mien studio`, and yield its address."""
    command = [sys.executable, "-m", "mien.cli", "studio", str(folder), "--lan", "--no-browser"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            address = next((found[0] for line in process.stderr if (found := re.search(r"http://\S+", line))), "")
            expect(address.startswith(FIND), "mien studio: tells no address")
            threading.Thread(target=process.stderr.read, daemon=True).start()
            yield address
        finally:
            process.terminate()


def wait_for(made: Walk, name: str, done: Callable[[], bool], failed: Path) -> None:
    """Wait until something is so, as a step.

    Raises:
        WalkError: it takes hours, or the making has failed.
    """
    with made.step(name):
        ends = time.monotonic() + HOURS
        while not done():
            expect(time.monotonic() < ends, f"{name}: takes more than {HOURS / 3600:.0f} h")
            state = json.loads(failed.read_text()) if failed.is_file() else {}
            expect(state.get("status") != "failed", f"{name}: {state.get('error')}")
            time.sleep(0.2)


def walk(film: Path, out: Path, seconds: float) -> Walk:
    """Take the pictures of all steps.

    Raises:
        WalkError: a step fails, or a page asks for anything outside of the studio, or writes an error.
    """
    people = out / "people"
    if people.exists():
        shutil.rmtree(people)
    out.mkdir(parents=True, exist_ok=True)
    made, camera = Walk(out), out / "camera.y4m"
    write_camera(film, 0, camera)
    state, growing = people / ".studio" / "states" / f"{NAME}.json", people / ".studio" / "growing" / f"{NAME}.mien"
    with studio(people) as address:
        shown = Studio(made, address, camera)
        add: list[Any] = ["empty", {"click": "New person"}, {"see": "Who is it?"}, "new_person"]
        shown.show(*add, of="")
        fill = [{"fill": ["Who is it?", NAME]}, {"click": "This person has agreed"}, {"click": "Continue"}]
        shown.look([add[1], *fill, {"see": "Half a minute of film is enough."}])
        ready = [{"see": NAME}, "person", {"press": "#film"}, {"see": "Put your face"}, "camera", {"press": "#record"}]
        throw = ["recording", {"press": "#cancel"}, {"see": "Half a minute of film"}]
        code = [{"press": "#from-phone"}, {"see": "Scan the"}, "code"]
        shown.show(*ready, {"see": " saved"}, {"wait": 2000}, *throw, *code)
        keep = [{"see": " saved"}, {"wait": round(1000 * seconds)}, {"press": "#finish"}, {"see": "Film 1"}, "filmed"]
        with made.step("film"):
            shown.look([{"press": "#film"}, {"see": "Put your face"}, {"press": "#record"}, *keep], of=NAME)
        more: list[Any] = [{"click": "More"}, {"wait": 300}, "settings"]
        make = [{"press": "#quality"}, {"keys": ["Home", "Enter"]}, {"press": "#make"}, {"see": "The avatar grows"}]
        shown.look([*more, *make, "making"], of=NAME)
        wait_for(made, "until the fit", (people / NAME / "tracking_preview.html").is_file, state)
        shown.look([{"wait": 3000}, "fit"], of=NAME)
        wait_for(made, "until the avatar grows", growing.is_file, state)
        shown.show({"see": "The avatar grows"}, {"wait": 2500}, "growing")
        drag = [{"wait": 2500}, {"drag": [150, 0]}, {"wait": 500}, "turned"]
        shown.look(drag, of=NAME)
        wait_for(made, "until it is made", (people / NAME / "me.mien").is_file, state)
        be_me = {"press": "#be-me"}
        driven = [be_me, {"see": "The avatar follows your face."}, {"wait": 3000}, "be_me", be_me]
        ask = [{"press": "#delete"}, {"see": "are removed from this machine"}, "delete", {"click": "Keep"}]
        shown.show({"see": "Take away"}, {"wait": 4000}, "done", *driven, *ask)
        shown.look([{"press": '[aria-label="Save: Page"]'}, {"wait": 2000}], of=NAME, downloads=str(out))
        expect((out / f"{NAME} me.html").is_file(), "Save: writes no page")
        shown.look(["people", {"press": "#people button"}, *ask[:2], {"press": "#sure [value=yes]"}, {"see": "Nobody"}])
        expect(not (people / NAME).exists(), "Delete: leaves the person")
    (out / "seconds.json").write_text(json.dumps(made.seconds, indent=1) + "\n", encoding="utf-8")
    return made


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--film", type=Path, required=True, help="a video of one person")
    parser.add_argument("--seconds", type=float, default=15.0, help="how long the camera films")
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    try:
        done = walk(chosen.film, chosen.out, chosen.seconds)
    except WalkError as error:
        sys.exit(str(error))
    write_sheet(done)
    print(json.dumps(done.seconds, indent=1), f"{chosen.out / 'sheet.png'}: {len(done.pictures)} pictures", sep="\n")
