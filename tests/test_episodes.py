"""The store of running episodes: a step reads the values drawn by the generator of each world."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.envs.episodes import EpisodeStore
from rbl_gym.worlds import scenes, simulation

LOSSY = {"drop_probability": 0.2, "nlos_probability": 0.1}


def generators(seeds):
    return [np.random.default_rng(seed) for seed in seeds]


@pytest.mark.parametrize("name", ["uwb_room", "auv_buoys", "camsap2013"])
@pytest.mark.parametrize("links", [{}, LOSSY], ids=["all links", "lossy"])
def test_every_world_is_at_its_epoch_of_its_own_episode(name, links):
    scene = scenes.get({"name": name, "steps": 4, "links": links})
    store = EpisodeStore(scene, 5)
    start = store.begin(np.arange(5), generators(range(5)))
    again = store.begin(np.array([1, 3]), generators([11, 13]))
    seeds = [0, 11, 2, 13, 4]
    singles = [simulation.draw_episode(scene, rng) for rng in generators(seeds)]
    for key, value in again.items():
        for row, world in enumerate((1, 3)):
            np.testing.assert_allclose(value[row], getattr(singles[world], key), atol=1e-12)
        assert start[key].shape == (5, *value.shape[1:])
    for epochs in (np.full(5, 2), np.array([0, 4, 1, 2, 3])):
        at = store.at(epochs)
        for world, single in enumerate(singles):
            want = simulation.epoch_of(single, int(epochs[world]))
            for got, expected in zip(at, want, strict=True):
                if expected is None:
                    assert got is None
                else:
                    assert got is not None
                    np.testing.assert_allclose(got[world], expected, rtol=1e-12, atol=1e-12)


def test_more_worlds_than_are_built_together_are_all_begun():
    scene = scenes.get({"name": "uwb_room", "steps": 2})
    store = EpisodeStore(scene, 1100)
    assert store.empty
    anchors = store.begin(np.arange(1100), generators(range(1100)))["anchors"]
    assert anchors.shape == (1100, 6, 3)
    last = simulation.draw_episode(scene, np.random.default_rng(1099))
    at = store.at(np.full(1100, 2))
    np.testing.assert_allclose(at.translation[1099], last.translation[2], rtol=1e-12)
