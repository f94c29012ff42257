"""Avatars are written and read; the tensors of their Gaussians stay together with their moments."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from damage import edit_json
from mien.avatar import DEFAULT_METHOD, METHODS, Avatar, GaussianStore, Moments, load_avatar, write_avatar
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
    path = tmp_path / "avatar.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[:500])
    with pytest.raises(UserError, match="damaged"):
        load_avatar(tmp_path)
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 0xFF]) + whole[middle + 1 :])
    with pytest.raises(UserError, match=r"avatar\.safetensors: .*differs from what was written"):
        load_avatar(tmp_path)


def test_face_models_that_may_not_be_passed_on_are_not(tmp_path: Path) -> None:
    write_avatar(tmp_path, new_avatar(face_model=replace(toy_face_model(), name="flame", shareable=False)))
    assert not list(tmp_path.glob("face_model*"))
    with pytest.raises(UserError, match="flame"):
        load_avatar(tmp_path)


def make_store(n: int = 6) -> GaussianStore:
    store = GaussianStore(
        {"means": torch.arange(3.0 * n).reshape(n, 3), "opacity_logits": torch.arange(n) / 10.0},
        {"face_index": torch.arange(n) * 100},
    )
    for name in ("means", "opacity_logits"):
        moments = Moments.zeros(store[name].detach())
        moments.first += store[name].detach() + 1
        moments.second += 2
        moments.step += 7
        store.moments[name] = moments
    return store


def moments_of(store: GaussianStore, name: str) -> Moments:
    moments = store.moments[name]
    assert isinstance(moments, Moments)
    return moments


def test_select_keeps_tensors_and_moments_together() -> None:
    store = make_store()
    store.select(torch.tensor([True, False, False, True, False, True]))
    assert store["face_index"].tolist() == [0, 300, 500]
    assert store["means"][:, 0].tolist() == [0, 9, 15]
    assert torch.equal(moments_of(store, "means").first, store["means"].detach() + 1)
    assert moments_of(store, "means").step == 7
    assert isinstance(store["means"], torch.nn.Parameter)
    assert store["means"].is_leaf


def test_children_copy_their_parents_and_start_without_momentum() -> None:
    store = make_store()
    store.append(torch.tensor([4, 1]), {"means": torch.full((2, 3), -1.0)})
    assert len(store) == 8
    assert store["face_index"][-2:].tolist() == [400, 100]
    assert store["means"][-2:].eq(-1).all()
    torch.testing.assert_close(store["opacity_logits"][-2:], torch.tensor([0.4, 0.1]))
    assert moments_of(store, "means").first[-2:].eq(0).all()
    assert moments_of(store, "means").first[:-2].ne(0).all()
    assert moments_of(store, "opacity_logits").second[-2:].eq(0).all()


def test_assign_forgets_momentum() -> None:
    store = make_store()
    store.assign("opacity_logits", torch.zeros(6))
    assert store["opacity_logits"].eq(0).all()
    assert moments_of(store, "opacity_logits").first.eq(0).all()
    assert moments_of(store, "means").first.ne(0).any()


def test_what_does_not_fit_a_store_is_our_bug() -> None:
    with pytest.raises(AssertionError, match="triangle"):
        make_store().append(torch.tensor([0]), {"triangle": torch.tensor([1])})
    with pytest.raises(AssertionError, match="differ in length"):
        GaussianStore({"means": torch.zeros(3, 3)}, {"face_index": torch.zeros(4)})


def test_state_dict_holds_everything_and_loads_into_another_length() -> None:
    store, other = make_store(), make_store(2)
    other.resize(6)
    other.load_state_dict(store.state_dict())
    for name in store.names():
        assert torch.equal(store[name], other[name]), name
    assert other.moments == {}


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2**31 - 1)), max_size=8))
def test_any_sequence_of_changes_keeps_lengths_and_ties(changes: list[tuple[bool, int]]) -> None:
    store = make_store()
    for grow, seed in changes:
        random = torch.Generator().manual_seed(seed)
        if grow:
            store.append(torch.randint(len(store), (3,), generator=random))
        else:
            mask = torch.rand(len(store), generator=random) < 0.7
            mask[0] = True
            store.select(mask)
    assert {len(store[name]) for name in store.names()} == {len(store)}
    assert {len(moments_of(store, name).first) for name in store.moments} == {len(store)}
    # Tensors and moments still belong together.
    assert torch.equal(store["means"].detach()[:, 0] / 3, store["face_index"] / 100)
