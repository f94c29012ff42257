"""Instruction sets of the native core that a build for this kind of processor has.

The fixture `isa` skips levels that a machine lacks.
"""

import platform

ISAS = ("avx512", "avx2", "sse4") if platform.machine() in ("x86_64", "AMD64") else ("baseline",)
