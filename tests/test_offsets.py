"""Ranges with an unknown offset in common: against naive forms that estimate it as a parameter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym import bounds, kernels
from rbl_gym.bounds import pose, smoothing, twist
from rbl_gym.geometry import rotations
from rbl_gym.measurements import noise_laws, offsets
from rbl_gym.measurements.ranging import RangeNoise
from rbl_gym.motion import ProcessNoise

every_offset = pytest.mark.parametrize("offset", offsets.OFFSETS)
NOISE = RangeNoise(0.05, 0.01)
M, N = 6, 5


def groups(offset: str, m: int = M, n: int = N) -> np.ndarray:
    """Columns of the links' offsets (m n, G), by loops."""
    rows = []
    for i in range(m):
        for j in range(n):
            row = np.zeros({"tag": n, "anchor": m, "epoch": 1}[offset])
            row[{"tag": j, "anchor": i, "epoch": 0}[offset]] = 1.0
            rows.append(row)
    return np.array(rows)


def world(seed: int = 0, batch: tuple[int, ...] = ()):
    rng = np.random.default_rng(seed)
    anchors = rng.uniform(-10, 10, (*batch, M, 3))
    tags = rng.normal(0, 0.5, (N, 3))
    return anchors, tags, rotations.random(rng, batch), rng.normal(0, 3, (*batch, 3))


def distances(anchors, tags, rotation, translation) -> np.ndarray:
    places = tags @ rotation.T + translation
    return np.array([[np.linalg.norm(s - a) for s in places] for a in anchors])


def numeric_jacobian(anchors, tags, rotation, translation, step=1e-6) -> np.ndarray:
    columns = []
    for i in range(6):
        ends = []
        for sign in (1, -1):
            e = np.zeros(6)
            e[i] = sign * step
            turned = Rotation.from_rotvec(e[:3]).as_matrix() @ rotation
            ends.append(distances(anchors, tags, turned, translation + e[3:]).ravel())
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=-1)


def naive_information(anchors, tags, rotation, translation, links, offset) -> np.ndarray:
    """Of the pose, from the Fisher information about pose and offsets by a Schur complement."""
    J = numeric_jacobian(anchors, tags, rotation, translation)
    H = np.concatenate([J, groups(offset)], axis=1)
    weight = links.ravel() / NOISE.variance(distances(anchors, tags, rotation, translation)).ravel()
    F = H.T @ (weight[:, None] * H)
    heard = np.diag(F)[6:] > 0
    A, B, D = F[:6, :6], F[:6, 6:][:, heard], F[6:, 6:][np.ix_(heard, heard)]
    return A - B @ np.linalg.solve(D, B.T)


# --- bounds ------------------------------------------------------------------------------------


@every_offset
def test_information_is_what_a_parameter_leaves(offset):
    anchors, tags, rotation, translation = world()
    links = np.random.default_rng(1).random((M, N)) < 0.7
    links[:, 2], links[3] = False, False
    got = bounds.range_information(
        anchors, tags, rotation, translation, NOISE, links, offset=offset
    )
    want = naive_information(anchors, tags, rotation, translation, links, offset)
    np.testing.assert_allclose(got, want, atol=1e-6 * np.abs(want).max())
    crb = bounds.pose_crb(anchors, tags, rotation, translation, NOISE, offset=offset)
    plain = bounds.pose_crb(anchors, tags, rotation, translation, NOISE)
    assert np.linalg.eigvalsh(crb - plain)[0] > -1e-12


def test_an_unknown_offset_costs_an_anchor():
    anchors, tags, rotation, translation = world()
    assert bounds.pose_crb(anchors[:4], tags, rotation, translation, NOISE).shape == (6, 6)
    # Three ranges of a tag give two differences: a curve. Two anchors give nothing for certain.
    with pytest.raises(ValueError, match="rank"):
        bounds.pose_crb(anchors[:2], tags, rotation, translation, NOISE, offset="tag")
    one = bounds.range_information(anchors[:1], tags, rotation, translation, NOISE, offset="tag")
    np.testing.assert_allclose(one, 0, atol=1e-9)


def test_offsets_that_are_none_are_refused():
    with pytest.raises(ValueError, match="offset must be one of 'tag'"):
        bounds.pose_crb(*world(), NOISE, offset="tags")
    with pytest.raises(ValueError, match="offset goes with model 'raw'"):
        bounds.pose_crb(*world(), NOISE, offset="tag", model="squared")


@pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")
@every_offset
@pytest.mark.parametrize("batch", [(), (3,)], ids=str)
@pytest.mark.parametrize(
    "law", [NOISE, RangeNoise(0.05, 0.01, reference_tag=1), noise_laws.SquaredRangeNoise(0.1)]
)
def test_information_by_its_kernel(batch, law, offset):
    share = np.random.default_rng(1).random((*batch, M, N))
    share = np.where(share < 0.3, 0.0, share)
    prior = np.broadcast_to(np.eye(6), (*batch, 6, 6))
    args = prior, *world(2, batch), noise_laws.numbers_of(law, N), share, offsets.code_of(offset)
    form = pose._offset_information
    got, want = form.kernel(*args), form.textbook(*args)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())


def test_recursions_take_the_offset():
    anchors, tags, rotation, translation = world()
    process = ProcessNoise(0.1, 0.2)
    seen = bounds.range_information(anchors, tags, rotation, translation, NOISE, offset="tag")
    places = anchors, tags, rotation, translation, NOISE
    zero = np.zeros(6)
    J = bounds.posterior_crb_step(np.eye(6), *places, zero, 0.0, process, offset="tag")
    np.testing.assert_allclose(J, np.eye(6) + seen, rtol=1e-9)
    law = twist.WanderingTwist(0.5, 1.0, 0.1, 0.1)
    J = twist.posterior_crb_step(np.eye(12), *places, zero, 0.1, process, law, offset="tag")
    plain = twist.posterior_crb_step(np.eye(12), *places, zero, 0.1, process, law, np.zeros((M, N)))
    np.testing.assert_allclose(J[:6, :6] - plain[:6, :6], seen, atol=1e-9 * seen.max())
    several = tuple(np.stack([x] * 3) for x in (rotation, translation))
    P = smoothing.smoothing_crb(
        anchors, tags, *several, NOISE, np.zeros((2, 6)), 1.0,
        ProcessNoise(1e-7, 1e-7), np.eye(6), offset="tag",
    )  # fmt: skip
    # A body that stands: all epochs add up.
    np.testing.assert_allclose(P[1], np.linalg.inv(np.eye(6) + 3 * seen), rtol=1e-3, atol=1e-9)
