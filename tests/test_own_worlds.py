"""Bodies, noise, process and dt with leading axes: a world of its own for each trial."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, motion
from rbl_gym.measurements.ranging import LinkNoise, RangeNoise
from rbl_gym.worlds import scenes
from tests.helpers import random_world, twist_filters

B, M, N = 5, 4, 5


def worlds() -> dict[str, Any]:
    """Everything that each of five trials has of its own."""
    rng = np.random.default_rng(3)
    anchors, _, rotation, translation = random_world(rng, M, N, (B,))
    tags = rng.uniform(-0.5, 0.5, (B, N, 3))
    positions = tags @ np.swapaxes(rotation, -1, -2) + translation[:, None]
    distances = np.linalg.norm(positions[:, None] - anchors[:, :, None], axis=-1)
    root = 0.1 * rng.standard_normal((B, 6, 6))
    return {
        "tags": tags,
        "noise": rng.uniform(0.01, 0.2, (B, M, N)),
        "rotation_rad": rng.uniform(0.01, 0.3, (B, 3)),
        "translation_m": rng.uniform(0.01, 2, (B, 3)),
        "dt": rng.uniform(0.1, 2, B),
        "twist": rng.uniform(-0.3, 0.3, (B, 6)),
        "prior": (rotation, translation, root @ np.swapaxes(root, -1, -2) + 0.01 * np.eye(6)),
        "ranges": distances + 0.01 * rng.standard_normal(distances.shape),
        "anchors": anchors,
    }


def step(world: dict[str, Any], robust: bool, **options: Any) -> Any:
    """Predict and update."""
    process = motion.ProcessNoise(world["rotation_rad"], world["translation_m"])
    filter: Any = estimators.make(
        "iekf", tags=world["tags"], noise=LinkNoise(world["noise"]), process=process,
        robust=robust, **options,
    )  # fmt: skip
    state = filter.initial(*world["prior"])
    state = filter.predict(state, world["twist"], world["dt"])
    return state, filter.update(state, world["ranges"], world["anchors"])


def alone(world: dict[str, Any], i: int) -> dict[str, Any]:
    fields = {key: value[i] for key, value in world.items() if key != "prior"}
    return {**fields, "prior": tuple(field[i] for field in world["prior"])}


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("shared", [(), ("dt",), ("rotation_rad", "tags"), ("twist", "noise")])
def test_each_trial_has_a_world_of_its_own(shared, robust):
    world = worlds()
    for key in shared:
        world[key] = np.broadcast_to(world[key][0], world[key].shape)
    together = step({key: v[0] if key in shared else v for key, v in world.items()}, robust)
    for i in range(B):
        for got, want in zip(together, step(alone(world, i), robust), strict=True):
            for mine, plain in zip(got, want, strict=True):
                np.testing.assert_allclose(mine[i], plain, rtol=1e-9, atol=1e-11)


def test_one_state_goes_on_by_many_steps():
    world = alone(worlds(), 0)
    filter: Any = estimators.make(
        "iekf", tags=world["tags"], noise=RangeNoise(0.1), process=motion.ProcessNoise(0.1, 0.1)
    )
    state, times = filter.initial(*world["prior"]), np.array([[0.5], [1.0]])
    many = filter.predict(state, world["twist"], times)
    assert many.translation.shape == (2, 1, 3)
    for i, time in enumerate(times.ravel()):
        for mine, plain in zip(many, filter.predict(state, world["twist"], time), strict=True):
            np.testing.assert_allclose(mine[i, 0], plain, rtol=1e-12, atol=1e-14)


def test_the_noise_of_many_motions():
    process = motion.ProcessNoise(np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]), 0.7)  # pyrefly: ignore[bad-argument-type]
    np.testing.assert_array_equal(
        process.std(), [[0.1, 0.2, 0.3, 0.7, 0.7, 0.7], [0.4, 0.5, 0.6, 0.7, 0.7, 0.7]]
    )
    assert process == dataclasses.replace(process)
    assert hash(process) == hash(dataclasses.replace(process))
    twist = np.array([0.1, -0.4, 0.2, 1, 2, 3])
    together = process.covariance(twist, np.array([0.5, 2.0]))
    for i, dt in enumerate((0.5, 2.0)):
        one = motion.ProcessNoise(process.rotation_rad[i], 0.7)  # pyrefly: ignore[bad-index]
        np.testing.assert_allclose(together[i], one.covariance(twist, dt), rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": np.ones(3)}, "leading axes of .* must broadcast"),
        ({"dt": [1.0, 1, 1, 1, -1]}, "dt must not be negative, got -1"),
        ({"dt": [1.0, 1, 1, 1, np.nan]}, "dt"),
        ({"dt": "long"}, "dt must be a number"),
        ({"rotation_rad": np.ones((3, 3))}, "rotation_rad and translation_m must broadcast"),
        (
            {"rotation_rad": np.ones((3, 3)), "translation_m": 1.0},
            "leading axes of .* must broadcast",
        ),
        ({"rotation_rad": np.ones((5, 2))}, "rotation_rad must be one number or three"),
        ({"rotation_rad": -np.ones((5, 3))}, "rotation_rad must not be negative"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        step({**worlds(), **change}, False)


@pytest.mark.parametrize("name", [name for name in twist_filters() if name != "iekf"])
def test_the_other_filters_and_scenes_refuse_a_process_of_each_trial(name):
    world = worlds()
    process = motion.ProcessNoise(world["rotation_rad"], 0.1)
    with pytest.raises(ValueError, match="process must be the same for all trials"):
        estimators.make(name, tags=world["tags"][0], noise=RangeNoise(0.1), process=process)
    with pytest.raises(ValueError, match="process must be the same for all worlds"):
        dataclasses.replace(scenes.get("hall"), process=process)
    filter: Any = estimators.make(
        name, tags=world["tags"][0], noise=RangeNoise(0.1), process=motion.ProcessNoise(0.1, 0.1)
    )
    with pytest.raises(ValueError, match="dt must be a number"):
        filter.predict(filter.initial(*world["prior"]), world["twist"], world["dt"])


@pytest.mark.parametrize("batch", [(), (B,)], ids=str)
@pytest.mark.parametrize("lost", [0.0, 7.0, np.nan])
def test_a_law_for_every_link_and_lost_links_by_booleans_and_by_numbers(batch, lost):
    """Booleans and arrays of full shape go a quicker way than what has to be broadcast."""
    world = worlds() if batch else alone(worlds(), 2)
    links = np.random.default_rng(1).random((*batch, M, N)) < 0.7
    law = LinkNoise(world["noise"])
    filter: Any = estimators.make(
        "iekf", tags=np.random.default_rng(2).uniform(-0.5, 0.5, (N, 3)), noise=RangeNoise(0.1),
        process=motion.ProcessNoise(0.1, 0.1),
    )  # fmt: skip
    state = filter.initial(*world["prior"])
    ranges = np.where(links, world["ranges"], lost)
    quick = filter.update(state, ranges, world["anchors"], links, noise=law)
    slow = filter.update(state, ranges, world["anchors"], links.astype(int), noise=law)
    for got, want in zip(quick, slow, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-12)
    ranges[..., 0, 0] = -1.0
    links[..., 0, 0] = True
    with pytest.raises(ValueError, match="ranges must be positive where measured"):
        filter.update(state, ranges, world["anchors"], links, noise=law)
