"""Functions return the NamedTuples that their documentation names."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import estimators, motion
from rbl_gym.geometry import bodies
from rbl_gym.measurements import bearing, ranging
from rbl_gym.motion import unknown_twist
from rbl_gym.networks import g2o, graphs, rigidity, sensing
from rbl_gym.worlds import scenes, simulation

SQUARE = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
EDGES = np.array([[0, 1], [1, 2], [2, 3], [0, 3], [0, 2]])
TAGS = bodies.pyramid()
PROCESS = motion.ProcessNoise(0.1, 0.1)


def graph_file(folder):
    path = folder / "two.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.5\nEDGE_SE2 0 1 1 0 0.5 1 0 0 1 0 1\n")
    return path


def wandering():
    law, process = unknown_twist.WanderingTwist(), motion.ProcessNoise()
    return unknown_twist.simulate_wandering(
        np.eye(3), np.zeros(3), law, process, 0.1, 3, np.random.default_rng(0)
    )


def first_state():
    filter: estimators.Filter = estimators.make(
        "iekf-bank", tags=TAGS, noise=ranging.RangeNoise(0.1), process=PROCESS
    )
    return filter.initial(np.eye(3), np.zeros(3), np.eye(6))


def stream():
    filter = estimators.make("iekf", tags=TAGS, noise=ranging.RangeNoise(0.1), process=PROCESS)
    links = estimators.Asynchronous(filter, np.eye(3), len(TAGS))
    return links.start(filter.initial(np.eye(3), np.zeros(3), np.eye(6)), time=0.0)


CASES = {
    "stream": (lambda _: stream(), estimators.Stream),
    "bank": (lambda _: first_state(), estimators.BankState),
    "g2o": (lambda folder: g2o.read_graph(graph_file(folder)), g2o.PoseGraph),
    "tree": (lambda _: graphs.spanning_tree(EDGES, 4), graphs.SpanningTree),
    "freedom": (lambda _: rigidity.freedom(np.eye(4)[:, :3], EDGES), rigidity.Freedom),
    "localizability": (lambda _: rigidity.localizability(SQUARE, EDGES), rigidity.Localizability),
    "triangle": (
        lambda _: estimators.triangle_frames(sensing.measure_in_space(
            np.eye(3), np.tile(np.eye(3), (3, 1, 1)), [[0, 1], [1, 2], [2, 0]], 0.0,
            np.random.default_rng(0),
        )),
        estimators.TriangleFrames,
    ),
    "locate": (
        lambda _: estimators.locate(
            np.full((4, 5), 3.0), np.diag([3.0, 4, 5, 6])[:, :3], bodies.pyramid(),
            ranging.RangeNoise(0.1),
        ),
        estimators.PoseEstimate,
    ),
    "frames": (
        lambda _: estimators.frames([[0, 1]], [[0.5, -2.0]], 2, (0, 1), 3.0),
        estimators.FrameEstimate,
    ),
    "network": (
        lambda _: sensing.random_network(12, 6, 0.1, np.random.default_rng(0)),
        sensing.SensingNetwork,
    ),
    "path": (lambda _: wandering(), unknown_twist.WanderingPath),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_results_have_their_types(name, tmp_path):
    make, expected = CASES[name]
    result = make(tmp_path)
    assert type(result) is expected
    for field in result._fields:
        assert getattr(result, field) is not None


def test_the_quality_of_links_is_one_in_sight_and_a_fraction_behind_a_rack():
    scene = scenes.get("hall")
    episode = simulation.draw_episode(scene, np.random.default_rng(1))
    at = simulation.epoch_of(episode, 0)
    quality = simulation.link_quality(scene, at, np.array(scene.anchors))
    assert quality.shape == (scene.n_anchors,)
    assert set(quality) == {scene.blocked_information, 1.0}


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("kf", {}, estimators.KalmanFamily),
        ("iekf", {}, estimators.IteratedEkf),
        ("iekf", {"measurement": "doa"}, estimators.DoaEkf),
        ("iekf-bank", {}, estimators.IteratedEkfBank),
        ("iekf-cv", {}, estimators.AugmentedEkf),
    ],
)
def test_filters_have_their_types(name, options, expected):
    noise = bearing.AngleNoise() if options else ranging.RangeNoise(0.1)
    filter: estimators.Filter = estimators.make(
        name, tags=TAGS, noise=noise, process=PROCESS, **options
    )
    assert type(filter) is expected
