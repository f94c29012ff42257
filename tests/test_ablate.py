"""`benchmarks/ablate.py` changes constants that decide quality as long as it is asked to."""

import contextlib
import importlib
from pathlib import Path
from types import ModuleType

import pytest
import torch

from mien.avatar.bound_surface import SurfacePrior
from mien.avatar.constants import AVATAR
from mien.errors import UserError


@pytest.fixture(scope="module")
def ablate() -> ModuleType:
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
        return importlib.import_module("ablate")


def test_changes_have_the_type_of_the_constant(ablate: ModuleType) -> None:
    for text, value in (("whole_head.hair_frames=12", 12), ("avatar.calm_share=1", 1.0),
                        ("whole_head.moving_near=(0.1, 0.2)", (0.1, 0.2))):  # fmt: skip
        found = ablate.change_of(text)[2]
        assert (found, type(found)) == (value, type(value))
    for text in ("whole_head.hair=1", "nowhere.hair_frames=1", "avatar", "whole_head.hair_frames=1.5",
                 "avatar.calm_share=few", "whole_head.moving_near=(0.1,)", "whole_head.hair_frames=True"):  # fmt: skip
        with pytest.raises(UserError, match=r"no such constant|give a value like"):
            ablate.change_of(text)
    # A change holds as long as it is asked for.
    prior, before = SurfacePrior(torch.ones(3)), ablate.run_name("one", ["--steps", "9"])
    with ablate.changed(ablate.change_of("avatar.fill_height_share=0.25")):
        assert prior.fill_height.tolist() == [0.25] * 3
        assert ablate.run_name("one", ["--steps", "9"]) != before
    assert AVATAR.fill_height_share == 0.9
    with contextlib.suppress(UserError), ablate.changed(ablate.change_of("avatar.fill_height_share=0.25")):
        raise UserError("stop")
    assert AVATAR.fill_height_share == 0.9
    assert ablate.run_name("one", ["--steps", "9"]) == before != ablate.run_name("one", ["--steps", "8"])
