"""Checks of arguments: valid ones are returned as float64, errors name invalid ones."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from rbl_gym import checks


@pytest.mark.parametrize(
    "value",
    [[[1, 2, 3]], [[True, False, True]], np.ones((4, 2, 3), np.float32), [[9e49, 9e49, 9e49]]],
    ids=["ints", "bools", "batch", "very large"],
)
def test_good_array_comes_back_as_float64(value):
    got = checks.check_array("x", value, ("M", 3))
    assert got.dtype == np.float64
    np.testing.assert_array_equal(got, np.asarray(value))


def test_good_float64_array_is_not_copied():
    value = np.ones((2, 3))
    assert checks.check_array("x", value, ("M", 3)) is value


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        (np.ones((2, 4)), ("M", 3), "tags must have shape (..., M, 3), got (2, 4)"),
        (np.ones((0, 3)), ("M", 3), "tags must have shape (..., M, 3), got (0, 3)"),
        (np.ones((0, 2, 3)), ("M", 3), "tags must not be empty, got shape (0, 2, 3)"),
        (np.ones(3), ("M", 3), "tags must have shape (..., M, 3), got (3,)"),
        (1.0, (6, 6), "tags must have shape (..., 6, 6), got ()"),
        ("abc", (), "tags must be an array of real numbers, got 'abc'"),
        ([1, None], ("K",), "tags must be an array of real numbers, got [1, None]"),
        ([[1, 2], [3]], ("K", 2), "tags must be an array of real numbers"),
        (1j, (), "tags must be an array of real numbers, got 1j"),
        ([[0, 1], [np.nan, 2]], (2, 2), "tags must be finite, got nan at index (1, 0)"),
        ([0, np.inf, np.nan], (3,), "tags must be finite, got inf at index (1,)"),
        ([0, np.inf, -np.inf], (3,), "tags must be finite, got inf at index (1,)"),
        (np.nan, (), "tags must be finite, got nan"),
        (-2e50, (), "tags must be below 1e+50 in magnitude, got -2e+50"),
        ([1, -1e50], (2,), "tags must be below 1e+50 in magnitude, got -1e+50 at index (1,)"),
    ],
)
def test_bad_array_is_named(value, shape, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}") as caught:
        checks.check_array("tags", value, shape)
    assert "index ()" not in str(caught.value)


@pytest.mark.parametrize("value", [0, 2.0, np.float32(1), np.int64(2)])
def test_good_number_comes_back_as_float(value):
    got = checks.check_number("x", value, low=0, high=2)
    assert type(got) is float
    assert got == value


@pytest.mark.parametrize(
    ("value", "limits", "message"),
    [
        (np.nan, {}, "dt must be a finite number, got nan"),
        (-np.inf, {}, "dt must be a finite number, got -inf"),
        (-1, {"low": 0}, "dt must be a finite number of at least 0, got -1.0"),
        (2, {"low": 0, "high": 1}, "dt must be a finite number in [0, 1], got 2.0"),
        (None, {}, "dt must be a number, got None"),
        ([1.0, 2.0], {}, "dt must be a number, got [1.0, 2.0]"),
        ("fast", {}, "dt must be a number, got 'fast'"),
        ("0.5", {}, "dt must be a number, got '0.5'"),
        pytest.param(10**400, {}, "dt must be a", id="beyond float"),
    ],
)
def test_bad_number_is_named(value: Any, limits, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        checks.check_number("dt", value, **limits)


@pytest.mark.parametrize("dtype", [bool, int, float])
def test_links_of_zeros_and_ones_become_boolean(dtype):
    mask = checks.check_links(np.array([[1, 0, 1]], dtype), (7, 1, 3))
    assert mask is not None
    assert mask.dtype == np.bool_
    np.testing.assert_array_equal(mask, [[True, False, True]])


def test_no_links_stay_none():
    assert checks.check_links(None, (2, 3)) is None


@pytest.mark.parametrize(
    ("links", "message"),
    [
        (np.ones((3, 2)), "links must have shape (..., 2, 3), got (3, 2)"),
        (True, "links must have shape (..., 2, 3), got ()"),
        (np.full((2, 3), 0.5), "links must be True (measured) or False, got 0.5 at index (0, 0)"),
        (np.full((2, 3), np.nan), "links must be True"),
        (np.full((2, 3), 2), "links must be True"),
        (np.full((2, 3), "x"), "links must be True"),
    ],
)
def test_bad_links_are_refused(links, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        checks.check_links(links, (2, 3))


def test_choice():
    assert checks.check_one_of("method", "ls", ("ls", "ml")) == "ls"
    with pytest.raises(ValueError, match=r"^method must be one of 'ls', 'ml', got 'svd'$"):
        checks.check_one_of("method", "svd", ("ls", "ml"))


@pytest.mark.parametrize(
    ("value", "hint"),
    [
        ("iekff", "; did you mean 'iekf'?"),
        ("uwb", ""),
        (None, ""),
        (3, ""),
        ("IEKF", "; did you mean 'iekf'?"),
    ],
)
def test_a_misspelt_name_gets_a_suggestion(value, hint):
    assert checks.did_you_mean(value, ["iekf", "uc-kf", "kf"]) == hint
