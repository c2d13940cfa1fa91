"""Bad input gives a ValueError that names the argument and the value, for every filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, motion
from rbl_gym.geometry import bodies
from rbl_gym.measurements import ranging
from tests.helpers import twist_filters

TAGS = bodies.pyramid()
ANCHORS = np.array([[0, 0, 0], [9, 0, 1], [0, 9, 2], [9, 9, 3.0]])
RANGES = ranging.distances(ANCHORS, TAGS + [3.0, 4.0, 1.0])
GOOD_PRIOR = {
    "rotation": np.eye(3),
    "translation": np.array([3.0, 4.0, 1.0]),
    "covariance": np.diag([0.01] * 3 + [0.1] * 3),
}
NAMES = estimators.names()


def make(name, noise=None):
    noise = noise or ranging.RangeNoise(0.1)
    return estimators.make(name, tags=TAGS, noise=noise, process=motion.ProcessNoise(0.1, 0.1))


def spoiled(array, index, value):
    array = np.array(array, dtype=float)
    array[index] = value
    return array


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotation": np.eye(2)}, r"rotation must have shape \(..., 3, 3\), got \(2, 2\)"),
        (
            {"rotation": 2 * np.eye(3)},
            r"rotation must be orthogonal .*, but rotation times .* by 3",
        ),
        ({"rotation": -np.eye(3)}, "rotation must be a proper rotation, got a reflection"),
        ({"translation": [0, 0]}, r"translation must have shape \(..., 3\), got \(2,\)"),
        ({"translation": [0, np.nan, 0]}, r"translation must be finite, got nan at index \(1,\)"),
        ({"translation": "here"}, "translation must be an array of real numbers, got 'here'"),
        ({"covariance": np.eye(5)}, r"covariance must have shape .*, got \(5, 5\)"),
        (
            {"covariance": np.zeros((6, 6))},
            "covariance must be positive definite, .* eigenvalue is 0",
        ),
        (
            {"covariance": spoiled(np.eye(6), (0, 1), 0.5)},
            "covariance must be symmetric, but its asymmetry is",
        ),
    ],
)
def test_priors(name, changes, message):
    with pytest.raises(ValueError, match=message):
        make(name).initial(**{**GOOD_PRIOR, **changes})


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ranges": RANGES[:, :4]}, r"ranges must have shape \(..., 4, 5\), got \(4, 4\)"),
        ({"ranges": RANGES.T}, r"ranges must have shape \(..., 4, 5\), got \(5, 4\)"),
        (
            {"ranges": spoiled(RANGES, (2, 3), np.nan)},
            r"ranges must be finite, got nan at .*\(2, 3\); if the link has no range, set",
        ),
        (
            {"ranges": spoiled(RANGES, (0, 1), np.inf)},
            r"ranges must be finite, got inf at .*\(0, 1\)",
        ),
        (
            {"ranges": spoiled(RANGES, (1, 1), -2)},
            r"ranges must be positive .*, got -2.0 at index \(1, 1\)",
        ),
        (
            {"ranges": spoiled(RANGES, (1, 1), 0)},
            r"ranges must be positive .*, got 0.0 at index \(1, 1\)",
        ),
        ({"ranges": RANGES.astype(complex)}, "ranges must be an array of real numbers"),
        ({"anchors": ANCHORS[:, :2]}, r"anchors must have shape \(..., M, 3\), got \(4, 2\)"),
        (
            {"anchors": spoiled(ANCHORS, (3, 0), np.nan)},
            r"anchors must be finite, got nan at .*\(3, 0\)",
        ),
        ({"anchors": np.zeros((0, 3))}, r"anchors must have shape \(..., M, 3\), got \(0, 3\)"),
        ({"links": np.ones((5, 4), bool)}, r"links must have shape \(..., 4, 5\), got \(5, 4\)"),
        ({"links": np.full((4, 5), 0.5)}, "links must be True"),
    ],
)
def test_epochs(name, changes, message):
    filter = make(name)
    epoch: dict[str, Any] = {"ranges": RANGES, "anchors": ANCHORS, **changes}
    with pytest.raises(ValueError, match=message):
        filter.update(filter.initial(**GOOD_PRIOR), **epoch)


@pytest.mark.parametrize("name", twist_filters())
@pytest.mark.parametrize(
    ("twist", "dt", "message"),
    [
        (np.zeros(3), 1.0, r"twist must have shape \(..., 6\), got \(3,\)"),
        (np.full(6, np.nan), 1.0, "twist must be finite"),
        (np.zeros(6), -1.0, r"dt must be a finite number of at least 0, got -1.0"),
        (np.zeros(6), np.nan, "dt must be a finite number"),
        (np.zeros(6), "soon", "dt must be a number, got 'soon'"),
    ],
)
def test_motion(name, twist, dt, message):
    filter = make(name)
    with pytest.raises(ValueError, match=message):
        filter.predict(filter.initial(**GOOD_PRIOR), twist, dt)


@pytest.mark.parametrize("name", ["kf", "uc-kf", "et-kf", "kf-ortho"])
@pytest.mark.parametrize("shape", [(3,), (4, 3)])
def test_weights_that_do_not_fit_the_links(name, shape):
    process = motion.ProcessNoise(0.1, 0.1)
    noise = ranging.RangeNoise(0.1)
    filter = estimators.make(name, tags=TAGS, noise=noise, process=process, weights=np.ones(shape))
    with pytest.raises(ValueError, match=r"weights must fit links \(4, 5\)"):
        filter.update(filter.initial(**GOOD_PRIOR), RANGES, ANCHORS)


@pytest.mark.parametrize("name", NAMES)
def test_a_reference_tag_that_is_not_there(name):
    filter = make(name, ranging.RangeNoise(0.1, reference_tag=7))
    with pytest.raises(ValueError, match="reference_tag must be below the number of tags 5, got 7"):
        filter.update(filter.initial(**GOOD_PRIOR), RANGES, ANCHORS)
