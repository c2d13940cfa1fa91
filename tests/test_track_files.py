"""Files of tracks: reading what was written, and the formats of other programs."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym.app.cli import main
from rbl_gym.geometry import rotations
from rbl_gym.recordings import (
    TrackFile,
    check_track_path,
    read_track,
    read_truth,
    write_track,
)
from rbl_gym.studies import replay
from tests import recorded

COUNT = 7


def track(seed=0) -> Any:
    rng = np.random.default_rng(seed)
    L = rng.standard_normal((COUNT, 6, 6))
    return TrackFile(
        1.7e9 + np.cumsum(rng.uniform(0.01, 0.2, COUNT)),
        rotations.random(rng, (COUNT,)),
        rng.standard_normal((COUNT, 3)) * (1e5, 1, 1e-3),
        1e-3 * L @ np.swapaxes(L, 1, 2),
        rng.uniform(0, 50, COUNT),
        rng.integers(1, 24, COUNT),
        rng.integers(0, 7, COUNT),
    )


def test_a_csv_holds_all_of_a_track(tmp_path):
    want = track()
    write_track(tmp_path / "track.csv", want)
    for name in ("new/of/track.csv", "other/track.tum"):  # in folders that are made
        write_track(tmp_path / name, want)
    assert (tmp_path / "new/of/track.csv").read_text() == (tmp_path / "track.csv").read_text()
    got: Any = read_track(tmp_path / "track.csv")
    for name in ("times", "translation", "nis", "dof", "rank"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
    np.testing.assert_allclose(got.rotation, want.rotation, atol=1e-15)
    np.testing.assert_allclose(got.covariance, want.covariance, rtol=1e-14)
    header = (tmp_path / "track.csv").read_text().split("\n")[0]
    assert header.startswith("t,x,y,z,qw,qx,qy,qz,cov_rx_rx,cov_rx_ry,cov_rx_rz,cov_rx_x,")
    assert header.endswith(",cov_z_z,nis,dof,rank")
    # The first row of the upper triangle is in the first columns.
    table = np.genfromtxt(tmp_path / "track.csv", delimiter=",", skip_header=1)
    np.testing.assert_allclose(table[:, 8:14], want.covariance[:, 0], rtol=1e-14)


@pytest.mark.parametrize("ending", [".tum", ".txt"])
def test_tum_is_eight_numbers_between_blanks(ending, tmp_path):
    want = track()
    path = tmp_path / f"track{ending}"
    write_track(path, want)
    table = np.loadtxt(path)
    np.testing.assert_array_equal(table[:, 0], want.times)
    np.testing.assert_array_equal(table[:, 1:4], want.translation)
    turned = Rotation.from_quat(table[:, 4:]).as_matrix()
    np.testing.assert_allclose(turned, want.rotation, atol=1e-14)
    got: Any = read_track(path)
    np.testing.assert_allclose(got.rotation, want.rotation, atol=1e-14)
    assert got[3:] == (None,) * 4
    assert read_truth(path).form == "TUM, poses"


def test_what_a_track_does_not_have_is_not_written(tmp_path):
    want = TrackFile(*track()[:3])
    write_track(tmp_path / "track.csv", want)
    assert (tmp_path / "track.csv").read_text().startswith("t,x,y,z,qw,qx,qy,qz\n")
    assert read_track(tmp_path / "track.csv")[3:] == (None,) * 4
    lost = track()._replace(nis=np.array([1.0, np.inf, 2, 3, 4, 5, 6]), rank=None)
    write_track(tmp_path / "lost.csv", lost)
    np.testing.assert_array_equal(read_track(tmp_path / "lost.csv").nis, lost.nis)


def test_what_is_wrong_is_named(tmp_path):
    with pytest.raises(
        ValueError, match=r"track\.json: the name of a track must end in \.tum or \.txt"
    ):
        check_track_path(tmp_path / "track.json")
    with pytest.raises(ValueError, match=r"must end in"):
        write_track(tmp_path / "track", track())
    with pytest.raises(ValueError, match="rank must have shape"):
        write_track(tmp_path / "track.csv", track()._replace(rank=np.zeros(3, int)))
    with pytest.raises(ValueError, match="covariance must"):
        write_track(tmp_path / "track.csv", track()._replace(covariance=np.zeros((COUNT, 3, 3))))
    path = tmp_path / "track.csv"
    path.write_text("t,x,y,z\n0,1,2,3\n")
    with pytest.raises(ValueError, match=r"track\.csv: a track must have rotations"):
        read_track(path)
    write_track(path, track())
    text = path.read_text()
    path.write_text(text.replace("cov_rx_ry", "other"))
    with pytest.raises(ValueError, match=r"line 1: missing column 'cov_rx_ry'"):
        read_track(path)
    rows = text.split("\n")
    rows[2] = rows[2].rpartition(",")[0] + ",1.5"
    path.write_text("\n".join(rows))
    with pytest.raises(ValueError, match=r"line 3, column 'rank': must be a whole number"):
        read_track(path)


ANCHORS = np.array([[0, 0, 0.5], [6, 0, 2], [6, 5, 0.3], [0, 5, 2.5], [3, 2, 3]])
TAGS = np.array([[0.3, 0, 0], [-0.3, 0.2, 0], [0, -0.2, 0.25]])


def log():
    rng = np.random.default_rng(0)
    times = np.arange(20) * 0.1
    points = np.array([3, 2, 1]) + np.stack([0.3 * times, 0 * times, 0 * times], -1)
    ranges = np.linalg.norm(
        ANCHORS[:, None] - (points[:, None, None] + TAGS), axis=-1
    ) + 0.02 * rng.standard_normal((20, 5, 3))
    links = np.ones(ranges.shape, bool)
    links[5], links[6], links[7, 1:] = False, False, False
    links[6, 0, 0] = True
    return recorded.recording(times, ranges * links, ANCHORS, TAGS)


def test_ranks_of_epochs_are_those_of_their_jacobians():
    recording = log()
    found = replay.replay_recording(recording, replay.Settings.of(walk_m=0.3, walk_deg=20))
    file = replay.track_file(recording, found.track)
    ranks = replay.epoch_ranks(recording, found.track)
    np.testing.assert_array_equal(file.rank, ranks)
    assert ranks[5] == 0
    assert ranks[6] == 1
    assert ranks[7] == 3
    assert (np.delete(ranks, [5, 6, 7]) == 6).all()
    np.testing.assert_array_equal(file.covariance, found.track.covariance)
    assert found.track.innovations is not None
    np.testing.assert_array_equal(file.nis, found.track.innovations.nis)
    assert found.figures["microseconds_per_epoch"] > 0


@pytest.mark.parametrize("ending", ["tum", "csv"])
def test_the_command_writes_a_track_that_judges_itself(ending, tmp_path, capsys):
    recording = log()
    seen = recording.links.any(axis=(1, 2))
    ranges = np.where(recording.links, recording.ranges, np.nan)[seen]
    files = recorded.files(tmp_path, ANCHORS, TAGS, recording.times[seen], ranges)
    command = ["replay", *recorded.options(files)]
    path = tmp_path / f"track.{ending}"
    assert main([*command, f"--track={path}"]) == 0
    assert str(path) in capsys.readouterr().out
    assert len(read_track(path).times) == 19
    # Of its own track a run has no errors.
    assert main([*command, f"--truth={path}", "--json", str(tmp_path / "f.json")]) == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["epochs_with_truth"] == 19
    assert figures["position_rmse_m"] < 1e-12
    assert figures["rotation_rmse_deg"] < 1e-10
    assert main([*command, "--track", str(tmp_path / "track.png")]) == 2
    assert "a track must end in" in capsys.readouterr().err
