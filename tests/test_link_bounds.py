"""Bounds of links that are lost, reflected or biased: by differences, integrals, Monte Carlo."""

# pyright: reportCallIssue=false
from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, optimize, stats

from rbl_gym import bounds, motion
from rbl_gym.bounds import links as link_bounds
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from tests.helpers import random_world

NOISE = ranging.RangeNoise(0.1, 0.01)


def world(seed, m=5, n=4):
    return random_world(np.random.default_rng(seed), m, n)


def ranges_at(anchors, tags, rotation, translation, error, biases, rows):
    """Ranges (M N,) of a moved pose with biases, straight from the definition."""
    moved = rotations.exp(error[:3]) @ rotation
    positions = tags @ moved.T + translation + error[3:]
    plain = np.linalg.norm(positions[None] - anchors[:, None], axis=-1).ravel()
    return plain + rows.T @ biases


@pytest.mark.parametrize("groups", link_bounds.GROUPS)
def test_joint_information_by_finite_differences(groups):
    anchors, tags, rotation, translation = world(1, 4, 3)
    m, n = len(anchors), len(tags)
    owner = {
        "link": lambda i, k: i * n + k,
        "anchor": lambda i, k: i,
        "tag": lambda i, k: k,
        "common": lambda i, k: 0,
    }[groups]
    count = {"link": m * n, "anchor": m, "tag": n, "common": 1}[groups]
    rows = np.zeros((count, m * n))
    for i in range(m):
        for k in range(n):
            rows[owner(i, k), i * n + k] = 1.0
    links = np.random.default_rng(2).random((m, n)) > 0.2
    step = 1e-6
    H = np.empty((m * n, 6 + count))
    for axis in range(6 + count):
        d = step * np.eye(6 + count)[axis]
        ends = [
            ranges_at(anchors, tags, rotation, translation, s * d[:6], s * d[6:], rows)
            for s in (1, -1)
        ]
        H[:, axis] = (ends[0] - ends[1]) / (2 * step)
    true = ranges_at(anchors, tags, rotation, translation, np.zeros(6), np.zeros(count), rows)
    weight = links.ravel() / (0.1**2 + (0.01 * true) ** 2)
    got = link_bounds.bias_information(
        anchors, tags, rotation, translation, NOISE, links, groups=groups
    )
    np.testing.assert_allclose(got, H.T @ (weight[:, None] * H), rtol=1e-6, atol=1e-4)


def test_the_schur_complement_is_the_block_of_the_inverse():
    """Marginal information = inverse of the pose block of the inverse joint information."""
    places = world(3)
    joint = link_bounds.with_biases(np.eye(6), 0.2, 5)
    joint = joint + link_bounds.bias_information(*places, NOISE, groups="anchor")
    want = np.linalg.inv(np.linalg.inv(joint)[:6, :6])
    np.testing.assert_allclose(link_bounds.marginal_information(joint), want, rtol=1e-9)


def test_a_bias_of_each_link_is_noise_within_one_epoch():
    places = world(4)
    noise, both = ranging.RangeNoise(0.1), ranging.RangeNoise(float(np.hypot(0.1, 0.3)))
    joint = link_bounds.with_biases(np.zeros((6, 6)), 0.3, 20)
    joint = joint + link_bounds.bias_information(*places, noise)
    want = bounds.range_information(*places, both)
    np.testing.assert_allclose(link_bounds.marginal_information(joint), want, rtol=1e-9)


def test_a_link_without_ranges_leaves_its_bias_idle():
    places = world(5)
    links = np.ones((5, 4), bool)
    links[2] = False
    got = link_bounds.marginal_information(
        link_bounds.bias_information(*places, NOISE, links, groups="anchor")
    )
    kept = [0, 1, 3, 4]
    want = link_bounds.marginal_information(
        link_bounds.bias_information(places[0][kept], *places[1:], NOISE, groups="anchor")
    )
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-6)


def test_constant_biases_over_epochs_by_stacking_them_all():
    """The recursion without process noise against one batch of all epochs' ranges."""
    anchors, tags, rotation, translation = world(6)
    twist, dt = np.array([0.3, -0.2, 0.1, 1.0, 0.5, -0.4]), 0.5
    still = motion.ProcessNoise(1e-9, 1e-9)
    joint = link_bounds.with_biases(np.diag([4.0] * 6), 0.3, 5)
    whole = joint.copy()
    turn = np.eye(3)
    for k in range(4):
        if k:
            turn = rotations.exp(twist[:3] * dt) @ turn
        pose = turn @ rotation, translation + k * dt * twist[3:]
        told = link_bounds.bias_information(anchors, tags, *pose, NOISE, groups="anchor")
        # The error at epoch k is that of epoch 0, turned.
        F = np.eye(11)
        F[:3, :3] = turn
        whole = whole + F.T @ told @ F
        if k == 0:
            joint = joint + told
        else:
            joint = link_bounds.posterior_bias_step(
                joint, anchors, tags, *pose, NOISE, twist, dt, still, groups="anchor"
            )
    np.testing.assert_allclose(F.T @ joint @ F, whole, rtol=1e-6, atol=1e-6 * np.abs(whole).max())


