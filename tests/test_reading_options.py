"""Logs in the style of public data sets, and those sets, into `rbl-gym replay` by options alone."""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
import pytest

from rbl_gym import motion
from rbl_gym.app import reading_options
from rbl_gym.app.cli import main
from rbl_gym.measurements import ranging
from rbl_gym.recordings import Files, Format, read_recording
from tests.helpers import ROOT

DATA = ROOT.parent / "shared" / "data"
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"the real measurements are not at {DATA}"
)
ANCHORS = np.array([[0, 0, 0.3], [8, 0, 2.7], [8, 6, 0.3], [0, 6, 2.7], [4, 0, 2.0], [8, 3, 0.5]])
TAGS = np.array([[0.3, 0.2, 0], [-0.3, 0.2, 0], [-0.3, -0.2, 0.05]])
WALK = ["--walk-m", "0.3", "--walk-deg", "20", "--range-std-m", "0.05"]


@pytest.fixture(scope="module")
def flight():
    """Poses and ranges (40, 6, 3) of a body in a room at 10 Hz."""
    rng = np.random.default_rng(0)
    twists = motion.constant_twist(np.eye(3), [2, 2, 1.2], [0.0, 0, 0.3, 0.4, 0.1, 0], 39)
    path = motion.simulate(twists, 0.1, motion.ProcessNoise())
    points = ranging.tag_positions(path.rotation, path.translation, TAGS)
    exact = ranging.distances(ANCHORS, points)
    return path, exact + 0.05 * rng.standard_normal(exact.shape)


def table(header: str, rows, delimiter: str = ",") -> str:
    lines = [delimiter.join(map(str, row)) for row in rows]
    return "\n".join([header.replace(",", delimiter), *lines, ""])


def points(column: str, names, places) -> str:
    return table(f"{column},x,y,z", ([n, *p] for n, p in zip(names, places.tolist(), strict=True)))


def truth(path, columns: str = "t,x,y,z,yaw_deg") -> str:
    yaw = np.rad2deg(np.arctan2(path.rotation[:, 1, 0], path.rotation[:, 0, 0]))
    values: dict[str, Any] = {
        "t": 0.1 * np.arange(len(yaw)), "yaw_deg": yaw,
        **dict(zip("xyz", path.translation.T, strict=True)),
    }  # fmt: skip
    names = columns.split(",")
    return table(columns, np.stack([values[name] for name in names], axis=-1).tolist())


def replayed(folder, arguments, capsys, **texts: str) -> dict:
    """The figures of `rbl-gym replay` on files of these texts."""
    parts = ["replay", "--json", *WALK, *arguments]
    for name, text in texts.items():
        (folder / f"{name}.csv").write_text(text)
        parts += [f"--{name}", str(folder / f"{name}.csv")]
    assert main(parts) == 0
    return json.loads(capsys.readouterr().out)


def test_one_range_a_row_under_other_names(flight, tmp_path, capsys):
    """Milliseconds and millimetres, raw ranges beside calibrated ones, dirty cells."""
    path, ranges = flight
    rows = [
        [100 * k, f"0x{10 + j:X}", f"T{i}", round(1000 * r[j, i] + 900), round(1000 * r[j, i]), -80]
        for k, r in enumerate(ranges) for j in range(6) for i in range(3)
    ]  # fmt: skip
    for bad, cell in ((7, 0), (50, -1), (51, "nan"), (300, 65535000)):
        rows[bad][4] = cell
    rows[100], rows[103] = rows[103], rows[100]
    figures = replayed(
        tmp_path,
        ["--columns", "time=stamp,anchor=to_id,tag=from_id", "--columns", "range=range_calib",
         "--unit", "mm", "--time-unit", "ms"],
        capsys,
        ranges=table("stamp;to_id;from_id;range;range_calib;rssi".replace(";", ","), rows, "\t"),
        anchors=points("anchor", (f"0x{10 + j:x}" for j in range(6)), ANCHORS),
        tags=points("id", ("T0", "T1", "T2"), TAGS),
        truth=truth(path),
    )  # fmt: skip
    assert figures["epochs"] == 40
    assert figures["links"] == 716
    assert figures["position_rmse_m"] < 0.1
    assert figures["reading"] == {
        "ranges": 720,
        "dropped": {"zero": 1, "negative": 1, "not a number": 1, "too long": 1},
        "sorted_rows": 0,
    }
    assert any("4 of 720 ranges are left out: " in note for note in figures["notes"])
    assert any("not read: range, rssi." in note for note in figures["notes"])


