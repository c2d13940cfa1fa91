"""A filter of one body in environments of many worlds: the loop, and the messages without it."""

from __future__ import annotations

import json
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from rbl_gym.app.cli import main
from rbl_gym.estimators import IteratedEkf, PoseBelief, one_by_one
from rbl_gym.testing import check_filter
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests import recorded
from tests.test_tracking_vector_env import ID, short


class OneBody:
    """An EKF of one body that keeps its state in itself and returns none."""

    def __init__(self, tags, noise, process):
        self.inner = IteratedEkf(tags, noise, process, iterations=1)
        self.state: Any = None

    def initial(self, rotation, translation, covariance):
        assert np.shape(translation) == (3,), "one body"
        self.state = self.inner.initial(rotation, translation, covariance)

    def predict(self, state, twist, dt):
        self.state = self.inner.predict(self.state, twist, dt)

    def update(self, state, ranges, anchors, links=None, noise=None):
        assert np.ndim(ranges) == np.ndim(anchors) == 2
        self.state = self.inner.update(self.state, ranges, anchors, links, noise)

    def belief(self, state):
        return self.inner.belief(self.state)


class Ambiguous(OneBody):
    """An array as a condition, as code for one body often has it."""

    def initial(self, rotation, translation, covariance):
        if np.trace(covariance) > 0:
            super().initial(rotation, translation, covariance)


class Refuses(OneBody):
    def update(self, state, ranges, anchors, links=None, noise=None):
        raise ValueError("never")


Batched = one_by_one(OneBody)


class NoNoise(OneBody):
    def update(self, state, ranges, anchors, links=None):  # pyrefly: ignore[bad-override]
        super().update(state, ranges, anchors, links)


class OneBelief(IteratedEkf):
    """Accepts batches, but returns the belief of the first body."""

    def belief(self, state):
        belief = super().belief(state)
        return PoseBelief(*(field[0] for field in belief)) if belief[1].ndim > 1 else belief


def vector(filter: Any, scene: Any, mode: Any = AutoresetMode.NEXT_STEP, steps: int = 7) -> Any:
    envs: Any = gym.make_vec(ID, num_envs=3, scene=scene, reward="none", autoreset_mode=mode)
    envs = VectorEstimatePose(envs, filter)
    return [envs.reset(seed=5), *(envs.step(np.zeros(3, int)) for _ in range(steps))]


def test_it_passes_the_checks_of_every_filter():
    check_filter(one_by_one(OneBody))


# The hall loses links, and its noise law changes in every epoch.
@pytest.mark.parametrize("name", ["hall", "uwb_room"])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_beliefs_are_those_of_the_filter_for_batches(name, mode):
    mine = vector(one_by_one(OneBody), short(name, 4), mode)
    want = vector("iekf/iterations=1", short(name, 4), mode)
    for (got, *_), (expected, *_) in zip(mine, want, strict=True):
        for key in ("belief_rotation", "belief_translation", "belief_covariance"):
            np.testing.assert_allclose(got[key], expected[key], rtol=1e-7, atol=1e-9)


def test_scalar_and_vector_environments_give_the_same_beliefs():
    together = vector(one_by_one(OneBody), short("hall", 4), steps=3)
    for world in range(3):
        env: Any = gym.make(ID, scene=short("hall", 4), reward="none")
        env = EstimatePose(env, one_by_one(OneBody))
        alone = [env.reset(seed=5 + world), *(env.step(0) for _ in range(3))]
        for many, one in zip(together, alone, strict=True):
            for key in ("belief_rotation", "belief_translation", "belief_covariance"):
                np.testing.assert_allclose(many[0][key][world], one[0][key], rtol=1e-9, atol=1e-12)


def test_a_pickled_environment_goes_on_in_the_same_way():
    filter = one_by_one(OneBody)
    env: Any = EstimatePose(gym.make(ID, scene=short("hall", 4), reward="none"), filter)
    env.reset(seed=1)
    again = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(
        env.step(0)[0]["belief_covariance"], again.step(0)[0]["belief_covariance"]
    )


@pytest.mark.parametrize(
    ("filter", "named"),
    [
        (
            OneBody,
            r"filter OneBody must accept leading batch axes, here \(3,\).*one_by_one",
        ),
        (OneBelief, r"filter OneBelief must accept .* belief has a translation of shape \(3,\)"),
    ],
)
def test_a_filter_of_one_body_is_told_what_to_do(filter, named):
    with pytest.raises(ValueError, match=named):
        vector(filter, short("hall", 4))
    with pytest.raises(AssertionError, match=r"must accept leading batch axes .*one_by_one"):
        check_filter(filter)


def test_the_benchmark_names_the_loop_and_the_status_is_an_error(tmp_path, capsys):
    (tmp_path / "short.json").write_text('{"name": "uwb_room", "steps": 3}')

    def bench(filters: str, *more: str) -> int:
        arguments = ["--scenes", str(tmp_path / "short.json"), "--out", str(tmp_path / "x.jsonl")]
        return main(["bench", "--filters", filters, "--trials", "4", *arguments, *more])

    here = "tests.test_one_by_one"
    assert bench(f"iekf,{here}:Ambiguous", "--conditions", "nominal") == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "ValueError at epoch 0: The truth value of an array" in said
    assert f"{here}:Ambiguous accepts a single body" in said
    assert "Batched = rbl_gym.estimators.one_by_one(...)" in said
    # An error that every body has is left as it is.
    assert bench(f"{here}:Refuses", "--conditions", "nominal") == 1
    assert "single body" not in capsys.readouterr().out
    assert bench(f"iekf/iterations=1,{here}:Batched", "--json", str(tmp_path / "x.json")) == 0
    rows = json.loads((tmp_path / "x.json").read_text())["rows"]
    for want, got in zip(rows[::2], rows[1::2], strict=True):
        np.testing.assert_allclose(got["tags_m"]["rmse"], want["tags_m"]["rmse"], rtol=1e-6)


def test_a_replay_runs_the_loop(tmp_path, capsys):
    rng = np.random.default_rng(0)
    anchors = rng.uniform(-5, 5, (6, 3))
    tags = np.array([[0.4, 0, 0], [-0.4, 0.3, 0], [0, -0.3, 0.5]])
    ranges = np.linalg.norm(anchors[:, None] - tags, axis=-1)
    ranges = ranges + 0.05 * rng.standard_normal((9, 6, 3))
    files = recorded.files(tmp_path, anchors, tags, 0.1 * np.arange(9), ranges)
    found = []
    for name in ("tests.test_one_by_one:Batched", "iekf/iterations=1"):
        args = ["--filter", name, "--range-std-m", "0.05", "--json"]
        assert main(["replay", *recorded.options(files), *args, str(tmp_path / "f.json")]) == 0
        found.append(json.loads((tmp_path / "f.json").read_text())["consistency"]["nis_per_dof"])
    capsys.readouterr()
    # The command makes the filter of the package robust.
    assert found[0] == pytest.approx(found[1], rel=0.02)


def test_an_error_that_one_body_also_has_stays_as_it_is():
    class Broken(IteratedEkf):
        def update(self, state, ranges, anchors, links=None, noise=None):
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        vector(Broken, short("hall", 4))


def test_wrong_use_is_named():
    with pytest.raises(ValueError, match="filter must be one of"):
        one_by_one("nothing")
    with pytest.raises(ValueError, match=r"must take update.*noise"):
        vector(one_by_one(NoNoise), short("hall", 4))
