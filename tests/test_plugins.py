"""A package of a stranger adds a method, a format and a dataset, each by its recipe in CONTRIBUTING.md."""

import re
from pathlib import Path

import pytest

from forked import ForkServer
from mien.avatar import METHODS, has_method, method_named, method_names, method_of
from mien.avatar.methods import Method
from mien.cli import main
from mien.errors import UserError
from test_new_dataset import cache, puppet, write
from toy_package import blocks, entry_points, help_of, install, mien
from toy_scene import toy_face_model
from toy_workspace import write_toy_workspace

__all__ = ["cache"]
RECIPES = ("Add a method", "Add a format", "Add a dataset")


def install_toys(folder: Path) -> None:
    """Install `mien_toys`: what the three recipes make, in one module, under names that mien may not have."""
    method = blocks(RECIPES[0], "python")[:-1]
    (ending,) = re.findall(r"`(METHOD = [^`]*)`", " ".join(Path("CONTRIBUTING.md").read_text("utf-8").split()))
    code = [
        *method,
        f"from mien.avatar import Method\n{ending}\n",
        *(blocks(each, "python")[0] for each in RECIPES[1:]),
    ]
    points = re.sub(r"= mien_\w+:", "= mien_toys:", "".join(entry_points(each) for each in RECIPES))
    for word in ("mesh_points", "xyz", "puppet"):
        points = points.replace(f"{word} =", f"{word}9 =")
    text = "\n".join(code).replace("mien_mesh_points:", "mien_toys:")
    text = text.replace('"xyz"', '"xyz9"').replace('".xyz"', '".xyz9"').replace('"puppet"', '"puppet9"')
    install(folder, "mien_toys", text.replace('".puppet"', '".puppet9"'), points)


def test_one_package_adds_one_of_each(fork_server: ForkServer, tmp_path: Path, cache: str) -> None:  # noqa: F811
    """Footage is imported by its dataset, an avatar is trained by its method and exported in its format."""
    install_toys(tmp_path)
    out, me = str(tmp_path / "out"), tmp_path / "me.xyz9"
    path = str(write(tmp_path / "me.puppet9", puppet()))
    lines = (
        ("import", path, "--out", out, "--face-model", "mine"),
        ("train", out, "--method", "mesh_points9", "--method.start-scale", "0.01", "--steps", "2", "--split", "tail"),
        ("export", out, "--out", str(me)),
        ("export", out, "--out", str(tmp_path / "me.mien")),
        ("export", str(tmp_path / "me.mien"), "--out", str(tmp_path / "again.xyz9")),
    )
    for line in lines:
        done = mien(fork_server, tmp_path, *line, MIEN_CACHE=cache)
        assert done.returncode == 0, done.stderr
    assert len(me.read_text().splitlines()) == len(toy_face_model().template)
    assert (tmp_path / "again.xyz9").read_text() == me.read_text()
    assert '"kind": "mesh_points9"' in (Path(out) / "runs/mesh_points9/avatar/avatar.json").read_text()
    assert "textured_mesh, mesh_points9 (compared" in help_of(fork_server, tmp_path, "train")
    assert ".xyz9 files get numbers" in help_of(fork_server, tmp_path, "export")
    wrong = mien(fork_server, tmp_path, "train", out, "--method", "nerf").stderr
    names = "gaussian_avatars, headgas, mono_gaussian_avatar, point_avatar, textured_mesh, mesh_points9"
    assert f"give one of {names} instead" in wrong
    # Without the package, its avatar is refused with the remedy.
    gone = mien(fork_server, Path(out), "export", out, "--out", str(tmp_path / "b.ply"))
    assert gone.returncode == 2
    assert "no method 'mesh_points9'; give one of" in gone.stderr
    assert "or install the package that adds it" in gone.stderr


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("place") / "W"
    write_toy_workspace(folder)
    return folder


BROKEN = "[mien.formats]\nnone9 = mien_none9:IT\n[mien.datasets]\nnone9 = mien_none9:IT\n"
"""Entry points of a package whose module cannot be imported."""


@pytest.mark.parametrize("code", ["from mien.formats import NO_SUCH_NAME as IT", "raise SystemExit(3)"])
def test_a_broken_package_is_named_and_everything_else_works(
    fork_server: ForkServer, workspace: Path, tmp_path: Path, code: str
) -> None:
    install(tmp_path, "mien_none9", code, BROKEN)
    (good,) = blocks(RECIPES[1], "python")
    install(tmp_path, "mien_xyz9", good.replace("xyz", "xyz9"), entry_points(RECIPES[1]).replace("xyz", "xyz9"))
    (tmp_path / "F").mkdir()
    (tmp_path / "F/point_cloud.ply").touch()
    out = ("export", str(workspace), "--out")
    quiet = (("create", "--help"), (*out, str(tmp_path / "me.ply"), "--format", "ply"))
    named = (("export", "--help"), ("import", "--help"), (*out, str(tmp_path / "me.xyz9")))
    for line in (*quiet, *named):
        done = mien(fork_server, tmp_path, *line)
        told = [text for text in done.stderr.splitlines() if text.startswith("warning: ")]
        assert done.returncode == 0, done.stderr
        assert len(told) == (line in named)
        assert all("mien_none9:IT: mien-none9 adds it to mien." in text for text in told)
        assert all(text.endswith("; update or uninstall mien-none9; mien goes on without it") for text in told)
    assert (tmp_path / "me.xyz9").exists()
    for line in (
        (*out, str(tmp_path / "a.none9"), "--format"),
        ("import", str(tmp_path / "F"), "--out", "O", "--dataset"),
    ):
        refused = mien(fork_server, tmp_path, *line, "none9")
        (told,) = refused.stderr.splitlines()
        assert (refused.returncode, told[:39]) == (2, "mien: mien_none9:IT: mien-none9 adds it")


