"""Errors of functions that no other test covers, each by its message."""

# Most arguments here are wrong on purpose.
# pyrefly: ignore-errors[bad-argument-type]
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rbl_gym import bounds, estimators, motion
from rbl_gym.app import terminal
from rbl_gym.bounds import links as link_bounds
from rbl_gym.checks import as_tuples
from rbl_gym.geometry import bodies
from rbl_gym.geometry.regions import Box
from rbl_gym.measurements import ranging
from rbl_gym.networks import rigidity
from rbl_gym.placement import design, scene_files
from rbl_gym.recordings import Truth
from rbl_gym.studies import replay
from rbl_gym.studies.bench import spec_files, worlds
from rbl_gym.worlds import scenes
from tests import recorded

TAGS = bodies.pyramid()
ANCHORS = np.array([[0, 0, 0], [9, 0, 1], [0, 9, 2], [9, 9, 3.0]])
PLACE = TAGS, np.eye(3), np.array([3.0, 4.0, 1.0])


def test_filters_need_a_name_and_a_factory():
    for name in ("", 7):
        with pytest.raises(ValueError, match="name must be a string, not empty"):
            estimators.register(name, dict)
    with pytest.raises(ValueError, match="factory must be callable, got None"):
        estimators.register("mine", None)


def test_links_and_ranges_of_other_batches():
    filter = estimators.make(
        "iekf", tags=TAGS, noise=ranging.RangeNoise(0.1), process=motion.ProcessNoise(0.1, 0.1)
    )
    state = filter.initial(np.eye(3), PLACE[2], 0.1 * np.eye(6))
    ranges = np.ones((2, 4, 5))
    with pytest.raises(ValueError, match=r"links and ranges must broadcast, got \(3, 4, 5\) and"):
        filter.update(state, ranges, ANCHORS, np.ones((3, 4, 5), dtype=bool))


@pytest.mark.parametrize("name", estimators.names())
def test_batches_that_do_not_fit(name):
    filter = estimators.make(
        name, tags=TAGS, noise=ranging.RangeNoise(0.1), process=motion.ProcessNoise(0.1, 0.1)
    )
    many = np.tile(np.eye(3), (3, 1, 1))
    state = filter.initial(many, PLACE[2], 0.1 * np.eye(6))
    ranges = ranging.distances(ANCHORS, ranging.tag_positions(*PLACE[1:], TAGS))
    with pytest.raises(
        ValueError, match=r"of state and ranges must broadcast, got \(3,\) and \(2,"
    ):
        filter.update(state, np.tile(ranges, (2, 1, 1)), ANCHORS)
    with pytest.raises(ValueError, match=r"ranges and anchors must broadcast, got \(3,\) and \(2,"):
        filter.update(state, np.tile(ranges, (3, 1, 1)), np.tile(ANCHORS, (2, 1, 1)))


def test_a_bank_is_of_one_body():
    laws = {"noise": ranging.RangeNoise(0.1), "process": motion.ProcessNoise(0.1, 0.1)}
    with pytest.raises(ValueError, match=r"tags must have shape \(N, 3\), got \(2, 5, 3\)"):
        estimators.make("iekf-bank", tags=np.tile(TAGS, (2, 1, 1)), **laws)


@pytest.mark.parametrize("spread", [0.1, 100.0])
@pytest.mark.parametrize("name", [n for n in estimators.names() if n != "iekf-bank"])
def test_bodies_with_tags_of_their_own(name, spread):
    anchors = np.vstack([ANCHORS, [4.0, 4.0, 6.0]])
    tags = np.array([1.0, 1.5, 2.0])[:, None, None] * TAGS
    ranges = ranging.distances(anchors, ranging.tag_positions(*PLACE[1:], tags)) + 0.05
    found = []
    for which in (slice(None), 0, 1, 2):
        filter = estimators.make(
            name,
            tags=tags[which],
            noise=ranging.RangeNoise(0.1),
            process=motion.ProcessNoise(0.1, 0.1),
        )
        batch = ranges[which].shape[:-2]
        state = filter.initial(
            np.broadcast_to(np.eye(3), (*batch, 3, 3)), PLACE[2] + 0.1, spread * np.eye(6)
        )
        found.append(filter.belief(filter.update(state, ranges[which], anchors)))
    for field in range(3):
        np.testing.assert_allclose(
            found[0][field], [each[field] for each in found[1:]], rtol=1e-6, atol=1e-6
        )


def test_a_filter_takes_tags_as_a_list():
    laws = ranging.RangeNoise(0.1), motion.ProcessNoise(0.1, 0.1)
    for kind in (estimators.IteratedEkf, estimators.KalmanFamily):
        assert isinstance(kind(TAGS.tolist(), *laws).tags, np.ndarray)


BOUNDS = {
    "raw": bounds.range_information,
    "uncertain tags": lambda *a: bounds.range_information(*a, tag_std_m=0.01),
    "squared": lambda *a: bounds.range_information(*a, model="squared"),
    "lost links": lambda *a: link_bounds.expected_information(*a, link_model=ranging.LinkModel()),
}


