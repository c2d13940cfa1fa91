"""Logs as people have them: other names, units, delimiters, dirty ranges, runs, moving anchors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym.recordings import Files, Format, Recording, Report, read_recording, read_runs
from tests.test_recordings import ANCHORS, LONG, TAGS, TRUTH, WIDE, assert_same, write
from tests.test_recordings import write_and_read as read


def read_as(folder: Path, ranges: str, **options) -> Recording:
    files = write(folder, ranges=ranges, anchors=ANCHORS, tags=TAGS)
    run = options.pop("run", None)
    return read_recording(Files(**files), run=run, format=Format(**options))


def note_of(log: Recording, pattern: str) -> str:
    found = [note for note in log.report.notes if pattern in note]
    assert len(found) == 1, log.report.notes
    return found[0]


def many(count: int = 20, step: float = 0.1, **changes: Any) -> str:
    """A long log of one link, `count` rows; `changes` are cells by row, ``r3="0"``."""
    rows = [f"{step * k:.6g},A,1,{changes.get(f'r{k}', 2.5)}" for k in range(count)]
    return "\n".join(["t,anchor,tag,range", *rows, ""])


def test_columns_are_mapped_and_others_are_named_once(tmp_path):
    text = LONG.replace("t,anchor,tag,range", "time_s,to_id,from_id,range")
    text = text.replace("\n", ",9,x\n").replace("range,9,x", "range,range_calib,rssi")
    columns = {"time": "time_s", "anchor": "to_id", "tag": "from_id", "range": "range_calib"}
    log = read_as(tmp_path, text, columns=columns)
    np.testing.assert_array_equal(log.links, read(tmp_path).links)
    np.testing.assert_array_equal(log.ranges[log.links], 9.0)
    assert note_of(log, "not read").endswith("ranges.csv: columns not read: range, rssi.")


def test_a_column_that_is_mapped_and_not_there(tmp_path):
    with pytest.raises(ValueError, match=r"ranges.csv, line 1: missing column 'to' for anchor"):
        read_as(tmp_path, LONG, columns={"anchor": "to"})
    with pytest.raises(ValueError, match=r"missing column 't', .*; if it .* --columns time=NAME$"):
        read(tmp_path, LONG.replace("t,", "when,", 1))
    message = r"anchors.csv, line 1: missing columns 'x', 'y', 'z', got .* "
    names = "anchors.x=NAME,anchors.y=NAME,anchors.z=NAME"
    with pytest.raises(ValueError, match=f"{message}.*--columns {names}$"):
        read(tmp_path, anchors="anchor,px,py,pz\nA,0,0,1\n")
    # All missing columns of a file are named at once, its own ones in their order.
    header = "stamp_ms,beacon,node,dist_m"
    message = (
        rf"columns 'anchor', 'tag', got {re.escape(repr(header.split(',')))}; if they have .* give "
    )
    with pytest.raises(ValueError, match=f"{message}--columns anchor=NAME,tag=NAME$"):
        read(tmp_path, LONG.replace("t,anchor,tag,range", header, 1))
    columns = {f"anchors.{axis}": f"p{axis}" for axis in "xyz"}
    files = write(tmp_path, ranges=LONG, anchors=ANCHORS.replace("x,y,z", "px,py,pz"), tags=TAGS)
    assert read_recording(Files(**files), format=Format(columns=columns)).anchors.shape == (3, 3)


def test_a_pair_of_columns_the_wrong_way_round(tmp_path):
    text = LONG.replace("t,", "zeit,", 1)
    with pytest.raises(
        ValueError, match=r"'zeit' is not the name of a quantity; did you mean time=zeit\?$"
    ):
        read_as(tmp_path, text, columns={"zeit": "time"})
    assert len(read_as(tmp_path, text, columns={"time": "zeit"}).times) == 2
    files = write(tmp_path, ranges=LONG, anchors=ANCHORS.replace("x", "ost", 1), tags=TAGS)
    with pytest.raises(ValueError, match=r"did you mean anchors.x=ost\?$"):
        read_recording(Files(**files), format=Format(columns={"anchors.ost": "x"}))


def test_wide_columns_by_a_pattern(tmp_path):
    text = "when,r_A_1,r_A_left,r_C_1,r_B_left,sd_A_1,sd_A_left,sd_C_1,sd_B_left\n"
    text += "0.0,2.5,2.25,3.0,,.1,.2,.3,\n0.1,,,,1.5,,,,.4\n"
    columns = {"time": "when", "range": "r_{anchor}_{tag}", "std": "sd_{anchor}_{tag}"}
    log = read_as(tmp_path, text, columns=columns)
    assert_same(log._replace(range_std=None), read(tmp_path, WIDE))
    assert log.range_std is not None
    np.testing.assert_allclose(log.range_std[0], [[0.1, 0.2], [0, 0], [0.3, 0]])
    columns["std"] = "s_{anchor}_{tag}"
    with pytest.raises(ValueError, match=r"line 1: column 'r_A_1' of ranges must have .* like 's_"):
        read_as(tmp_path, text, columns=columns)
    columns["range"] = "r_{tag}_{anchor}"
    with pytest.raises(ValueError, match=r"line 1: no column of ranges .* like 'r_1_A'"):
        read_as(tmp_path, text, columns=columns)


@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize("step", [0.02, 0.1, 1.0])
def test_units_of_time(tmp_path, unit, scale, start, step):
    times = start + step * np.arange(30)
    rows = [f"{scale * t:.0f},A,1,2.5" if unit != "s" else f"{t},A,1,2.5" for t in times]
    text = "\n".join(["t,anchor,tag,range", *rows])
    for options in ({}, {"time_unit": unit}, {"columns": {"time": f"t[{unit}]"}}):
        log = read_as(tmp_path, text, **options)
        np.testing.assert_allclose(log.times, times, atol=1e-6)
        said = any("are read as" in note for note in log.report.notes)
        assert said == (unit != "s" and not options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LONG.replace("0.0,A", "12:00:00.0,A"), "column 't': times of day need a date.*'12:00:00"),
        ("Logger v1, device 7\n" + LONG, "line 2: .*lines above the header.* line 1, must begin"),
        (LONG.replace("2.25", "2,25").replace("2.5", "2,5"), "line 2: .*must be a semicolon or a"),
    ],
)
def test_what_loggers_and_spreadsheets_write_is_explained(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, text)


def test_names_of_columns_in_other_spellings(tmp_path):
    want = read(tmp_path)
    header, *rows = LONG.splitlines()
    assert header == "t,anchor,tag,range"
    texts = {"ranges": "\n".join(["Timestamp (s),Anchor ID,Tag-ID,Distance [m]", *rows])}
    for name, text in (("anchors", ANCHORS), ("tags", TAGS)):
        texts[name] = "\n".join(["ID,X [m],Y [m],Z [m]", *text.splitlines()[1:]])
    found = read(tmp_path, **texts)
    assert_same(found, want)
    assert found.report.notes == ()


@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_unit_of_the_times_of_a_truth(tmp_path, unit, scale):
    """Poses may be rare: the unit follows from the length of the log."""
    rows = [f"{scale * t:.0f},{t},0,0" for t in range(30)]
    log = read(tmp_path, many(300), truth="\n".join(["t,x,y,z", *rows]))
    assert log.truth is not None
    np.testing.assert_allclose(log.truth.times, np.arange(30), atol=1e-9)
    notes = [note for note in log.report.notes if "span about as long as the ranges" in note]
    assert len(notes) == (unit != "s")
    assert all("set --columns truth.time=t[s]" in note for note in notes)
    # A truth of one hour at 100 Hz contains a short log.
    rows = [f"{0.01 * k:.2f},{k},0,0" for k in range(0, 360_000, 1000)]
    rows = [*rows[:1], *(f"{0.01 * k:.2f},{k},0,0" for k in range(1, 500)), *rows[1:]]
    log = read(tmp_path, many(40), truth="\n".join(["t,x,y,z", *rows]))
    assert log.truth is not None
    assert log.truth.times[-1] == 3590.0


def test_unit_of_time_in_the_header(tmp_path):
    for head in ("t [ms]", "time_ms", "timestamp(ms)"):
        text = many(5, 1.0).replace("t,", f"{head},", 1)
        log = read(tmp_path, text)
        np.testing.assert_allclose(log.times, 1e-3 * np.arange(5))
        (note,) = log.report.notes
        assert note.endswith("times are in ms, as the header states.")
    for micro in ("u", "\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"):
        log = read(tmp_path, many(5, 1000.0).replace("t,", f"t [{micro}s],", 1))
        np.testing.assert_allclose(log.times, 1e-3 * np.arange(5))


def test_iso_times(tmp_path):
    stamps = ["2024-05-01T12:00:00Z", "2024-05-01 14:00:00.25+02:00", "2024-05-01T12:00:01,5"]
    rows = [f"{stamp};A;1;2.5" for stamp in stamps]
    log = read(tmp_path, "\n".join(["t;anchor;tag;range", *rows]))
    start = np.datetime64("2024-05-01T12:00:00").astype("datetime64[s]").astype(float)
    np.testing.assert_allclose(log.times - start, [0.0, 0.25, 1.5], atol=1e-6)
    with pytest.raises(ValueError, match=r"line 3, column 't': must be a time of ISO .*'x'"):
        read(tmp_path, f"t,anchor,tag,range\n{stamps[0]},A,1,2\nx,A,1,2\n")


@pytest.mark.parametrize("step", [2, 5, 9])
def test_whole_numbers_some_units_apart(tmp_path, step):
    """Ticks at some hundred a second are likelier than a range every few seconds; both are said."""
    log = read(tmp_path, many(40, step))
    np.testing.assert_allclose(log.times, 1e-3 * step * np.arange(40))
    assert "are read as milliseconds" in note_of(log, f"{step} apart")
    for text in (many(12, step), many(40, step + 0.5)):
        log = read(tmp_path, text)
        assert log.times[1] == float(text.splitlines()[2].split(",")[0])
        assert "read as seconds; set the time unit to ms" in note_of(log, "apart (median)")
    assert read_as(tmp_path, many(40, step), time_unit="s").times[1] == step


@pytest.mark.parametrize(("unit", "scale"), [("m", 1), ("cm", 100), ("mm", 1000)])
def test_units_of_ranges(tmp_path, unit, scale):
    text = f"t,anchor,tag,range,std\n0,A,1,{2.5 * scale},{0.1 * scale}\n0,B,1,{2 * scale},{scale}\n"
    for log in (
        read_as(tmp_path, text, unit=unit),
        read_as(tmp_path, text.replace("range", f"range [{unit}]")),
        read_as(tmp_path, text, columns={"range": f"range[{unit}]"}),
        read_as(tmp_path, text.replace("range", f"range_{unit}")),
    ):
        np.testing.assert_allclose(log.ranges[0, :2, 0], [2.5, 2.0])
        assert log.range_std is not None
        np.testing.assert_allclose(log.range_std[0, :2, 0], [0.1, 1.0])
    own = read_as(tmp_path, text.replace("std", "std [m]"), unit=unit).range_std
    assert own is not None
    np.testing.assert_allclose(own[0, :2, 0], [0.1 * scale, scale])
    with pytest.raises(ValueError, match=r"unit must be one of 'm', 'cm', 'mm', got 'ft'"):
        Format(unit="ft")


BAD = {"zero": "0.0", "negative": "-3", "not a number": "NaN", "too long": "65535"}


@pytest.mark.parametrize("cause", BAD)
def test_what_is_no_measurement_is_dropped_and_counted(tmp_path, cause):
    text = many(20, r3=BAD[cause], r7="", r9=BAD[cause])
    log = read(tmp_path, text)
    assert log.report.dropped == {"empty": 1, cause: 2}
    assert log.report.ranges == 19
    assert note_of(log, "left out").endswith(f"2 of 19 ranges are left out: 2 {cause}.")
    assert log.links.sum() == 17
    assert not log.links[[3, 7, 9]].any()
    with pytest.raises(ValueError, match=rf"ranges.csv, line 5, column 'range': .*{BAD[cause]}"):
        read_as(tmp_path, text, strict=True)


def test_one_zero_in_a_wide_log(tmp_path):
    text = WIDE.replace("2.25", "0.0") + "".join(f"0.{k},2,2,2,2\n" for k in range(2, 8))
    log = read(tmp_path, text)
    assert log.report.dropped == {"empty": 4, "zero": 1}
    assert not log.links[0, 0, 1]
    with pytest.raises(ValueError, match=r"line 2, column 'aAtleft': range must be .*, got '0.0'"):
        read_as(tmp_path, text, strict=True)


def test_a_log_that_is_a_fifth_bad_is_read_and_one_that_is_more_is_refused(tmp_path):
    bad: dict[str, Any] = {f"r{k}": "0" for k in (2, 4)} | {"r5": "-1", "r6": "nan"}
    assert read(tmp_path, many(20, **bad)).links.sum() == 16
    message = r"5 of 20 ranges cannot be used .1 not a number, 3 zero, 1 negative., .* line 4, "
    with pytest.raises(ValueError, match=message):
        read(tmp_path, many(20, **bad, r7="0"))


def test_unknown_ids(tmp_path):
    text = many(20) + "1.9,E,1,2\n1.9,A,7,2\n"
    log = read(tmp_path, text)
    assert log.report.dropped == {"of an unknown anchor": 1, "of an unknown tag": 1}
    assert "1 of an unknown anchor (E), 1 of an unknown tag (7)" in note_of(log, "left out")
    with pytest.raises(ValueError, match=r"line 22, column 'anchor': .* one of A, B, C, got 'E'"):
        read_as(tmp_path, text, strict=True)


def test_a_range_without_its_standard_deviation(tmp_path):
    rows = [f"{0.1 * k:.1f},A,1,2,{0.1 if k else 0}\n" for k in range(9)]
    log = read(tmp_path, "t,anchor,tag,range,std\n" + "".join(rows))
    assert log.report.dropped == {"without a standard deviation": 1}
    assert log.range_std is not None
    np.testing.assert_array_equal(log.range_std > 0, log.links)


def test_variances(tmp_path):
    text = LONG.replace("\n", ",0.04\n").replace("range,0.04", "range,var")
    log = read(tmp_path, text)
    assert log.range_std is not None
    np.testing.assert_allclose(log.range_std[log.links], 0.2)


def test_rows_out_of_order_are_sorted_and_counted(tmp_path):
    lines = many(20).splitlines()
    lines[4:8] = lines[6], lines[4], lines[7], lines[5]
    log = read(tmp_path, "\n".join(lines))
    assert_same(log, read(tmp_path, many(20)))
    assert log.report.sorted_rows == 2
    assert "2 rows come after later ones" in note_of(log, "sorted")
    with pytest.raises(
        ValueError, match=r"line 6, column 't': time must not decrease by more than 0"
    ):
        read_as(tmp_path, "\n".join(lines), strict=True)
    lines[9], lines[20] = lines[20], lines[9]
    with pytest.raises(
        ValueError, match=r"line 21, column 't': time must not decrease .* column run; if the"
    ):
        read(tmp_path, "\n".join(lines))


@pytest.mark.parametrize("wide", [False, True])
def test_rows_that_come_twice(tmp_path, wide):
    text = many(20)
    if wide:
        text = text.replace("anchor,tag,range", "aAt1").replace("A,1,", "")
    row = "1.9,2.5\n" if wide else "1.9,A,1,2.5\n"
    log = read(tmp_path, text + row)
    assert_same(log, read(tmp_path, text))
    assert log.report.dropped == {"repeated": 1}
    other = read(tmp_path, text + row.replace("2.5", "2.6"))
    assert_same(other, log)
    assert "1 twice with two values" in note_of(other, "left out")
    with pytest.raises(ValueError, match=r"line 22, .* only one range .* 'A' and tag '1'"):
        read_as(tmp_path, text + row, strict=True)


def test_coarse_stamps_are_refused(tmp_path):
    """Ten ranges of a link within each second are no log of one range a second."""
    rows = "".join(f"{k // 10},A,1,{2 + 0.01 * k}\n" for k in range(40))
    message = "36 of 40 ranges cannot be used .36 twice with two values., .*stamps too coarse"
    with pytest.raises(ValueError, match=message):
        read(tmp_path, "t,anchor,tag,range\n" + rows)


def test_a_last_line_that_is_cut_off(tmp_path):
    log = read(tmp_path, LONG + "0.2,A")
    assert_same(log, read(tmp_path))
    assert "the last line, 6, is cut off" in note_of(log, "cut off")
    with pytest.raises(ValueError, match=r"ranges.csv, line 6: the last line is cut off"):
        read_as(tmp_path, LONG + "0.2,A", strict=True)


def test_no_header(tmp_path):
    with pytest.raises(
        ValueError, match=r"ranges.csv, line 1: must have the names of the columns, got '0.0,A,"
    ):
        read(tmp_path, LONG.split("\n", 1)[1])


def test_points_and_commas_in_one_column(tmp_path):
    text = many(5).replace(",", ";").replace("0.2;A;1;2.5", "0.2;A;1;2,5")
    with pytest.raises(
        ValueError, match=r"ranges.csv, line 4: must not mix points and commas as dec"
    ):
        read(tmp_path, text)


def test_mac_addresses(tmp_path):
    anchors = "id,x,y,z\nDE:CA:00:01,0,0,1\n0x1F,4,0,1\n"
    text = "t,anchor,tag,range\n0,DE:CA:00:01,1,2\n0,0x1f,1,3\n"
    log = read(tmp_path, text, anchors=anchors)
    assert log.anchor_ids == ("DE:CA:00:01", "0x1F")
    np.testing.assert_array_equal(log.ranges[0, :, 0], [2, 3])


def runs_text(*names: str) -> str:
    rows = [f"{name},{row}" for name in names for row in many(5).splitlines()[1:]]
    return "\n".join(["run,t,anchor,tag,range", *rows, ""])


def test_runs(tmp_path):
    files = write(tmp_path, ranges=runs_text("b", "a"), anchors=ANCHORS, tags=TAGS)
    runs = read_runs(Files(**files))
    assert [*runs] == ["b", "a"]
    for name, log in runs.items():
        assert_same(log, read_recording(Files(**files), run=name))
        assert log.links.sum() == 5
        np.testing.assert_allclose(log.times, 0.1 * np.arange(5))
    with pytest.raises(ValueError, match=r"has 2 runs, \['b', 'a'\]; choose one"):
        read_recording(Files(**files))
    with pytest.raises(ValueError, match=r"has no run 'c', got \['b', 'a'\]"):
        read_recording(Files(**files), run="c")
    files = Files(**write(tmp_path, ranges=many(5), anchors=ANCHORS, tags=TAGS))
    with pytest.raises(ValueError, match="has no run 'c', as it has no column run"):
        read_recording(files, run="c")
    assert [*read_runs(files)] == [""]


def test_truth_of_runs(tmp_path):
    """One pose of each run, without time: the body stands."""
    files = write(
        tmp_path, ranges=runs_text("b", "a"), anchors=ANCHORS, tags=TAGS,
        truth="run,site,x,y,yaw_deg\na,1,1,2,90\nb,1,3,2,0\n",
    )  # fmt: skip
    for name, place in (("a", [1, 2, 0]), ("b", [3, 2, 0])):
        truth = read_runs(Files(**files))[name].truth
        assert truth is not None
        np.testing.assert_array_equal(truth.translation, [place] * 5)
        np.testing.assert_allclose(truth.times, 0.1 * np.arange(5))


def test_one_tag_without_a_table_of_tags(tmp_path):
    text = "t,anchor,range\n0,A,2\n0,C,3\n"
    for ranges in (text, text.replace(",range", ",tag,range").replace(",2", ",x,2")
                   .replace(",3", ",x,3"), "t,aAt7,aCt7\n0,2,3\n"):  # fmt: skip
        log = read_recording(Files(**write(tmp_path, ranges=ranges, anchors=ANCHORS)))
        np.testing.assert_array_equal(log.tags, np.zeros((1, 3)))
        np.testing.assert_array_equal(log.ranges, [[[2], [0], [3]]])
    with pytest.raises(ValueError, match=r"positions of the tags on the body .*left"):
        read_recording(Files(**write(tmp_path, ranges=LONG, anchors=ANCHORS)))
    with pytest.raises(ValueError, match=r"positions of the tags on the body .*left"):
        read_recording(Files(**write(tmp_path, ranges=WIDE, anchors=ANCHORS)))
    with pytest.raises(ValueError, match=r"ranges.csv, line 1: missing column 'tag'"):
        read(tmp_path, text)


def test_anchors_beside_the_ranges(tmp_path):
    text = "t,range,var,anchor_x,anchor_y,anchor\n0.1,2,.01,0,-1,105\n0.2,3,.01,4,2.5,107\n"
    text += "0.3,2.1,.01,0,-1,105\n"
    log = read_recording(Files(**write(tmp_path, ranges=text)))
    assert log.anchor_ids == ("105", "107")
    np.testing.assert_array_equal(log.anchors, [[0, -1, 0], [4, 2.5, 0]])
    np.testing.assert_array_equal(log.ranges[:, :, 0], [[2, 0], [0, 3], [2.1, 0]])
    assert "anchors are 0" in note_of(log, "heights")
    nameless = "\n".join(line.rsplit(",", 1)[0] for line in text.splitlines())
    other = read_recording(Files(**write(tmp_path, ranges=nameless)))
    assert other.anchor_ids == ("0 -1 0", "4 2.5 0")
    np.testing.assert_array_equal(other.ranges, log.ranges)


def test_anchors_beside_the_ranges_move(tmp_path):
    text = "t,anchor,range,ax,ay,az\n0,A,2,0,0,1\n0,B,3,5,5,1\n1,A,2,2,0,1\n2,B,3,5,5,1\n"
    log = read_recording(Files(**write(tmp_path, ranges=text)))
    want = [[[0, 0, 1], [5, 5, 1]], [[2, 0, 1], [5, 5, 1]], [[2, 0, 1], [5, 5, 1]]]
    np.testing.assert_allclose(log.anchors, want)


def test_anchors_that_move(tmp_path):
    """Rows of places and times, in any order, between which an anchor moves straight."""
    anchors = (
        "anchor,t,x,y,z\nA,10,4,0,1\nA,0,0,0,1\nB,0,4,0,1\nC,0,0,4,2\nC,10,0,4,7\nA,20,4,9,1\n"
    )
    rows = "".join(f"{t},A,1,2\n{t},C,1,3\n" for t in (0, 1, 2.5, 5))
    log = read(tmp_path, "t,anchor,tag,range\n" + rows, anchors=anchors)
    t = np.array([0, 1, 2.5, 5])
    fixed = np.zeros(4)
    np.testing.assert_allclose(log.anchors[:, 0], np.stack([0.4 * t, fixed, fixed + 1], -1))
    np.testing.assert_allclose(log.anchors[:, 1], np.tile([4, 0, 1], (4, 1)))
    np.testing.assert_allclose(log.anchors[:, 2], np.stack([fixed, fixed + 4, 2 + 0.5 * t], -1))
    late = "".join(f"{t},A,1,2\n" for t in (28, 29, 40))
    gone = read(tmp_path, "t,anchor,tag,range\n" + rows + late, anchors=anchors)
    assert gone.report.dropped == {"of an anchor without a position at that time": 1}
    rare = "".join(f"A,{t},{t},0,1\n" for t in (0, 1, 2, 3, 9))
    holed = read(tmp_path, anchors="anchor,t,x,y,z\n" + rare + "B,0,4,0,1\nC,0,0,4,2\n")
    assert "'A' has no position for 6 s (usually 1 s)" in note_of(holed, "straight motion")
    still = "anchor,t,x,y,z\nA,0,0,0,1\nA,9,0,0,1\nB,0,4,0,1\nC,0,0,4,2\n"
    np.testing.assert_array_equal(read(tmp_path, anchors=still).anchors, read(tmp_path).anchors)
    with pytest.raises(ValueError, match=r"anchors.csv, line 8, column 't': anchor 'A' must have"):
        read(tmp_path, anchors=anchors + "A,10,5,0,1\n")
    with pytest.raises(
        ValueError, match=r"tags.csv, line 4, column 'tag': every tag must have its"
    ):
        read(tmp_path, tags="tag,t,x,y,z\n1,0,0,0,0\nleft,0,1,0,0\n1,1,0,0,0\n")


def two_bodies(relative: bool, folder: Path) -> tuple[Recording, dict[str, np.ndarray]]:
    """A wide file with the poses of both bodies, as of two agents; arms of both in one file."""
    rng = np.random.default_rng(5)
    times = np.arange(6.0)
    arms = {"1": rng.normal(0, 0.5, (3, 3)), "2": rng.normal(0, 0.5, (2, 3))}
    angles = {name: rng.uniform([-5, -5, -180], [5, 5, 180], (6, 3)) for name in "AB"}
    places = {"A": rng.normal(0, 3, (6, 3)), "B": rng.normal(0, 3, (6, 3)) + [20, 0, 0]}
    turns = {name: Rotation.from_euler("xyz", angles[name], degrees=True) for name in "AB"}
    points = {
        name: np.stack([turns[name].apply(arm) + places[name] for arm in arms[agent]], 1)
        for name, agent in zip("AB", "12", strict=True)
    }
    ranges = np.linalg.norm(points["A"][:, :, None] - points["B"][:, None], axis=-1)
    pose = [f"{n}_{c}" for n in "AB" for c in ("x", "y", "z", "roll", "pitch", "yaw")]
    links = [f"r_{i}_{j}" for i in (1, 2, 3) for j in (1, 2)]
    table = np.column_stack(
        [times, *(a for n in "AB" for a in (places[n], angles[n])), ranges.reshape(6, -1)]
    )
    head = ",".join(["t", *pose, *links])
    text = "\n".join([head, *(",".join(map(repr, row)) for row in table.tolist())])
    rows = [f"{agent},{i},{x!r},{y!r},{z!r}" for agent in arms
            for i, (x, y, z) in enumerate(arms[agent].tolist(), 1)]  # fmt: skip
    files = write(folder, both=text, arms="\n".join(["agent,antenna,x,y,z", *rows]))
    columns = {"range": "r_{anchor}_{tag}", "anchors.anchor": "antenna", "tags.tag": "antenna"}
    for part, name in (("truth", "B"), ("carrier", "A")):
        columns |= {f"{part}.*": f"{name}_*"}
        columns |= {f"{part}.{a}_deg": f"{name}_{a}" for a in ("roll", "pitch", "yaw")}
    log = read_recording(
        Files(
            files["both"],
            files["arms"],
            files["arms"],
            files["both"],
            carrier=files["both"],
            relative=relative,
        ),
        format=Format(columns=columns, where={"anchors.agent": "1", "tags.agent": "2"}),
    )
    return log, {**points, **{f"R{n}": turns[n].as_matrix() for n in "AB"}, **places}


def test_anchors_on_a_body_that_moves(tmp_path):
    log, want = two_bodies(False, tmp_path)
    assert log.anchors.shape == (6, 3, 3)
    assert log.truth is not None
    assert log.truth.rotation is not None
    np.testing.assert_allclose(log.truth.rotation, want["RB"], atol=1e-12)
    tags = np.einsum("kij,nj->kni", log.truth.rotation, log.tags) + log.truth.translation[:, None]
    distances = np.linalg.norm(log.anchors[:, :, None] - tags[:, None], axis=-1)
    np.testing.assert_allclose(distances, log.ranges, atol=1e-12)
    assert not any("not read" in note for note in log.report.notes)


def test_ranges_between_two_bodies_seen_from_one(tmp_path):
    log, want = two_bodies(True, tmp_path)
    assert log.anchors.shape == (3, 3)
    assert log.truth is not None
    assert log.truth.rotation is not None
    want_rotation = np.swapaxes(want["RA"], -1, -2) @ want["RB"]
    np.testing.assert_allclose(log.truth.rotation, want_rotation, atol=1e-12)
    tags = np.einsum("kij,nj->kni", log.truth.rotation, log.tags) + log.truth.translation[:, None]
    distances = np.linalg.norm(log.anchors[:, None] - tags[:, None], axis=-1)
    np.testing.assert_allclose(distances, log.ranges, atol=1e-12)


def test_a_carrier_that_is_nowhere(tmp_path):
    carrier = TRUTH.replace("\n0,", "\n9,").replace("\n1,", "\n10,")
    message = r"carrier.csv: the carrier has no pose at any time .* 0 to 0.1 s, poses 9"
    with pytest.raises(ValueError, match=message):
        read(tmp_path, carrier=carrier)
    log = read(tmp_path, LONG + "1.5,A,1,2\n", carrier=TRUTH)
    assert log.report.dropped == {"where the carrier's pose is not known": 1}
    assert len(log.times) == 2
    with pytest.raises(ValueError, match="relative needs carrier"):
        read_recording(
            Files(**write(tmp_path, ranges=LONG, anchors=ANCHORS, tags=TAGS), relative=True)
        )


def test_heights_that_nobody_tells(tmp_path):
    log = read(tmp_path, anchors="anchor,x,y\nA,0,0\nB,4,0\nC,0,4\n")
    np.testing.assert_array_equal(log.anchors[:, 2], 0.0)
    assert "anchors.csv" in note_of(log, "heights are 0")
    with pytest.raises(ValueError, match=r"anchors.csv, line 1: missing column 'z'"):
        read(tmp_path, anchors="anchor,x,y,height\nA,0,0,1\nB,4,0,1\nC,0,4,1\n")


def test_a_calibration_without_slopes(tmp_path):
    log = read(tmp_path, calibration="anchor,tag,bias_m\nA,1,0.5\nC,1,3.5\n")
    np.testing.assert_allclose(log.ranges[0], [[2.0, 2.25], [0, 0], [0, 0]])
    assert log.report.dropped == {"not positive after calibration": 1}
    assert "1 ranges are not positive" in note_of(log, "after calibration")


def test_units_of_the_header_that_are_none(tmp_path):
    with pytest.raises(ValueError, match=r"line 1, column 'time_m': unit must be one of s, ms"):
        read(tmp_path, LONG.replace("t,", "time_m,", 1))
    with pytest.raises(ValueError, match=r"line 1, column 'range': unit must be one of m, cm"):
        read(tmp_path, LONG.replace("range", "range [s]", 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": {"lidar.x": "x"}}, "one of ranges, anchors, .*; got lidar.x=x"),
        ({"columns": {"time": ""}}, "columns must have keys QUANTITY .*; got time="),
        ({"time_unit": "min"}, r"time_unit must be one of 's', 'ms', .*, got 'min'"),
        ({"where": {"run": "7"}}, r"line 1: no column 'run' to choose rows by, got \['t', "),
        ({"where": {"anchor": "Z"}}, r"line 1: no row has anchor=Z, got \['A', 'B', 'C'\]"),
        ({"columns": {"*": "B_*"}}, r"line 1: no column fits 'B_\*', got \['t', "),
        ({"columns": {"*": "B_"}}, r"the value of \* must have a \*, as in \*=B_\*, got 'B_'"),
        ({"columns": {"range": "r_{tag}"}}, "columns of links must be like .*, got 'r_{tag}'"),
    ],
)
def test_formats_that_do_not_fit(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        read_as(tmp_path, LONG, **options)


def test_a_recording_made_of_arrays_has_an_empty_report(tmp_path):
    log = read(tmp_path)
    bare = Recording(*log[: Recording._fields.index("report")])  # pyrefly: ignore[bad-argument-type]
    assert bare.report == Report() == Report(0, {}, 0, ())
    assert bare.anchors_by_epoch.shape == (2, 3, 3)
    np.testing.assert_array_equal(bare.anchors_by_epoch[1], bare.anchors)


def test_an_anchor_that_is_missing_gives_a_warning(tmp_path):
    text = many(95) + "".join(f"{9.5 + 0.1 * k:.1f},E,1,2\n" for k in range(5))
    (note,) = [note for note in read(tmp_path, text).report.notes if "left out" in note]
    assert note.startswith("WARNING: ")
    assert "(E)" in note
    assert "add it to the table of anchors" in note


def test_swapped_columns_of_anchors_and_tags_are_named(tmp_path):
    text = LONG.replace("t,anchor,tag,range", "t,to,from,range")
    with pytest.raises(ValueError, match='swapped: give --columns "anchor=to,tag=from"'):
        read_as(tmp_path, text, columns={"anchor": "from", "tag": "to"})
    with pytest.raises(ValueError, match="add it to the table of anchors"):
        read_as(tmp_path, LONG.replace("A,", "E,"))
