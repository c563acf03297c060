"""The one place that knows numba: a typed decorator, and the array type kernels take.

Kernels are compiled at their first call and cached on disk. The cache looks only at the file a
kernel stands in: after editing a kernel that another file calls, delete `__pycache__/*.nbi`.
No kernel is compiled with fast-math, so no product and sum are fused and none is reordered: the
batched kernels give the same bits as the single-stream ones.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba  # pyright: ignore[reportMissingTypeStubs]
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

P = ParamSpec("P")
T = TypeVar("T")


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """Compile to machine code (cached, without the interpreter lock, IEEE division)."""
    return cast(
        "Callable[P, T]",
        numba.njit(cache=True, nogil=True, error_model="numpy")(function),  # pyright: ignore
    )
