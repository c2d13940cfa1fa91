"""Check arguments: convert them to finite float64 arrays of the right shape, or raise.

Every error names the argument, the shape it should have, the shape it has, and the first
offending value with its index. Public functions check their arguments. Those called on hot paths
use the decorator `checked`; callers with checked arguments use the `kernel` without checks.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import json
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

# float64 throughout; the stubs of NumPy guarantee no more than this for most functions.
FloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]
# One number for all three world axes, or one for each.
Axes = float | tuple[float, float, float]
# Upper limit of lengths, times and rates; its powers are still finite.
HUGE = 1e50
# Up to this size BLAS computes sums in one thread.
_ONE_THREAD = 10_000
_FLOAT64 = np.dtype(np.float64)

P = ParamSpec("P")
R = TypeVar("R")


def checked(**shapes: tuple[int | str, ...]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that applies `check_array` to the named arguments.

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
                if not (optional and held[key] is None):  # pyrefly: ignore[bad-index]
                    held[key] = check_array(name, held[key], shape)  # pyrefly: ignore[bad-argument-type, bad-index, unsupported-operation]
            return function(*values, **kwargs)  # pyrefly: ignore[invalid-param-spec]

        door.kernel = function  # pyrefly: ignore[missing-attribute]
        return door

    return decorate


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function inside `checked`, for callers with checked arguments."""
    return function.kernel  # pyrefly: ignore[missing-attribute]


def check_array(name: str, value: ArrayLike, shape: tuple[int | str, ...]) -> FloatArray:
    """Return `value` as a finite float64 array whose trailing axes match `shape`.

    Parameters
    ----------
    name
        Name of the argument, for the message.
    value
        The value to check.
    shape
        Trailing axes: an int is an exact size, a string a free one of at least 1
        (``("M", 3)`` accepts ``(..., M, 3)``). Leading axes are free, but not empty.

    Raises
    ------
    ValueError
        If `value` is not numeric, has other trailing axes, is empty, or holds NaN, inf, or a
        magnitude of `HUGE` or more.
    """
    if (
        type(value) is np.ndarray
        and value.dtype is _FLOAT64
        and value.shape == shape
        # Fastest for a few numbers, and for matrices.
        and (math.hypot(*value.tolist()) if value.ndim == 1 else np.vdot(value, value)) < HUGE
    ):
        return value
    return check_finite(name, check_shape(name, value, shape))


def check_shape(name: str, value: ArrayLike, shape: tuple[int | str, ...]) -> FloatArray:
    """Check as `check_array` does, except for the values."""
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
    """Return `value` as a float64 array, or raise ValueError with its name."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise TypeError(array.dtype)
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of real numbers, got {value!r:.80}") from error


def as_array(name: str, value: Any) -> NDArray[Any]:
    """Return an array of any type, or raise ValueError with its name for ragged lists."""
    try:
        return np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} must be an array, got {value!r:.80}") from error


def check_finite(name: str, array: FloatArray, advice: str = "") -> FloatArray:
    """Return `array` unchanged, or raise ValueError with the first NaN, inf or `HUGE` entry.

    The message of a NaN or inf ends with the `advice`, a text that says what to do instead.
    """
    # The sum of squares suffices for most arrays, in one pass; False for NaN too. For larger ones
    # BLAS would split the sum over threads, whose start takes longer.
    if array.size <= _ONE_THREAD and np.vdot(array, array) < HUGE:
        return array
    if not (array.min(initial=0.0) > -HUGE and array.max(initial=0.0) < HUGE):
        if np.isfinite(array).all():
            index = tuple(int(i) for i in np.argwhere(np.abs(array) >= HUGE)[0])
            raise ValueError(
                f"{name} must be below {HUGE:g} in magnitude, got {array[index]}{at(index)}"
            )
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(
            f"{name} must be finite, got {array[index]}{at(index)}{advice and '; '}{advice}"
        )
    return array


def at(index: tuple[int, ...]) -> str:
    """Return ``" at index (1, 2)"``, or ``""`` for the only entry of an array without axes."""
    return f" at index {index}" if index else ""


def all_finite(figures: Any) -> bool:
    """Return whether all values of an array or NumPy scalar are finite, quickly."""
    if figures.ndim == 0:
        return math.isfinite(figures)
    # One product usually suffices; it may overflow.
    if figures.size <= _ONE_THREAD and math.isfinite(np.vdot(figures, figures)):
        return True
    return bool(np.isfinite(figures).all())


def are_finite(array: FloatArray, trailing: int) -> BoolArray:
    """Return whether all entries of the last `trailing` axes are finite, (...)."""
    return np.asarray(np.isfinite(array).all(axis=tuple(range(-trailing, 0))))


def check_number(name: str, value: Any, *, low: float = -math.inf, high: float = math.inf) -> float:
    """Return `value` as a finite float in ``[low, high]``, or raise ValueError with its name."""
    if type(value) is float and low <= value <= high and -HUGE < value < HUGE:
        return value
    try:
        # NumPy versions differ in whether an array of one number is a number.
        if isinstance(value, (str, bytes)) or getattr(value, "ndim", 0):
            raise TypeError(type(value))
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be a number, got {value!r:.80}") from error
    if not abs(number) < HUGE or not low <= number <= high:
        bounds = f" in [{low:g}, {high:g}]" if low > -math.inf else f" of at most {high:g}"
        if high == math.inf:
            bounds = f" of at least {low:g}" if low > -math.inf else ""
        raise ValueError(f"{name} must be a finite number{bounds}, got {number}")
    return number


def check_axes(name: str, value: ArrayLike, leading: bool = False) -> Any:
    """Return a standard deviation, or one for each world axis; or raise ValueError.

    `leading`: whether it may be (..., 3), with individual values for trials.
    """
    array = check_array(name, value, ())
    if array.shape not in ((), (3,)) and not (leading and array.ndim > 1 and array.shape[-1] == 3):
        raise ValueError(f"{name} must be one number or three, got shape {array.shape}")
    if (array < 0).any():
        raise ValueError(f"{name} must not be negative, got {array.tolist()!s:.80}")
    # JSON gives lists; tuples keep the configuration hashable.
    return as_tuples(array)


def as_tuples(value: FloatArray) -> Any:
    """Return an array as nested tuples of floats, which can be hashed and compared."""
    return tuple(as_tuples(row) for row in value) if value.ndim else float(value)


def check_duration(name: str, value: ArrayLike) -> Any:
    """Return nonnegative seconds, a float or an array (...) of trials; or raise ValueError."""
    if type(value) is float and 0 <= value < HUGE:
        return value
    if not (getattr(value, "ndim", 0) or isinstance(value, list | tuple)):
        return check_number(name, value, low=0.0)
    array = check_array(name, value, ())
    if (array < 0).any():
        raise ValueError(f"{name} must not be negative, got {array.min()}")
    return array


def check_count(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """Return `value` as an int from `least` to `most`, or raise ValueError with its name."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        wanted = "a positive int" if least == 1 else f"an int of at least {least}"
        if most is not None:
            wanted = f"an int from {least} to {most}"
        raise ValueError(f"{name} must be {wanted}, got {value!r:.80}")
    return int(value)


