"""The registry of filters and its entry-point group."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, motion
from rbl_gym.estimators import filter as belief
from rbl_gym.geometry import bodies
from rbl_gym.measurements import ranging

LAWS: dict[str, Any] = {
    "tags": bodies.pyramid(),
    "noise": ranging.RangeNoise(0.1),
    "process": motion.ProcessNoise(0.1, 0.1),
}


class Standstill:
    """The least filter: it believes its prior. What a third party would write."""

    def __init__(self, tags, noise, process, shift=0.0):
        self.shift = shift

    def initial(self, rotation, translation, covariance):
        return belief.PoseBelief(rotation, translation, covariance, rotation)

    def predict(self, state, twist, dt):
        return state

    def update(self, state, ranges, anchors, links=None, noise=None):
        return state._replace(translation=state.translation + self.shift)

    def belief(self, state):
        return state


def test_our_filters_go_by_their_names():
    assert set(estimators.names()) >= {"kf", "uc-kf", "et-kf", "kf-ortho", "iekf"}
    for name in estimators.names():
        filter = estimators.make(name, **LAWS)
        state = filter.initial(np.eye(3), np.zeros(3), np.eye(6))
        assert filter.belief(state).covariance.shape == (6, 6)


def test_a_package_adds_its_filter_by_an_entry_point(monkeypatch):
    entry = EntryPoint("standstill", "tests.test_belief:Standstill", "rbl_gym.filters")
    monkeypatch.setattr(belief, "entry_points", lambda group: [entry])
    assert "standstill" in estimators.names()
    filter = estimators.make("standstill", **LAWS, shift=2.0)
    state = filter.initial(np.eye(3), np.zeros(3), np.eye(6))
    state = filter.update(
        filter.predict(state, np.zeros(6), 1.0), np.ones((4, 5)), np.eye(4)[:, :3]
    )
    assert filter.belief(state).translation[0] == 2.0


def test_register_keeps_the_first_holder_of_a_name(monkeypatch):
    monkeypatch.setattr(belief, "_FACTORIES", dict(belief._FACTORIES))
    estimators.register("standstill", Standstill)
    estimators.register("standstill", Standstill)
    with pytest.raises(ValueError, match="filter 'standstill' is already registered"):
        estimators.register("standstill", estimators.IteratedEkf)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("ekf", {}, "filter must be one of .*et-kf, .*kf-ortho, .*uc-kf.*, or a name .*got 'ekf'"),
        ("kf", {"robust": True}, "filter 'kf' has no option 'robust'; its options are"),
        ("iekf", {"threshold": 1.0}, "its options are iterations, robust"),
        ("kf", {"noise": 0.1}, "noise must be .* ranging.RangeNoise, .* got 0.1"),
        ("kf", {"process": None}, "process must be .* motion.ProcessNoise, .* got None"),
        ("iekf", {"tags": np.zeros((5, 2))}, r"tags must have shape \(..., N, 3\), got \(5, 2\)"),
        (
            "iekf/robust",
            {},
            "filter 'iekf/robust' must have the form name/option=value/..., got 'robust'",
        ),
        ("iekf/robust=true/robust=late", {}, "has the option 'robust' twice"),
        ("iekf/robust=true", {"robust": True}, "has the option 'robust' twice"),
        ("iekf/tags=3", {}, "filter 'iekf' has no option 'tags'; its options are"),
        ("iekf", {"iterations": 0}, "iterations must be a positive int, got 0"),
        ("et-kf", {"threshold": -1}, "threshold must be a finite number"),
        ("kf", {"engine": "numpy"}, "engine must be one of 'auto', 'batched', 'filterpy', got"),
        ("kf", {"weights": [1.0, -1.0]}, "weights must not be negative, got -1.0"),
    ],
)
def test_wrong_names_and_options_are_named(name, changes, message):
    with pytest.raises(ValueError, match=message):
        estimators.make(name, **{**LAWS, **changes})


@pytest.mark.parametrize(
    ("text", "name", "options"),
    [
        ("kf", "kf", {}),
        (" iekf/robust=late ", "iekf", {"robust": "late"}),
        ("iekf/robust=True/offset=None", "iekf", {"robust": True, "offset": None}),
        ("a.b:make/count=2/std_m=[0.1,2e-3]", "a.b:make", {"count": 2, "std_m": [0.1, 2e-3]}),
    ],
)  # fmt: skip
def test_options_after_a_name(text, name, options):
    assert estimators.parse_filter(text) == (name, options)
    assert estimators.parse_filter(belief.filter_text(name, options)) == (name, options)
    merged = {**options, "gain": 3}
    assert estimators.parse_filter(text, {"gain": 3}) == (name, merged)


def test_options_after_a_name_are_those_of_the_filter():
    told = estimators.make("iekf/robust=late/iterations=3", **LAWS)
    assert isinstance(told, estimators.IteratedEkf)
    assert (told.robust, told.iterations) == ("late", 3)
    with pytest.raises(ValueError, match="name must have no '/'"):
        estimators.register("iekf/robust", Standstill)


@pytest.mark.parametrize("name", estimators.names())
def test_a_belief_shares_no_memory_with_its_state(name):
    filter = estimators.make(
        name,
        tags=bodies.octahedron(),
        noise=ranging.RangeNoise(0.1),
        process=motion.ProcessNoise(0.1, 0.1),
    )
    state = filter.initial(np.eye(3), np.zeros(3), 0.1 * np.eye(6))
    for field in filter.belief(state):
        assert not any(np.shares_memory(field, array) for array in state)
