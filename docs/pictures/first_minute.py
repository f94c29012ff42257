"""Walk a stranger's first minute and take its pictures: `python docs/pictures/first_minute.py --out out/first_minute`.

The steps are those of README.md on the drawn person of `make demo`, each by one command: the page that opens alive, the
page that a face drives (a camera of Chromium's plays the person's own video), the report, the viewer, a page of one's
own with the element, and the .glb file for Blender, drawn here by three.js. Numbered pictures, all of them on sheets,
and the seconds of each step go into the folder of --out. A step that shows no head, asks for anything outside of its
page, or writes an error ends the walk with a message. It needs `npm ci` in web/ and Chromium.
"""

import argparse
import contextlib
import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mien.cli import main
from mien.disk.workspace import open_workspace
from mien.media.pictures import picture_grid
from mien.pages.pages import LIVING_PAGE
from mien.pipeline.create import show_film, show_page
from mien.pipeline.sheets import named_picture
from mien.tracking import read_tracking

HERE = Path(__file__).parent
WEB = HERE.parent.parent / "web"
SCREENS = {"desktop": (1280, 800, 1), "phone": (390, 844, 2), "landscape": (844, 390, 2)}
"""Width and height of the windows, and pixels of the screen for each of the page."""
THEMES = ("light", "dark")
CAMERA_FPS, CAMERA_SIDE = 5, 480
"""Pictures per second of the camera, of which software WebGL leaves the detector four to eight, and their side."""
STILL = 5 * CAMERA_FPS
"""Pictures at its beginning in which nothing moves. Some pass before the page looks at them."""
LEAST_HEAD, LEAST_MOVE = 0.04, 0.1
"""Least share of a picture that a head covers, and least change of a coefficient that counts as a face."""
TILE, COLUMNS = 400, 4
"""Height of a picture on a sheet, in pixels, and pictures in a row."""
FACES = ("Smile", "Laugh", "Surprise")


class WalkError(Exception):
    """A place where a stranger would stumble, in one line."""


@dataclass
class Walk:
    """Pictures and times of a walk, in the order of its steps."""

    out: Path
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds of each step. Those of a page are from its address to its first picture."""
    pictures: list[Path] = field(default_factory=list)

    def picture(self, name: str) -> str:
        """Return the path of the next picture."""
        self.pictures.append(self.out / f"{len(self.pictures) + 1:02d}_{name}.png")
        return str(self.pictures[-1])

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Note how long a step takes."""
        began = time.monotonic()
        yield
        self.seconds[name] = round(time.monotonic() - began, 1)

    def command(self, *words: str | Path) -> None:
        """Run a command of mien as a step."""
        with self.step(f"mien {words[0]} {Path(words[-1]).name}"):
            expect(main([str(word) for word in words]) == 0, f"mien {' '.join(map(str, words))}: failed")


def expect(so: bool, message: str) -> None:
    """Raise a `WalkError` with the message unless something is so."""
    if not so:
        raise WalkError(message)


def walk(workspace: Path, out: Path, only: Sequence[str] = ()) -> Walk:
    """Take the pictures of all steps, or of those in `only`.

    Raises:
        WalkError: a step shows no head, asks for anything outside of its page, or writes an error.
    """
    out.mkdir(parents=True, exist_ok=True)
    made = Walk(out)
    if not (workspace / LIVING_PAGE).is_file():
        made.command("demo", "--out", workspace)
    for name in only or STEPS:
        STEPS[name](made, workspace)
    (out / "seconds.json").write_text(json.dumps(made.seconds, indent=1) + "\n", encoding="utf-8")
    write_sheet(made)
    return made


def living_page(made: Walk, workspace: Path) -> None:
    """The page that `mien create` ends with, as this checkout writes it."""
    opened = open_workspace(workspace)
    with made.step(f"the end of mien create: {LIVING_PAGE}"):
        show_page(opened, opened.run_names()[0])
        show_film(opened, opened.run_names()[0])
    for screen in SCREENS:
        for theme in THEMES:
            look_at_page(made, workspace / LIVING_PAGE, screen, theme)


def look_at_page(made: Walk, page: Path, screen: str, theme: str) -> None:
    """Open a page, press its faces, and open what is behind "More".

    Raises:
        WalkError: there is no head, or a face does not come.
    """
    scripts = {"first": "walk.first()", "after_3_s": "walk.later(3000)"}
    scripts |= {name.lower(): f"walk.face('{name}')" for name in FACES}
    scripts |= {"more": "walk.more()", "more_mouth": "walk.more('Mouth')"}
    name = f"page_{screen}_{theme}"
    told = shoot(made, page, name, scripts, screen, theme)
    made.seconds[f"{name}: first picture"] = round(told["first"]["seconds"], 1)
    for state in ("first", "after_3_s"):
        expect(told[state]["covered"] >= LEAST_HEAD, f"{name}: there is no head in the picture {state}")
    for face in FACES:
        expect(told[face.lower()]["moved"] >= LEAST_MOVE, f"{name}: the button {face} moves nothing")