def check_generator(name: str, rng: Any) -> np.random.Generator:
    """Return `rng` if it is a random generator, or raise ValueError with its name."""
    if not isinstance(rng, np.random.Generator):
        raise ValueError(
            f"{name} must be a numpy.random.Generator, such as numpy.random.default_rng(1), got "
            f"{rng!r:.80}"
        )
    return rng


def check_links(links: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray | None:
    """Return `links` as a boolean mask that broadcasts against ranges of `shape`; None for None.

    ValueError if the mask holds other values than 0 and 1, or does not end in the (M, N) of the
    ranges.
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
            wrong = measured != mask if mask.dtype.kind in "iuf" else np.ones(mask.shape, bool)
            index = tuple(int(i) for i in np.argwhere(wrong)[0])
            raise ValueError(
                f"links must be True (measured) or False, got {mask[index]!s:.80}{at(index)}"
            )
        mask = measured
    return mask


def check_one_of(
    name: str, value: str, choices: tuple[str, ...] | list[str], advice: str = ""
) -> str:
    """Return `value` if it is among `choices`, or raise ValueError that lists them.

    The message ends with the `advice`, a text that says what to do instead.
    """
    if not isinstance(value, str) or value not in choices:
        near = did_you_mean(value, choices)
        raise ValueError(
            f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r:.80}{near}"
            f"{advice and '; '}{advice}"
        )
    return value


def did_you_mean(value: Any, choices: Iterable[str]) -> str:
    """Return ``"; did you mean 'iekf'?"`` if a choice is close to `value`, else ``""``."""
    known, name = {choice.lower(): choice for choice in choices}, str(value).lower()
    near = difflib.get_close_matches(name, list(known), n=2, cutoff=0.7)
    near = near or [choice for choice in known if len(name) > 2 and choice.startswith(name)][:2]
    return f"; did you mean {' or '.join(repr(known[name]) for name in near)}?" if near else ""


def imported(name: str, path: str) -> Callable[..., Any]:
    """Return the function of ``"module:function"``, or raise ValueError with the name."""
    module, _, attribute = path.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{name} {path!r:.80} cannot be imported: {error}") from error
    if not callable(found):
        raise ValueError(f"{name} {path!r:.80} must be callable, got {found!r:.80}")
    return found


def parse_filter(text: Any, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
    """Parse ``name/option=value/option=value`` to the name of a filter and its options.

    Parameters
    ----------
    text
        Name of a filter, with or without options. A value is JSON (``true``, ``0.05``,
        ``[1, 2]``), or else text (``late``). A factory is returned as it is.
    options
        Further options.

    Raises
    ------
    ValueError
        If a part is not ``option=value``, or an option is given twice.

    Examples
    --------
    >>> parse_filter("iekf-log/robust=late/iterations=2")
    ('iekf-log', {'robust': 'late', 'iterations': 2})
    """
    name, *parts = text.strip().split("/") if isinstance(text, str) else (text,)
    result: dict[str, Any] = dict(options or {})
    for part in parts:
        key, equals, value = part.partition("=")
        if not key or not equals:
            raise ValueError(
                f"filter {text!r:.80} must have the form name/option=value/..., got {part!r}"
            )
        if key in result:
            raise ValueError(f"filter {text!r:.80} has the option {key!r} twice")
        try:
            result[key] = json.loads(_PYTHON.get(value, value))
        except json.JSONDecodeError:
            result[key] = value
    return name, result


# Values as Python writes them.
_PYTHON = {"True": "true", "False": "false", "None": "null"}