def test_one_tag_and_anchors_beside_the_ranges(flight, tmp_path, capsys):
    path, _ = flight
    rng = np.random.default_rng(1)
    rows = []
    for k, place in enumerate(path.translation):
        anchor = ANCHORS[k % 6]
        r = np.linalg.norm(place - anchor) + 0.05 * rng.standard_normal()
        rows.append([0.1 * k, r, 0.0025, *anchor[:2].tolist(), anchor[2], 105 + k % 6])
    head = "t,range,var,anchor_x,anchor_y,anchor_z,anchor"
    parts = ["replay", "--json", "--ranges", str(tmp_path / "r.csv"), *WALK[:4]]
    (tmp_path / "r.csv").write_text(table(head, rows))
    assert main(parts) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["epochs"] == figures["links"] == 40
    assert figures["settings"]["range_std_m"] == "recorded"


def test_runs_of_one_file(flight, tmp_path, capsys):
    path, ranges = flight
    links = [f"a{j}t{i}" for j in range(6) for i in range(3)]
    rows = [
        [run, 0.1 * k, *np.round(r.ravel(), 3)]
        for run in ("p1", "p2") for k, r in enumerate(ranges)
    ]  # fmt: skip
    files = {
        "ranges": table(",".join(["run", "t", *links]), rows),
        "anchors": points("anchor", range(6), ANCHORS),
        "tags": points("tag", range(3), TAGS),
        "truth": truth(path),
    }
    one = replayed(tmp_path, ["--run", "p2"], capsys, **files)
    assert one["position_rmse_m"] < 0.1
    every = replayed(tmp_path, [], capsys, **files)
    assert [*every["runs"]] == ["p1", "p2"]
    for name in ("position_rmse_m", "yaw_median_deg", "anees"):
        for run in ("p1", "p2"):
            assert every["runs"][run][name] == one[name], "each run from its own start"
    together = every["together"]
    assert (together["epochs"], together["links"], together["epochs_with_truth"]) == (80, 1440, 80)
    for name in ("position_rmse_m", "yaw_rmse_deg", "anees", "position_p95_m"):
        assert together[name] == pytest.approx(one[name], rel=0.1 if "p95" in name else 1e-9)
    arguments = [a for k in files for a in (f"--{k}", str(tmp_path / f"{k}.csv"))]
    assert main(["replay", *WALK, *arguments]) == 0
    assert "together" in capsys.readouterr().out
    assert main(["replay", *arguments, "--plot", str(tmp_path / "x.png")]) != 0
    assert "has 2, ['p1', 'p2']: choose one by --run" in capsys.readouterr().err
    assert main(["replay", *arguments, "--filter", "none"]) != 0
    assert "run 'p1': " in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["replay", "--columns", "time"])
    assert "must be WHAT=NAME,WHAT=NAME,..., got 'time'" in capsys.readouterr().err


def test_strict_refuses_by_line(flight, tmp_path, capsys):
    _, ranges = flight
    rows = [[0.1 * k, "0", "0", r[0, 0]] for k, r in enumerate(ranges)]
    rows[4][3] = 0.0
    (tmp_path / "r.csv").write_text(table("t,anchor,tag,range", rows))
    (tmp_path / "a.csv").write_text(points("anchor", range(6), ANCHORS))
    files = ["--ranges", str(tmp_path / "r.csv"), "--anchors", str(tmp_path / "a.csv")]
    assert main(["replay", *files, "--strict"]) != 0
    error = capsys.readouterr().err
    assert "r.csv, line 6, column 'range': range must be positive, got '0.0'" in error
    assert main(["replay", *files, "--json"]) == 0