def test_a_walking_bias_forgets():
    """With a large walk every epoch brings a new bias: as noise. Without, it is learned."""
    places, twist = world(7), np.zeros(6)
    process = motion.ProcessNoise(0.02, 0.1)
    found = {}
    for walk in (0.0, 0.05, 1e4):
        J = link_bounds.with_biases(np.eye(6), 0.3, 5)
        for _ in range(5):
            J = link_bounds.posterior_bias_step(
                J, *places, NOISE, twist, 0.1, process, groups="anchor", bias_walk_m=walk
            )
        found[walk] = np.trace(np.linalg.inv(link_bounds.marginal_information(J))[3:, 3:])
    assert found[0.0] < found[0.05] < found[1e4]


def test_the_bound_with_anchor_biases_is_reached_by_maximum_a_posteriori():
    """300 trials: a MAP estimate of pose and biases has the bound's variance, 4 sigma."""
    rng = np.random.default_rng(8)
    anchors, tags, rotation, translation = world(8, 6, 6)
    anchors = 10 * anchors / np.linalg.norm(anchors, axis=-1, keepdims=True) + translation
    noise, std, trials = ranging.RangeNoise(0.02), 0.1, 300
    rows = np.repeat(np.eye(6), 6, axis=1)
    joint = link_bounds.with_biases(np.zeros((6, 6)), std, 6)
    joint = joint + link_bounds.bias_information(
        anchors, tags, rotation, translation, noise, groups="anchor"
    )
    bound = np.linalg.inv(link_bounds.marginal_information(joint))
    squares = []
    for _ in range(trials):
        biases = std * rng.standard_normal(6)
        measured = ranges_at(anchors, tags, rotation, translation, np.zeros(6), biases, rows)
        measured = measured + 0.02 * rng.standard_normal(36)

        def residuals(x, measured=measured):
            at = ranges_at(anchors, tags, rotation, translation, x[:6], x[6:], rows)
            return np.concatenate([(at - measured) / 0.02, x[6:] / std])

        found = optimize.least_squares(residuals, np.zeros(12), method="lm").x
        squares.append(found[:6] @ np.linalg.solve(bound, found[:6]))
    assert abs(np.mean(squares) - 6) < 4 * np.sqrt(12 / trials)


