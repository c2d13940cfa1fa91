"""Whatever comes in: a sound answer, or a ValueError or TypeError that names an argument.

Every public function of `fuzz_cases` is called with one argument spoilt at a time, once through a
table of other types, NaN, inf, huge, tiny, empty, negative and other shapes, and with what
hypothesis makes of them. NaN and inf must never be taken for numbers. docs/fuzzing.md says what
is tried.
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.fuzz_cases import CASES, Rng, call

# What is no array of finite numbers at all, or has no entries.
WRONG: list[Any] = [
    None, "x", b"bytes", object(), {}, [], [[]], [[1.0], [2.0, 3.0]], 1 + 2j, True, -1, 0, "1",
    [1.0, 2.0], 10**400, np.array(["a"]), np.zeros((0, 3)), np.zeros((3, 0)), np.ones((2,) * 5),
    np.array([None, 1.0]), np.array("2020-01-01", "datetime64[D]"),
]  # fmt: skip
NO_NUMBERS = [float("nan"), float("inf"), float("-inf")]
SIZES = [1e-320, 1e-300, 1e-200, 1e-12, 1e12, 1e160, 1e300, -1e300, 0.0, -1.0, *NO_NUMBERS]
EXAMPLES = 4  # of each argument

ARGUMENTS = [
    (name, argument)
    for name, (_, arguments) in CASES.items()
    for argument, value in arguments.items()
    if value is not Rng and argument != "state"
]


def is_no_number(value: Any) -> bool:
    """Whether a value is, or holds, a float that is not finite."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind == "f" and not np.isfinite(value).all()
    return isinstance(value, float) and not np.isfinite(value)


def is_sound(result: Any) -> bool:
    """Whether every number of a result is one; infinities say "none" in costs and odds."""
    if isinstance(result, tuple):
        return all(is_sound(field) for field in result)
    if isinstance(result, np.ndarray) and result.dtype.kind == "f":
        return not np.isnan(result).any()
    return True


def check(name: str, argument: str, value: Any) -> None:
    function, arguments = CASES[name]
    try:
        result = call(function, {**arguments, argument: value})
    except (ValueError, TypeError) as error:
        known = {*arguments, *inspect.signature(function).parameters, "geometry"}
        if not any(one in str(error) for one in known):
            pytest.fail(f"{argument} = {value!r:.60}: {error}")
    else:
        assert not is_no_number(value), f"{argument} = {value!r:.60} was answered"
        # `locate` says NaN where the links determine nothing.
        sound = is_sound(result) or "locate" in name
        assert sound, f"{argument} = {value!r:.60} gave NaN"


def forms(good: Any) -> list[Any]:
    """Other values of an argument, once through."""
    if not isinstance(good, np.ndarray):
        return [*WRONG, *SIZES]
    found: list[Any] = [*WRONG, good[:0], good[..., :-1], good[None], np.empty((0, *good.shape))]
    if good.dtype.kind == "f":
        found += [np.full(good.shape, size) for size in SIZES]
        found += [good + 1j, good.astype(str), good.astype(object), -np.abs(good), 1e-300 * good]
    return found


@pytest.mark.parametrize("name", CASES)
def test_spoilt_arguments(name):
    function, arguments = CASES[name]
    call(function, arguments)
    for of, argument in ARGUMENTS:
        if of == name:
            # The methods of `locate` share its checks.
            alike = "locate " in name and not name.endswith(" ml")
            for form in forms(arguments[argument])[:: 4 if alike else 1]:
                check(name, argument, form)


@st.composite
def spoilt(draw: st.DrawFn, good: np.ndarray) -> Any:
    """An array that may stand where `good` should: other types, entries, sizes, shapes, noise."""
    change = draw(st.sampled_from(["type", "entry", "scale", "shape", "drop", "noise"]))
    if change == "type":
        return good.astype(draw(st.sampled_from([np.float32, np.int8, complex, object])))
    if change == "entry":
        array = good.copy()
        array.flat[draw(st.integers(0, array.size - 1))] = draw(
            st.one_of(st.sampled_from(SIZES), st.floats())
        )
        return array
    if change == "scale":
        with np.errstate(all="ignore"):
            return good * draw(st.sampled_from(SIZES))
    if change == "shape":
        return np.zeros(draw(arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=7)))
    if change == "drop":
        return good[:-1]
    return good + draw(arrays.arrays(float, good.shape, elements=st.floats(-1e3, 1e3)))


@pytest.mark.parametrize(
    ("name", "argument"),
    [
        pair
        for pair in ARGUMENTS
        if isinstance(good := CASES[pair[0]][1][pair[1]], np.ndarray) and good.dtype.kind == "f"
    ],
    ids=str,
)
def test_spoilt_arrays(name, argument):
    @settings(max_examples=EXAMPLES, database=None, phases=[Phase.generate],
              suppress_health_check=[*HealthCheck])  # fmt: skip
    @given(spoilt(CASES[name][1][argument]))
    def run(value: Any) -> None:
        check(name, argument, value)

    run()
