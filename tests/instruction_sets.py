"""Instruction sets of the native core that a build for this kind of processor has.

Levels that a machine lacks are skipped.
"""

import platform
from collections.abc import Iterator

import pytest

from mien import _native
from needs import use_instructions

ISAS = ("avx512", "avx2", "sse4") if platform.machine() in ("x86_64", "AMD64") else ("baseline",)


def each_isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Body of a fixture with `params=ISAS`.

    It sets one level during a test, and restores the previous one afterwards.
    """
    before = _native.rasterize_isa()
    use_instructions(request.param)
    yield request.param
    assert _native.set_rasterize_isa(before)