@pytest.mark.parametrize("bias", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("spread", [0.0, 0.5, 8.0])
@pytest.mark.parametrize("p", [0.1, 0.6])
def test_mixture_efficiency_by_a_fine_grid(bias, spread, p):
    """Against the integral of f'^2 / f itself, the density differentiated by differences."""
    std = 0.4

    wide = np.hypot(std, spread)
    x = np.linspace(-12 * wide, 12 * wide + bias, 400_001)
    density = (1 - p) * stats.norm.pdf(x, 0, std) + p * stats.norm.pdf(x, bias, wide)
    slope = np.gradient(density, x)
    want = integrate.trapezoid(slope**2 / np.maximum(density, 1e-290), x)
    got = link_bounds.nlos_efficiency(p, bias, std, spread)
    assert got == pytest.approx(want * std**2, rel=2e-4)
    # Who is told which ranges are reflected knows more.
    assert got <= link_bounds.nlos_efficiency(p, bias, std, spread, known=True) + 1e-9


def test_far_biases_of_unknown_size_cost_their_share_of_ranges():
    std = np.array([[0.1, 0.2], [0.1, 0.3]])
    got = link_bounds.nlos_efficiency(0.1, 5.0, std, 2.0)
    np.testing.assert_allclose(got, 0.9, atol=0.03)
    assert (got < link_bounds.nlos_efficiency(0.1, 5.0, std, 2.0, known=True)).all()
    np.testing.assert_array_equal(link_bounds.nlos_efficiency(0.1, 5.0, std), 0.9)
    # A known bias far away is subtracted: nothing is lost.
    np.testing.assert_allclose(link_bounds.nlos_efficiency(0.1, 5.0, std, 0.0), 1.0, atol=1e-9)


def test_expected_information_is_the_mean_over_realised_links():
    places = world(9)
    model = ranging.LinkModel(drop_probability=0.3, reach_m=float(np.median(
        ranging.distances(places[0], ranging.tag_positions(*places[2:], places[1])))))  # fmt: skip
    rng = np.random.default_rng(10)
    masks = [ranging.simulate(*places, NOISE, rng, link_model=model).links for _ in range(4000)]
    want = np.mean([bounds.range_information(*places, NOISE, mask) for mask in masks], axis=0)
    got = link_bounds.expected_information(*places, NOISE, model)
    np.testing.assert_allclose(got, want, atol=0.03 * np.abs(want).max())


def test_the_mean_of_the_bounds_is_above_the_bound_of_the_mean():
    places = world(11, 6, 5)
    model = ranging.LinkModel(drop_probability=0.4)
    prior = np.diag([25.0] * 3 + [4.0] * 3)
    realised = link_bounds.realised_crb(
        *places, NOISE, model, np.random.default_rng(12), 4000, prior
    )
    expected = np.linalg.inv(prior + link_bounds.expected_information(*places, NOISE, model))
    assert np.linalg.eigvalsh(realised - expected).min() > 0
    # And it is the mean of bounds of links that are drawn by the simulator itself.
    rng = np.random.default_rng(13)
    drawn = [
        bounds.pose_crb(
            *places, NOISE, prior, ranging.simulate(*places, NOISE, rng, link_model=model).links
        )
        for _ in range(4000)
    ]
    np.testing.assert_allclose(np.trace(realised), np.trace(np.mean(drawn, axis=0)), rtol=0.03)


def test_expected_information_with_reflected_paths():
    places = world(14)
    base = bounds.range_information(*places, ranging.RangeNoise(0.1))
    model = ranging.LinkModel(nlos_probability=0.2, nlos_bias_m=5.0)
    noise = ranging.RangeNoise(0.1)
    told = {
        known: link_bounds.expected_information(
            *places, noise, model, nlos_std_m=1.0, nlos_known=known
        )
        for known in (False, True)
    }
    assert np.linalg.eigvalsh(base - told[True]).min() > 0
    assert np.linalg.eigvalsh(told[True] - told[False]).min() > 0
    np.testing.assert_allclose(link_bounds.expected_information(*places, noise, model), 0.8 * base)


def test_everything_broadcasts():
    anchors, tags, rotation, translation = random_world(np.random.default_rng(15), 5, 4, (3, 2))
    tags = bodies.pyramid()
    joint = link_bounds.bias_information(anchors, tags, rotation, translation, NOISE)
    model = ranging.LinkModel(0.1, nlos_probability=0.1)
    expected = link_bounds.expected_information(
        anchors, tags, rotation, translation, NOISE, model, nlos_std_m=1.0
    )
    one = anchors[2, 1], tags, rotation[2, 1], translation[2, 1], NOISE
    np.testing.assert_allclose(joint[2, 1], link_bounds.bias_information(*one))
    np.testing.assert_allclose(
        expected[2, 1], link_bounds.expected_information(*one, model, nlos_std_m=1.0)
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: link_bounds.bias_information(*w, NOISE, groups="wall"), "groups must be one of"),
        (lambda w: link_bounds.bias_information(w[0], w[1], w[2], w[3] * np.nan, NOISE),
         "translation must be finite"),
        (lambda w: link_bounds.expected_information(*w, NOISE, 0.1), "link_model must be"),
        (lambda w: link_bounds.expected_information(*w, 0.1, ranging.LinkModel()),
         "noise must be a noise law of rbl_gym.ranging, got 0.1"),
        (lambda w: link_bounds.realised_crb(*w, NOISE, ranging.LinkModel(), 7),
         "rng must be a numpy.random.Generator, got 7"),
        (lambda w: link_bounds.realised_crb(
            *w, NOISE, ranging.LinkModel(), np.random.default_rng(1), 0),
         "draws must be an int from 1 to 1000000, got 0"),
        (lambda w: link_bounds.nlos_efficiency(1.1, 5, 0.1), "probability must be a finite number"),
        (lambda w: link_bounds.nlos_efficiency(0.1, 5, 0.0), "std_m must be positive, got 0.0"),
        (lambda w: link_bounds.with_biases(np.eye(6), 0.1, 0), "n_biases must be an int from 1 to"),
        (lambda w: link_bounds.marginal_information(np.eye(6)), r"joint must have shape \(..., 6"),
        (lambda w: link_bounds.posterior_bias_step(
            np.eye(8), *w, NOISE, np.zeros(6), 0.1, motion.ProcessNoise(0.1, 0.1)),
         r"J must have shape \(..., 26, 26\) for groups 'link', got \(8, 8\)"),
    ],
)  # fmt: skip
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(world(16))