LIAS = "--anchors anchors_8_14.csv --tags tags_8_14.csv --calibration calibration_8_14.csv"
MURP = (
    "--ranges trial13_base1_target2.csv --truth trial13_base1_target2.csv "
    "--carrier trial13_base1_target2.csv --anchors antenna_lever_arms_fitted.csv "
    "--tags antenna_lever_arms_fitted.csv --where anchors.agent=1,tags.agent=2 "
    "--columns range=r_{anchor}_{tag},std=sd_{anchor}_{tag},anchors.anchor=antenna "
    "--columns truth.*=B_*,truth.roll_deg=B_roll,truth.pitch_deg=B_pitch,truth.yaw_deg=B_yaw "
    "--columns carrier.*=A_*,carrier.roll_deg=A_roll,carrier.pitch_deg=A_pitch "
    "--columns carrier.yaw_deg=A_yaw,tags.tag=antenna"
)
SETS = {
    "lias_planar": (
        f"--ranges static_ranges.csv --truth static_truth.csv {LIAS} --run 8_14_p1_d0",
        (213, 8, 3), 5112,
    ),
    "starloc_two_tags": (
        "--ranges uwb.csv --anchors anchors.csv --tags tags.csv --truth truth.csv "
        "--columns range=range_calib", (7602, 8, 2), 7602,
    ),
    "labyrinth_single_tag": ("--ranges ranges.csv --truth truth.csv", (233, 4, 1), 233),
    "murp_relative": (MURP, (177, 6, 6), 6372),
    "murp_relative, seen from A": (MURP + " --relative", (177, 6, 6), 6372),
}  # fmt: skip


@needs_data
@pytest.mark.parametrize("name", SETS)
def test_public_sets(name, monkeypatch):
    """Read by the options of the command; not replayed, which takes longer."""
    arguments, shape, links = SETS[name]
    monkeypatch.chdir(DATA / name.split(",")[0])
    parser = argparse.ArgumentParser()
    reading_options.add_reading(parser)
    (log,) = reading_options.read_runs(parser.parse_args(arguments.split())).values()
    assert log.ranges.shape == shape
    assert log.links.sum() == log.report.ranges == links
    assert log.truth is not None
    assert (log.anchors.ndim == 3) == (name == "murp_relative")


@needs_data
def test_ranges_that_a_set_has_calibrated(monkeypatch):
    monkeypatch.chdir(DATA / "starloc_two_tags")
    files: dict[str, Any] = {name: f"{name}.csv" for name in ("anchors", "tags", "truth")}
    log = read_recording(Files("uwb.csv", **files), format=Format(columns={"range": "range_calib"}))
    assert log.range_std is not None
    np.testing.assert_allclose(log.ranges[0].max(), 1.74375)
    np.testing.assert_allclose(log.range_std[0].max(), 0.11086)
    assert log.report.notes == ("uwb.csv: columns not read: range.",)


def test_a_table_of_calibrate_takes_the_columns_of_the_users_own_table(tmp_path):
    rows = [("A", "p", 3.0), ("B", "p", 4.0)]
    (tmp_path / "ranges.csv").write_text(table("t,anchor,tag,range", [(0, *row) for row in rows]))
    (tmp_path / "anchors.csv").write_text(points("anchor", "AB", ANCHORS[:2]))
    own = {"tags.tag": "addr", "tags.x": "bx_mm", "tags.y": "by_mm", "tags.z": "bz_mm"}
    ranges, anchors, tags = (
        str(tmp_path / f"{name}.csv") for name in ("ranges", "anchors", "tags")
    )
    files = Files(ranges, anchors, tags)
    for text in ("addr,bx_mm,by_mm,bz_mm\np,300,-200,50\n", "tag,x,y,z\np,0.3,-0.2,0.05\n"):
        (tmp_path / "tags.csv").write_text(text)
        read = read_recording(files, format=Format(columns=own))
        np.testing.assert_allclose(read.tags, [[0.3, -0.2, 0.05]])
    # Names that the table has are taken, also if they exchange the axes.
    read = read_recording(files, format=Format(columns={"tags.x": "y", "tags.y": "x"}))
    np.testing.assert_allclose(read.tags, [[-0.2, 0.3, 0.05]])
    (tmp_path / "tags.csv").write_text("tag,x,y,z,w\np,0.3,-0.2,0.05,0\n")
    with pytest.raises(ValueError, match="missing column"):
        read_recording(files, format=Format(columns=own))
