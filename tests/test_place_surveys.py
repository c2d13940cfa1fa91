"""The gain of a layout from a better survey or calibrated links."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bounds
from rbl_gym.app.place_survey import survey_table
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.placement import scene_files
from rbl_gym.studies.placing import accuracy, surveys
from rbl_gym.studies.placing.judging import Judged
from rbl_gym.studies.placing.requirements import turns
from rbl_gym.worlds import scenes

ANCHORS = np.array(scenes.SCENES["hall"].anchors)[:7]
PLACES = np.array([[2.0, 1, 1], [-5, 3, 1.5], [10, -4, 2]])


@pytest.fixture(scope="module")
def problem():
    return scene_files.problem("hall", 7)


def test_what_is_known_is_the_accuracy_of_the_problem(problem):
    zone = problem.zones[0]
    got = surveys.surveyed_accuracy(problem, ANCHORS, PLACES, zone)
    want = accuracy.accuracy(problem, ANCHORS, PLACES, zone)
    for mine, plain in zip(got, want, strict=True):
        np.testing.assert_allclose(mine, plain, rtol=1e-9)


def test_unknown_places_and_biases_by_brute_force(problem):
    zone, bias = problem.zones[0], LinkBias(0.07, None, 0.2)
    got = surveys.surveyed_accuracy(problem, ANCHORS, PLACES, zone, 0.04, bias)
    rotation = turns(zone.attitude, accuracy.TURNS)
    share = surveys.link_shares(problem, ANCHORS, PLACES, rotation)
    squares = np.zeros(len(PLACES))
    for k, place in enumerate(PLACES):
        for n, Q in enumerate(rotation):
            distance, J = bounds.range_jacobian(ANCHORS, problem.tags, Q, place)
            unit = J[3:].reshape(3, *distance.shape)
            covariance = np.diag((problem.noise.variance(distance) / share[k, n]).ravel())
            covariance += 0.07**2 * np.eye(distance.size) + 0.2**2
            for m in range(len(ANCHORS)):
                rows = np.zeros((3, *distance.shape))
                rows[:, m] = unit[:, m]
                rows = rows.reshape(3, -1)
                covariance += 0.04**2 * rows.T @ rows
            told = J @ np.linalg.solve(covariance, J.T) + accuracy.prior_of(problem, zone)
            squares[k] += np.trace(np.linalg.inv(told)[3:, 3:]) / len(rotation)
    np.testing.assert_allclose(got.position, np.sqrt(squares), rtol=1e-7)


def test_rows_rise_with_what_is_not_known(problem):
    zone = problem.zones[0]
    errors = accuracy.accuracy(problem, ANCHORS, PLACES, zone)
    rows = surveys.survey_rows(problem, ANCHORS, [Judged(zone, PLACES, errors)])
    assert [row["anchor_std_m"] for row in rows] == [0, 0.01, 0.03, 0.1, 0]
    assert (np.diff([row["score_m"] for row in rows[:4]]) > 0).all()
    assert rows[-1]["position_m"] > rows[0]["position_m"]
    assert rows[-1]["bias_std_m"] > 0
    _, headings, cells = survey_table({"survey": rows})
    assert len(cells) == 5
    assert all(len(row) == len(headings) for row in cells)
