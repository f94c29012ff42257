"""A training step reads no number from a GPU between posing and the optimiser, since the host would wait for it.

This needs no GPU: tensors on torch's `meta` device have no numbers, so reading one raises an error.
"""

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from mien.adam import FactoredMoments
from mien.avatar import METHODS, MethodConfig, Moments
from mien.camera import Camera
from mien.gaussians import Gaussians
from mien.render.rendering import Rendering
from mien.training import batch, trainer
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Targets
from plain_settings import plain_config, plain_run
from toy_scene import toy_sequence

META = torch.zeros((), device="meta")


def configs() -> dict[str, MethodConfig]:
    """All methods, with every loss, and again with colours that depend on the view where a method has them."""
    found = {}
    for name in METHODS:
        config = plain_config(name)
        tuning = replace(config.face_tuning, keep_mean_pose=True, keep_turns=True)
        config = replace(config, face_tuning=tuning)
        found[name] = replace(config, photometric=replace(config.photometric, alpha_weight=0.1))
        if "sh_degree" in {field.name for field in fields(config)}:
            found[f"{name}-sh3"] = replace(config, sh_degree=3)
    return found


CONFIGS = configs()


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_a_step_of_training_asks_for_no_number(config: MethodConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trainer's own step reads no number, in a run whose pictures are composited in every step."""
    monkeypatch.setattr(batch, "rasterize", _rendered)
    face_model, sequence = toy_sequence(timesteps=3, size=32)
    settings = plain_run(steps=1_000_000, split="none", background="random", record_every=1_000_000)
    state = trainer.start([sequence], face_model, config, settings, META)
    order = FrameOrder(training_frames([sequence], settings), settings.seed)
    data = trainer.TrainingData(order, (Targets(sequence, 0, like=META),))
    for _ in range(3):
        trainer.step(state, data, settings)
    state.track.steady_pose()
    store = state.avatar.gaussian_store()
    assert all(store[name].device.type == "meta" for name in store.names())
    updated = {**store.moments, **state.adam.state()}
    assert updated
    for moments in updated.values():
        if isinstance(moments, FactoredMoments):
            assert moments.second.device.type == "meta"
        else:
            assert float(moments.step) == 3
            assert moments.first.device.type == "meta"


def test_regions_are_looked_for_where_the_model_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU refuses tensors of two devices. The `meta` device does not."""
    asked: list[tuple[str, str]] = []
    monkeypatch.setattr(torch, "isin", lambda a, b: asked.append((a.device.type, b.device.type)) or a == 0)
    face_model, _ = toy_sequence(timesteps=1, size=32)
    face_model.to(META).region_mask("lips")
    assert asked == [("meta", "meta")]


def test_meta_tensors_show_who_asks_for_a_number_and_steps_are_counted_on_the_host() -> None:
    for ask in (Tensor.item, bool, Tensor.tolist, Tensor.nonzero, Tensor.cpu):
        with pytest.raises((RuntimeError, NotImplementedError)):
            ask(META + 1)
    assert Moments.zeros(META).step.device.type == "cpu"


def _rendered(gaussians: Gaussians, camera: Camera, background: Tensor) -> Rendering:
    """Return a rendering with the same dependences as a rasterizer's."""
    count = len(gaussians)
    offset = torch.zeros(count, 2, device="meta", requires_grad=True)
    parts = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, offset]
    parts += [camera.K, camera.viewmat, background]
    parts += [] if gaussians.T_world_local is None else [gaussians.T_world_local]
    value = torch.stack([part.sum() for part in parts]).sum()
    image = value + torch.zeros(camera.height, camera.width, 3, device="meta")
    return Rendering(image, image[..., 0], torch.ones(count, dtype=torch.int32, device="meta"), offset)