@pytest.mark.parametrize("noise", [ranging.RangeNoise(0.1), ranging.SquaredRangeNoise(0.1)])
@pytest.mark.parametrize("name", BOUNDS)
def test_an_anchor_on_a_tag(name, noise):
    # Coordinates without rounding, so that the distance is exactly zero.
    tags = bodies.octahedron(0.5)
    body = tags, np.eye(3), -tags[1]
    on_tag = np.vstack([ANCHORS + 0.1, np.zeros(3)])
    links = np.ones((5, 6), dtype=bool)
    links[4, 1] = False
    # A range without a gradient tells nothing: what is left is what the others tell.
    told = BOUNDS[name](on_tag, *body, noise)
    assert np.isfinite(told).all()
    if name != "lost links":
        without = {"uncertain tags": {"tag_std_m": 0.01}, "squared": {"model": "squared"}}
        expected = bounds.range_information(on_tag, *body, noise, links, **without.get(name, {}))
        np.testing.assert_allclose(told, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", BOUNDS)
def test_laws_without_a_variance(name):
    with pytest.raises(
        ValueError, match="noise must have a positive variance at every distance, got 0 at"
    ):
        BOUNDS[name](ANCHORS, *PLACE, ranging.LinkNoise(np.full((4, 5), 1e-200)))


def test_lost_links_out_of_reach_are_drawn_as_lost():
    noise, rng = ranging.RangeNoise(0.1), np.random.default_rng(0)
    near = link_bounds.realised_crb(
        ANCHORS, *PLACE, noise, ranging.LinkModel(reach_m=8.0), rng, draws=2
    )
    distance = ranging.distances(ANCHORS, ranging.tag_positions(*PLACE[1:], TAGS))
    assert (distance > 8).any()
    expected = bounds.pose_crb(ANCHORS, *PLACE, noise, links=distance <= 8)
    np.testing.assert_allclose(near, expected, rtol=1e-10)


def test_ranges_are_simulated_by_generators_and_link_models():
    noise = ranging.RangeNoise(0.1)
    with pytest.raises(ValueError, match=r"rng must be a numpy\.random\.Generator, .* got 7"):
        ranging.simulate(ANCHORS, *PLACE, noise, 7)
    with pytest.raises(ValueError, match=r"link_model must be a LinkModel or None, got 0\.5"):
        ranging.simulate(ANCHORS, *PLACE, noise, np.random.default_rng(0), 0.5)


def test_noise_of_every_link_keeps_ranges_positive():
    law = ranging.LinkNoise(np.array([[0.1, 5.0]]))
    drawn = law.sample(np.array([[1.0, 1.0]]), np.array([[1.0, -1.0]]))
    np.testing.assert_allclose(drawn, [[1.1, 0.0]])


def test_noise_of_every_link_takes_a_list():
    law = ranging.LinkNoise([[0.1, 0.2]])
    np.testing.assert_allclose(law.variance(np.ones((3, 1, 2))), [[[0.01, 0.04]]] * 3)


def test_directions_of_length_zero():
    with pytest.raises(ValueError, match="u_ij must be one nonzero vector"):
        rigidity.feasible_rotations(np.zeros(3), np.eye(3)[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_volume": [1, 2, 3]}, "start_volume must be a Box or None"),
        (
            {"start_volume": {"low": [0, 0, 0]}},
            "scene.start_volume must have the field 'high'",
        ),
        ({"start_volume": {"kind": "shell"}}, "scene.start_volume.kind must be one of 'box'"),
        ({"start_rotation": {"yaw": 1}}, "scene.start_rotation must be one value, got the dict"),
        ({"dt": {"kind": "box"}}, "scene.dt must be one value, got the dict"),
        (
            {"trajectory": "orbit", "volume": {"kind": "box", "low": [1, 1, 1], "high": [1, 3, 3]}},
            "volume must have low below high in x and y for trajectory 'orbit'",
        ),
    ],
)
def test_scenes(changes, message):
    with pytest.raises(ValueError, match=message):
        scenes.get({"name": "uwb_room", **changes})


def test_a_start_volume_is_a_dict_of_two_corners():
    corners = {"low": [0, 0, 1], "high": [1, 1, 2]}
    found = [
        scenes.get({"name": "uwb_room", "start_volume": {**kind, **corners}}).start_volume
        for kind in ({}, {"kind": "box"})
    ]
    assert found == [Box((0, 0, 1), (1, 1, 2))] * 2


def test_replays():
    with pytest.raises(ValueError, match="height_offset_m needs planar"):
        replay.Settings.of(height_offset_m=0.1)
    times = np.arange(3.0)
    truth = Truth(times + 100, np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)))
    recording = recorded.recording(times, np.full((3, 4, 5), 5.0), ANCHORS, TAGS, truth)
    track = replay.Track(times, truth.rotation, truth.translation, np.tile(np.eye(6), (3, 1, 1)))
    with pytest.raises(
        ValueError, match="truth does not overlap with the ranges in time: ranges 0 to 2 s"
    ):
        replay.truth_of(recording, track, replay.Settings())


def test_benchmarks():
    with pytest.raises(ValueError, match="condition 'noise-x2' cannot double"):
        worlds._noisier(ranging.LinkModel(), 2.0)
    with pytest.raises(
        Exception, match="must be different names separated by commas, got 'kf,,iekf'"
    ):
        terminal.names("kf,,iekf")
    with pytest.raises(ValueError, match="--scenes: two are named 'hall': rename a file"):
        spec_files.scene_specs(["hall", "hall"])


def test_rooms_full_of_obstacles():
    low, high = np.array(scenes.get("uwb_room").anchor_region.bounds())
    full = np.concatenate([0.5 * (low + high), (high - low)])
    problem = scene_files.problem("uwb_room")
    scene = dataclasses.replace(problem.scene, obstacles=as_tuples(full[None]))
    problem = dataclasses.replace(problem, scene=scene)
    with pytest.raises(ValueError, match="6 anchors cannot be mounted: obstacles leave 0"):
        design.free_candidates(problem, np.random.default_rng(0), 10)
