"""Calls are checked where a test does not say otherwise, and commands can be forked."""

import signal

import pytest
import torch
from jaxtyping import TypeCheckError

from checked_types import unchecked
from forked import ForkServer, run_forked
from mien.rotation import skew

NOT_FLOATS = torch.zeros(2, 3, dtype=torch.int64)


def test_a_wrong_shape_is_found() -> None:
    with pytest.raises(TypeCheckError):
        skew(NOT_FLOATS)


def test_checks_end_and_begin_again() -> None:
    with unchecked():
        skew(NOT_FLOATS)
    with pytest.raises(TypeCheckError):
        skew(NOT_FLOATS)


@pytest.mark.unchecked
def test_a_marked_test_has_no_checks() -> None:
    skew(NOT_FLOATS)


def test_forked_commands_have_exit_codes_and_signals(fork_server: ForkServer) -> None:
    told = run_forked(fork_server, "render", "nothing_here", "--out", "a.png")
    assert told.returncode == 2
    assert "nothing_here" in told.stderr
    sleeping = fork_server.call("time:sleep", 100)
    assert sleeping.poll() is None
    sleeping.send_signal(signal.SIGTERM)
    assert sleeping.wait() == -signal.SIGTERM
