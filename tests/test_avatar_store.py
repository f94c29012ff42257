import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mien.avatar import GaussianStore, Moments


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


def test_unknown_overrides_are_our_bug() -> None:
    with pytest.raises(AssertionError, match="triangle"):
        make_store().append(torch.tensor([0]), {"triangle": torch.tensor([1])})


def test_unequal_lengths_are_our_bug() -> None:
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
