"""Bounds of links that are lost or reflected: by integrals and Monte Carlo."""

# Worlds are unpacked from sequences of no fixed length.
# pyrefly: ignore-errors[bad-argument-count]
from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from rbl_gym import bounds
from rbl_gym.bounds import links as link_bounds
from rbl_gym.geometry import bodies
from rbl_gym.measurements import ranging
from tests.helpers import random_world

NOISE = ranging.RangeNoise(0.1, 0.01)


def world(seed, m=5, n=4):
    return random_world(np.random.default_rng(seed), m, n)


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
    model = ranging.LinkModel(0.1, nlos_probability=0.1)
    expected = link_bounds.expected_information(
        anchors, tags, rotation, translation, NOISE, model, nlos_std_m=1.0
    )
    one = anchors[2, 1], tags, rotation[2, 1], translation[2, 1], NOISE
    np.testing.assert_allclose(
        expected[2, 1], link_bounds.expected_information(*one, model, nlos_std_m=1.0)
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: link_bounds.expected_information(
            *w[:3], w[3] * np.nan, NOISE, ranging.LinkModel()), "translation must be finite"),
        (lambda w: link_bounds.expected_information(*w, NOISE, 0.1), "link_model must be"),
        (lambda w: link_bounds.expected_information(*w, 0.1, ranging.LinkModel()),
         "noise must be a noise law such as"),
        (lambda w: link_bounds.realised_crb(*w, NOISE, ranging.LinkModel(), 7),
         "rng must be a numpy.random.Generator, such as .*, got 7"),
        (lambda w: link_bounds.realised_crb(
            *w, NOISE, ranging.LinkModel(), np.random.default_rng(1), 0),
         "draws must be an int from 1 to 1000000, got 0"),
        (lambda w: link_bounds.nlos_efficiency(1.1, 5, 0.1), "probability must be a finite number"),
        (lambda w: link_bounds.nlos_efficiency(0.1, 5, 0.0), "std_m must be positive, got 0.0"),
    ],
)  # fmt: skip
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(world(16))
