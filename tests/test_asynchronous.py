"""Ranges one at a time: order, window, and the gain from their own time stamps."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, metrics, motion
from rbl_gym.estimators import Asynchronous
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from tests.helpers import random_world, simulate

NOISE = ranging.RangeNoise(0.02)
PROCESS = motion.ProcessNoise(0.05, 0.1)


def stream_of(name, rng, n_tags=4, **options):
    """A filter on a stream at its start, and 12 ranges (time, anchor, tag, range) in order."""
    anchors, tags, rotation, translation = random_world(rng, 5, n_tags)
    filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS, **options)
    links = Asynchronous(filter, anchors, n_tags, window_s=0.1)
    stream = links.start(filter.initial(rotation, translation, 0.01 * np.eye(6)), 0.0)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    times = np.cumsum(rng.uniform(0.005, 0.02, 12))
    where = [(int(rng.integers(5)), int(rng.integers(n_tags))) for _ in times]
    rows = [(float(t), m, n, float(ranges[m, n])) for t, (m, n) in zip(times, where, strict=True)]
    return links, stream, rows


def same(a, b):
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("name", ["iekf", "iekf-cv", "iekf-bias"])
def test_ranges_out_of_order_give_what_the_ordered_ones_give_to_the_last_bit(name):
    twist = None if name == "iekf-cv" else np.zeros(6)
    rng = np.random.default_rng(1)
    links, start, rows = stream_of(name, rng)
    want, got = start, start
    for row in rows:
        want = links.add(want, *row, twist=twist)
    late = list(rows)
    # Neighbours change places, and one comes four places late, all within the window.
    late[1], late[2] = late[2], late[1]
    late[6:10] = [*late[7:10], late[6]]
    assert late[9][0] > late[8][0] - links.window_s
    for row in late:
        got = links.add(got, *row, twist=twist)
    assert got.dropped == 0
    assert got.time == want.time == rows[-1][0]
    same(links.belief(got), links.belief(want))
    same(links.belief(got, got.time + 0.3, twist), links.belief(want, got.time + 0.3, twist))


def test_one_that_is_too_late_is_left_out_and_counted():
    rng = np.random.default_rng(2)
    links, stream, rows = stream_of("iekf", rng)
    first, *others = rows
    for row in others:
        stream = links.add(stream, *row)
    assert stream.time - first[0] > links.window_s
    after = links.add(stream, *first)
    assert (after.dropped, after.checkpoints) == (1, stream.checkpoints)
    assert links.add(after, -1.0, *first[1:]).dropped == 2
    # The memory is that of the window: nothing but its last state is kept of what lies before.
    ages = [stream.time - point.time for point in stream.checkpoints]
    assert ages[0] > links.window_s >= ages[1]
    edge = (stream.time - links.window_s, *first[1:])
    assert links.add(stream, *edge).dropped == 0


def test_ranges_of_one_moment_are_an_epoch():
    """One by one or all at once: the same, but for where each was linearised."""
    rng = np.random.default_rng(3)
    anchors, tags, rotation, translation = random_world(rng, 6, 4)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS)
    prior = filter.initial(rotation, translation, np.diag([1e-4] * 3 + [1e-3] * 3))
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    links = Asynchronous(filter, anchors, 4)
    stream = links.start(prior, 7.0)
    for m, n in np.ndindex(6, 4):
        stream = links.add(stream, 7.0, m, n, ranges[m, n])
    got, want = links.belief(stream), filter.belief(filter.update(prior, ranges, anchors))
    error = metrics.pose_error(got.rotation, got.translation, want.rotation, want.translation)
    assert metrics.nees(error, want.covariance) < 1e-3
    scale = np.sqrt(np.diag(want.covariance))
    np.testing.assert_allclose(
        got.covariance / scale / scale[:, None], want.covariance / scale / scale[:, None], atol=0.02
    )


def test_their_own_times_are_worth_more_than_one_stamp_for_all():
    """A body at 2 m/s, 24 links in a round of 0.12 s: one stamp a round is off by centimetres."""
    rng = np.random.default_rng(4)
    tags = bodies.octahedron(0.8)[:4]
    anchors = random_world(rng, 6, 4)[0]
    trials, rounds, slot = 40, 8, 0.005
    velocity = 2.0 * rotations.random(rng, (trials,))[:, 0]
    twist = np.concatenate([np.zeros((trials, 3)), velocity], axis=-1)
    filter = estimators.make(
        "iekf-cv", tags=tags, noise=NOISE, process=motion.ProcessNoise(0.01, 0.0),
        speed_m_s=2.0, turn_rate_rad_s=0.01, turn_acceleration=0.01, acceleration=0.1, iterations=2,
    )  # fmt: skip
    P = np.diag([1e-4] * 3 + [1e-2] * 3)
    offset = np.sqrt(np.diag(P)) * rng.standard_normal((trials, 6))
    prior = filter.initial(rotations.exp(offset[:, :3]), offset[:, 3:], P)
    links = Asynchronous(filter, anchors, 4, window_s=0.0)
    stream = links.start(prior, 0.0)
    stamped, before = prior, 0.0
    for k in range(rounds):
        ranges = np.empty((trials, 6, 4))
        for slot_number, (m, n) in enumerate(itertools.product(range(6), range(4))):
            time = (24 * k + slot_number + 1) * slot
            at = np.broadcast_to(np.eye(3), (trials, 3, 3)), time * twist[:, 3:]
            ranges[:, m, n] = simulate(rng, anchors, tags, *at, NOISE)[:, m, n]
            stream = links.add(stream, time, m, n, ranges[:, m, n], None)
        # What it is told of the twist is ignored.
        moved = filter.predict(stamped, np.zeros(6), time - before)
        stamped = filter.update(moved, ranges, anchors)
        before = time
    error = {}
    for name, belief in (("own", links.belief(stream)), ("one", filter.belief(stamped))):
        error[name] = np.sqrt(((belief.translation - time * velocity) ** 2).sum(-1).mean())
    assert error["own"] < 0.02
    assert error["one"] > 4 * error["own"]
    nees = metrics.nees(
        metrics.pose_error(*links.belief(stream)[:2], np.eye(3), time * velocity),
        links.belief(stream).covariance,
    ).mean()
    # The truth keeps its twist, and the filter allows for more: honest, if anything careful.
    assert 2.5 < nees < 7


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"anchor": 5}, "anchor must be an int from 0 to 4, got 5"),
        ({"tag": -1}, "tag must be an int from 0 to 3, got -1"),
        ({"tag": 1.5}, "tag must be an int from 0 to 3, got 1.5"),
        ({"anchor": True}, "anchor must be an int"),
        ({"range": 0.0}, "range must be positive, got 0"),
        ({"range": np.nan}, "range must be finite"),
        ({"range": "far"}, "range must be an array of real numbers, got 'far'"),
        ({"time": np.inf}, "time must be a finite number"),
        ({"twist": np.zeros(5)}, "twist must have shape"),
    ],
)
def test_a_range_that_cannot_be_is_refused(change, message):
    told: dict[str, Any] = {"time": 1.0, "anchor": 0, "tag": 0, "range": 1.0, **change}
    links, stream, _ = stream_of("iekf", np.random.default_rng(5))
    with pytest.raises(ValueError, match=message):
        links.add(stream, **told)


def test_a_stream_that_cannot_be_is_refused():
    links, stream, rows = stream_of("iekf", np.random.default_rng(6))
    stream = links.add(stream, *rows[0])
    with pytest.raises(ValueError, match=r"time must be at least .* the time of the newest range"):
        links.state(stream, rows[0][0] - 0.001)
    with pytest.raises(ValueError, match=r"anchors must be \(M, 3\)"):
        Asynchronous(links.filter, np.zeros((2, 4, 3)), 4)
    with pytest.raises(ValueError, match="window_s must be a finite number"):
        Asynchronous(links.filter, links.anchors, 4, window_s=-1)
    with pytest.raises(ValueError, match="n_tags must be"):
        Asynchronous(links.filter, links.anchors, 0)
    with pytest.raises(ValueError, match="n_tags must be a positive int, got '4'"):
        Asynchronous(links.filter, links.anchors, "4")  # pyrefly: ignore[bad-argument-type]


@pytest.mark.parametrize("name", ["kf", "uc-kf", "et-kf", "kf-ortho"])
def test_filters_to_which_one_range_tells_nothing_are_refused(name):
    with pytest.raises(ValueError, match="filter must use single ranges, got KalmanFamily"):
        stream_of(name, np.random.default_rng(0))


@pytest.mark.parametrize(("name", "options"), [("iekf-imu", {}), ("iekf-log", {"odometry": {}})])
def test_filters_of_sensor_readings_are_refused(name, options):
    with pytest.raises(ValueError, match="filter must predict from a twist, got"):
        stream_of(name, np.random.default_rng(0), **options)


def test_anchors_that_move_and_a_deviation_for_every_range():
    """As an epoch of one link with its anchors and its law; late ones find their own anchors."""
    rng = np.random.default_rng(5)
    links, stream, rows = stream_of("iekf", rng)
    places = [links.anchors + 0.3 * k * rng.standard_normal((5, 3)) for k in range(len(rows))]
    state, time = stream.checkpoints[-1].state, 0.0
    for (t, m, n, value), anchors in zip(rows, places, strict=True):
        state = links.filter.predict(state, np.zeros(6), t - time)
        mask = np.zeros((5, 4), dtype=bool)
        mask[m, n] = True
        law = ranging.LinkNoise(np.array([[0.05 + 0.01 * n]]))
        state, time = links.filter.update(state, value * mask, anchors, mask, noise=law), t
    order = [*range(8), 9, 8, 10, 11]
    for k in order:
        t, m, n, value = rows[k]
        stream = links.add(stream, t, m, n, value, std_m=0.05 + 0.01 * n, anchors=places[k])
    same(links.belief(stream), links.filter.belief(state))
    with pytest.raises(ValueError, match="std_m and noise must not both"):
        links.add(stream, time, 0, 0, 1.0, noise=NOISE, std_m=0.1)
    with pytest.raises(ValueError, match=r"anchors must have shape \(5, 3\), the number"):
        links.add(stream, time, 0, 0, 1.0, anchors=np.zeros((4, 3)))
