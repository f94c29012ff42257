"""Avatars are written and read; the tensors of their Gaussians stay together with their moments."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from damage import edit_json
from mien.avatar import DEFAULT_METHOD, METHODS, Avatar, GaussianStore, Moments, load_avatar, write_avatar
from mien.errors import UserError
from mien.face import FaceModel
from plain_settings import plain_config
from toy_scene import toy_face, toy_face_model


def new_avatar(method: str = DEFAULT_METHOD, face_model: FaceModel | None = None) -> Avatar:
    torch.manual_seed(0)
    return METHODS[method].avatar(plain_config(method), face_model or toy_face_model(), toy_face(5))


def test_what_cannot_be_loaded_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no trained avatar \\(no avatar.json\\)"):
        load_avatar(tmp_path)
    write_avatar(tmp_path, new_avatar())
    description, tensors = tmp_path / "avatar.json", tmp_path / "avatar.safetensors"
    edit_json(description, lambda content: None)
    content, whole = description.read_text(), tensors.read_bytes()
    for old, new, words in (
        (f'"{DEFAULT_METHOD}"', '"nerf"', "no method 'nerf'"),
        ('"sh_degree": 0', '"sh_degree": "zero"', "sh_degree"),
        ('"sh_degree": 0', '"sh_degree": 1', "does not fit its settings"),
        (toy_face_model().content_hash, "0" * 16, "was trained with face model 'toy'"),
    ):
        description.write_text(content.replace(old, new))
        with pytest.raises(UserError, match=words):
            load_avatar(tmp_path)
    for damage, words in (
        ({"kind": None}, "lacks \\['kind'\\]"),
        ({"config": "default"}, "config"),
        ({"gaussians": -1}, "-1 Gaussians"),
        ({"gaussians": 10**12}, "does not fit its settings"),
        ({"face_model": 7}, "face_model"),
        ({"surprise": 1}, "unknown entries \\['surprise'\\]"),
    ):
        damaged = {name: value for name, value in (json.loads(content) | damage).items() if value is not None}
        description.write_text(json.dumps(damaged))
        with pytest.raises(UserError, match=words):
            load_avatar(tmp_path)
    description.write_text(content)
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 0xFF]) + whole[middle + 1 :]
    for damaged, words in ((whole[:500], "damaged"), (flipped, r"\.safetensors: .*differs from what was written")):
        tensors.write_bytes(damaged)
        with pytest.raises(UserError, match=words):
            load_avatar(tmp_path)


def test_face_models_that_may_not_be_passed_on_are_not(tmp_path: Path) -> None:
    """Loading does not disturb random numbers."""
    write_avatar(tmp_path / "free", new_avatar())
    torch.manual_seed(9)
    expected = torch.rand(1)
    torch.manual_seed(9)
    load_avatar(tmp_path / "free")
    assert torch.equal(torch.rand(1), expected)
    write_avatar(tmp_path / "own", new_avatar(face_model=replace(toy_face_model(), name="flame", shareable=False)))
    assert not list((tmp_path / "own").glob("face_model*"))
    with pytest.raises(UserError, match="flame"):
        load_avatar(tmp_path / "own")


def make_store(n: int = 6) -> GaussianStore:
    store = GaussianStore(
        {"means": torch.arange(3.0 * n).reshape(n, 3), "opacity_logits": torch.arange(n) / 10.0},
        {"face_index": torch.arange(n) * 100},
    )
    for name in ("means", "opacity_logits"):
        values = store[name].detach()
        store.moments[name] = Moments(values + 1, torch.full_like(values, 2), torch.tensor(7.0))
    return store


def moments_of(store: GaussianStore, name: str) -> Moments:
    moments = store.moments[name]
    assert isinstance(moments, Moments)
    return moments


def test_rows_stay_together_with_their_moments_and_new_ones_have_none() -> None:
    store = make_store()
    store.select(torch.tensor([True, False, False, True, False, True]))
    assert store["face_index"].tolist() == [0, 300, 500]
    assert store["means"][:, 0].tolist() == [0, 9, 15]
    assert torch.equal(moments_of(store, "means").first, store["means"].detach() + 1)
    assert moments_of(store, "means").step == 7
    assert isinstance(store["means"], torch.nn.Parameter)
    assert store["means"].is_leaf
    store.append(torch.tensor([2, 1]), {"means": torch.full((2, 3), -1.0)})
    assert store["face_index"].tolist() == [0, 300, 500, 500, 300]
    assert store["means"][3:].eq(-1).all()
    torch.testing.assert_close(store["opacity_logits"][3:], torch.tensor([0.5, 0.3]))
    assert moments_of(store, "means").first[:3].ne(0).all()
    assert not moments_of(store, "means").first[3:].any()
    assert not moments_of(store, "opacity_logits").second[3:].any()
    store.assign("opacity_logits", torch.zeros(5))
    assert not store["opacity_logits"].any()
    assert not moments_of(store, "opacity_logits").first.any()
    assert moments_of(store, "means").first.any()
