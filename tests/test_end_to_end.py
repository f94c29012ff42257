"""A short version of the demo runs: video, capture, tracking, training, report; then every use of the avatar."""

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from conftest import MadeOnce
from demo_case import DEMO, FRAMES, make_demo
from forked import ForkServer, run_forked
from mien import runtime
from mien.avatar import DEFAULT_METHOD
from mien.capture.video import probe_video
from mien.cli import main
from mien.export import read_ply
from web_case import chromium, violations

pytestmark = pytest.mark.unchecked
RUN = Path("runs") / DEFAULT_METHOD


@pytest.fixture(scope="module")
def workspace(made_once: MadeOnce, fork_server: ForkServer) -> Path:
    return made_once("demo", partial(make_demo, fork_server))


def test_demo_beats_both_baselines(workspace: Path) -> None:
    metrics = json.loads((workspace / RUN / "metrics.json").read_text())
    assert (metrics["format"], metrics["version"]) == ("mien.metrics", 1)
    entry = metrics["protocols"]["self_reenactment"]
    assert entry["split"] == "blocks"
    assert entry["frames"] == 2
    best = max(baseline["head"]["psnr"] for baseline in entry["baselines"].values())
    assert entry["head"]["psnr"] > best + 1
    assert metrics["training"]["steps"] == int(DEMO[-1])


def test_demo_leaves_what_people_look_at(workspace: Path) -> None:
    page = (workspace / RUN / "report.html").read_text(encoding="utf-8")
    assert "<h1>" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert probe_video(workspace / "sequences/synthetic/tracking/overlay.mp4").frames == FRAMES
    assert probe_video(workspace / "me.mp4").frames == 10
    assert (workspace / "me.html").stat().st_size > 100_000


def test_everybody_can_read_the_reports(workspace: Path, tmp_path: Path) -> None:
    chromium()
    assert main(["evaluate", str(workspace), "--compare", "--out", str(tmp_path / "compare.html")]) == 0
    tracked = workspace / "sequences/synthetic/tracking/report.html"
    for page in (workspace / RUN / "report.html", tracked, tmp_path / "compare.html"):
        for size, device in (((1280, 800), []), ((390, 844), ["dark", "touch"])):
            assert violations(page, size, device) == [], (page, device)


def test_the_same_command_finds_everything_done(workspace: Path, fork_server: ForkServer, tmp_path: Path) -> None:
    shutil.copytree(workspace, tmp_path / "demo")
    avatar = tmp_path / "demo" / RUN / "avatar" / "avatar.safetensors"
    before = avatar.stat().st_mtime_ns
    done = run_forked(fork_server, "demo", "--out", tmp_path / "demo", *DEMO)
    assert done.returncode == 0, done.stderr
    assert avatar.stat().st_mtime_ns == before
    for work in ("Drawing", "capture synthetic:", "Tracking:", "training:", "evaluate self_reenactment:", "film:"):
        assert work not in done.stderr


def test_using_the_avatar(workspace: Path, tmp_path: Path) -> None:
    avatar = str(workspace)
    assert main(["export", avatar, "--out", str(tmp_path / "open.ply"), "--set", "jawOpen=0.6"]) == 0
    assert len(read_ply(tmp_path / "open.ply")) > 1000
    assert main(["render", avatar, "--out", str(tmp_path / "still.png"), "--size", "64"]) == 0
    assert main(["render", avatar, "--out", str(tmp_path / "aside.png"), "--size", "64", "--yaw", "30"]) == 0
    assert (tmp_path / "aside.png").read_bytes() != (tmp_path / "still.png").read_bytes()
    assert main(["export", avatar, "--out", str(tmp_path / "me.mien")]) == 0
    assert runtime.load(tmp_path / "me.mien").render()[1].max() > 0.5
    series = ["--series", "synthetic", "--every", "5"]
    assert main(["export", avatar, "--out", str(tmp_path / "talk.ply"), *series]) == 0
    assert len(list(tmp_path.glob("talk_*.ply"))) == 3
    clear = ["--background", "transparent", "--size", "64"]
    assert main(["render", avatar, "--out", str(tmp_path / "f"), "--path", "sway", "--frames", "2", *clear]) == 0
    assert len(list((tmp_path / "f").iterdir())) == 2
    (tmp_path / "a.json").write_text('[{"blendshapes": {"jawOpen": 0.5}}, {"blendshapes": {}}]')
    by = ["--by", str(tmp_path / "a.json")]
    assert main(["drive", avatar, *by, "--out", str(tmp_path / "d.webm"), *clear]) == 0
    assert main(["render", avatar, "--out", str(tmp_path / "turn.mp4"), "--size", "64", "--frames", "6"]) == 0
    assert probe_video(tmp_path / "turn.mp4").frames == 6
    assert main(["drive", avatar, "--by", avatar, "--out", str(tmp_path / "driven.mp4"), "--size", "64"]) == 0
    assert probe_video(tmp_path / "driven.mp4").frames == FRAMES


def test_bad_requests_to_an_avatar(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, part in (
        (["export", str(workspace), "--out", str(tmp_path / "a.ply"), "--set", "jawopen=1"], "no expression 'jawopen'"),
        (["export", str(workspace), "--out", str(tmp_path / "a.ply"), "--set", "jawOpen=wide"], "is not a number"),
        (["export", str(workspace), "--out", str(tmp_path / "a.ply"), "--run", "other"], "no run 'other'"),
        (["render", str(workspace), "--out", str(tmp_path / "a.gif")], "cannot write .gif"),
        (["render", str(workspace), "--out", str(tmp_path / "a.png"), "--size", "100000"], "--size 100000"),
    ):
        assert main(arguments) == 2
        assert part in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