def be_me(made: Walk, workspace: Path) -> None:
    """The page that a face drives. The camera shows the drawn person's video."""
    page, camera = made.out / "be_me.html", made.out / "camera.y4m"
    made.command("export", workspace, "--webcam", "--out", page)
    (sequence,) = open_workspace(workspace).tracked_names()
    turns = read_tracking(open_workspace(workspace).sequence_dir(sequence) / "tracking").face.head_rotation
    write_camera(next(iter(workspace.glob("synthetic-*.mp4"))), int(turns.norm(dim=-1).argmin()), camera)
    flags = ["--use-fake-device-for-media-stream", f"--use-file-for-fake-video-capture={camera}"]
    scripts = {"before": "walk.first()", "driven": "walk.beMe(6000)", "later": "walk.later(2000)"}
    scripts["more"] = "walk.more()"
    for screen, theme in (("desktop", "dark"), ("phone", "light"), ("landscape", "light")):
        name = f"be_me_{screen}_{theme}"
        told = shoot(made, page, name, scripts, screen, theme, [*flags, "--use-fake-ui-for-media-stream"])
        made.seconds[f"{name}: driven"] = round(told["driven"]["seconds"], 1)
        expect(told["driven"]["state"] == "running", f"{name}: the camera is {told['driven']['state']}")
        expect(told["driven"]["moved"] >= LEAST_MOVE, f"{name}: the camera moves nothing")
    shoot(made, page, "be_me_denied", {"": "walk.denied()"}, "phone", "light", ["--deny-permission-prompts"])


def report(made: Walk, workspace: Path) -> None:
    """The report of the run, from top to bottom."""
    opened = open_workspace(workspace)
    page = opened.run_dir(opened.run_names()[0]) / "report.html"
    for screen, theme in (("desktop", "light"), ("phone", "light"), ("phone", "dark")):
        shoot(made, page, f"report_{screen}_{theme}", {"": "walk.wait(1500)"}, screen, theme, whole=True)


def viewer(made: Walk, workspace: Path) -> None:
    """The viewer of `mien view`, until its first picture and a face later."""
    command = [str(Path(sys.executable).with_name("mien")), "view", str(workspace)]
    began = time.monotonic()
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        address = next((line.split()[1] for line in process.stderr if line.startswith("Open ")), "")
        try:
            expect(address.startswith("http://127.0.0.1:"), "mien view: tells no address")
            made.seconds["mien view: address"] = round(time.monotonic() - began, 1)
            threading.Thread(target=process.stderr.read, daemon=True).start()
            for screen in ("desktop", "phone"):
                shots = [made.picture(f"viewer_{screen}_{state}") for state in ("first", "later", "face")]
                steps: list[dict[str, Any]] = [{"see": "mien"}, {"wait": 2000}, {"screenshot": shots[0]}]
                steps += [{"wait": 4000}, {"screenshot": shots[1]}]
                if screen == "desktop":  # on phones, the panel begins folded
                    steps += [{"click": "Random face"}, {"wait": 3000}]
                steps += [{"screenshot": shots[2]}]
                width, height, _ = SCREENS[screen]
                given = {"width": width, "height": height, "steps": steps, "mobile": screen == "phone"}
                told = node(address, given)
                expect(not told["messages"], f"viewer: {told['messages']}")
        finally:
            process.terminate()


def own_page(made: Walk, workspace: Path) -> None:
    """A page of one's own: the example of the element, from a server, with the packed avatar."""
    site = made.out / "site"
    site.mkdir(exist_ok=True)
    made.command("export", workspace, "--out", site / "me.packed")
    with made.step("node build.mjs"):
        subprocess.run(["node", str(WEB / "build.mjs"), str(site)], check=True, capture_output=True)
    shutil.copy(WEB / "examples" / "element.html", site / "index.html")
    with served(site) as address:
        for screen in ("desktop", "phone"):
            told = shoot(made, f"{address}/index.html", f"own_{screen}", {"": "walk.element()"}, screen)
            expect(told[""]["covered"] >= LEAST_HEAD, f"own page, {screen}: there is no head")


def mesh(made: Walk, workspace: Path) -> None:
    """The .glb file, drawn by three.js from three sides with a face each: there is no Blender to test with."""
    site = made.out / "site"
    site.mkdir(exist_ok=True)
    made.command("export", workspace, "--out", site / "me.glb")
    modules = site / "first_minute_mesh.js"
    esbuild = [str(WEB / "node_modules" / ".bin" / "esbuild"), str(HERE / "first_minute_mesh.js")]
    options = ["--bundle", "--format=iife", "--global-name=mesh", f"--outfile={modules}"]
    environment = {"NODE_PATH": str(WEB / "node_modules"), "PATH": "/usr/bin:/bin"}
    subprocess.run([*esbuild, *options], check=True, capture_output=True, env=environment)
    script = '<script src="first_minute_mesh.js"></script>'
    (site / "mesh.html").write_text(f'<!doctype html><link rel="icon" href="data:,"><body style="margin: 0">{script}')
    with served(site) as address:
        told = shoot(made, f"{address}/mesh.html", "glb", {"": "mesh.start()"}, "desktop")
    expect(told[""]["morphs"] > 40, f"me.glb: has {told['']['morphs']} morph targets")


