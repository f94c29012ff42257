"""Avatars without torch draw the same pictures, do not import torch, and report damaged files."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import torch

from mien import runtime
from mien.avatar import DEFAULT_METHOD, METHODS, Avatar, make_portable
from mien.runtime.posing import run_network
from plain_settings import plain_config
from refusals import refuses
from toy_scene import runtime_face, toy_camera, toy_sequence

SIZE = 64
method = pytest.mark.parametrize("method", METHODS)


def new_avatar(method: str, **config: object) -> Avatar:
    """Return an avatar of the toy head whose parameters all differ from their initial values."""
    face_model, sequence = toy_sequence(5, SIZE)
    torch.manual_seed(0)
    settings = replace(plain_config(method), **config)  # type: ignore[arg-type]
    avatar = METHODS[method].avatar(settings, face_model, sequence.tracking.face)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return avatar


def export(avatar: Avatar, path: Path) -> runtime.Avatar:
    runtime.write_portable(path, make_portable(avatar, toy_camera(SIZE), "toy"))
    return runtime.load(path)


@method
def test_a_file_holds_the_avatar_and_the_subject(method: str, tmp_path: Path) -> None:
    """What training draws is compared in test_runtime_equality.py."""
    avatar = new_avatar(method)
    loaded = export(avatar, tmp_path / "a.mien")
    subject = runtime.pose(loaded.portable.baked, runtime_face(avatar.subject))
    np.testing.assert_allclose(loaded.pose().means, subject.means)
    assert (loaded.expression_names, loaded.joint_names) == (("drop", "swell"), ("neck",))
    assert loaded.portable.about.method == method
    runtime.write_portable(tmp_path / "b.mien", loaded.portable)
    assert (tmp_path / "a.mien").read_bytes() == (tmp_path / "b.mien").read_bytes()


def test_names_and_their_mistakes(tmp_path: Path) -> None:
    portable = export(new_avatar(DEFAULT_METHOD), tmp_path / "toy.mien")
    rest = portable.face()
    face = portable.face({"drop": 0.7}, {"neck": (0.1, 0, 0)}, head_rotation=(0, 0.2, 0))
    assert face.expression.tolist() == [np.float32(0.7), rest.expression[1]]
    assert face.joints.tolist() == [[np.float32(0.1), 0, 0]]
    assert face.head_translation.tolist() == rest.head_translation.tolist()
    for wrong, part in (
        ({"expression": {"dorp": 1.0}}, "no expression 'dorp'; did you mean drop?"),
        ({"expression": np.zeros(3, np.float32)}, "expected \\(2,\\)"),
        ({"expression": {"drop": float("nan")}}, "not finite"),
        ({"joints": {"nose": (0, 0, 0)}}, "did you mean neck"),
        ({"head_rotation": (0, 1)}, "three finite numbers"),
    ):
        with pytest.raises(ValueError, match=part):
            portable.pose(**wrong)  # pyright: ignore[reportArgumentType]


@torch.no_grad()
def test_the_features_network_equals_its_reference_in_numpy_and_has_directions_that_fit(tmp_path: Path) -> None:
    whole = export(new_avatar("headgas", directions=2), tmp_path / "a.mien").portable
    assert isinstance(whole.baked, runtime.Static)
    network = whole.baked.network
    assert network is not None
    for timestep in range(3):
        face = runtime_face(toy_sequence(5, SIZE)[1].tracking.face[timestep])
        posed = runtime.pose(whole.baked, face)
        by_hand = run_network(network, np.zeros_like(whole.baked.means), face)
        np.testing.assert_allclose(by_hand[:, :-1].reshape(posed.sh.shape), posed.sh, rtol=0, atol=2e-6)
        np.testing.assert_allclose(1 / (1 + np.exp(-by_hand[:, -1])), posed.opacities, rtol=0, atol=5e-7)
    along = network.along
    assert along is not None
    for wrong, part in (
        (replace(along, rest=along.rest[1:], directions=along.directions[1:]), "the shape of rest of its directions"),
        (replace(along, basis=np.repeat(along.basis, 9, 2)), "288 features, but"),
        (replace(along, basis=along.basis[1:]), "the shape of basis of its directions"),
        (None, "the input features, which does not fit its directions"),
    ):
        baked = replace(whole.baked, network=replace(network, along=wrong))
        refuses(part, runtime.write_portable, tmp_path / "a.mien", replace(whole, baked=baked))


def test_files_with_other_content_are_told(tmp_path: Path) -> None:
    """Files with other content are reported, although another program wrote a right checksum."""
    path = tmp_path / "a.mien"
    whole = export(new_avatar(DEFAULT_METHOD), path).portable
    bound = whole.baked
    assert isinstance(bound, runtime.MeshBound)
    many = replace(bound.rig, expression_names=tuple(f"e{index}" for index in range(300)))
    nan = np.full_like(whole.neutral.expression, np.nan)
    for wrong, part in (
        (replace(whole, neutral=replace(whole.neutral, expression=nan)), "NaN"),
        (replace(whole, baked=replace(bound, face_index=bound.face_index + 10**6)), "that does not exist"),
        (replace(whole, expression_names=("drop",)), "1 expression names"),
        (replace(whole, joint_names=()), "0 joint names"),
        (replace(whole, baked=replace(bound, rig=replace(bound.rig, joint_parents=(2, 0, 0)))), "before its parent"),
        (replace(whole, baked=replace(bound, rig=many)), "300 expressions and 1 free joints, more than can be posed"),
    ):
        refuses(part, runtime.write_portable, path, wrong)
    arrays = safetensors.numpy.load_file(path)
    for version in (0, 2, "1", None):
        safetensors.numpy.save_file(arrays, path, {"mien": json.dumps({"format": "mien.baked", "version": version})})
        told = f"version {version!r}, expected 'mien.baked' version 1; export it again with `mien export`"
        refuses(re.escape(told), runtime.load, path)
    safetensors.numpy.save_file(arrays, path)
    (tmp_path / "b.mien").write_text("{}")
    for name, told in (
        ("a.mien", r"is not a \.mien file"),
        ("b.mien", r"is damaged, or not a \.mien file .*"),
        ("none.mien", "no such file"),
    ):
        refuses(f"{told}; write one with `mien export", runtime.load, tmp_path / name)


def test_face_models_that_may_not_be_passed_on_are_not() -> None:
    avatar = new_avatar(DEFAULT_METHOD)
    avatar.face_model = replace(avatar.face_model, name="flame", shareable=False)
    refuses("not known to allow", make_portable, avatar, toy_camera(SIZE), "toy")
