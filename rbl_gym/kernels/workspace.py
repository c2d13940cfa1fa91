"""Small arrays for the calculations within a kernel.

They are on the stack. `np.empty` allocates memory and counts references, a fifth of the time of an
update of the iterated EKF.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from numba.core import cgutils
from numba.core.types import Array, float64, intp
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array


def _intrinsic(function: Callable[[Any, Any], Any]) -> Callable[[tuple[int, ...]], Any]:
    """Return a function of a shape for kernels to call, from one that generates its code."""
    made: Any = intrinsic(prefer_literal=True)(function)
    return made


def _array_on_stack(shape: Any, zero: bool) -> tuple[Any, Any]:
    """Return the type of a call, and the function that generates its code."""
    sizes = [size.literal_value for size in shape]
    kind = Array(float64, len(sizes), "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def number(value: int) -> Any:
            return context.get_constant(intp, value)

        entry, count = context.get_value_type(float64), math.prod(sizes)
        data = cgutils.alloca_once(builder, entry, size=number(count))
        if zero:
            cgutils.memset(builder, data, number(8 * count), 0)
        array = make_array(kind)(context, builder)
        populate_array(
            array,
            data=data,
            shape=[number(size) for size in sizes],
            strides=[number(8 * math.prod(sizes[k + 1 :])) for k in range(len(sizes))],
            itemsize=number(8),
            meminfo=None,
        )
        return array._getvalue()

    return kind(shape), generate


@_intrinsic
def workspace(context: Any, shape: Any) -> Any:
    """Return an array of a constant shape with arbitrary values.

    It exists until the calling function returns, so that function must not return it.
    """
    return _array_on_stack(shape, zero=False)


@_intrinsic
def zeros(context: Any, shape: Any) -> Any:
    """Return a `workspace` of zeros."""
    return _array_on_stack(shape, zero=True)
