"""Ranges with an unknown offset in common: against naive forms that estimate it as a parameter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rbl_gym import bounds, estimators, kernels, metrics
from rbl_gym.bounds import information, smoothing
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import noise_laws, offsets
from rbl_gym.measurements.ranging import RangeNoise
from rbl_gym.motion import ProcessNoise, propagate
from rbl_gym.motion.unknown_twist import WanderingTwist
from tests.helpers import with_kernels

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
    anchors = bodies.octahedron(18.0) + rng.uniform(-3, 3, (*batch, M, 3))
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
    with pytest.raises(ValueError, match="offset needs model 'raw'"):
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
    form = information._offset_information
    got, want = form.kernel(*args), form.textbook(*args)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())


def test_recursions_take_the_offset():
    anchors, tags, rotation, translation = world()
    process = ProcessNoise(0.1, 0.2)
    seen = bounds.range_information(anchors, tags, rotation, translation, NOISE, offset="tag")
    places = anchors, tags, rotation, translation, NOISE
    zero = np.zeros(6)
    epoch, common = bounds.RangeEpoch(*places), bounds.Nuisances(offset="tag")
    known = bounds.KnownTwist(zero, 0.0, process)
    J = bounds.posterior_step(np.eye(6), epoch, known, common)
    np.testing.assert_allclose(J, np.eye(6) + seen, rtol=1e-9)
    law = WanderingTwist(0.5, 1.0, 0.1, 0.1)
    unknown = bounds.UnknownTwist(zero, 0.1, process, law)
    J = bounds.posterior_step(np.eye(12), epoch, unknown, common)
    nothing = epoch._replace(links=np.zeros((M, N)))
    plain = bounds.posterior_step(np.eye(12), nothing, unknown)
    np.testing.assert_allclose(J[:6, :6] - plain[:6, :6], seen, atol=1e-9 * seen.max())
    Q, t = (np.stack([x] * 3) for x in (rotation, translation))
    stands = bounds.KnownTwist(np.zeros((2, 6)), 1.0, ProcessNoise(1e-7, 1e-7))
    epochs = bounds.RangeEpoch(anchors, tags, Q, t, NOISE)
    P = smoothing.smoothing_crb(epochs, stands, np.eye(6), offset="tag")
    # A body that stands: all epochs add up.
    np.testing.assert_allclose(P[1], np.linalg.inv(np.eye(6) + 3 * seen), rtol=1e-3, atol=1e-9)


# --- one epoch ---------------------------------------------------------------------------------


def readings(seed: int, offset: str, batch: tuple[int, ...] = (), size: float = 50.0, noise=NOISE):
    """A world, and its ranges with offsets of `size` metres (standard deviation)."""
    anchors, tags, rotation, translation = world(seed, batch)
    rng = np.random.default_rng(seed + 1)
    places = tags @ np.swapaxes(rotation, -1, -2) + translation[..., None, :]
    d = np.linalg.norm(places[..., None, :, :] - anchors[..., :, None, :], axis=-1)
    ranges = d + np.sqrt(noise.variance(d)) * rng.standard_normal(d.shape)
    shape = offsets.group_shape(offset, M, N)
    return (
        ranges + size * rng.standard_normal((*batch, *shape)),
        anchors,
        tags,
        rotation,
        translation,
    )


@every_offset
def test_locate_finds_what_a_fit_of_pose_and_offsets_finds(offset):
    law = RangeNoise(0.05)
    ranges, anchors, tags, rotation, translation = readings(3, offset, noise=law)
    columns = groups(offset)

    def residuals(x):
        turned = Rotation.from_rotvec(x[:3]).as_matrix() @ rotation
        predicted = distances(anchors, tags, turned, translation + x[3:6]).ravel()
        return (predicted + columns @ x[6:] - ranges.ravel()) / 0.05

    start = np.zeros(6 + columns.shape[1])
    fit = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = estimators.locate(ranges, anchors, tags, law, offset=offset)
    want = Rotation.from_rotvec(fit.x[:3]).as_matrix() @ rotation
    np.testing.assert_allclose(found.rotation, want, atol=1e-5)
    np.testing.assert_allclose(found.translation, translation + fit.x[3:6], atol=1e-4)
    np.testing.assert_allclose(found.cost, fit.cost, rtol=1e-8)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)[:6, :6]
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance)[3:]), np.sqrt(np.diag(covariance)[3:]), rtol=1e-3
    )


@every_offset
@pytest.mark.parametrize("method", ["ml", "robust"])
def test_a_constant_more_changes_nothing(offset, method):
    ranges, anchors, tags, *_ = readings(5, offset, (4,), size=0.0)
    shape = offsets.group_shape(offset, M, N)
    more = 1e4 * np.random.default_rng(0).standard_normal((4, *shape))
    plain, shifted = (
        estimators.locate(r, anchors, tags, NOISE, method=method, offset=offset)
        for r in (ranges, ranges + more)
    )
    assert (ranges + more < 0).any()
    for a, b in zip(plain[:3], shifted[:3], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)


@pytest.mark.parametrize("offset", ["tag", "epoch"])
def test_locate_stands_at_its_bound(offset):
    """RMS of 600 trials: the ratio's deviation is about 2.5 %, that of the mean NEES 0.14."""
    ranges, anchors, tags, rotation, translation = readings(7, offset, (600,))
    found = estimators.locate(ranges, anchors, tags, NOISE, offset=offset)
    P = bounds.pose_crb(anchors, tags, rotation, translation, NOISE, offset=offset)
    e = np.concatenate(
        [rotations.error(found.rotation, rotation), found.translation - translation], axis=-1
    )
    # In units of each trial's bound: poor draws of anchors do not rule the mean.
    for block in (slice(0, 3), slice(3, 6)):
        bound = np.trace(P[:, block, block], axis1=-2, axis2=-1)
        assert 0.9 < np.sqrt((np.square(e[:, block]).sum(axis=-1) / bound).mean()) < 1.1
    nees = metrics.nees(e, found.covariance)
    assert 5.4 < nees.mean() < 6.6
    assert (found.rank == 6).all()