def shoot(
    made: Walk,
    page: Path | str,
    name: str,
    scripts: Mapping[str, str],
    screen: str,
    theme: str = "light",
    flags: Sequence[str] = (),
    whole: bool = False,
) -> dict[str, Any]:
    """Open a page that may move, run scripts in it, and take a picture after each. Return what each script returns.

    Raises:
        WalkError: the page asks for anything outside of its folder, or writes a message.
    """
    width, height, scale = SCREENS[screen]
    given: dict[str, Any] = {"width": width, "height": height, "scale": 1 if whole else scale, "whole": whole}
    given |= {"flags": list(flags), "lively": True}
    given |= {"dark": theme == "dark", "touch": screen != "desktop", "scripts": list(scripts.values())}
    given |= {"screenshots": [made.picture("_".join(filter(None, (name, state)))) for state in scripts]}
    told = node(str(page), given | {"opening": (HERE / "first_minute.js").read_text(encoding="utf-8")})
    here = str(page).rpartition("/")[0] if str(page).startswith("http") else "blob:"
    outside = [address for address in told["requests"] if not address.startswith((here, "blob:", "data:"))]
    expect(not outside, f"{name}: asks for {outside}")
    expect(not told["messages"], f"{name}: says {told['messages']}")
    return dict(zip(scripts, told["results"], strict=True))


def node(address: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Open a page in Chromium by web/tests/browser.mjs, and return what it tells."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    expect(chromium is not None, "there is no Chromium")
    command = ["node", str(WEB / "tests" / "browser.mjs"), str(chromium), address]
    done = subprocess.run(command, input=json.dumps(given), text=True, capture_output=True, check=False, timeout=400)
    expect(done.returncode == 0, f"{address}: {done.stderr.strip()[-400:]}")
    return json.loads(done.stdout)


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder from loopback, and yield its address."""
    quiet = type("Quiet", (SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def write_camera(video: Path, straight: int, path: Path) -> None:
    """Write a video as Chromium's fake camera takes it: .y4m, square, with few pictures a second.

    It begins with some still seconds of the frame `straight`, since a page takes its first second as the face at rest.
    """
    reader, frames = cv2.VideoCapture(str(video)), []
    while True:
        read, picture = reader.read()
        if not read:
            break
        small = cv2.resize(picture, (CAMERA_SIDE, CAMERA_SIDE), interpolation=cv2.INTER_AREA)
        frames.append(cv2.cvtColor(small, cv2.COLOR_BGR2YUV_I420))
    every = max(1, round(reader.get(cv2.CAP_PROP_FPS) / CAMERA_FPS))
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{CAMERA_SIDE} H{CAMERA_SIDE} F{CAMERA_FPS}:1 Ip A1:1 C420jpeg\n".encode())
        for frame in [frames[straight]] * STILL + (frames[straight:] + frames[:straight])[::every]:
            file.write(b"FRAME\n" + frame.tobytes())


def write_sheet(made: Walk) -> None:
    """Write all pictures, with their names, on one sheet. Long pages are cut."""
    high, wide = TILE, TILE * 16 // 10
    tiles = []
    for path in made.pictures:
        picture = np.asarray(cv2.imread(str(path)))
        picture = picture[: 3 * picture.shape[1]]
        scale = min(high / picture.shape[0], wide / picture.shape[1])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)[:high, :wide]
        tile = np.full((high, wide, 3), 255, np.uint8)
        left = (wide - small.shape[1]) // 2
        tile[: small.shape[0], left : left + small.shape[1]] = small
        tiles.append(named_picture(tile, path.stem))
    cv2.imwrite(str(made.out / "sheet.png"), picture_grid(tiles, min(COLUMNS, len(tiles)), 8))


STEPS = {function.__name__: function for function in (living_page, be_me, report, viewer, own_page, mesh)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument(
        "workspace", type=Path, nargs="?", default=Path("out/demo"), help="made by `mien demo` if missing"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", choices=STEPS, default=[])
    chosen = parser.parse_args()
    try:
        done = walk(chosen.workspace, chosen.out, chosen.only)
    except WalkError as error:
        sys.exit(str(error))
    print(json.dumps(done.seconds, indent=1), f"{chosen.out / 'sheet.png'}: {len(done.pictures)} pictures", sep="\n")
