"""A guard around what has to be the same bits on every processor: arithmetic whose order is a library's fails in it.

It sees, in the thread that enters it:

- torch, by its dispatcher: matrix products (`@`, einsum and layers are lowered to them), decompositions, solvers,
  convolutions, and sums over more than `FEW` elements;
- numpy: an `@` that is reached in a function of mien or of a test; products by name (`np.matmul`, ...); the method
  `dot`; everything of `np.linalg` and `np.einsum`, also when numpy itself calls it (`np.polyfit`, ...); OpenCV's
  products and solvers.

It does not see the inside of the native core and of OpenCV's filters, other threads, what runs when a module is
imported, and numpy's functions that were imported by name (ruff's style keeps them out). numpy's sums are allowed,
since their order is that of one source for all processors, and so are functions such as `exp`, whose last bit may
differ: tolerances allow for it."""

import dis
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

FEW = 3
"""Number of elements that every kernel of torch adds one after the other, since its vectors are longer."""

_ROOTS = tuple(str(Path(__file__).parents[1] / folder) for folder in ("src", "tests"))
_PRODUCTS = {
    "mm", "bmm", "addmm", "addbmm", "baddbmm", "addmv", "mv", "dot", "vdot", "ger", "addr", "linear", "matmul", "cdist",
    "_cdist_forward", "_trilinear", "convolution", "_convolution", "mkldnn_convolution", "convolution_backward",
    "inverse", "svd", "qr", "geqrf", "ormqr", "cholesky", "cholesky_solve", "lstsq", "triangular_solve", "lu_solve",
    "_lu_with_info", "pinverse", "matrix_exp", "_scaled_dot_product_flash_attention_for_cpu", "_softmax",
    "_log_softmax", "native_layer_norm", "native_batch_norm",
}  # fmt: skip
_SUMS = {
    "sum", "mean", "nansum", "prod", "norm", "linalg_vector_norm", "var", "var_mean", "std", "std_mean", "logsumexp",
    "avg_pool2d",
}  # fmt: skip
_ALLOWED_LINALG = {"linalg_vector_norm", "linalg_cross"}
_CALLED = {"dot", "vdot", "inner", "matmul", "correlate", "c_einsum", "gemm", "solve", "eigen", "SVDecomp",
           "SVBackSubst", "PCACompute", "mulTransposed"}  # fmt: skip
_LIBRARY = ("numpy/linalg/_linalg.py", "numpy/_core/einsumfunc.py")
_NUMERIC = {"tensordot", "convolve", "correlate"}
_NAMED = ("matmul", "dot", "inner", "vdot", "matvec", "vecmat", "vecdot")


class InexactError(AssertionError):
    """A result that must be the same everywhere used arithmetic whose bits depend on the processor."""


@contextmanager
def exact_guard() -> Iterator[None]:
    """Raise `InexactError` at the first call whose bits depend on the processor."""
    before = sys.getprofile(), sys.gettrace()
    originals = {name: getattr(np, name) for name in _NAMED if hasattr(np, name)}
    with _TorchGuard():
        _ = torch.ones(1) + 1  # the first one makes torch import modules, which must not happen under a profiler
    for name in originals:
        setattr(np, name, _refusing(f"np.{name}"))
    sys.setprofile(_watch)
    sys.settrace(_trace)
    try:
        with _TorchGuard():
            yield
    finally:
        sys.setprofile(before[0])
        sys.settrace(before[1])
        for name, original in originals.items():
            setattr(np, name, original)


class _TorchGuard(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        name = str(func.overloadpacket.__name__)
        is_linalg = name.lstrip("_").startswith("linalg_") and name not in _ALLOWED_LINALG
        if name in _PRODUCTS or is_linalg:
            raise InexactError(f"torch's {name}: a product or decomposition in a library's order")
        out = func(*args, **(kwargs or {}))
        if name in _SUMS:
            result = out[0] if isinstance(out, tuple) else out
            added = args[0].numel() // max(result.numel(), 1)
            if added > FEW:
                raise InexactError(f"torch's {name} over {added} elements: a sum in a library's order")
        return out


def _refusing(name: str) -> Callable[..., Any]:
    def refuse(*_: Any, **__: Any) -> Any:
        raise InexactError(f"{name}: a product in a library's order")

    return refuse


def _watch(frame: FrameType, event: str, called: Any) -> None:
    code = frame.f_code
    if event == "c_call" and getattr(called, "__name__", "") in _CALLED and _is_numeric(called):
        raise InexactError(f"{called.__name__} in {code.co_filename}:{frame.f_lineno}: a product in a library's order")
    if event == "call":
        in_numpy = code.co_filename.endswith(_LIBRARY)
        if in_numpy or (code.co_name in _NUMERIC and code.co_filename.endswith("numpy/_core/numeric.py")):
            raise InexactError(f"numpy's {code.co_name}: a product or decomposition in a library's order")


def _is_numeric(called: Any) -> bool:
    owner = getattr(called, "__self__", None)
    module = owner.__name__ if isinstance(owner, ModuleType) else getattr(called, "__module__", None)
    is_of_opencv = owner is None and module is None  # its functions say neither
    return is_of_opencv or isinstance(owner, np.ndarray) or str(module).split(".")[0] in ("numpy", "cv2", "_operator")


def _trace(frame: FrameType, event: str, _: Any) -> Callable[..., Any] | None:
    """Trace only the functions that contain an `@`, line by line. A profiler would not see the operator as a call."""
    if event == "call" and frame.f_code.co_filename.startswith(_ROOTS) and _products_in(frame.f_code):
        frame.f_trace_opcodes = True
        return _trace_steps
    return None


def _trace_steps(frame: FrameType, event: str, _: Any) -> Callable[..., Any]:
    code = frame.f_code
    if event == "opcode" and frame.f_lasti in _products_in(code):
        raise InexactError(f"`@` in {code.co_filename}:{frame.f_lineno}: a product in a library's order")
    return _trace_steps


@cache
def _products_in(code: CodeType) -> frozenset[int]:
    """Find the lines of a function's own code that have an `@` between values."""
    steps = dis.get_instructions(code)
    return frozenset(step.offset for step in steps if step.opname == "BINARY_OP" and step.argrepr in ("@", "@="))
