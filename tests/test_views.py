"""The views of the learning tasks: compiled forms and textbook forms, ties, limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import kernels
from rbl_gym.geometry import rotations
from rbl_gym.wrappers import views

pytestmark = pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")
every_batch = pytest.mark.parametrize("batch", [(), (3,), (2, 3)], ids=str)


def belief(rng, batch):
    root = rng.standard_normal((*batch, 6, 6))
    return (
        rng.normal(0, 30, (*batch, 3)),
        rotations.random(rng, batch),
        root @ np.swapaxes(root, -1, -2),
    )


def assert_equal_forms(form, *args) -> Any:
    got, want = form.kernel(*args), form.textbook(*args)
    got, want = (x if isinstance(x, tuple) else (x,) for x in (got, want))
    for mine, plain in zip(got, want, strict=True):
        np.testing.assert_allclose(mine, plain, rtol=1e-9, atol=1e-9)
    return want


@every_batch
@pytest.mark.parametrize("sort", [True, False])
@pytest.mark.parametrize("m", [2, 3, 7])
def test_views_of_craft(batch, sort, m):
    rng = np.random.default_rng(m)
    anchors, twist = rng.normal(0, 90, (*batch, m, 3)), rng.standard_normal((*batch, 6))
    usual = rng.uniform(0.1, 1, 6)
    order, flat = assert_equal_forms(
        views.mobile_anchors, *belief(rng, batch), twist, anchors, usual, 1.5, sort,
        np.full(15 + 3 * m, 10.0),
    )  # fmt: skip
    assert flat.shape == (*batch, 15 + 3 * m)
    np.testing.assert_array_equal(
        np.sort(order, axis=-1), np.broadcast_to(np.arange(m), order.shape)
    )


@every_batch
def test_views_of_a_selection(batch):
    rng = np.random.default_rng(1)
    usual, half = rng.uniform(0.1, 1, 6), rng.uniform(1, 9, 3)
    assert_equal_forms(
        views.anchor_selection, *belief(rng, batch), rng.standard_normal((*batch, 6)), usual, 2.0,
        rng.normal(0, 1, 3), half, np.full(18, 10.0),
    )  # fmt: skip


def test_craft_of_one_bearing_keep_the_order_of_their_numbers():
    state = np.zeros(3), np.eye(3), 1e-30 * np.eye(6)
    anchors = np.array([[3.0, 3, 0], [-1, 0, 0], [1, 1, 0], [2, 2, 0], [0, -1, 0], [0, 0, 0]])
    order, flat = assert_equal_forms(
        views.mobile_anchors, *state, np.zeros(6), anchors, np.ones(6), 1.0, True,
        np.full(33, 10.0),
    )  # fmt: skip
    np.testing.assert_array_equal(order, [4, 5, 0, 2, 3, 1])
    assert (np.abs(flat) <= 10).all()
    assert (flat == -10).any()
