"""Public functions with one argument spoilt: a result that is finite, or an error that names it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from rbl_gym import bodies, bounds, estimators, link_bounds, motion, ranging
from rbl_gym.bearing import AngleNoise

TAGS = bodies.octahedron(0.8)
ANCHORS = np.array([[5, 0, 0], [-5, 0, 0], [0, 5, 3], [0, -5, 3.0], [1, 2, 6]])
NOISE, PROCESS = ranging.RangeNoise(0.1), motion.ProcessNoise(0.1, 0.1)
POSE = {"rotation": np.eye(3), "translation": np.array([0.3, 0.2, 0.1])}
PLACES = {"anchors": ANCHORS, "tags": TAGS, **POSE, "noise": NOISE}
RANGES = ranging.distances(ANCHORS, TAGS + POSE["translation"])
TWIST = {"twist": np.full(6, 0.1), "dt": 0.5, "process": PROCESS}
LINKS = np.ones(RANGES.shape, bool)
LINK_MODEL = ranging.LinkModel(0.1, nlos_probability=0.1)


def filter_steps(name: str, **options: Any) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """The three methods of a filter, with good arguments."""
    filter = estimators.make(name, tags=TAGS, noise=NOISE, process=PROCESS, **options)
    label = f"{name} {' '.join(options)}".strip()
    prior = {**POSE, "covariance": 0.01 * np.eye(6)}
    state = filter.initial(**prior)
    return {
        f"{label}.initial": (filter.initial, prior),
        f"{label}.predict": (
            lambda twist, dt: filter.predict(state, twist, dt),
            {key: TWIST[key] for key in ("twist", "dt")},
        ),
        f"{label}.update": (
            lambda ranges, anchors, links: filter.update(state, ranges, anchors, links),
            {"ranges": RANGES, "anchors": ANCHORS, "links": LINKS},
        ),
    }


CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "simulate": (ranging.simulate, {**PLACES, "rng": np.random.default_rng(1)}),
    "range_information": (bounds.range_information, {**PLACES, "links": LINKS, "tag_std_m": 0.01}),
    "pose_crb": (bounds.pose_crb, {**PLACES, "prior_information": np.eye(6)}),
    "posterior_crb_step": (bounds.posterior_crb_step, {"J": np.eye(6), **PLACES, **TWIST}),
    "doa_crb": (
        bounds.doa_crb,
        {"tags": TAGS, **POSE, "noise": AngleNoise(0.01), "prior_information": np.eye(6)},
    ),
    "expected_information": (
        link_bounds.expected_information,
        {**PLACES, "link_model": LINK_MODEL, "nlos_std_m": 1.0},
    ),
    "realised_crb": (
        link_bounds.realised_crb,
        {**PLACES, "link_model": LINK_MODEL, "rng": np.random.default_rng(1), "draws": 3,
         "prior_information": np.eye(6)},
    ),
    "nlos_efficiency": (
        link_bounds.nlos_efficiency,
        {"probability": 0.1, "bias_m": 5.0, "std_m": 0.1, "bias_std_m": 1.0},
    ),
    "bias_information": (link_bounds.bias_information, {**PLACES, "links": LINKS}),
    "with_biases": (
        link_bounds.with_biases, {"pose_information": np.eye(6), "bias_std_m": 0.1, "n_biases": 3}
    ),
    "marginal_information": (link_bounds.marginal_information, {"joint": np.eye(8)}),
    "posterior_bias_step": (
        link_bounds.posterior_bias_step,
        {"J": np.eye(11), **PLACES, **TWIST, "groups": "anchor", "bias_walk_m": 0.1},
    ),
    "locate": (
        estimators.locate, {"ranges": RANGES, "anchors": ANCHORS, "tags": TAGS, "noise": NOISE,
                            "links": LINKS, "tag_std_m": 0.01},
    ),
    "locate robust": (
        lambda ranges, anchors, tags, links: estimators.locate(
            ranges, anchors, tags, NOISE, "robust", links
        ),
        {"ranges": RANGES, "anchors": ANCHORS, "tags": TAGS, "links": LINKS},
    ),
    "make": (
        lambda tags, noise, process, iterations, robust, volume: estimators.make(
            "iekf-bank", tags=tags, noise=noise, process=process, iterations=iterations,
            robust=robust, volume=volume,
        ),
        {"tags": TAGS, "noise": NOISE, "process": PROCESS, "iterations": 4, "robust": True,
         "volume": np.array([[-1.0, -1, -1], [1, 1, 1]])},
    ),
    "RangeNoise": (
        ranging.RangeNoise, {"floor_m": 0.1, "proportional": 0.1, "reference_tag": 0}
    ),
    "LinkModel": (
        ranging.LinkModel,
        {"drop_probability": 0.1, "reach_m": 9.0, "nlos_probability": 0.1, "nlos_bias_m": 5.0},
    ),
    "ProcessNoise": (motion.ProcessNoise, {"rotation_rad": 0.1, "translation_m": 0.1}),
    **filter_steps("iekf"),
    **filter_steps("iekf", robust=True),
    **filter_steps("iekf-bank"),
    **filter_steps("kf"),
    **filter_steps("uc-kf"),
}  # fmt: skip
ARGUMENTS = [(call, name) for call, (_, good) in CALLS.items() for name in good]
# Of each argument.
EXAMPLES = 25
# What is no array of finite numbers at all, or has no entries.
WRONG = [
    None, "text", b"bytes", object(), {}, [], [[]], [[1.0, 2.0], [3.0]], np.nan, np.inf, -np.inf,
    1j, True, -1, 0, 10**400, np.array(["a"]), np.zeros((0, 3)), np.zeros((3, 0)),
    np.zeros((2, 2, 2, 2, 2)), np.array([None, 1.0]), np.array("2020-01-01", "datetime64[D]"),
]  # fmt: skip
SIZES = [1e-320, 1e-200, 1e-12, 1e12, 1e160, 1e308, np.nan, np.inf, -np.inf, -1.0]


@st.composite
def spoilt(draw: st.DrawFn, good: Any) -> Any:
    """Something that may stand where `good` should: wrong kinds, shapes, types, sizes, holes."""
    if not isinstance(good, np.ndarray) or draw(st.booleans()):
        return draw(st.sampled_from([*WRONG, *SIZES]))
    array = np.array(
        good, dtype=draw(st.sampled_from([float, np.float32, np.int8, complex, object]))
    )
    change = draw(st.sampled_from(["entry", "scale", "shape", "drop", "noise"]))
    if change == "entry":
        array = np.array(good, dtype=float)
        array.flat[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from(SIZES))
    elif change == "scale":
        with np.errstate(all="ignore"):
            array = np.array(good, dtype=float) * draw(st.sampled_from(SIZES))
    elif change == "shape":
        array = np.zeros(draw(arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=7)))
    elif change == "drop":
        array = array[:-1]
    else:
        array = np.array(good, dtype=float) + draw(
            arrays.arrays(float, np.shape(good), elements=st.floats(-1e3, 1e3))
        )
    return array


def is_sound(result: Any) -> bool:
    """Whether every number of a result is one; infinities say "none" in costs and odds."""
    if isinstance(result, tuple):
        return all(is_sound(field) for field in result)
    if isinstance(result, np.ndarray) and result.dtype.kind == "f":
        return not np.isnan(result).any()
    return True


def flaw(call: str, name: str, value: Any) -> str | None:
    """What is wrong with the answer of a call to a spoilt argument, None if nothing is."""
    function, good = CALLS[call]
    try:
        result = function(**{**good, name: value})
    except (ValueError, TypeError) as error:
        known = {*good, *inspect.signature(function).parameters}
        return None if any(one in str(error) for one in known) else f"no name in {error!r}"
    return None if call.startswith("locate") or is_sound(result) else "NaN"


@pytest.mark.parametrize(("call", "name"), ARGUMENTS, ids=str)
def test_one_spoilt_argument(call, name):
    @settings(max_examples=EXAMPLES, deadline=None, database=None, derandomize=True,
              suppress_health_check=list(HealthCheck), phases=[Phase.generate])  # fmt: skip
    @given(spoilt(CALLS[call][1][name]))
    def check(value: Any) -> None:
        assert flaw(call, name, value) is None

    check()
