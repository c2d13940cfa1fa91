"""Checks of arguments: in comes a finite float64 array of the right shape, or an error goes out.

Every error names the argument, the shape it should have, the shape it has, and the first
offending value with its index. Public functions check at the door: those that hot paths call get
it from `checked`, and whoever has checked already takes the `kernel` behind it.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

# float64 throughout; numpy's own stubs promise no more than this of most functions.
FloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]
# One number for all three of the world's axes, or one for each.
Axes = float | tuple[float, float, float]
# No length, time or rate is as large; its powers still are finite numbers.
HUGE = 1e50
# Up to so many numbers BLAS sums in one thread.
_ONE_THREAD = 10_000
_FLOAT64 = np.dtype(np.float64)

P = ParamSpec("P")
R = TypeVar("R")


def checked(
    **shapes: tuple[int | str, ...],
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator: `check_array` of these arguments, by their names, before the function runs.

    An argument whose default is None may be None.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        parameters = list(inspect.signature(function).parameters.values())
        doors = [
            (place, p.name, shapes[p.name], p.default is None)
            for place, p in enumerate(parameters)
            if p.name in shapes
        ]

        @functools.wraps(function)
        def door(*args: P.args, **kwargs: P.kwargs) -> R:
            values: list[Any] = list(args)
            for place, name, shape, optional in doors:
                held, key = (values, place) if place < len(values) else (kwargs, name)
                if held is kwargs and name not in kwargs:
                    continue
                if not (optional and held[key] is None):  # pyright: ignore[reportArgumentType, reportCallIssue]
                    held[key] = check_array(name, held[key], shape)  # pyright: ignore
            return function(*values, **kwargs)  # pyright: ignore[reportCallIssue]

        door.kernel = function  # pyright: ignore[reportAttributeAccessIssue]
        return door

    return decorate


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """The function behind the door of `checked`, for callers whose arguments are checked."""
    return function.kernel  # pyright: ignore[reportFunctionMemberAccess]


def check_array(name: str, value: ArrayLike, shape: tuple[int | str, ...]) -> FloatArray:
    """Return `value` as a finite float64 array whose trailing axes match `shape`.

    Parameters
    ----------
    name
        The argument's name, for the message.
    value
        What came.
    shape
        Trailing axes: an int is an exact size, a string a free one of at least 1
        (``("M", 3)`` accepts ``(..., M, 3)``). Leading axes are free, but not empty.

    Raises
    ------
    ValueError
        If `value` is not numeric, has other trailing axes, is empty, or holds NaN, inf, or
        what is as large as `HUGE`.
    """
    if (
        type(value) is np.ndarray
        and value.dtype is _FLOAT64
        and value.shape == shape
        and np.vdot(value, value) < HUGE
    ):
        return value
    return check_finite(name, check_shape(name, value, shape))


def check_shape(name: str, value: ArrayLike, shape: tuple[int | str, ...]) -> FloatArray:
    """`check_array` without the look at the values."""
    array = value if type(value) is np.ndarray else as_float(name, value)
    if array.dtype is not _FLOAT64:
        array = as_float(name, array)
    fits = array.ndim >= len(shape)
    for got, want in zip(reversed(array.shape), reversed(shape), strict=False):
        fits = fits and (got == want if isinstance(want, int) else got > 0)
    if not fits:
        wanted = ", ".join(["...", *map(str, shape)])
        raise ValueError(f"{name} must have shape ({wanted}), got {array.shape}")
    if not array.size:
        raise ValueError(f"{name} must not be empty, got shape {array.shape}")
    return array


def as_float(name: str, value: Any) -> FloatArray:
    """`value` as a float64 array, or a ValueError that names it."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise TypeError(array.dtype)
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of real numbers, got {value!r:.80}") from error


def as_array(name: str, value: Any) -> NDArray[Any]:
    """An array of anything, or a ValueError that names it: ragged lists are none."""
    try:
        return np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} must be an array, got {value!r:.80}") from error


def check_finite(name: str, array: FloatArray) -> FloatArray:
    """`array` unchanged, or a ValueError with the first entry that is NaN, inf or `HUGE`."""
    # The sum of squares of most arrays says it all, in one look; false of NaN too. Of larger ones
    # BLAS would share out the sum to threads, whose start takes longer.
    if array.size <= _ONE_THREAD and np.vdot(array, array) < HUGE:
        return array
    if not (array.min(initial=0.0) > -HUGE and array.max(initial=0.0) < HUGE):
        if np.isfinite(array).all():
            index = tuple(int(i) for i in np.argwhere(np.abs(array) >= HUGE)[0])
            raise ValueError(
                f"{name} must be below {HUGE:g} in magnitude, got {array[index]} at index {index}"
            )
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name} must be finite, got {array[index]} at index {index}")
    return array


