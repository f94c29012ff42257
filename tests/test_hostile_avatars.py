"""Avatars, face models and checkpoints from a stranger are refused when they are read, whatever their checksums say."""

import hashlib
import itertools
import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import torch
from torch import Tensor

import train_toy
from damage import edit_json, nested
from mien import runtime
from mien.avatar import DEFAULT_METHOD, METHODS, Avatar, load_avatar, make_portable, write_avatar
from mien.errors import UserError
from mien.face.loading import read_face_model, read_landmarks, write_face_model
from mien.face.model import FaceModel
from mien.runtime import baked as portable
from mien.storage import file_digest, read_tensors, write_tensors
from mien.training.checkpoint import checkpoint_files, resume
from mien.training.trainer import start
from plain_settings import plain_config
from toy_scene import toy_camera, toy_face_model, toy_sequence

HUGE = 10**400
WRONG_NUMBERS = (float("nan"), float("inf"), 3e38)


@pytest.fixture(scope="module")
def avatars(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a folder with an untrained avatar of each method."""
    face_model, sequence = toy_sequence(5, 32)
    folders = {}
    for name, method in METHODS.items():
        torch.manual_seed(0)
        folders[name] = tmp_path_factory.mktemp(name) / "avatar"
        write_avatar(folders[name], method.avatar(plain_config(name), face_model, sequence.tracking.face))
    return folders


def received(avatars: dict[str, Path], method: str, place: Path) -> Path:
    return shutil.copytree(avatars[method], place / "avatar")


def refused(folder: Path, match: str = ".") -> None:
    with pytest.raises(UserError, match=match) as error:
        load_avatar(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


def change(folder: Path, edit: Callable[[dict[str, Tensor]], object]) -> None:
    """Change an avatar's tensors and correct its checksums."""
    tensors = read_tensors(folder / "avatar.safetensors")
    edit(tensors)
    write_tensors(folder / "avatar.safetensors", {name: tensor.contiguous() for name, tensor in tensors.items()})
    digest = file_digest(folder / "avatar.safetensors")
    edit_json(folder / "avatar.json", lambda content: content.update(tensors_sha256=digest))


@pytest.mark.parametrize("method", METHODS)
def test_numbers_that_cannot_be_drawn(method: str, avatars: dict[str, Path], tmp_path: Path) -> None:
    """Numbers that cannot be drawn are refused, wherever they are in the tensors."""
    names = [name for name, tensor in read_tensors(avatars[method] / "avatar.safetensors").items()
             if tensor.is_floating_point() and tensor.numel()]  # fmt: skip
    folder = received(avatars, method, tmp_path)
    whole = (folder / "avatar.safetensors").read_bytes()
    for name, value in zip(names[:: -(-len(names) // 12)], itertools.cycle(WRONG_NUMBERS), strict=False):
        (folder / "avatar.safetensors").write_bytes(whole)
        change(folder, lambda tensors, name=name, value=value: tensors[name].flatten()[-1:].fill_(value))
        refused(folder)


TENSORS: dict[str, Callable[[dict[str, Tensor]], object]] = {
    "triangle out of range": lambda t: t["avatar.store.face_index"].fill_(10**6),
    "triangle negative": lambda t: t["avatar.store.face_index"].fill_(-1),
    "triangle of floats": lambda t: t.update({"avatar.store.face_index": t["avatar.store.face_index"].double()}),
    "shape": lambda t: t.update({"avatar.store.trained.quats": t["avatar.store.trained.quats"][:, :3]}),
    "number": lambda t: t.update({"avatar.store.trained.quats": t["avatar.store.trained.quats"][:5]}),
    "dtype": lambda t: t.update({"avatar.store.trained.means": t["avatar.store.trained.means"].double()}),
    "missing": lambda t: t.pop("avatar.store.trained.means"),
    "one more": lambda t: t.update({"avatar.more": torch.zeros(3)}),
    "scales": lambda t: t["avatar.store.trained.log_scales"].fill_(1000),
    "subject missing": lambda t: t.pop("subject.joints"),
    "subject more": lambda t: t.update({"subject.more": torch.zeros(3)}),
    "subject shape": lambda t: t.update({"subject.expression": torch.zeros(1, 9)}),
    "subject times": lambda t: t.update({name: t[name][:0] for name in t if name.startswith("subject.head")}),
    "offsets": lambda t: t.update({"subject.vertex_offsets": torch.zeros(7, 3)}),
    "identity": lambda t: t.update({"subject.identity": torch.zeros(99)}),
}


@pytest.mark.parametrize("name", TENSORS)
def test_tensors_that_do_not_fit(name: str, avatars: dict[str, Path], tmp_path: Path) -> None:
    """In every method that has such tensors."""
    changed = 0
    for method in METHODS:
        folder = received(avatars, method, tmp_path / method)
        try:
            change(folder, TENSORS[name])
        except KeyError:
            continue
        changed += 1
        refused(folder)
    assert changed


def of_config(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda content: content["config"].update(values)


SETTINGS: dict[str, tuple[str, Callable[[dict[str, Any]], object]]] = {
    "degree odd": ("sh_degree", of_config(sh_degree=17)),
    "degree negative": ("sh_degree", of_config(sh_degree=-1)),
    "degree text": ("sh_degree", of_config(sh_degree="2")),
    "degree huge": ("sh_degree", of_config(sh_degree=HUGE)),
    "frame": ("sh_frame", of_config(sh_frame=["world"])),
    "rate huge": ("means_rate", of_config(means_rate={"kind": "Rate", "start": HUGE})),
    "density": ("density", of_config(density=[1])),
    "hidden": ("hidden", of_config(hidden=10**9)),
    "features": ("features", of_config(features=10**9)),
    "bands": ("encoding_bands", of_config(encoding_bands=10**9)),
    "length": ("encoding_length", of_config(encoding_length=0.0)),
    "width": ("attribute_width", of_config(attribute_width=10**9)),
    "layers": ("attribute_layers", of_config(attribute_layers=10**9)),
    "gaussians": ("", lambda c: c.update(gaussians=10**12)),
    "gaussians huge": ("", lambda c: c.update(gaussians=HUGE)),
    "method": ("", lambda c: c.update(kind=next(name for name in METHODS if name != c["kind"]))),
    "no method": ("", lambda c: c.update(kind=[c["kind"]])),
    "config": ("", lambda c: c.update(config=[])),
    "face model": ("", lambda c: c.update(face_model="../../../secret")),
    "face model of text": ("", lambda c: c.update(face_model=3)),
    "face model elsewhere": ("", lambda c: c.update(face_model="../x", face_model_carried=False)),
}
"""The setting that a method has to have, and a change of avatar.json."""


def having(setting: str) -> list[str]:
    """The methods that have a setting; "" is had by all."""
    return [name for name, method in METHODS.items() if setting in ("", *(f.name for f in fields(method.config)))]


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_that_cannot_be(name: str, avatars: dict[str, Path], tmp_path: Path) -> None:
    """Impossible settings of an avatar are refused in one line."""
    setting, edit = SETTINGS[name]
    assert having(setting)
    for method in having(setting):
        folder = received(avatars, method, tmp_path / method)
        edit_json(folder / "avatar.json", edit)
        with pytest.raises(UserError) as error:
            load_avatar(folder)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("method", having("points"))
def test_what_counts_only_at_the_beginning_takes_no_memory(
    method: str, avatars: dict[str, Path], tmp_path: Path
) -> None:
    """Settings that only matter at the start take no memory. The avatar has the points of its tensors."""
    folder = received(avatars, method, tmp_path)
    edit_json(folder / "avatar.json", of_config(points=1_000_000))
    expected, found = load_avatar(avatars[method]), load_avatar(folder)
    assert len(found.gaussian_store()) == len(expected.gaussian_store())
    assert found.config.points == 1_000_000  # pyright: ignore[reportAttributeAccessIssue]
    posed = [avatar.pose(avatar.subject).gaussians.means for avatar in (found, expected)]
    assert torch.equal(*posed)


def test_an_avatar_that_is_a_link_is_not_read(avatars: dict[str, Path], tmp_path: Path) -> None:
    folder = received(avatars, DEFAULT_METHOD, tmp_path / "run")
    secret = tmp_path / "secret.safetensors"
    (folder / "avatar.safetensors").rename(secret)
    (folder / "avatar.safetensors").symlink_to(secret)
    refused(folder, "a link")
    refused(folder.parent, "a link")
    shutil.rmtree(folder)
    folder.symlink_to(avatars[DEFAULT_METHOD])
    with pytest.raises(UserError, match="a link"):
        load_avatar(folder.parent)


MODELS: dict[str, Callable[[FaceModel], FaceModel]] = {
    "vertex out of range": lambda m: replace(m, faces=m.faces + 10**6),
    "vertex negative": lambda m: replace(m, faces=m.faces - 1),
    "texture out of range": lambda m: replace(m, uv_faces=m.uv_faces + 10**6),
    "region out of range": lambda m: replace(m, face_regions=m.face_regions + 1),
    "parents of text": lambda m: replace(m, joint_parents=("-1", "0", "0")),  # pyright: ignore[reportArgumentType]
    "parents in a circle": lambda m: replace(m, joint_parents=(-1, 2, 1)),
    "parents beyond": lambda m: replace(m, joint_parents=(-1, 0, 7)),
    "parents too few": lambda m: replace(m, joint_parents=(-1,)),
    "free of text": lambda m: replace(m, joint_free=("no", "yes", "no")),  # pyright: ignore[reportArgumentType]
    "free too many": lambda m: replace(m, joint_free=(True, True, True, True)),
    "names": lambda m: replace(m, expression_names=("drop",)),
    "names of numbers": lambda m: replace(m, expression_names=(1, 2)),  # pyright: ignore[reportArgumentType]
    "names of lines": lambda m: replace(m, joint_names=("head", "a\nb", "jaw")),
    "no joints": lambda m: replace(m, joint_names=(), joint_parents=(), joint_free=()),
    "NaN": lambda m: replace(m, template=m.template.clone().fill_(torch.nan)),
    "huge": lambda m: replace(m, expression_basis=m.expression_basis + 3e38),
    "shapes": lambda m: replace(m, skinning_weights=m.skinning_weights[:5]),
    "bounds": lambda m: replace(m, expression_bounds=m.expression_bounds[:1]),
    "correctives": lambda m: replace(m, pose_basis=torch.zeros(5, *m.template.shape)),
    "dtype": lambda m: replace(m, template=m.template.double()),
}


@pytest.mark.parametrize("name", MODELS)
def test_face_models_that_cannot_be(
    name: str, avatars: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Impossible face models are refused, by themselves and inside an avatar, with a matching hash."""
    monkeypatch.setattr("mien.face.model.FaceModel.__init__", unchecked_init(FaceModel))
    wrong = MODELS[name](toy_face_model())
    folder = received(avatars, DEFAULT_METHOD, tmp_path)
    monkeypatch.setattr("mien.face.model.FaceModel.content_hash", "0123")
    write_face_model(folder / "face_model", wrong)
    edit_json(folder / "avatar.json", lambda content: content.update(face_model_hash="0123"))
    with pytest.raises(UserError, match="face_model"):
        read_face_model(folder / "face_model")
    refused(folder)


def unchecked_init(cls: type) -> Callable[..., None]:
    """Return an `__init__` without the type checks of the tests, since users have none."""
    defaults = {f.name: f.default for f in fields(cls)}

    def init(self: Any, **values: Any) -> None:
        for name in defaults:
            object.__setattr__(self, name, values.get(name, defaults[name]))

    return init


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a\0b", ""])
def test_landmarks_of_a_name_that_leads_elsewhere(name: str) -> None:
    with pytest.raises(UserError, match="cannot be the name of a face model"):
        read_landmarks(name, toy_face_model())


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    train_toy.main(folder, 8)
    return folder


CHECKPOINTS: dict[str, Callable[[dict[str, Tensor]], object]] = {
    "triangle": lambda t: t["avatar.store.face_index"].fill_(10**6),
    "NaN": lambda t: t["avatar.store.trained.means"].fill_(torch.nan),
    "moments": lambda t: t["store.means:first"].fill_(torch.inf),
    "moments' shape": lambda t: t.update({"store.means:first": torch.zeros(3)}),
    "moments of nothing": lambda t: t.update({f"store.none:{part}": torch.zeros(3) for part in ("first", "second")}),
    "step negative": lambda t: t["step"].fill_(-1),
    "step of several": lambda t: t.update({"step": torch.zeros(3)}),
    "gaussians": lambda t: t["gaussians"].fill_(10**12),
    "density": lambda t: t.update({"density.seen": torch.zeros(3)}),
    "density missing": lambda t: t.pop("density.pull"),
    "track": lambda t: t.update({"track.expression": torch.zeros(9)}),
    "curves": lambda t: t.update({"curves.loss": torch.zeros(())}),
    "no curves": lambda t: [t.pop(name) for name in list(t) if name.startswith("curves.")],
}


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_checkpoints_that_cannot_be(name: str, run_dir: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(run_dir / "checkpoints", tmp_path / "checkpoints")
    newest = checkpoint_files(folder)[-1]
    tensors = read_tensors(newest)
    CHECKPOINTS[name](tensors)
    write_tensors(newest, tensors)
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    state = start([sequence], face_model, train_toy.CONFIG, train_toy.SETTINGS)
    with pytest.raises(UserError, match=newest.name) as error:
        resume(folder, state, first_record=1)
    assert "\n" not in str(error.value)


@cache
def new_portable(method: str) -> portable.PortableAvatar:
    face_model, sequence = toy_sequence(5, 32)
    torch.manual_seed(0)
    avatar: Avatar = METHODS[method].avatar(plain_config(method), face_model, sequence.tracking.face)
    return make_portable(avatar, toy_camera(32), "toy")


def rewrite(path: Path, edit: Callable[[dict[str, Any], dict[str, np.ndarray]], object]) -> None:
    """Change a .mien file and correct all of its checksums, by the format's own description."""
    with safetensors.safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["mien"])
    arrays = safetensors.numpy.load_file(path)
    edit(header["content"], arrays)
    digest = hashlib.sha256(json.dumps(header["content"], sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(name.encode() + str(array.dtype).encode() + struct.pack(f"<{array.ndim}q", *array.shape))
        digest.update(np.ascontiguousarray(array).data)
    header["sha256"] = digest.hexdigest()
    safetensors.numpy.save_file(arrays, path, {"mien": json.dumps(header)})


Edit = Callable[[dict[str, Any], dict[str, np.ndarray]], object]
PORTABLES: dict[str, Edit] = {
    "array for a text": lambda c, a: c["about"].update(name={"tensor": "camera.K"}),
    "array for a choice": lambda c, a: c["baked"]["network"].update(input={"tensor": "camera.K"}),
    "array for a kind": lambda c, a: c["baked"].update(kind={"tensor": "camera.K"}),
    "array for a number": lambda c, a: c["camera"].update(width={"tensor": "camera.K"}),
    "array for a scale": lambda c, a: c["baked"].update(scale_gain={"tensor": "camera.K"}),
    "tensor of a list": lambda c, a: c["camera"].update(K={"tensor": [1]}),
    "content of a list": lambda c, a: c.update(baked=[1]),
    "width": lambda c, a: c["camera"].update(width=10**9),
    "width huge": lambda c, a: c["camera"].update(width=HUGE),
    "camera": lambda c, a: a["camera.K"].fill(3e38),
    "viewmat": lambda c, a: a["camera.viewmat"].fill(0),
    "parents of text": lambda c, a: c["baked"]["rig"].update(joint_parents=["-1", "0", "0"]),
    "parents in a circle": lambda c, a: c["baked"]["rig"].update(joint_parents=[-1, 2, 1]),
    "parents huge": lambda c, a: c["baked"]["rig"].update(joint_parents=[-1, 0, HUGE]),
    "too few parents": lambda c, a: c["baked"]["rig"].update(joint_parents=[-1]),
    "free": lambda c, a: c["baked"]["rig"].update(joint_free=[True] * 3),
    "triangle": lambda c, a: a["baked.faces"].fill(2**31 - 1),
    "triangle negative": lambda c, a: a["baked.face_index"].fill(-1),
    "scales": lambda c, a: a["baked.attributes.log_scales"].fill(1000),
    "gain": lambda c, a: c["baked"].update(scale_gain=1e300),
    "outputs twice": lambda c, a: c["baked"]["network"].update(outputs=["sh", "sh"]),
    "outputs": lambda c, a: c["baked"]["network"].update(outputs=["means"]),
    "no layers": lambda c, a: c["baked"]["network"].update(weights=[], biases=[]),
    "sh": lambda c, a: a.update({"baked.attributes.sh": np.zeros((len(
        a["baked.attributes.quats"]), 2, 3), np.float32)}),
    "dtype": lambda c, a: a.update({"baked.means": a["baked.means"].astype(np.float64)}),
    "shape": lambda c, a: a.update({"baked.means": a["baked.means"][:3].copy()}),
    "lines": lambda c, a: c["about"].update(name="a\x1b[2Jb"),
    "deep": lambda c, a: c["about"].update(name=nested(400)),
}  # fmt: skip


@pytest.mark.parametrize("name", PORTABLES)
def test_portable_files_that_cannot_be(name: str, tmp_path: Path) -> None:
    """In every method whose files have such a part."""
    changed, path = 0, tmp_path / "a.mien"
    for method in METHODS:
        runtime.write_portable(path, new_portable(method))
        rewrite(path, lambda content, arrays: None)
        runtime.read_portable(path)
        try:
            rewrite(path, PORTABLES[name])
        except (KeyError, AttributeError):
            continue
        changed += 1
        with pytest.raises(UserError) as error:
            runtime.read_portable(path)
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)
    assert changed


@pytest.mark.parametrize("method", METHODS)
def test_numbers_of_portable_files_that_cannot_be(method: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mien"
    runtime.write_portable(path, new_portable(method))
    whole = path.read_bytes()
    names = [
        name for name, array in safetensors.numpy.load_file(path).items() if array.dtype.kind == "f" and array.size
    ]
    for name, value in zip(names, itertools.cycle(WRONG_NUMBERS), strict=False):
        path.write_bytes(whole)

        def put(content: dict[str, Any], arrays: dict[str, np.ndarray], name: str = name, value: float = value) -> None:
            arrays[name] = np.array(arrays[name])
            arrays[name].flat[-1] = value

        rewrite(path, put)
        with pytest.raises(UserError, match="NaN|camera"):
            runtime.read_portable(path)
