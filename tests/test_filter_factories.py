"""Filters given as a class or a function, in Python, in place of a name."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import estimators
from rbl_gym.estimators import IteratedEkf
from rbl_gym.studies.watching.played import own_filter
from rbl_gym.testing import check_filter
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests.helpers import assert_same
from tests.test_tracking_vector_env import ID, short

NOTEBOOK = """
from rbl_gym import estimators

class Mine:
    def __init__(self, tags, noise, process, iterations=1):
        self.inner = estimators.make(
            "iekf", tags=tags, noise=noise, process=process, iterations=iterations)
        self.initial, self.predict = self.inner.initial, self.inner.predict
        self.update, self.belief = self.inner.update, self.inner.belief
"""


def in_notebook() -> Any:
    """A class that belongs to no module that can be imported, as in a notebook or a script."""
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(NOTEBOOK, names)
    return names["Mine"]


def once(tags, noise, process):
    return estimators.make("iekf/iterations=1", tags=tags, noise=noise, process=process)


def scalar(filter: Any, **options: Any) -> list[Any]:
    env: Any = EstimatePose(gym.make(ID, scene=short("hall", 4)), filter, **options)
    return [env.reset(seed=1), *(env.step(0) for _ in range(3))]


def vector(filter: Any, **options: Any) -> list[Any]:
    envs: Any = gym.make_vec(ID, num_envs=3, scene=short("hall", 4))
    envs = VectorEstimatePose(envs, filter, **options)
    return [envs.reset(seed=1), *(envs.step(np.zeros(3, int)) for _ in range(5))]


@pytest.mark.parametrize("run", [scalar, vector])
def test_a_class_or_function_gives_the_same_as_its_name(run):
    want = run("iekf/iterations=1")
    mine = in_notebook()
    for filter in (mine, once, {"name": mine, "iterations": 1}):
        assert_same(run(filter), want)
    assert_same(run(mine, options={"iterations": 3}), run("iekf/iterations=3"))


def test_the_environments_that_run_a_filter_take_a_class():
    env: Any = gym.make("rbl_gym:RBL/AnchorSelection-v0", filter=in_notebook())
    assert np.isfinite(env.reset(seed=1)[1]["tag_error_m"])


def test_the_wrapped_environment_can_be_pickled_and_its_spec_makes_it_again():
    env: Any = EstimatePose(gym.make(ID, scene=short("hall", 4)), IteratedEkf)
    for again in (pickle.loads(pickle.dumps(env)), gym.make(env.spec)):
        assert_same(again.reset(seed=1), env.reset(seed=1))
    with pytest.raises(TypeError, match="not JSON"):
        env.spec.to_json()


def test_check_filter_takes_a_path():
    check_filter("tests.test_filter_factories:once", skip=["nees"])
    with pytest.raises(ValueError, match=r"'module:factory'; for a filter with a name"):
        check_filter("iekf")


def test_wrong_factories_are_named():
    with pytest.raises(ValueError, match=r"made by factory\(tags=.*its arguments are \(tags\)"):
        scalar(lambda tags: None)
    with pytest.raises(ValueError, match=r"has no option 'iteration'; .*did you mean 'iterations'"):
        scalar(in_notebook(), options={"iteration": 2})
    with pytest.raises(ValueError, match="or a class or function that makes the filter, got 3"):
        scalar(3)


def test_a_filter_without_a_method_is_named_before_it_runs():
    class Still:
        def __init__(self, tags, noise, process):
            made = once(tags, noise, process)
            self.initial, self.update, self.belief = made.initial, made.update, made.belief

    with pytest.raises(ValueError, match=r"filter Still must have .*, got Still without predict"):
        scalar(Still)


def test_the_studio_names_a_filter_by_its_class():
    env: Any = EstimatePose(gym.make(ID, scene=short("hall", 4)), once, {})
    found = own_filter(env)
    assert found is not None
    assert (found.label, found.name) == ("once", once)
