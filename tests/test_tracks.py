"""Filters that run many epochs in one call, against the loop over epochs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, kernels, motion
from rbl_gym.estimators.costs.losses import LATE, huber
from rbl_gym.estimators.iekf.augmented_steps import track_augmented
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.offsets import Clock
from rbl_gym.studies.epochs import Reading, Step, track_epochs
from rbl_gym.studies.groups import Steps, beliefs_of, each, innovations_of, joined, track_log
from tests.helpers import random_world

NOISE = ranging.RangeNoise(0.05, 0.01)
LEVEL = Level(height_m=0.5, height_std_m=0.2, tilt_std_rad=0.05)
KNOWN = np.diag([0.01] * 3 + [0.04] * 3)
EPOCHS = 30


def a_log(seed: int = 0, noise: Any = None, lost: float = 0.2) -> tuple[Any, Any, Any]:
    """Tags, prior and log of a body at rest: lost links, an epoch without any, gaps, outliers."""
    rng = np.random.default_rng(seed)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    shape = (EPOCHS, *true.shape)
    ranges = true + 0.05 * rng.standard_normal(shape)
    ranges[rng.random(shape) < 0.05] += 3.0
    links = rng.random(shape) >= lost
    links[7], links[8:12] = False, True
    ranges[~links] = 0.0
    dt: Any = np.full(EPOCHS, 0.1)
    dt[0], dt[15], dt[25] = 0.0, 1.0, 10.0
    twist = np.zeros((EPOCHS, 6))
    log = Reading(ranges, np.tile(anchors, (EPOCHS, 1, 1)), links, noise, twist, dt)
    return tags, (rotation, translation, KNOWN), log


def a_filter(name: str, tags: Any, **options: Any) -> Any:
    process = motion.ProcessNoise(0.05, 0.1)
    return estimators.make(name, tags=tags, noise=NOISE, process=process, **options)


def assert_same(mine: Any, theirs: Any) -> None:
    for a, b in zip(mine, theirs, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def assert_same_tracks(filter: Any, prior: Any, log: Reading, **how: Any) -> list[Step | Steps]:
    """The loop over epochs and the track in groups give the same; return the groups."""
    singly = [*track_epochs(filter, prior, each(log), **how)]
    groups = [*track_log(filter, prior, log, **how)]
    split = [s for group in groups for s in (group.each() if isinstance(group, Steps) else [group])]
    assert sum(group.count for group in groups) == len(split) == len(singly)
    for one, other in zip(singly, split, strict=True):
        for part in range(3):
            assert_same(one[part], other[part])
        np.testing.assert_array_equal(one.reading.ranges, other.reading.ranges)
        assert (one.reading.links is None) == (other.reading.links is None)
    told = [[i for _, i in innovations_of(filter, s, filter_tags(filter), NOISE)]
            for s in (singly, groups)]  # fmt: skip
    assert_same(joined(told[0]), joined(told[1]))
    assert_same(beliefs_of(singly), beliefs_of(groups))
    return groups


def filter_tags(filter: Any) -> Any:
    return getattr(filter, "pose", filter).tags


@pytest.mark.parametrize("robust", [False, True, "late"])
@pytest.mark.parametrize("name", ["iekf-bias", "iekf-log"])
@pytest.mark.parametrize("how", [{}, {"level": LEVEL}], ids=["free", "level"])
def test_groups_of_epochs_are_the_loop_over_them(name, robust, how):
    tags, prior, log = a_log()
    groups = assert_same_tracks(a_filter(name, tags, robust=robust), prior, log, **how)
    # The first epoch adds the biases; others are taken alone only if the rotation is vague.
    assert len(groups) < EPOCHS / 2
    assert isinstance(groups[0], Step)


def test_a_vague_start_and_a_lost_track_are_searched_in_the_loop():
    tags, prior, log = a_log(3, lost=0.0)
    vague = prior[0], prior[1] + 0.5, np.diag([9.0] * 3 + [4.0] * 3)
    filter = a_filter("iekf-bias", tags, robust=True)
    groups = assert_same_tracks(filter, vague, log._replace(dt=np.where(log.dt > 5, 900, log.dt)))
    alone = np.cumsum([group.count for group in groups])[[isinstance(g, Step) for g in groups]]
    # Fifteen minutes without ranges leave the rotation open.
    assert {1, 26} <= {*alone.tolist()}
    assert max(group.count for group in groups) > 10


def test_epochs_with_their_own_noise():
    std = np.random.default_rng(5).uniform(0.03, 0.2, (EPOCHS, 5, 4))
    tags, prior, log = a_log(1, noise=ranging.LinkNoise(std))
    filter = a_filter("iekf-log", tags)
    assert any(isinstance(group, Steps) for group in assert_same_tracks(filter, prior, log))


def test_a_known_twist_moves_the_body():
    tags, prior, log = a_log(2)
    rng = np.random.default_rng(6)
    log = log._replace(twist=0.05 * rng.standard_normal((EPOCHS, 6)), links=None,
                       ranges=np.where(log.ranges > 0, log.ranges, 5.0))  # fmt: skip
    groups = assert_same_tracks(a_filter("iekf-bias", tags, robust=True), prior, log)
    assert [group.count for group in groups] == [1, EPOCHS - 1]


def test_a_restart_ends_a_group():
    tags, prior, log = a_log(4)
    filter = a_filter("iekf-bias", tags)
    east = beliefs_of(track_log(filter, prior, log)).translation[:, 0]
    limit = np.sort(east)[-3]

    def restart(belief: Any, anchors: np.ndarray) -> Any:
        assert anchors.shape == (5, 3)
        return prior if belief.translation[0] > limit else None

    groups = assert_same_tracks(filter, prior, log, restart=restart)
    assert sum(isinstance(group, Step) for group in groups) > 1


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("iekf", {}),
        ("iekf-cv", {}),
        ("kf", {}),
        ("iekf-bias", {"offset": "epoch"}),
        ("iekf-log", {"clock": Clock()}),
    ],
)
def test_filters_with_other_steps_are_looped(name, options):
    tags, prior, log = a_log(lost=0.0)
    log = log._replace(
        links=None, ranges=np.where(log.ranges > 0, log.ranges, 5.0), dt=0.1 + log.dt
    )
    groups = assert_same_tracks(a_filter(name, tags, **options), prior, log)
    assert all(isinstance(group, Step) for group in groups)


def test_an_invalid_epoch_is_named_by_the_loop():
    tags, prior, log = a_log(lost=0.0)
    log = log._replace(links=None, ranges=np.where(log.ranges > 0, log.ranges, 5.0))
    log.ranges[20, 1, 2] = np.nan
    filter, seen = a_filter("iekf-bias", tags), []
    with pytest.raises(ValueError, match=r"ranges must be finite.*\(1, 2\)"):
        seen.extend(track_log(filter, prior, log))
    assert sum(group.count for group in seen) == 20
    state = seen[0].state
    with pytest.raises(ValueError, match="dt must be finite"):
        filter.track(state, log.ranges[:3], log.anchors[:3], dt=[0, 1, np.nan])


@pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")
@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize(("n_twist", "loss"), [(0, huber(1.0)), (6, LATE)])
def test_the_kernel_is_the_textbook_form(batch, n_twist, loss):
    rng = np.random.default_rng(8)
    E, m, n, laws = 6, 4, 3, np.array([[0.05, np.inf, 0.1], [0.03, 2.0, 0.02]])
    anchors, tags, rotation, translation = random_world(rng, m, n, batch)
    k = n_twist + 2 * m * n
    A = 0.05 * rng.standard_normal((*batch, 2 * k + 12, 6 + k))
    P = np.swapaxes(A, -1, -2) @ A / (2 * k + 12) + 1e-4 * np.eye(6 + k)
    true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    ranges = true[..., None, :, :] + 0.1 * rng.standard_normal((*batch, E, m, n))
    weights = np.where(rng.random(ranges.shape) < 0.3, 0.0, rng.uniform(50, 400, ranges.shape))
    turned = rotations.exp(0.02 * rng.standard_normal((*batch, 3))) @ rotation
    args = (
        turned, translation, 0.01 * rng.standard_normal((*batch, k)), P,
        0.1 * rng.standard_normal((E, 6)), rng.uniform(0, 0.5, E), np.full(6, 0.01),
        np.full(6, 0.02), laws, n_twist, LEVEL.numbers, ranges, weights,
        np.broadcast_to(anchors[..., None, :, :], (*batch, E, m, 3)), tags, 4, loss,
    )  # fmt: skip
    got, want = track_augmented.kernel(*args), track_augmented.textbook(*args)
    assert (want[-1] == E).all()
    assert_same(got, want)
