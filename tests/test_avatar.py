"""Avatars survive a round trip to disk."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from damage import edit_json
from mien.avatar import DEFAULT_METHOD, METHODS, Avatar, FixedDensity, load_avatar, write_avatar
from mien.errors import UserError
from mien.face import FaceModel
from plain_settings import plain_config
from toy_scene import toy_face, toy_face_model


def new_avatar(method: str = DEFAULT_METHOD, face_model: FaceModel | None = None) -> Avatar:
    torch.manual_seed(0)
    return METHODS[method].avatar(plain_config(method), face_model or toy_face_model(), toy_face(5))


def test_subject_keeps_identity_and_offsets() -> None:
    face = replace(toy_face(5), vertex_offsets=torch.full((len(toy_face_model().template), 3), 0.001))
    method = METHODS[DEFAULT_METHOD]
    avatar = method.avatar(plain_config(DEFAULT_METHOD), toy_face_model(), face)
    assert len(avatar.subject) == 1
    assert torch.equal(avatar.subject.identity, face.identity)
    assert avatar.subject.vertex_offsets is not None


@pytest.mark.parametrize("method", METHODS)
def test_round_trip_of_a_run_and_of_an_avatar_folder(method: str, tmp_path: Path) -> None:
    avatar = new_avatar(method)
    if not isinstance(avatar.density(), FixedDensity):
        avatar.gaussian_store().append(torch.tensor([5, 6, 7]))
    write_avatar(tmp_path / "avatar", avatar)
    for folder in (tmp_path, tmp_path / "avatar"):
        loaded = load_avatar(folder)
        assert loaded.config == avatar.config
        for name, tensor in avatar.state_dict().items():
            assert torch.equal(tensor, loaded.state_dict()[name]), name
        for name, tensor in avatar.subject.tensors().items():
            assert torch.equal(tensor, loaded.subject.tensors()[name]), name


def test_loading_does_not_disturb_random_numbers(tmp_path: Path) -> None:
    write_avatar(tmp_path, new_avatar())
    torch.manual_seed(9)
    expected = torch.rand(1)
    torch.manual_seed(9)
    load_avatar(tmp_path)
    assert torch.equal(torch.rand(1), expected)


def test_what_cannot_be_loaded_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no trained avatar \\(no avatar.json\\)"):
        load_avatar(tmp_path)
    write_avatar(tmp_path, new_avatar())
    edit_json(tmp_path / "avatar.json", lambda content: None)
    content = (tmp_path / "avatar.json").read_text()
    (tmp_path / "avatar.json").write_text(content.replace(f'"{DEFAULT_METHOD}"', '"nerf"'))
    with pytest.raises(UserError, match="no method 'nerf'"):
        load_avatar(tmp_path)
    (tmp_path / "avatar.json").write_text(content.replace('"sh_degree": 0', '"sh_degree": "zero"'))
    with pytest.raises(UserError, match="sh_degree"):
        load_avatar(tmp_path)
    (tmp_path / "avatar.json").write_text(content.replace('"sh_degree": 0', '"sh_degree": 1'))
    with pytest.raises(UserError, match="does not fit its settings"):
        load_avatar(tmp_path)
    for damage, part in (
        ({"kind": None}, "lacks \\['kind'\\]"),
        ({"kind": 3}, "3 is not"),
        ({"kind": [DEFAULT_METHOD]}, "is not"),
        ({"config": "default"}, "config"),
        ({"config": None}, "config"),
        ({"gaussians": "many"}, "gaussians"),
        ({"gaussians": True}, "gaussians"),
        ({"gaussians": -1}, "-1 Gaussians"),
        ({"gaussians": 5}, "does not fit its settings"),
        ({"gaussians": 10**12}, "does not fit its settings"),
        ({"face_model": 7}, "face_model"),
        ({"tensors_sha256": None}, "tensors_sha256"),
        ({"surprise": 1}, "unknown entries \\['surprise'\\]"),
    ):
        damaged = {name: value for name, value in (json.loads(content) | damage).items() if value is not None}
        (tmp_path / "avatar.json").write_text(json.dumps(damaged))
        with pytest.raises(UserError, match=part):
            load_avatar(tmp_path)
    hash_line = toy_face_model().content_hash
    (tmp_path / "avatar.json").write_text(content.replace(hash_line, "0" * 16))
    with pytest.raises(UserError, match="was trained with face model 'toy'"):
        load_avatar(tmp_path)
    (tmp_path / "avatar.json").write_text(content)
    (tmp_path / "avatar.safetensors").write_bytes((tmp_path / "avatar.safetensors").read_bytes()[:500])
    with pytest.raises(UserError, match="damaged"):
        load_avatar(tmp_path)


def test_face_models_that_may_not_be_passed_on_are_not(tmp_path: Path) -> None:
    write_avatar(tmp_path, new_avatar(face_model=replace(toy_face_model(), name="flame", shareable=False)))
    assert not list(tmp_path.glob("face_model*"))
    with pytest.raises(UserError, match="flame"):
        load_avatar(tmp_path)


def test_a_flipped_byte_is_noticed(tmp_path: Path) -> None:
    write_avatar(tmp_path, new_avatar())
    path = tmp_path / "avatar.safetensors"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"avatar\.safetensors: .*differs from what was written"):
        load_avatar(tmp_path)
