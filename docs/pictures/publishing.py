"""Make the picture of docs/publishing.md: `python docs/pictures/publishing.py DIR [--run NAME]`.

DIR is a workspace of a drawn person, such as out/demo. The avatar is shown by the element in a page, between the
objects of a three.js scene, and as the mesh of its .glb file in three.js. It needs `make web` and Chromium.
"""

import argparse
import base64
import json
import shutil
import subprocess
import tempfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np

from mien.cli import main

ROOT = Path(__file__).parent.parent.parent
WEB, OUT = ROOT / "web", Path(__file__).parent / "publishing.webp"
SIDE = 400
_SHOT = "return document.getElementById('scene').toDataURL();"
_LOADED = """(async () => {
  const avatar = document.querySelector("mien-avatar");
  if (!avatar.viewer) await new Promise((done) => avatar.addEventListener("load", done));
  await new Promise((done) => setTimeout(done, 1500));
})()"""
_SCENE = """(async () => {
  const { start } = await import("./main.bundle.js");
  const file = new Uint8Array(await (await fetch("me.packed")).arrayBuffer());
  window.made = await start(document.getElementById("scene"), file);
  made.left.pause();
  made.left.setFace({ mouthSmileLeft: 0.7, mouthSmileRight: 0.7 });
  for (let i = 0; i < 4; ++i) await new Promise(requestAnimationFrame);
})()"""
_MESH = """
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
export async function start(canvas) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  renderer.setSize(400, 400, false);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(25, 1, 0.05, 10);
  scene.background = new THREE.Color(0xdde4ea);
  const { scene: head } = await new GLTFLoader().loadAsync("me.glb");
  scene.add(head);
  head.traverse((part) => {
    if (part.morphTargetDictionary) part.morphTargetInfluences[part.morphTargetDictionary.jawOpen] = 0.6;
  });
  camera.position.set(0.2, 0.05, 0.75);
  camera.lookAt(0, 0, 0);
  renderer.render(scene, camera);
}
"""


def shoot(address: str, script: str, path: Path) -> None:
    """Run a script in a page, and write the picture that it returns, or what the window shows."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    told = json.dumps(
        {"width": SIDE, "height": SIDE, "scripts": [script], "screenshots": [None if _SHOT in script else str(path)]}
    )
    command = ["node", str(WEB / "tests" / "browser.mjs"), chromium, address]
    done = subprocess.run(command, input=told, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    if _SHOT in script:
        (address,) = json.loads(done.stdout)["results"]
        path.write_bytes(base64.b64decode(address.partition(",")[2]))


def bundle(source: Path, out: Path) -> None:
    """Bundle a script with three.js and the package."""
    esbuild = WEB / "node_modules" / ".bin" / "esbuild"
    options = ["--bundle", "--format=esm", f"--outfile={out}"]
    subprocess.run([str(esbuild), str(source), *options], check=True, capture_output=True)


def make(workspace: Path, run: str | None) -> None:
    """Write the picture beside this file."""
    chosen = ["--run", run] if run else []
    with tempfile.TemporaryDirectory(dir=WEB) as name:
        site = Path(name)
        for kind in ("packed", "glb"):
            assert main(["export", str(workspace), *chosen, "--out", str(site / f"me.{kind}")]) == 0
        shutil.copy(WEB / "dist" / "element.js", site)
        page = (WEB / "examples" / "element.html").read_text().replace(" controls idle", " yaw='-15'")
        (site / "element.html").write_text(page)
        bundle(WEB / "examples" / "three" / "main.js", site / "main.bundle.js")
        (site / "mesh.js").write_text(_MESH)
        bundle(site / "mesh.js", site / "mesh.bundle.js")
        canvas = f'<body style="margin: 0"><canvas id="scene" style="width: {SIDE}px; height: {SIDE}px"></canvas>'
        (site / "three.html").write_text(canvas)
        quiet = type("Quiet", (SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
        with ThreadingHTTPServer(("127.0.0.1", 0), partial(quiet, directory=name)) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            address = f"http://127.0.0.1:{server.server_address[1]}"
            mesh = 'await (await import("./mesh.bundle.js")).start(document.getElementById("scene"));'
            shots = {"element": _LOADED, "three": _SCENE, "mesh": f"(async () => {{ {mesh} {_SHOT} }})()"}
            for what, script in shots.items():
                page = "element" if what == "element" else "three"
                shoot(f"{address}/{page}.html", script, site / f"{what}.png")
            server.shutdown()
        pictures = [np.asarray(cv2.imread(str(site / f"{what}.png"))) for what in shots]
    cv2.imwrite(str(OUT), np.concatenate(pictures, 1), [cv2.IMWRITE_WEBP_QUALITY, 80])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--run")
    given = parser.parse_args()
    make(given.workspace, given.run)