def all_finite(figures: Any) -> bool:
    """Whether figures (...), an array or a single number of NumPy's, are all finite; quick."""
    if figures.ndim == 0:
        return math.isfinite(figures)
    # Mostly one product tells; it may overflow.
    if figures.size <= _ONE_THREAD and math.isfinite(np.vdot(figures, figures)):
        return True
    return bool(np.isfinite(figures).all())


def are_finite(array: FloatArray, trailing: int) -> BoolArray:
    """Whether all of the last `trailing` axes are finite, (...) of the axes before them."""
    return np.asarray(np.isfinite(array).all(axis=tuple(range(-trailing, 0))))


def check_number(name: str, value: Any, *, low: float = -math.inf, high: float = math.inf) -> float:
    """`value` as a finite float in ``[low, high]``, or a ValueError that names it."""
    if type(value) is float and low <= value <= high and -HUGE < value < HUGE:
        return value
    try:
        # Whether an array of one number is a number, NumPy's versions do not agree.
        if isinstance(value, (str, bytes)) or getattr(value, "ndim", 0):
            raise TypeError(type(value))
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be a number, got {value!r:.80}") from error
    if not abs(number) < HUGE or not low <= number <= high:
        bounds = f" in [{low:g}, {high:g}]" if low > -math.inf or high < math.inf else ""
        raise ValueError(f"{name} must be a finite number{bounds}, got {number}")
    return number


def check_axes(name: str, value: ArrayLike, leading: bool = False) -> Any:
    """A standard deviation, or one for each of the world's axes; or a ValueError.

    `leading`: whether it may be (..., 3), of each trial its own.
    """
    array = check_array(name, value, ())
    if array.shape not in ((), (3,)) and not (leading and array.ndim > 1 and array.shape[-1] == 3):
        raise ValueError(f"{name} must be one number or three, got shape {array.shape}")
    if (array < 0).any():
        raise ValueError(f"{name} must not be negative, got {array.tolist()!s:.80}")
    # Lists come out of JSON; tuples keep the configuration hashable.
    return as_tuples(array)


def as_tuples(value: FloatArray) -> Any:
    """An array as nested tuples of floats: configuration that hashes and compares."""
    return tuple(as_tuples(row) for row in value) if value.ndim else float(value)


def check_duration(name: str, value: ArrayLike) -> Any:
    """Seconds that are not negative, a float or an array (...) of trials; or a ValueError."""
    if type(value) is float or not (getattr(value, "ndim", 0) or isinstance(value, list | tuple)):
        return check_number(name, value, low=0.0)
    array = check_array(name, value, ())
    if (array < 0).any():
        raise ValueError(f"{name} must not be negative, got {array.min()}")
    return array


def check_count(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """`value` as an int from `least` to `most`, or a ValueError that names it."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        wanted = "a positive int" if least == 1 else f"an int of at least {least}"
        if most is not None:
            wanted = f"an int from {least} to {most}"
        raise ValueError(f"{name} must be {wanted}, got {value!r:.80}")
    return int(value)


def check_generator(name: str, rng: Any) -> np.random.Generator:
    """`rng` if it is a source of random numbers, or a ValueError that names it."""
    if not isinstance(rng, np.random.Generator):
        raise ValueError(f"{name} must be a numpy.random.Generator, got {rng!r:.80}")
    return rng


def check_links(links: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray | None:
    """`links` as a boolean mask that broadcasts against ranges of `shape`; None stays None.

    Raises
    ------
    ValueError
        If the mask holds anything but 0 and 1, or does not end in the ranges' (M, N).
    """
    if links is None:
        return None
    try:
        mask = np.asarray(links)
    except ValueError as error:
        raise ValueError(f"links must be an array of booleans, got {links!r:.80}") from error
    if mask.shape[-2:] != shape[-2:]:
        raise ValueError(f"links must have shape (..., {shape[-2]}, {shape[-1]}), got {mask.shape}")
    if not mask.size:
        raise ValueError(f"links must not be empty, got shape {mask.shape}")
    if mask.dtype != np.bool_:
        measured = mask != 0
        if mask.dtype.kind not in "iuf" or (measured != mask).any():
            raise ValueError("links must be boolean (True: measured), got other values")
        mask = measured
    return mask


def check_one_of(name: str, value: str, choices: tuple[str, ...] | list[str]) -> str:
    """`value` if it is among `choices`, or a ValueError that lists them."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")
    return value
