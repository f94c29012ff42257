"""A graph of a method's pose gives the same training as the pose, holds between rounds, and is never needed.

PyTorch's own graphs need a GPU. Here, what stands for one calls the pose, and counts how often it is made.
"""

import pytest
import torch

from mien.training import graphs, trainer
from mien.training.graphs import VARIABLE, PoseGraph
from plain_settings import plain_config, plain_run
from toy_scene import toy_data, toy_sequence

SETTINGS = plain_run(steps=40, split="none", record_every=1000)


def trained(method: str = "mono_gaussian_avatar", steps: int = 6) -> list[torch.Tensor]:
    """The parameters after some steps. A round of density is after the fourth."""
    changes = {"points": 60, "max_points": 90, "epochs": 10} if method == "mono_gaussian_avatar" else {}
    config = plain_config(method, **changes)
    face_model, sequence = toy_sequence(timesteps=3, size=24)
    state = trainer.start([sequence], face_model, config, SETTINGS)
    data = toy_data(sequence, SETTINGS)
    for _ in range(steps):
        trainer.step(state, data, SETTINGS)
    return [one.detach().clone() for one in state.avatar.parameters()]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let a processor count as a GPU, and list the number of points in each graph."""
    found: list[int] = []

    def graph(pose: torch.nn.Module, samples: tuple[torch.Tensor, ...], **_: object) -> torch.nn.Module:
        found.append(pose(*samples)[0].shape[-2])
        return pose

    monkeypatch.setattr(graphs, "is_on_gpu", lambda face: True)
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", graph)
    monkeypatch.setenv(VARIABLE, "1")
    return found


@pytest.mark.unchecked
def test_a_graph_trains_as_the_pose_does_and_is_made_anew_after_a_round(made: list[int], monkeypatch) -> None:
    found = trained()
    before = len(made)
    assert before == 2, "one before the round, and one after it"
    monkeypatch.delenv(VARIABLE)
    expected = trained()
    assert len(made) == before, "off by default"
    assert all(torch.equal(one, other) for one, other in zip(expected, found, strict=True))


@pytest.mark.unchecked
def test_methods_with_side_effects_have_no_graph(made: list[int]) -> None:
    trained("headgas", steps=3)
    assert made == []


@pytest.mark.unchecked
def test_where_no_graph_can_be_made_the_pose_runs(made: list[int], monkeypatch, capsys) -> None:
    def refused(*_: object, **__: object) -> None:
        raise RuntimeError("operation not permitted")

    expected = trained()
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", refused)
    found = trained()
    assert all(torch.equal(one, other) for one, other in zip(expected, found, strict=True))
    assert capsys.readouterr().err.count("operation not permitted") == 1


def test_a_processor_has_no_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "1")
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", None)
    assert PoseGraph()._wanted
    trained(steps=3)
