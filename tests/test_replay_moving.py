"""Recordings with moving anchors: the same replay as with fixed ones."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.geometry import rotations
from rbl_gym.studies import replay
from tests.helpers import with_kernels
from tests.recorded import ROOM, flight, swaying

TAGS = np.array([[0.3, 0.2, 0], [-0.3, 0.2, 0], [-0.3, -0.2, 0.05], [0.3, -0.2, 0.25]])
SETTINGS = replay.Settings.of(walk_m=0.3, walk_deg=20.0, range_std_m=0.05)


def standing(times):
    """The anchors told at every epoch."""
    return np.tile(ROOM, (len(times), 1, 1))


@pytest.mark.parametrize("options", [{}, {"volume": (0, 8, 0, 6, 0, 3)}, {"below_anchors": True}])
def test_anchors_that_stand_may_be_told_at_every_epoch(options):
    log = flight(TAGS, standing)
    settings = SETTINGS.changed(**options)
    want = replay.replay_recording(log._replace(anchors=ROOM), settings)
    got = replay.replay_recording(log, settings)
    np.testing.assert_array_equal(got.track.translation, want.track.translation)
    np.testing.assert_array_equal(got.track.covariance, want.track.covariance)


@with_kernels
def test_a_track_among_anchors_that_move():
    """0.05 m a range, 24 ranges an epoch: some centimetres; a metre off if they were held still."""
    log = flight(TAGS, swaying)
    moving = replay.replay_recording(log, SETTINGS).figures
    assert moving["position_rmse_m"] < 0.06
    still = replay.replay_recording(log._replace(anchors=log.anchors[0]), SETTINGS).figures
    assert still["position_rmse_m"] > 0.5


def test_a_map_and_anchors_that_move():
    """Coordinates of a map are taken relative to all places of the anchors."""
    shift = np.array([448_262.0, 5_411_932.0, 310.0])
    log = flight(TAGS, swaying)
    assert log.truth is not None
    there = log._replace(
        anchors=log.anchors + shift,
        truth=log.truth._replace(translation=log.truth.translation + shift),
    )
    want = replay.replay_recording(log, SETTINGS).track.translation
    got = replay.replay_recording(there, SETTINGS).track.translation
    np.testing.assert_allclose(got - shift, want, atol=2e-3)


def test_a_flat_array_on_a_body_that_moves_is_planar():
    """Six antennas in a plane on a turning carrier, a body some metres away, in the plane."""
    arms = 0.4 * np.array([[np.cos(a), np.sin(a), 0] for a in np.arange(6) * np.pi / 3])

    def carried(times: np.ndarray) -> np.ndarray:
        turn = rotations.exp(0.5 * times[:, None] * (0.0, 0.0, 1.0))
        place = np.stack([4 - 0.2 * times, 1 + 0 * times, 1.2 + 0 * times], axis=-1)
        return (turn @ arms.T).swapaxes(1, 2) + place[:, None]

    log = flight(TAGS * (1, 1, 0), carried)
    figures = replay.replay_recording(log, SETTINGS.changed(planar=True)).figures
    assert figures["position_median_m"] < 0.3


def test_runs_are_replayed_each_from_its_own_start():
    """Errors together are those of all epochs; a run without truth counts its epochs alone."""
    logs = {"a": flight(TAGS, standing), "b": flight(TAGS, swaying, count=30)}
    logs["none"] = logs["a"]._replace(truth=None)
    found = replay.replay_runs(logs, SETTINGS)
    alone = {run: replay.replay_recording(log, SETTINGS) for run, log in logs.items()}
    for run, one in alone.items():
        np.testing.assert_array_equal(found.runs[run].track.translation, one.track.translation)
    together = found.figures["together"]
    assert (together["epochs"], together["epochs_with_truth"]) == (150, 90)
    squares = [np.square(one.errors.position) for one in alone.values() if one.errors is not None]
    rmse = np.sqrt(np.concatenate(squares).mean())
    assert together["position_rmse_m"] == pytest.approx(rmse)
    assert isinstance(found, replay.ReplayedRuns)
    with pytest.raises(ValueError, match="recordings must hold a run, got none"):
        replay.replay_runs({}, SETTINGS)
