"""Units of a recording: impossible units raise ValueError, possible ones are read."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import motion
from rbl_gym.measurements import ranging
from rbl_gym.recordings.units import check_units

PATHS = "ranges.csv", "anchors.csv", "tags.csv"
ROOM = np.array([[0, 0, 0.3], [8, 0, 2.7], [8, 6, 0.3], [0, 6, 2.7], [4, 0, 2], [8, 3, 0.5]])
CEILING = ROOM * [1, 1, 0] + [0, 0, 3.0]
SOLID = np.array([[0.3, 0.2, 0], [-0.3, 0.2, 0], [-0.3, -0.2, 0.05], [0.3, -0.2, 0.25]])
FLAT = SOLID * [1, 1, 0]
ROD = np.array([[0.3, 0, 0], [-0.3, 0, 0.0]])
UTM = np.array([448_262.0, 5_411_932.0, 310.0])


def recording(anchors, tags, noise_m=0.05, seed=0, one_at_a_time=False):
    """Times, ranges and links of a body that turns and flies through a room at 0.4 m/s."""
    rng = np.random.default_rng(seed)
    path = motion.simulate(
        motion.constant_twist(np.eye(3), [2, 2, 1.2], [0.05, 0, 0.3, 0.4, 0.1, 0], 40),
        0.1,
        motion.ProcessNoise(),
    )
    points = ranging.tag_positions(path.rotation, path.translation + anchors[0] - ROOM[0], tags)
    exact = ranging.distances(anchors, points)
    ranges = exact + noise_m * rng.standard_normal(exact.shape)
    times = 0.1 * np.arange(len(ranges))
    links = np.ones(ranges.shape, bool)
    if one_at_a_time:
        count = ranges[0].size
        links = np.tile(np.eye(count, dtype=bool).reshape(count, *ranges[0].shape), (41, 1, 1, 1))
        links = links.reshape(-1, *ranges[0].shape)
        ranges = np.repeat(ranges, count, axis=0)
        times = 0.1 / count * np.arange(len(ranges))
    return times, ranges * links, links


GOOD = {
    "room": (ROOM, SOLID), "ceiling": (CEILING, FLAT), "ceiling, rod": (CEILING, ROD),
    "one anchor": (ROOM[:1], SOLID), "one tag": (ROOM, SOLID[:1]), "map": (ROOM + UTM, SOLID),
    "an array of antennas": (0.3 * ROOM, SOLID), "a small body": (ROOM, 0.02 * SOLID),
    "tags at one place": (ROOM, 0 * SOLID),
}  # fmt: skip


@pytest.mark.parametrize("one_at_a_time", [False, True])
@pytest.mark.parametrize("name", GOOD)
def test_metres_pass(name, one_at_a_time):
    anchors, tags = GOOD[name]
    check_units(PATHS, *recording(anchors, tags, 0.1, 1, one_at_a_time), anchors, tags)


@pytest.mark.parametrize("one_at_a_time", [False, True])
@pytest.mark.parametrize("factor", [100, 1000])
@pytest.mark.parametrize("name", ["room", "ceiling", "map"])
def test_tags_in_another_unit_are_refused(name, factor, one_at_a_time):
    anchors, tags = GOOD[name]
    unit = {100: "cm", 1000: "mm"}[factor]
    seen = recording(anchors, tags, 0.05, 2, one_at_a_time)
    with pytest.raises(ValueError, match=rf"tags.csv: units look inconsistent, .*{unit}\?"):
        check_units(PATHS, *seen, anchors, factor * tags)


def test_a_small_body_far_away_in_centimetres_is_refused():
    """Two ranges add up to more than 30 m: only their differences tell."""
    anchors = 20 * ROOM
    seen = recording(anchors, 0.5 * SOLID)
    check_units(PATHS, *seen, anchors, 0.5 * SOLID)
    with pytest.raises(ValueError, match=r"tags.csv: .* differ by at most \S+ % .* in cm\?"):
        check_units(PATHS, *seen, anchors, 50 * SOLID)


def test_a_rod_whose_anchors_are_all_broadside_is_no_fault():
    """Tags above each other, anchors at their middle height: all differences are noise."""
    anchors, pole = ROOM * [1, 1, 0] + [0, 0, 1.2], np.array([[0, 0, 1.0], [0, 0, -1.0]])
    times, ranges, links = recording(ROOM, ROD)
    exact = np.linalg.norm(anchors[:, None] - (np.array([3, 2, 1.2]) + pole), axis=-1)
    check_units(PATHS, times, np.broadcast_to(exact, ranges.shape), links, anchors, pole)


@pytest.mark.parametrize(
    ("ranges_in", "anchors_in", "tags_in", "file"),
    [(100, 1, 1, "ranges"), (1, 100, 1, "ranges"), (1, 10, 1, "anchors"), (100, 100, 1, "tags")],
)
def test_one_table_in_another_unit_is_refused(ranges_in, anchors_in, tags_in, file):
    """Ranges or anchors in centimetres, anchors in decimetres, all but the tags in centimetres."""
    times, ranges, links = recording(ROOM, SOLID)
    with pytest.raises(ValueError, match=rf"{file}.csv: units look inconsistent"):
        check_units(PATHS, times, ranges_in * ranges, links, anchors_in * ROOM, tags_in * SOLID)


def test_ranges_in_too_small_a_unit_are_named_beside_the_anchors():
    times, ranges, links = recording(ROOM, SOLID)
    with pytest.raises(ValueError, match=r"Or is the unit of the ranges in .*ranges.csv wrong"):
        check_units(PATHS, times, 0.1 * ranges, links, ROOM, SOLID)