def test_wrong_ranges_among_those_with_offsets():
    ranges, anchors, tags, _, translation = readings(9, "tag", (50,))
    wrong = np.random.default_rng(3).random(ranges.shape) < 0.05
    found = estimators.locate(ranges + 8 * wrong, anchors, tags, NOISE, "robust", offset="tag")
    clean = estimators.locate(ranges, anchors, tags, NOISE, offset="tag")
    off = np.linalg.norm(found.translation - translation, axis=-1)
    assert np.median(off) < 1.5 * np.median(
        np.linalg.norm(clean.translation - translation, axis=-1)
    )
    assert (off < 1.0).mean() > 0.9


@pytest.mark.parametrize("method", ["ls", "ls-projected", "cls", "procrustes", "two-step"])
def test_linear_methods_difference_the_offset_away(method):
    law = RangeNoise(1e-6)
    ranges, anchors, tags, rotation, translation = readings(11, "tag", (5,), noise=law)
    found = estimators.locate(ranges, anchors, tags, law, method=method, offset="tag")
    np.testing.assert_allclose(found.translation, translation, atol=1e-3)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-3)


def test_rank_says_what_differences_leave():
    ranges, anchors, tags, *_ = readings(3, "tag")
    rank = [
        int(estimators.locate(ranges[:m], anchors[:m], tags, NOISE, offset="tag").rank)
        for m in (1, 2, 3)
    ]
    assert rank[0] == 0
    assert rank[1] < rank[2] == 6
    one = estimators.locate(ranges[:4, :1], anchors[:4], tags[:1], NOISE, offset="tag")
    assert one.rank == 3
    one = estimators.locate(ranges[:3, :1], anchors[:3], tags[:1], NOISE, offset="tag")
    assert one.rank == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"offset": "tags"}, "offset must be one of"),
        ({"offset": "tag", "tag_std_m": 0.1}, "offset needs tag_std_m = 0"),
        ({"offset": "anchor", "method": "cls"}, "offset 'anchor' needs"),
        ({"offset": "tag", "ranges": np.full((M, N), np.nan)}, "ranges must be finite"),
        ({"offset": "tag", "ranges": np.ones((M, N + 1))}, "ranges must"),
        ({"offset": "tag", "links": np.ones((M, N + 1))}, "links must have shape"),
        ({"ranges": -np.ones((M, N))}, "ranges must be positive"),
    ],
)
def test_bad_input_is_refused(change, message):
    ranges, anchors, tags, *_ = readings(3, "tag")
    arguments = {"ranges": ranges, "anchors": anchors, "tags": tags, "noise": NOISE} | change
    with pytest.raises(ValueError, match=message):
        estimators.locate(**arguments)


