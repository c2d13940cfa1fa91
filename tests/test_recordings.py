"""Recordings: the arrays have the values of the files, and errors name file, line and column."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from rbl_gym.geometry import rotations
from rbl_gym.recordings import Files, Recording, Truth, read_recording, truth_at

DATA = Path(__file__).parents[2] / "shared" / "data" / "lias_planar"

ANCHORS = "anchor,x,y,z\nA,0,0,1\nB,4,0,1\nC,0,4,2\n"
TAGS = "tag,x,y,z\n1,0.1,0,0\nleft,-0.1,0.1,0\n"
LONG = """t,anchor,tag,range
0.0,A,1,2.5
0.0,A,left,2.25
0.0,C,1,3.0
0.1,B,left,1.5
"""
WIDE = "t,aAt1,aAtleft,aCt1,aBtleft\n0.0,2.5,2.25,3.0,\n0.1,,,,1.5\n"
LONG_STD = """t,anchor,tag,range,std,valid
0.0,A,1,2.5,0.1,1
0.0,A,left,2.25,0.1,1
0.0,B,1,-1,,0
0.0,B,left,,,1
0.0,C,1,3.0,0.2,1
0.1,A,1,70000,0,0
0.1,B,left,1.5,0.1,1
"""
TRUTH = "t,x,y,z,qw,qx,qy,qz\n0,1,2,3,1,0,0,0\n1,2,2,3,0.6,0,0,0.8\n"
PLANAR = "t,x,y,yaw_deg\n0,1,2,90\n1,2,2,180\n"
CALIBRATION = "anchor,tag,bias_m,slope,sigma_m\nA,1,0.5,0.25,0.01\nC,1,3.5,0,\n"


def write(folder: Path, **texts: str | bytes) -> dict[str, Any]:
    """Files of these texts, by their names."""
    for name, text in texts.items():
        data = text.encode() if isinstance(text, str) else text
        (folder / f"{name}.csv").write_bytes(data)
    return {name: folder / f"{name}.csv" for name in texts}


def write_and_read(folder: Path, ranges: str | bytes = LONG, **texts: str | bytes) -> Recording:
    """The recording of these texts, each written to `folder` as the file of its name."""
    texts = {"ranges": ranges, "anchors": ANCHORS, "tags": TAGS} | texts
    return read_recording(Files(**write(folder, **texts)))


def poses_at(*args: Any, **options: Any) -> Any:
    """`truth_at` of a truth with rotations."""
    return truth_at(*args, **options)


def assert_same(got: Recording, want: Recording) -> None:
    assert got.anchor_ids == want.anchor_ids
    assert got.tag_ids == want.tag_ids
    for name in ("times", "ranges", "links", "range_std", "anchors", "tags"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)


def test_long_table(tmp_path):
    log = write_and_read(tmp_path)
    np.testing.assert_array_equal(log.times, [0.0, 0.1])
    np.testing.assert_array_equal(log.ranges[0], [[2.5, 2.25], [0, 0], [3, 0]])
    np.testing.assert_array_equal(log.ranges[1], [[0, 0], [0, 1.5], [0, 0]])
    np.testing.assert_array_equal(log.links, log.ranges > 0)
    assert log.links.dtype == np.bool_
    np.testing.assert_array_equal(log.anchors, [[0, 0, 1], [4, 0, 1], [0, 4, 2]])
    np.testing.assert_array_equal(log.tags, [[0.1, 0, 0], [-0.1, 0.1, 0]])
    assert log.anchor_ids == ("A", "B", "C")
    assert log.tag_ids == ("1", "left")
    assert log.range_std is None
    assert log.truth is None


def test_wide_equals_long(tmp_path):
    assert_same(write_and_read(tmp_path, WIDE), write_and_read(tmp_path, LONG))


SPELLINGS: dict[str, str | bytes] = {
    "byte order mark": LONG.encode("utf-8-sig"),
    "crlf": LONG.replace("\n", "\r\n"),
    "comments": "# a log\n\n" + LONG.replace("0.1,B", "  # moved\n \n0.1,B"),
    "spaces": LONG.replace(",", " ,  "),
    "quotes": LONG.replace("left", '"left"'),
    "no newline at the end": LONG.rstrip("\n"),
    "empty range": LONG + "0.1,A,1,\n",
    "semicolons": LONG.replace(",", ";"),
    "decimal commas": LONG.replace(",", ";").replace(".", ","),
    "tabs": LONG.replace(",", "\t"),
    "tabs and decimal commas": LONG.replace(",", "\t").replace(".", ","),
    "white space": LONG.replace(",", "   "),
    "header in a comment": "# made by a logger, 2024\n#" + LONG,
    "header in a comment, spaces": "# " + LONG.replace(",", " "),
    "crlf and semicolons": LONG.replace(",", ";").replace("\n", "\r\n"),
    "delimiter at the end": LONG.replace("\n", ",\n"),
    "delimiter at the end of rows": LONG.replace("\n", ",\n").replace("range,", "range"),
    "other names": LONG.replace("t,anchor,tag,range", "Timestamp,anchor_id,tag_id,distance"),
    "units in the header": LONG.replace("t,", "time [s],", 1).replace("range", "range (m)"),
    "ids as floats": LONG.replace(",1,", ",1.0,"),
    "ids in capitals": LONG.replace("left", "LEFT").replace("A", "a"),
    "a spreadsheet's first line": "SEP=;\r\n" + LONG.replace(",", ";").replace("\n", "\r\n"),
    "more columns": LONG.replace("\n", ",-80\n").replace("range,-80", "range,rssi"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_spellings_of_one_log(tmp_path, spelling):
    assert_same(write_and_read(tmp_path, SPELLINGS[spelling]), write_and_read(tmp_path, LONG))


def test_first_column_may_be_called_id(tmp_path):
    named = {"anchors": ANCHORS.replace("anchor", "id"), "tags": TAGS.replace("tag", "id")}
    assert_same(write_and_read(tmp_path, **named), write_and_read(tmp_path))


def test_std_and_valid(tmp_path):
    log = write_and_read(tmp_path, LONG_STD)
    assert log.range_std is not None
    np.testing.assert_array_equal(log.range_std[0], [[0.1, 0.1], [0, 0], [0.2, 0]])
    np.testing.assert_array_equal(log.range_std[1], [[0, 0], [0, 0.1], [0, 0]])
    assert_same(log._replace(range_std=None), write_and_read(tmp_path))


def test_calibration(tmp_path):
    raw = write_and_read(tmp_path, LONG_STD)
    log = write_and_read(tmp_path, LONG_STD, calibration=CALIBRATION)
    assert log.range_std is not None
    np.testing.assert_allclose(log.ranges[0], [[2.0 / 1.25, 2.25], [0, 0], [0, 0]])
    np.testing.assert_allclose(log.range_std[0], [[0.1 / 1.25, 0.1], [0, 0], [0, 0]])
    assert not log.links[0, 2, 0], "3.0 m with a bias of 3.5 m cannot be a distance"
    np.testing.assert_array_equal(log.ranges[1], raw.ranges[1])


def test_calibration_makes_no_links(tmp_path):
    text = "anchor,tag,bias_m,slope\nB,1,-0.5,0\n"
    assert_same(write_and_read(tmp_path, calibration=text), write_and_read(tmp_path))


def test_truth_files(tmp_path):
    truth: Any = write_and_read(
        tmp_path, truth=TRUTH.replace("0.6,0,0,0.8", "0.603,0,0,0.804")
    ).truth
    assert truth is not None
    np.testing.assert_array_equal(truth.times, [0, 1])
    np.testing.assert_array_equal(truth.translation, [[1, 2, 3], [2, 2, 3]])
    want = Rotation.from_quat([[0, 0, 0, 1], [0, 0, 0.8, 0.6]]).as_matrix()
    np.testing.assert_allclose(truth.rotation, want, atol=1e-15)

    planar: Any = write_and_read(tmp_path, truth=PLANAR).truth
    assert planar is not None
    np.testing.assert_array_equal(planar.translation, [[1, 2, 0], [2, 2, 0]])
    np.testing.assert_allclose(rotations.yaw(planar.rotation), [np.pi / 2, np.pi], atol=1e-15)
    with_z = "t,x,y,z,yaw_deg\n0,1,2,5,90\n1,2,2,6,180\n"
    lifted = write_and_read(tmp_path, truth=with_z).truth
    assert lifted is not None
    np.testing.assert_array_equal(lifted.translation[:, 2], [5, 6])


# What is wrong, the files that differ from the good ones, what the message says.
ERRORS = {
    "empty": ({"ranges": ""}, r"ranges.csv: the file is empty; it must have a header"),
    "only comments": (
        {"tags": "# none\n\n"},
        r"tags.csv: the file is empty; it must have a header",
    ),
    "header only": ({"anchors": "anchor,x,y,z\n"}, r"anchors.csv: must have rows below the header"),
    "binary": ({"ranges": b"\x93NUMPY\x01\x00"}, r"ranges.csv: must be UTF-8 text, .* at byte 0"),
    "utf-16": ({"tags": TAGS.encode("utf-16")}, r"tags.csv: must be UTF-8 text"),
    "zeros": (
        {"ranges": b"\0\0\0\n\0"},
        r"ranges.csv, line 1: no column of ranges found.* --columns time=NAME,",
    ),
    "open quote": ({"tags": TAGS + '"3,0,0,0\n'}, r"tags.csv, line \d: unexpected end of data"),
    "ragged": ({"ranges": LONG + "0.2,A,1\n"}, r"ranges.csv, line 6: must have 4 .*, got 3"),
    "ragged wide": ({"ranges": WIDE + "0.2\n"}, r"ranges.csv, line 4: must have 5 .*, got 1"),
    "missing column": (
        {"anchors": "anchor,x,z\nA,0,0\n"},
        r"anchors.csv, line 1: missing column 'y', got \['anchor', 'x', 'z'\]; .* anchors.y=NAME$",
    ),
    "missing range": (
        {"ranges": "# x\nt,anchor,tag\n0,A,1\n"},
        r"ranges.csv, line 2: missing column 'range'",
    ),
    "duplicate column": (
        {"tags": "tag,x,y,z,x\n1,0,0,0,0\n"},
        r"tags.csv, line 1: two columns have the name 'x'",
    ),
    "two pairs fit": (
        {
            "ranges": "t,a1t2t3\n0,1\n",
            "anchors": "id,x,y,z\n1,0,0,0\n1t2,1,0,0\n",
            "tags": "id,x,y,z\n3,0,0,0\n2t3,0,0,0\n",
        },
        r"ranges.csv: the name of column 'a1t2t3' fits two links",
    ),
    "not a number": (
        {"ranges": LONG.replace("3.0", "three")},
        r"ranges.csv, line 4, column 'range': must be a finite number, got 'three'",
    ),
    "underscore": (
        {"anchors": ANCHORS.replace("B,4", "B,1_0")},
        r"anchors.csv, line 3, column 'x': must be a finite number, got '1_0'",
    ),
    "line after comments": (
        {"ranges": "# one\n\n" + WIDE.replace("0.1,,", "# two\n0.1,,x")},
        r"ranges.csv, line 6, column 'aAtleft': must be a finite number, got 'x'",
    ),
    "nan": ({"ranges": WIDE.replace("2.5", "nan")}, r"line 2, column 'aAt1': .*, got 'nan'"),
    "inf": ({"ranges": LONG.replace("2.5", "-inf")}, r"line 2, column 'range': .*, got '-inf'"),
    "empty time": ({"ranges": WIDE + ",1,1,1,1\n"}, r"line 4, column 't': .* number, got ''"),
    "empty coordinate": ({"tags": "tag,x,y,z\n1,0,,0\n"}, r"tags.csv, line 2, column 'y': .*''"),
    "unknown anchor": (
        {"ranges": LONG.replace("B", "E")},
        r"ranges.csv, line 5, column 'anchor': anchor must be one of A, .*, got 'E'",
    ),
    "unknown tag": (
        {"calibration": CALIBRATION.replace("C,1", "C,2")},
        r"calibration.csv, line 3, column 'tag': tag must be one of 1, .*, got '2'",
    ),
    "duplicate id": (
        {"anchors": ANCHORS + "A,9,9,9\n"},
        r"anchors.csv, line 5, column 'anchor': every anchor must have its own id, got 'A'",
    ),
    "empty id": ({"tags": TAGS + ",0,0,0\n"}, r"line 4, column 'tag': every tag must have an id"),
    "calibration twice": (
        {"calibration": CALIBRATION + "A,1,0,0,0\n"},
        r"calibration.csv, line 4, column 'tag': each link must be .*, got \('A', '1'\)",
    ),
    "time falls": (
        {"ranges": LONG + "-1.05,A,1,1\n"},
        r"ranges.csv, line 6, column 't': time must not decrease by more than 1 s .*, got '-1.05'",
    ),
    "truth repeats": ({"truth": TRUTH + "1,0,0,0,1,0,0,0\n"}, r"truth.csv, line 4, column 't'"),
    "zero range": (
        {"ranges": LONG.replace("1.5", "0")},
        r"ranges.csv, line 5, column 'range': range must be positive, got '0'",
    ),
    "negative range": (
        {"ranges": WIDE.replace("2.25", "-2")},
        r"ranges.csv, line 2, column 'aAtleft': range must be positive, got '-2'",
    ),
    "huge range": (
        {"ranges": LONG.replace("3.0", "30000")},
        r"line 4, column 'range': must be at most 10000 m \(looks like mill.*, got '30000'",
    ),
    "huge coordinate": (
        {"anchors": ANCHORS.replace("4,0", "-4e8,0")},
        r"line 3, column 'x': must be at most 100000000 m \(looks like mill.*, got '-4e8'",
    ),
    "huge truth": ({"truth": PLANAR.replace("1,2,2", "1,2,2e9")}, r"truth.csv, line 3, column 'y'"),
    "millimetres": (
        {"ranges": "t,aAt1,aBt1\n0,2500,3500\n"},
        r"ranges.csv: units look inconsistent, the median range is 3000 m and .* lie 2\.\d",
    ),
    "kilometres": (
        {"ranges": "t,aAt1\n0,0.0025\n"},
        r"units look inconsistent, the median range is 0.0025 m",
    ),
    "quaternion norm": (
        {"truth": TRUTH.replace("0.6,", "0.9,")},
        r"truth.csv, line 3, column 'qw': quaternion norm must be 1 within 0.01, got 1.204",
    ),
    "std": (
        {"ranges": "t,anchor,tag,range,std\n0,A,1,2,0\n"},
        r"ranges.csv, line 2, column 'std': must be positive .*, got '0'",
    ),
    "empty std": (
        {"ranges": "t,anchor,tag,range,std\n0,A,1,2,\n"},
        r"ranges.csv, line 2, column 'std': must be positive .*, got ''",
    ),
    "valid": (
        {"ranges": "t,anchor,tag,range,valid\n0,A,1,2,2\n"},
        r"ranges.csv, line 2, column 'valid': must be 0 or 1, got '2'",
    ),
    "slope": (
        {"calibration": "anchor,tag,bias_m,slope\nA,1,0,-1\n"},
        r"calibration.csv, line 2, column 'slope': must be above -1, got '-1'",
    ),
    "no links": (
        {"ranges": "t,aAt1\n0,\n1,\n"},
        r"ranges.csv: must have at least one usable range",
    ),
    "no link is valid": (
        {"ranges": "t,anchor,tag,range,valid\n0,A,1,2,0\n"},
        r"ranges.csv: must have at least one usable range",
    ),
    "calibrated away": (
        {"ranges": "t,aCt1\n0,3\n", "calibration": CALIBRATION},
        r"ranges.csv: must have at least one usable range",
    ),
}


@pytest.mark.parametrize("case", ERRORS)
def test_errors_name_the_place(tmp_path, case):
    files, message = ERRORS[case]
    with pytest.raises(ValueError, match=message):
        write_and_read(tmp_path, **files)


def test_missing_file_and_folder(tmp_path):
    write_and_read(tmp_path)
    good = [tmp_path / f"{name}.csv" for name in ("ranges", "anchors", "tags")]
    with pytest.raises(ValueError, match=r"none.csv: No such file"):
        read_recording(Files(*good, truth=str(tmp_path / "none.csv")))
    with pytest.raises(ValueError, match=r"Is a directory"):
        read_recording(Files(tmp_path, *good[1:]))


def test_one_anchor_has_no_scale(tmp_path):
    log = write_and_read(tmp_path, "t,aAt1\n0,5000\n", anchors="anchor,x,y,z\nA,1,2,3\n")
    assert log.ranges.shape == (1, 1, 2)


@pytest.fixture
def truth() -> Any:
    rng = np.random.default_rng(3)
    times = np.array([0.0, 0.3, 0.5, 2.0, 2.1])
    return Truth(times, rotations.random(rng, (5,)), rng.normal(size=(5, 3)))


def test_truth_at_is_slerp_and_linear(truth):
    times = np.linspace(0.0, 2.1, 97)
    rotation, translation, valid = poses_at(truth, times, max_gap_s=2.0)
    want = Slerp(truth.times, Rotation.from_matrix(truth.rotation))(times).as_matrix()
    np.testing.assert_allclose(rotation, want, atol=1e-12)
    for axis in range(3):
        want = np.interp(times, truth.times, truth.translation[:, axis])
        np.testing.assert_allclose(translation[:, axis], want, atol=1e-12)
    assert valid.all()


def test_truth_at_its_own_times(truth):
    rotation, translation, valid = poses_at(truth, truth.times)
    np.testing.assert_allclose(rotation, truth.rotation, atol=1e-12)
    np.testing.assert_array_equal(translation, truth.translation)
    assert valid.all(), "a pose at the edge of a gap is not inside it"


def test_truth_at_gaps_and_span(truth):
    times = [-0.1, 0.0, 0.4, 0.51, 1.9, 2.05, 2.1, 2.2]
    rotation, translation, valid = poses_at(truth, times)
    np.testing.assert_array_equal(valid, [False, True, True, False, False, True, True, False])
    assert np.isfinite(rotation).all()
    assert np.isfinite(translation).all()
    np.testing.assert_array_equal(translation[[0, -1]], truth.translation[[0, -1]])


def test_truth_at_broadcasts_and_takes_one_pose(truth):
    times = np.linspace(-0.5, 2.5, 12)
    for got, want in zip(poses_at(truth, times.reshape(3, 4)), poses_at(truth, times), strict=True):
        np.testing.assert_array_equal(got.reshape(want.shape), want)
    single = Truth(*(field[:1] for field in truth[:3]))
    rotation, _, valid = poses_at(single, [-1.0, 0.0, 1.0])
    np.testing.assert_array_equal(valid, [False, True, False])
    np.testing.assert_allclose(rotation, np.broadcast_to(truth.rotation[0], (3, 3, 3)), atol=1e-15)


@pytest.mark.parametrize(
    ("times", "gap", "message"),
    [
        ([0.0, np.nan], 0.5, "times must be finite, got nan at index"),
        ([], 0.5, "times must have shape"),
        ([0.0], -1.0, "max_gap_s must be a finite number"),
    ],
)
def test_truth_at_errors(truth, times, gap, message):
    with pytest.raises(ValueError, match=message):
        truth_at(truth, times, gap)


@settings(deadline=None, max_examples=25)
@given(data=st.data())
def test_order_does_not_matter_and_gaps_are_links(tmp_path_factory, data):
    """Rows of an epoch and columns permuted: the same recording; empty cells: no links."""
    folder = tmp_path_factory.mktemp("log")
    shape = (data.draw(st.integers(1, 4)), 3, 2)
    cells = st.none() | st.integers(300, 700).map(lambda centimetres: centimetres / 100)
    size = int(np.prod(shape))
    drawn = data.draw(st.lists(cells, min_size=size, max_size=size).filter(any))
    ranges = np.array([cell or 0.0 for cell in drawn]).reshape(shape)
    anchors, tags = ("A", "B", "C"), ("1", "left")

    rows = []
    for k in range(shape[0]):
        for m, n in data.draw(st.permutations(list(np.ndindex(3, 2)))):
            value = ranges[k, m, n]
            rows.append({"t": k, "anchor": anchors[m], "tag": tags[n], "range": value or ""})
    columns = data.draw(st.permutations(["t", "anchor", "tag", "range"]))
    long = [",".join(columns), *(",".join(str(row[name]) for name in columns) for row in rows)]

    links = data.draw(st.permutations([None, *np.ndindex(3, 2)]))
    wide = [",".join("t" if ij is None else f"a{anchors[ij[0]]}t{tags[ij[1]]}" for ij in links)]
    for k, epoch in enumerate(ranges):
        wide.append(",".join(str(k if ij is None else epoch[ij] or "") for ij in links))

    for lines in (long, wide):
        log = write_and_read(folder, "\n".join(lines))
        np.testing.assert_array_equal(log.times, np.arange(shape[0]))
        np.testing.assert_array_equal(log.ranges, ranges)
        np.testing.assert_array_equal(log.links, ranges > 0)


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the real measurements are not at {DATA}")
def test_real_recording():
    log = read_recording(
        Files(
            DATA / "dynamic_fast_ranges.csv",
            DATA / "anchors_8_14.csv",
            DATA / "tags_8_14.csv",
            DATA / "dynamic_fast_truth.csv",
            DATA / "calibration_8_14.csv",
        )
    )
    assert log.ranges.shape == (13_481, 8, 3)
    assert log.links.any(axis=0).all()
    step = np.diff(log.times)
    assert np.median(step) == pytest.approx(0.010, abs=1e-3)
    assert step.max() == pytest.approx(0.26, abs=0.005)

    assert log.truth is not None
    rotation, translation, valid = poses_at(log.truth, log.times)
    assert valid.all()
    # The motion-capture body is upside down and turned by 7 degrees against the tag table.
    yaw = rotations.yaw(rotation) + np.radians(7)
    planar = rotations.exp(yaw[:, None] * (0.0, 0.0, 1.0))
    tags = log.tags @ np.swapaxes(planar, -1, -2) + translation[:, None]
    tags[..., 2] = log.anchors[:, 2].mean() - 0.08
    distances = np.linalg.norm(log.anchors[:, None] - tags[:, None], axis=-1)
    residuals = (log.ranges - distances)[log.links]
    centre = np.median(residuals)
    assert centre == pytest.approx(0.0, abs=0.02)
    assert 1.4826 * np.median(np.abs(residuals - centre)) == pytest.approx(0.063, abs=0.002)