def test_a_dataset_that_fails_to_look_is_named(fork_server: ForkServer, tmp_path: Path) -> None:
    code = (
        "from mien.datasets import Dataset\nIT = Dataset('none9', 'none', 'avatar', lambda path: path.nothing, print)\n"
    )
    install(tmp_path, "mien_none9", code, "[mien.datasets]\nnone9 = mien_none9:IT\n")
    (tmp_path / "F").mkdir()
    done = mien(fork_server, tmp_path, "import", str(tmp_path / "F"), "--out", str(tmp_path / "O"))
    warning, told = done.stderr.splitlines()
    assert done.returncode == 2
    assert warning.startswith(f"warning: {tmp_path / 'F'}: the dataset 'none9' fails (AttributeError(")
    assert "is no dataset that mien knows" in told


def assert_holds(server: ForkServer, folder: Path, function: str) -> None:
    """Check what a function of this file asserts in a process where the packages of a folder are installed."""
    process = server.call(f"test_plugins:{function}", path=[folder])
    assert process.wait() == 0, process.stderr


def test_a_method_without_its_classes_is_named_and_stops_no_other(fork_server: ForkServer, tmp_path: Path) -> None:
    code = (
        "from dataclasses import dataclass\nfrom mien.avatar import Method, MethodConfig\n\n\n"
        "@dataclass(frozen=True)\nclass ToyConfig(MethodConfig):\n    pass\n\n\n"
        "A, B = (Method(f'mien_toys_c:{name}', f'mien_toys_c:{name}Config') for name in ('Typo', 'Toy'))\n"
    )
    install(tmp_path, "mien_toys_c", code, "[mien.methods]\ntoy_a = mien_toys_c:A\ntoy_b = mien_toys_c:B\n")
    assert_holds(fork_server, tmp_path, "a_method_without_its_classes_is_named")


def a_method_without_its_classes_is_named() -> None:
    assert method_of(method_named("toy_b").config()) == "toy_b"
    with pytest.raises(UserError, match="^mien_toys_c:TypoConfig: cannot be imported .*; update or uninstall"):
        print(method_named("toy_a").config)
    with pytest.raises(UserError, match="^mien_toys_c:Typo: cannot be imported .*; update or uninstall"):
        print(method_named("toy_a").avatar)


CODE = "from mien.avatar.methods import Method\nOWN = Method('nowhere:Toy', 'nowhere:ToyConfig')\nWRONG = 1\n"


def test_methods_of_packages_are_found_by_name(fork_server: ForkServer, tmp_path: Path) -> None:
    points = "[mien.methods]\ntoy_a = mien_toys_a:OWN\nheadgas = mien_toys_a:OWN\nwrong = mien_toys_a:WRONG\n"
    install(tmp_path, "mien_toys_a", CODE, points)
    assert_holds(fork_server, tmp_path, "methods_are_found_by_name")
    install(tmp_path, "mien_toys_b", CODE, "[mien.methods]\ntoy_a = mien_toys_b:OWN\n")
    assert_holds(fork_server, tmp_path, "one_name_of_two_packages_is_told")


def methods_are_found_by_name() -> None:
    assert method_names() == [*METHODS, "toy_a", "wrong"]
    assert has_method("toy_a")
    assert not has_method("toy_b")
    assert method_named("toy_a") == Method("nowhere:Toy", "nowhere:ToyConfig")
    assert method_named("headgas") is METHODS["headgas"], "mien's own come first"
    with pytest.raises(UserError, match="it is no Method; update or uninstall mien-toys-a"):
        method_named("wrong")
    with pytest.raises(UserError, match="no method 'toy_b'; give one of gaussian_avatars, .*, toy_a, wrong, or"):
        method_named("toy_b")


def one_name_of_two_packages_is_told() -> None:
    with pytest.raises(UserError, match="mien-toys-. and mien-toys-. both add 'toy_a' to mien.methods; uninstall"):
        method_named("toy_a")
    assert method_names() == [*METHODS, "toy_a", "wrong"], "others go on working"


def test_entry_points_are_read_only_for_methods_that_mien_lacks(fork_server: ForkServer, tmp_path: Path) -> None:
    assert_holds(fork_server, tmp_path, "entry_points_are_read_late")


def entry_points_are_read_late() -> None:
    asked = {"mien.methods": lambda: pytest.fail("read")}  # libraries read groups of their own
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("importlib.metadata.entry_points", lambda group: asked.get(group, tuple)())
        assert main(["train", "gone"]) == 2
        assert main(["train", "gone", "--method", "headgas"]) == 2
        with pytest.raises(pytest.fail.Exception, match="read"):
            main(["train", "gone", "--method", "nerf"])
