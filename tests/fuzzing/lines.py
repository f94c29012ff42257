"""Command lines of all sub-commands on faulty workspaces, with values at edges and little memory or disk."""

import contextlib
import functools
import io
import os
import re
import resource
import shlex
import signal
from pathlib import Path
from random import Random
from typing import Any

from fuzzing import faults
from fuzzing.faults import Place
from fuzzing.kinds import LITERALS, PORT, TEXTS
from fuzzing.uses import run_words
from mien import cli
from mien.avatar.methods import METHODS
from mien.cli import COMMANDS

PARTS = ("given", "pictures", "videos", "flame", "gaussian_avatars", "flame_avatars", "head.mien", "head.ply", "cache")
_BASES = (
    "render {W} --out {root}/o.png --width 16 --height 16", "render {W} --out {root}/o.png --size 16 --path captured",
    "render {W} --out {root}/o.png --size 16 --motion clip", "export {W} --out {root}/o.ply",
    "render {W} --out {root}/o_%03d.png --size 16 --frames 2", "export {W} --out {root}/o.mien",
    "drive {W} --by {W} --out {root}/o.mp4 --size 16", "export {W} --out {root}/o.ply --series clip",
    "export {W} --out {root}/o --format gaussian-avatars",
    "evaluate {W} --no-perceptual", "evaluate compare {W}", "evaluate compare {W} --json",
    "train {W} --steps 1 --run other", "train {W} --steps 1 --run toy", "track {W} --again", "track {W}",
    "track {W} --hold-out clip", "face-models --json", "analyze gaussian-avatars {W} --parts growth",
    "render {W} --out {root}/o.webm --size 16 --frames 2 --background transparent",
    "render {W} --path {root}/given/cameras.json --out {root}/o_%d.png",
    "drive {W} --by {root}/given/take.csv --out {root}/o.mp4 --size 16",
    "drive {W} --by {root}/given/take.json --out {root}/o.mp4 --size 16",
    "evaluate images {root}/pictures {root}/pictures --no-perceptual",
    "evaluate images {root}/given/mattes {root}/given/mattes --no-perceptual --crops {root}/given/crops.json",
    "import {root}/flame_avatars --out {root}/new", "import {root}/gaussian_avatars --out {W} --run other",
    "evaluate {W} --no-perceptual --fit-faces --fit-steps 1", "study make {W} --out {root}/o.html",
    "study tally {root}/given/crops.json {root}/given/cameras.json", "bench compare {W} --methods nobody",
    "view {root}/none.mien", "bench", "bench quality --captures nobody --out {root}/o",
    "capture none.mp4 --out {root}/n", "create none.mp4 --out {root}/new", "demo --out {root}/head.ply",
)  # fmt: skip
SECONDS = 8.0
"""Seconds after which a line is interrupted, as by Ctrl-C."""
_PATHS = (
    "W", "W/", "./W/../W", "W/runs/toy", "W/sequences/clip/capture", "none", "none.png", "videos/clip.mp4", "pictures",
    "pictures/a.png", "given/take.csv", "given/take.json", "given/points.csv", "given/mattes", "given/crops.json",
    "head.mien", "head.ply", "flame/tiny.npz", "flame/tiny.pkl", "gaussian_avatars", "/dev/null", "/dev/zero",
    "/proc/self/mem", "/nowhere/x", ".", "..", "~", "-", "x" * 300, "a/" * 2000 + "x", f"http://127.0.0.1:{PORT}/x.mp4",
    "a\x1b[31m.png", "a\nb.mp4", "größer.png", "\udcff.png", "%s.png", "%d%d.png", "o.png", "o.mp4", "o.webm", "o.ply",
    "o.json", "o.html", "o", "o_%06d.png", "out/deep/o.png", "W/o.png", "head.ply/x.png", "/dev/full", "/proc/x.png",
)  # fmt: skip


def faulty_or_not(place: Place, dice: Random) -> str:
    return faults.any_fault(place, dice) if dice.random() < 0.6 else "none"


def run_an_odd_line(root: Path, found: Any, dice: Random) -> None:
    """Run a command with some odd options, sometimes on a full disk or with little memory."""
    words = [word.format(W=root / "W", root=root) for word in shlex.split(dice.choice(_BASES))]
    options = options_of(words[0]) if words[0] in COMMANDS else []
    for _ in range(dice.choice((0, 0, 1, 2)) if options else 0):
        words += _with_value(dice.choice(options), dice)
    if dice.random() < 0.1:
        words[dice.randrange(len(words))] = dice.choice((*TEXTS[:40], *_PATHS, *COMMANDS))
    if dice.random() < 0.1:
        words.append(dice.choice(("--help", "--help-all", "-h", "--", "--x", "--out", "--out=", "--version")))
    # A shell cannot pass null bytes, nor lone surrogates other than those of bytes.
    words = [word.replace("\x00", "").replace("\ud800", "\udcff") for word in words]
    limit, amount = dice.choice((*((None, 0),) * 6, (resource.RLIMIT_FSIZE, 500), (resource.RLIMIT_FSIZE, 20_000)))
    os.chdir(root)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit is not None:
        resource.setrlimit(limit, (amount, before[1]))
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)  # a line may ask for many frames, or for a page without end
    try:
        run_words(words, root)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@functools.cache
def options_of(command: str) -> list[tuple[str, str]]:
    """Return all options of a sub-command with what they take, as its help says them."""
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.suppress(SystemExit):
        cli.main([command, "--help-all"])
    return re.findall(r"^ +(--[a-z][\w.-]*) ?(\[?(?:\{[^}\s]+\}|INT|FLOAT|STR|PATH)(?: \[)?|)", told.getvalue(), re.M)


def _with_value(option: tuple[str, str], dice: Random) -> list[str]:
    name, kind = option
    if not kind:
        return [dice.choice((name, name.replace("--", "--no-", 1)))]
    count = dice.choice((0, 1, 1, 2, 30)) if kind.endswith("[") else 1
    return [name, *(_value(kind.strip("[ "), dice) for _ in range(count))]


def _value(kind: str, dice: Random) -> str:
    if dice.random() < 0.04:
        return dice.choice((*TEXTS[:40], *LITERALS, *_PATHS))
    if kind.startswith("{"):
        return dice.choice(kind.strip("{}").split(","))
    if kind in ("INT", "FLOAT"):
        return dice.choice((*LITERALS, "0", "-1", "2147483648", *("1", "2", "3", "16", "20") * 5))
    if kind == "PATH":
        return dice.choice(_PATHS)
    return dice.choice((*TEXTS[:40], *METHODS, "clip", "toy", "anny", "drop=0.5", "drop=nan", "white", "jawOpen=1"))
