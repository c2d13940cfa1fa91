"""Alignment of tracks: against scipy's solution, and undetermined cases."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from rbl_gym.geometry import rotations
from rbl_gym.recordings import ALIGNMENTS, align_positions, apply_alignment


def scene(seed=0, count=50, noise=0.1):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, 3)) * (5, 3, 1) + (100, -40, 7)
    R = rotations.random(rng)
    target = source @ R.T + rng.normal(size=3) * 10 + noise * rng.normal(size=(count, 3))
    return source, target


def rmse(alignment, source, target):
    moved = apply_alignment(alignment, None, source)[1]
    return float(np.sqrt(((moved - target) ** 2).sum(axis=-1).mean()))


@pytest.mark.parametrize("seed", range(5))
def test_se3_is_scipys_rotation_about_the_centres(seed):
    source, target = scene(seed)
    found = align_positions(source, target, "se3")
    centred = target - target.mean(axis=0), source - source.mean(axis=0)
    want = Rotation.align_vectors(*centred)[0]
    np.testing.assert_allclose(found.rotation, want.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(
        found.translation, target.mean(axis=0) - want.apply(source.mean(axis=0)), atol=1e-7
    )
    assert found.turn_rad == pytest.approx(want.magnitude())
    assert found.shift_m == pytest.approx(np.linalg.norm(target.mean(0) - source.mean(0)))


def test_mirrored_positions_get_a_rotation():
    source, target = scene(noise=0.0)
    assert np.linalg.det(align_positions(source, target * (1, 1, -1)).rotation) > 0


def test_yaw_is_the_best_of_all_turns_about_z():
    source, target = scene(1)
    found = align_positions(source, target, "yaw")

    def cost(angle):
        R = Rotation.from_euler("z", angle).as_matrix()
        return ((source - source.mean(0)) @ R.T - target + target.mean(0)).ravel() @ (
            ((source - source.mean(0)) @ R.T - target + target.mean(0)).ravel()
        )

    tried: list[Any] = [
        minimize_scalar(cost, bounds=(a, a + 2), method="bounded") for a in (-3, -1, 1)
    ]
    best = min(tried, key=lambda result: result.fun)
    turned = Rotation.from_euler("z", best.x).as_matrix()
    np.testing.assert_allclose(found.rotation, turned, atol=1e-4)


def test_more_freedom_leaves_less():
    source, target = scene(2)
    left = [rmse(align_positions(source, target, mode), source, target) for mode in ALIGNMENTS]
    assert left == sorted(left, reverse=True)
    assert left[-1] == pytest.approx(0.1 * 3**0.5, rel=0.2)


def test_none_and_position_turn_nothing():
    source, target = scene(3)
    for mode, shift in (("none", np.zeros(3)), ("position", (target - source).mean(axis=0))):
        found = align_positions(source, target, mode)
        np.testing.assert_array_equal(found.rotation, np.eye(3))
        np.testing.assert_allclose(found.translation, shift, atol=1e-10)


def test_rotations_go_with_the_world_frame():
    source, target = scene(4)
    found = align_positions(source, target)
    Q = rotations.random(np.random.default_rng(0), (50,))
    moved, places = apply_alignment(found, Q, source)
    assert moved is not None
    np.testing.assert_allclose(moved, found.rotation @ Q, atol=1e-12)
    point = np.array([0.3, -0.2, 0.1])
    # A point of the body is where the transform takes it.
    np.testing.assert_allclose(
        moved @ point + places,
        (Q @ point + source) @ found.rotation.T + found.translation,
        atol=1e-9,
    )


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_what_positions_do_not_tell_is_refused(offset):
    line = np.linspace(0, 1, 20)[:, None] * (3.0, 1.0, 2.0) + offset
    with pytest.raises(ValueError, match=r"the 20 positions do not determine a rotation"):
        align_positions(line, line + 1)
    upright = np.linspace(0, 1, 20)[:, None] * (0, 0, 2.0) + offset
    with pytest.raises(ValueError, match="do not determine a heading"):
        align_positions(upright, upright + 1, "yaw")
    align_positions(upright, upright + 1, "position")
    align_positions(line, line + 1, "yaw")


def test_bad_arguments_are_named():
    source, target = scene()
    with pytest.raises(ValueError, match="mode must be"):
        align_positions(source, target, "sim3")
    with pytest.raises(ValueError, match="source and target must both be"):
        align_positions(source, target[:-1])