def test_squared_ranges_with_an_offset_need_five_anchors():
    ranges, anchors, tags, *_ = readings(3, "tag")
    with pytest.raises(ValueError, match="needs 5 anchors"):
        estimators.locate(ranges[:4], anchors[:4], tags, NOISE, method="cls", offset="tag")


# --- filters -----------------------------------------------------------------------------------


def track(offset, batch=100, steps=8, seed=0, prior=(0.2, 0.5), size=30.0, name="iekf", **options):
    """A filter over epochs with new offsets: errors (K, B, 6), its covariances, the bounds."""
    rng = np.random.default_rng(seed)
    anchors = bodies.octahedron(18.0) + rng.uniform(-3, 3, (M, 3))
    tags, process, dt = rng.normal(0, 0.5, (N, 3)), ProcessNoise(0.05, 0.1), 0.1
    rotation, translation = rotations.random(rng, (batch,)), rng.normal(0, 2, (batch, 3))
    P = np.diag([prior[0] ** 2] * 3 + [prior[1] ** 2] * 3)
    filter = estimators.make(
        name, tags=tags, noise=NOISE, process=process, offset=offset, **options
    )
    state = filter.initial(
        rotations.exp(prior[0] * rng.standard_normal((batch, 3))) @ rotation,
        translation + prior[1] * rng.standard_normal((batch, 3)),
        P,
    )
    J = np.broadcast_to(np.linalg.inv(P), (batch, 6, 6))
    errors, beliefs, crb = [], [], []
    for k in range(steps):
        twist = rng.normal(0, 0.5, (batch, 6))
        if k:
            walked = twist + rng.standard_normal((batch, 6)) * process.std() / np.sqrt(dt)
            rotation, translation = propagate(rotation, translation, walked, dt)
            state = filter.predict(state, twist, dt)
        epoch = bounds.RangeEpoch(anchors, tags, rotation, translation, NOISE)
        moved = bounds.KnownTwist(twist, dt if k else 0.0, process)
        J = bounds.posterior_step(J, epoch, moved, bounds.Nuisances(offset=offset))
        places = tags @ np.swapaxes(rotation, -1, -2) + translation[:, None]
        d = np.linalg.norm(places[:, None] - anchors[:, None], axis=-1)
        ranges = d + np.sqrt(NOISE.variance(d)) * rng.standard_normal(d.shape)
        ranges += size * rng.standard_normal((batch, *offsets.group_shape(offset, M, N)))
        state = filter.update(state, ranges, anchors)
        belief = filter.belief(state)
        turned = rotations.error(belief.rotation, rotation)
        errors.append(np.concatenate([turned, belief.translation - translation], axis=-1))
        beliefs.append(belief.covariance)
        crb.append(np.linalg.inv(J))
    return np.array(errors), np.array(beliefs), np.array(crb)


@with_kernels
@pytest.mark.parametrize(
    ("offset", "prior"),
    [(kind, (0.2, 0.5)) for kind in offsets.OFFSETS]
    + [("tag", (2.0, 10.0)), ("epoch", (2.0, 10.0))],
)
def test_the_filter_stands_at_its_bound(offset, prior):
    """RMS over 200 trials: a deviation of 2.9 %, of the mean over the epochs less; NEES 0.25."""
    errors, beliefs, crb = track(offset, 200, prior=prior)
    for block in (slice(0, 3), slice(3, 6)):
        bound = np.trace(crb[..., block, block], axis1=-2, axis2=-1).mean(axis=-1)
        ratio = np.sqrt(np.square(errors[..., block]).sum(axis=-1).mean(axis=-1) / bound)
        # From nothing the first poses are not where the bound is linear.
        assert ratio[2:].mean() < (1.05 if prior[0] < 1 else 1.15)
    assert abs(metrics.nees(errors, beliefs)[2:].mean() - 6) < 0.6


