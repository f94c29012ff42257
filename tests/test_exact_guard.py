"""The guard finds inexact arithmetic, and everything that must be the same everywhere passes it."""

import cv2
import numpy as np
import pytest
import torch

from exact_guard import InexactError, exact_guard
from mien.avatar.methods import DEFAULT_METHOD
from mien.machine import exact
from mien.training import trainer
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Targets
from plain_settings import plain_config, plain_run
from toy_scene import toy_sequence

pytestmark = pytest.mark.exact

T, A = torch.ones(5, 5), np.ones((5, 5))
LEARNT = torch.ones(5, 5, requires_grad=True)
INEXACT = (
    lambda: T @ T, lambda: LEARNT.matmul(T), lambda: torch.einsum("ij,jk->ik", T, T), lambda: torch.linalg.svd(T),
    lambda: T.sum(), lambda: T.softmax(-1), lambda: torch.conv2d(T[None, None], T[None, None, :2, :2]),
    lambda: A @ A, lambda: np.dot(A, A), lambda: A.dot(A), lambda: np.einsum("ij,jk->ik", A, A),
    lambda: np.linalg.norm(A[0]), lambda: np.polyfit(np.arange(5), A[0], 1), lambda: cv2.gemm(A, A, 1.0, A, 0.0),
)  # fmt: skip


def test_the_guard_refuses_what_has_several_orders_and_lets_pass_what_has_one():
    for inexact in INEXACT:
        with pytest.raises(InexactError), exact_guard():
            inexact()
        inexact()  # all is as before
    with exact_guard():
        assert torch.equal(T * 2 + T, 3 * T)
        assert (float((T[:, :3] * T[:, :3]).sum(-1)[0]), exact.product(A, A)[0, 0]) == (3, 5)
        assert A.sum() == 25


def test_a_step_of_training_adds_up_by_itself():
    """From the pose to the optimiser. The first step fills the caches."""
    face_model, sequence = toy_sequence(timesteps=3, size=32)
    settings = plain_run(steps=100, split="none", background="random", record_every=100)
    state = trainer.start([sequence], face_model, plain_config(DEFAULT_METHOD), settings, torch.zeros(()))
    order = FrameOrder(training_frames([sequence], settings), settings.seed)
    data = trainer.TrainingData(order, (Targets(sequence, 0),))
    trainer.step(state, data, settings)
    with exact_guard():
        trainer.step(state, data, settings)
