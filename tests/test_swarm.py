"""Particle swarm and participatory search over the distances."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bearing, bodies, estimators, ranging
from rbl_gym.estimators.swarm import ParticipatorySearch, ParticleSwarm, search_places

TAGS = bodies.doa2019()
T = np.array([5.0, 5.0, 3.0])
SEARCHES = [ParticleSwarm(), ParticipatorySearch()]


def angles_of(count, sigma_deg=0.01):
    noise = bearing.AngleNoise(np.deg2rad(sigma_deg))
    rotation = np.tile(np.eye(3), (count, 1, 1))
    return bearing.simulate(TAGS, rotation, T, noise, np.random.default_rng(1))


@pytest.mark.parametrize("search", SEARCHES)
def test_places_lie_along_the_directions(search):
    angles = angles_of(5)
    places = search_places(search, angles, np.tile(TAGS, (5, 1, 1)), np.random.default_rng(2))
    np.testing.assert_allclose(bearing.angles(places.positions), angles, atol=1e-9)
    assert (places.positions[..., 1] >= 0).all()


def test_the_swarm_often_finds_the_body_and_never_worse_with_a_larger_one():
    angles, tags = angles_of(100), np.tile(TAGS, (100, 1, 1))
    rate = {}
    for size in (10, 80):
        swarm = ParticleSwarm(size=size)
        places = search_places(swarm, angles, tags, np.random.default_rng(3)).positions
        error = np.abs(places - ranging.tag_positions(np.eye(3), T, TAGS)).max(axis=(-2, -1))
        rate[size] = (error < 0.5).mean()
    assert rate[80] > 0.5
    assert rate[10] < rate[80]


@pytest.mark.parametrize("search", SEARCHES)
def test_no_unit_of_length_matters(search):
    angles, tags = angles_of(10), np.tile(TAGS, (10, 1, 1))
    metres = search_places(search, angles, tags, np.random.default_rng(4)).positions
    kilometres = search_places(search, angles, 1e-3 * tags, np.random.default_rng(4)).positions
    np.testing.assert_allclose(1e3 * kilometres, metres, rtol=1e-6)


@pytest.mark.parametrize("method", ["pso", "psa"])
def test_the_same_generator_gives_the_same_pose(method):
    angles = angles_of(3)
    one, two, other = (
        estimators.locate_doa(
            angles, TAGS, method, half_space="y>0", rng=np.random.default_rng(seed)
        )
        for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(one.translation, two.translation)
    assert not np.array_equal(one.translation, other.translation)
    default = estimators.locate_doa(angles, TAGS, method, half_space="y>0")
    again = estimators.locate_doa(angles, TAGS, method, half_space="y>0")
    np.testing.assert_array_equal(default.translation, again.translation)
