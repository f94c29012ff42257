"""Posing in one native call agrees with the same posing from its parts."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mien import _native
from mien.avatar.ops.bound_gaussians import pose_bound_gaussians, pose_bound_gaussians_reference
from mien.avatar.store import GaussianStore
from mien.face import FaceModel, FaceParams, load_face_model
from mien.gaussians import Gaussians

FACE_FIELDS = ("expression", "joints", "head_rotation", "head_translation")
COUNT = 20_000


@pytest.fixture(scope="module")
def face_model() -> FaceModel:
    return load_face_model()


def a_face(face_model: FaceModel) -> FaceParams:
    generator = torch.Generator().manual_seed(3)
    neutral = face_model.neutral(1)

    def some(like: Tensor) -> Tensor:
        return (0.2 * torch.randn(like.shape, generator=generator)).requires_grad_()

    return replace(neutral, **{name: some(getattr(neutral, name)) for name in FACE_FIELDS})


def a_store(face_model: FaceModel) -> GaussianStore:
    generator = torch.Generator().manual_seed(4)
    shapes = {"means": (COUNT, 3), "quats": (COUNT, 4), "log_scales": (COUNT, 3), "opacity_logits": (COUNT,)}
    trained = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    face_index = torch.randint(len(face_model.faces), (COUNT,), generator=generator)
    return GaussianStore(trained | {"sh": torch.zeros(COUNT, 1, 3)}, {"face_index": face_index})


def results(gaussians: Gaussians, face: FaceParams, store: GaussianStore) -> list[Tensor]:
    """Return values, and gradients of a loss that weighs every number differently."""
    parts = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities]
    parts += [] if gaussians.T_world_local is None else [gaussians.T_world_local]
    generator = torch.Generator().manual_seed(5)
    loss = torch.stack([(part * torch.randn(part.shape, generator=generator)).sum() for part in parts]).sum()
    inputs = [getattr(face, name) for name in FACE_FIELDS]
    inputs += [store[name] for name in ("means", "quats", "log_scales", "opacity_logits")]
    found = torch.autograd.grad(loss, inputs, allow_unused=True)
    gradients = [torch.zeros_like(i) if g is None else g for i, g in zip(inputs, found, strict=True)]
    return [*(part.detach() for part in parts), *gradients]


@pytest.mark.parametrize("in_head", [True, False])
@pytest.mark.parametrize("threads", [1, 3])
def test_it_equals_its_parts_to_the_bit(face_model: FaceModel, in_head: bool, threads: int) -> None:
    face, store = a_face(face_model), a_store(face_model)
    before = _native.thread_count()
    _native.set_thread_count(threads)
    try:
        native = results(pose_bound_gaussians(face_model, face, store, store["sh"], in_head), face, store)
    finally:
        _native.set_thread_count(before)
    expected = results(pose_bound_gaussians_reference(face_model, face, store, store["sh"], in_head), face, store)
    assert all(torch.equal(one, other) for one, other in zip(native, expected, strict=True))
    assert all(bool(tensor.abs().sum() > 0) for tensor in native)


def test_a_fixed_face_gets_no_gradient(face_model: FaceModel) -> None:
    face, store = a_face(face_model).detach(), a_store(face_model)
    gaussians = pose_bound_gaussians(face_model, face, store, store["sh"], in_head=True)
    gaussians.means.sum().backward()
    assert store["means"].grad is not None
    assert gaussians.T_world_local is not None
    torch.testing.assert_close(gaussians.T_world_local, face.T_world_head)


def test_a_new_store_and_changed_indices_are_noticed(face_model: FaceModel) -> None:
    face, store = a_face(face_model).detach(), a_store(face_model)
    before = pose_bound_gaussians(face_model, face, store, store["sh"], in_head=True).means
    store["face_index"].copy_(store["face_index"].flip(0))
    changed = pose_bound_gaussians(face_model, face, store, store["sh"], in_head=True).means
    expected = pose_bound_gaussians_reference(face_model, face, store, store["sh"], in_head=True).means
    assert torch.equal(changed, expected)
    assert not torch.equal(changed, before)
    store.select(torch.arange(100))
    assert pose_bound_gaussians(face_model, face, store, store["sh"], in_head=True).means.shape == (1, 100, 3)
    store["face_index"][0] = len(face_model.faces)
    with pytest.raises(IndexError, match="face"):
        pose_bound_gaussians(face_model, face, store, store["sh"], in_head=True)
