"""A state is its values: nothing of it is in strides, bases or caches."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from rbl_gym import estimators, motion
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import bearing, ranging
from tests.helpers import simulate, twist_filters

TAGS = bodies.pyramid(1.0)
NOISE, PROCESS = ranging.RangeNoise(0.05), motion.ProcessNoise(0.05, 0.1)
FILTERS = [
    *((name, {}) for name in twist_filters()),
    ("iekf", {"robust": True}),
    ("iekf-bank", {"robust": True}),
    ("uc-kf", {"coupled": True}),
    ("kf", {"weights": np.linspace(1, 2, 6)}),
]


def epochs(batch, count=6):
    """Anchors, a pose to start near, twists, ranges and links of a run."""
    rng = np.random.default_rng(11)
    anchors = 8 * rng.standard_normal((6, 3))
    rotation, translation = rotations.random(rng, batch), rng.uniform(-2, 2, (*batch, 3))
    start = rotations.exp(0.1 * rng.standard_normal((*batch, 3))) @ rotation, translation + 0.1
    run = []
    for k in range(count):
        twist = 0.3 * rng.standard_normal((*batch, 6))
        rotation, translation = motion.propagate(rotation, translation, twist, 0.1)
        ranges = simulate(rng, anchors, TAGS, rotation, translation, NOISE)
        if k == 4:
            # Lost: the bank looks around.
            ranges = ranges + 2.0 * (np.arange(6) < 3)[:, None]
        run.append((twist, ranges, rng.random(ranges.shape) > (0.2 if k == 2 else -1)))
    return anchors, start, run


def assert_same_bytes(one, other):
    assert type(one) is type(other)
    for a, b in zip(one, other, strict=True):
        assert type(a) is np.ndarray
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        assert a.tobytes() == b.tobytes()


def laid_out(state):
    """The same values, with the first axis running fastest in memory."""
    return type(state)(*(np.array(field, order="F") for field in state))


@pytest.mark.parametrize(("name", "options"), FILTERS, ids=str)
@pytest.mark.parametrize("batch", [(), (2, 40)], ids=str)
@pytest.mark.parametrize(
    "through",
    [lambda state: pickle.loads(pickle.dumps(state)), laid_out],
    ids=["pickle", "Fortran order"],
)
def test_what_became_of_a_state_never_changes_what_comes_after(name, options, batch, through):
    filter = estimators.make(name, tags=TAGS, noise=NOISE, process=PROCESS, **options)
    anchors, start, run = epochs(batch)
    straight = copied = filter.initial(*start, np.diag([0.02] * 3 + [0.1] * 3))
    for twist, ranges, links in run:
        straight, copied = (filter.predict(s, twist, 0.1) for s in (straight, through(copied)))
        assert_same_bytes(straight, copied)
        straight, copied = (
            filter.update(s, ranges, anchors, links) for s in (straight, through(copied))
        )
        assert_same_bytes(straight, copied)
        assert_same_bytes(filter.belief(straight), filter.belief(through(copied)))


def test_a_state_of_angles_too():
    filter = estimators.make("iekf", tags=TAGS, noise=bearing.AngleNoise(0.01), process=PROCESS,
                             measurement="doa")  # fmt: skip
    rng = np.random.default_rng(3)
    pose = rotations.random(rng, (7,)), rng.uniform(3, 5, (7, 3))
    angles = bearing.angles(ranging.tag_positions(*pose, TAGS))
    straight = copied = filter.initial(*pose, 0.01 * np.eye(6))
    for _ in range(3):
        copied = pickle.loads(pickle.dumps(copied))
        straight, copied = (filter.predict(s, np.ones(6), 0.01) for s in (straight, copied))
        copied = pickle.loads(pickle.dumps(copied))
        straight, copied = (filter.update(s, angles, np.zeros(3)) for s in (straight, copied))
        assert_same_bytes(straight, copied)