def test_the_filter_does_not_see_the_size_of_offsets():
    (small, P, _), (large, R, _) = (track("tag", 5, size=size) for size in (0.0, 1e5))
    np.testing.assert_allclose(small, large, atol=1e-6)
    np.testing.assert_allclose(P, R, rtol=1e-5, atol=1e-12)


def test_one_update_is_that_of_a_filter_with_offsets_as_states():
    """A linear update with offsets of an enormous prior, at a prior so good that all is linear."""
    law = RangeNoise(0.05)
    _, anchors, tags, rotation, translation = readings(3, "tag", noise=law)
    P = 1e-8 * np.diag([1.0, 2, 1, 3, 1, 1])
    J = numeric_jacobian(anchors, tags, rotation, translation)
    H = np.concatenate([J, groups("tag")], axis=1)
    whole = np.zeros((6 + N, 6 + N))
    whole[:6, :6], whole[6:, 6:] = P, 1e6 * np.eye(N)
    rng = np.random.default_rng(1)
    r = distances(anchors, tags, rotation, translation).ravel()
    y = 0.001 * rng.standard_normal(M * N) + groups("tag") @ rng.standard_normal(N)
    gain = whole @ H.T @ np.linalg.inv(H @ whole @ H.T + 0.05**2 * np.eye(M * N))
    want = (np.eye(6 + N) - gain @ H) @ whole
    filter = estimators.make(
        "iekf", tags=tags, noise=law, process=ProcessNoise(0.1, 0.1), offset="tag"
    )
    state = filter.update(filter.initial(rotation, translation, P), (r + y).reshape(M, N), anchors)
    np.testing.assert_allclose(state.covariance, want[:6, :6], atol=1e-12)
    np.testing.assert_allclose(state.translation - translation, (gain @ y)[3:6], atol=1e-9)


def test_a_filter_refuses_what_is_no_offset():
    options = {"tags": np.eye(3), "noise": NOISE, "process": ProcessNoise(0.1, 0.1)}
    with pytest.raises(ValueError, match="offset must be one of"):
        estimators.make("iekf", offset="clock", **options)
    with pytest.raises(ValueError, match="offset"):
        estimators.make("kf", offset="tag", **options)


@pytest.mark.parametrize("robust", [False, True])
def test_a_filter_with_biases_that_are_nothing_is_the_plain_one(robust):
    (plain, P, _), (biased, R, _) = (
        track("tag", 5, name=name, robust=robust, **law)
        for name, law in (("iekf", {}), ("iekf-bias", {"bias_std_m": 1e-6, "common_std_m": 0.0}))
    )
    # Of squares the same; the losses differ.
    np.testing.assert_allclose(plain, biased, atol=0.1 if robust else 1e-5)
    if not robust:
        np.testing.assert_allclose(P, R, rtol=1e-3, atol=1e-9)


@every_offset
def test_innovations_are_those_of_differences(offset):
    """NIS by differences to the first link of every group, whose noise they share."""
    ranges, anchors, tags, rotation, translation = readings(13, offset)
    filter = estimators.make(
        "iekf", tags=tags, noise=NOISE, process=ProcessNoise(0.1, 0.1), offset=offset
    )
    P = 1e-4 * np.diag([1.0, 2, 1, 3, 1, 2])
    before = filter.initial(rotation, translation, P)
    after = filter.update(before, ranges, anchors)
    found = estimators.innovations(filter, before, after, ranges, anchors, tags, NOISE)
    d = distances(anchors, tags, after.rotation, after.translation)
    H = numeric_jacobian(anchors, tags, after.rotation, after.translation)
    moved = np.concatenate(
        [rotations.error(after.rotation, rotation), after.translation - translation]
    )
    v = (ranges - d).ravel() + H @ moved
    R = np.diag(NOISE.variance(d).ravel())
    U = groups(offset)
    differences = []
    for column in U.T:
        first, *others = np.flatnonzero(column)
        for i in others:
            row = np.zeros(len(v))
            row[i], row[first] = 1.0, -1.0
            differences.append(row)
    D = np.array(differences)
    S = D @ (H @ P @ H.T + R) @ D.T
    np.testing.assert_allclose(found.nis, D @ v @ np.linalg.solve(S, D @ v), rtol=1e-6)
    assert found.dof == len(D)
