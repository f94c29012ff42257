"""Several sequences of one subject, several calibrated cameras: one identity, one face a timestep."""

from dataclasses import replace

import pytest
import torch

from mien.capture import Capture
from mien.tracking import Tracking, TrackingSettings, track, track_subject
from small_face_model import make_small_face_model
from tracking_case import FOCAL, SIZE, TrackingCase, capture_of, make_tracking_case

KNOWN_FOCAL = TrackingSettings(focal=FOCAL)


def _part(case: TrackingCase, part: slice, name: str, noise: float = 0.6) -> Capture:
    """Some timesteps as a sequence of their own, with noise of their own, in pixels, in both coordinates."""
    random = torch.Generator().manual_seed(part.start)
    seen = case.pixels[part] + noise * torch.randn(case.pixels[part].shape, generator=random, dtype=torch.float64)
    return replace(capture_of(seen), name=name)


def _shape_error(case: TrackingCase, tracking: Tracking) -> float:
    """RMS distance of the vertices at rest from the true ones without shift and scale, millimetres."""

    def at_rest(identity: torch.Tensor) -> torch.Tensor:
        vertices = case.model(replace(case.model.neutral(1).to(case.pixels), identity=identity.double()))[0]
        vertices = vertices - vertices.mean(0)
        return vertices / vertices.norm() * case.model.template.norm()

    return 1000 * float(
        (at_rest(tracking.face.identity) - at_rest(case.face.identity)).norm(dim=1).square().mean().sqrt()
    )


@pytest.fixture(scope="module")
def two_sequences():
    case = make_tracking_case(timesteps=60, noise=0)
    captures = [_part(case, slice(0, 10), "short"), _part(case, slice(25, 60), "long")]
    # The second was filmed with half as many pixels a side, and at another rate.
    small = replace(
        captures[1], landmarks=captures[1].landmarks / 2, images=captures[1].images[:, :, ::2, ::2],
        mattes=captures[1].mattes[:, :, ::2, ::2], principal_point=captures[1].principal_point / 2, fps=30.0,
    )  # fmt: skip
    captures = [captures[0], small]
    return case, captures, track_subject(captures, make_small_face_model())


def test_sequences_of_a_subject_have_one_identity(two_sequences):
    case, captures, together = two_sequences
    first, second = together
    assert torch.equal(first.face.identity, second.face.identity)
    assert (len(first.face), len(second.face)) == (10, 35)
    assert (second.cameras[0].width, second.cameras[0].height) == (SIZE // 2, SIZE // 2)
    alone = [track(capture, make_small_face_model()) for capture in captures]
    assert not torch.equal(alone[0].face.identity, alone[1].face.identity)
    error, errors = _shape_error(case, first), [_shape_error(case, tracking) for tracking in alone]
    assert error < max(errors)
