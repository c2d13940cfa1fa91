"""Units in brackets after the names of columns, in headers and in `Format.columns`."""

from typing import Any

import numpy as np
import pytest

from rbl_gym.recordings import Files, Format, read_odometry, read_recording
from rbl_gym.recordings.inertial import read_inertial
from rbl_gym.recordings.tables import Source
from tests.helpers import ROOT

LOG = ROOT / "examples" / "log"
FILES: dict[str, Any] = {name: LOG / f"{name}.csv" for name in ("ranges", "anchors", "tags")}


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_speeds_and_turn_rates_in_other_units(tmp_path):
    plain = written(tmp_path / "a.csv", "t,speed_ms,turn\n0,1500,90\n1,1400,-90\n")
    columns = {"vx": "speed_ms[mm/s]", "wz": "turn[deg/s]"}
    log = read_odometry(plain, Source(columns, file="odometry"))
    np.testing.assert_allclose(log.readings[:, 3], [1.5, 1.4])
    np.testing.assert_allclose(log.readings[:, 2], [np.pi / 2, -np.pi / 2])
    # The unit of the header comes before the unit of the file.
    headed = written(tmp_path / "b.csv", "t,speed [cm/s],wz (rad/s)\n0,150,0.5\n1,140,0.5\n")
    log = read_odometry(headed, Source({"vx": "speed"}), turn_unit="deg/s")
    np.testing.assert_allclose(log.readings[:, [2, 3]], [[0.5, 1.5], [0.5, 1.4]])
    wheels = written(tmp_path / "c.csv", "t,left [mm/s],right [mm/s],width [cm]\n0,900,1100,40\n")
    np.testing.assert_allclose(read_odometry(wheels).readings, [[0, 0, 0.5, 1.0, 0, 0]])
    # An ending of a name is no unit here: metres per second, not milliseconds.
    named = written(tmp_path / "d.csv", "t,left_ms,right_ms\n0,1,1\n")
    found = read_odometry(named, Source({"left": "left_ms", "right": "right_ms"}), wheelbase_m=1)
    np.testing.assert_allclose(found.readings[0, 3], 1.0)


def test_an_inertial_sensor_states_its_units(tmp_path):
    header = "time,gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]"
    text = f"{header}\n0,0,0,90,0,0,1\n1,0,0,90,0,0,1\n"
    columns = {"time": "time", **{f"w{axis}": f"g{axis}" for axis in "xyz"}}
    log = read_inertial(written(tmp_path / "imu.csv", text), columns=columns)
    np.testing.assert_allclose(log.readings, [[0, 0, np.pi / 2, 0, 0, 9.80665]] * 2, rtol=1e-5)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"odometry.vx": "v[mm]"}, r"unit of vx must be one of m/s, cm/s, mm/s, got 'mm'"),
        ({"odometry.wz": "w[m/s]"}, r"unit of wz must be one of rad/s, deg/s, got 'm/s'"),
        ({"anchors.anchor": "anchor[m]"}, r"unit of anchor cannot be given, got 'm'"),
        ({"range": "range[ms]"}, r"unit of range must be one of m, cm, mm, got 'ms'"),
    ],
)
def test_a_unit_is_never_ignored(tmp_path, columns, message):
    odometry = written(tmp_path / "o.csv", "t,v,w\n0,1,0\n1,1,0\n")
    with pytest.raises(ValueError, match=message):
        read_recording(Files(**FILES, odometry=odometry), format=Format(columns=columns))


def test_the_error_of_large_speeds_names_the_option(tmp_path):
    odometry = written(tmp_path / "o.csv", "t,speed,w\n0,1500,0\n1,1500,0\n")
    columns = {"odometry.vx": "speed"}
    with pytest.raises(ValueError, match=r'--columns "odometry.vx=speed\[mm/s\]"'):
        read_recording(Files(**FILES, odometry=odometry), format=Format(columns=columns))
    columns = {"odometry.vx": "speed[mm/s]"}
    log = read_recording(Files(**FILES, odometry=odometry), format=Format(columns=columns))
    assert log.odometry is not None
    np.testing.assert_allclose(log.odometry.readings[:, 3], 1.5)


def test_a_wide_table_in_millimetres(tmp_path):
    anchors = written(tmp_path / "anchors.csv", "anchor,x,y,z\nA,0,0,0\nB,4,0,0\nC,0,4,0\n")
    wide = "t,r_A,r_B,r_C\n" + "".join(f"{t},2500,2600,2700\n" for t in range(5))
    ranges = written(tmp_path / "ranges.csv", wide)
    format = Format(columns={"range": "r_{anchor}[mm]"})
    log = read_recording(Files(ranges, anchors), format=format)
    np.testing.assert_allclose(log.ranges[0, :, 0], [2.5, 2.6, 2.7])


def test_positions_in_millimetres_name_the_option(tmp_path):
    rows = (LOG / "anchors.csv").read_text(encoding="utf-8").splitlines()
    cells = [row.split(",") for row in rows[1:]]
    many = [",".join([row[0], *(repr(1000 * float(x)) for x in row[1:4])]) for row in cells]
    files: dict[str, Any] = {
        **FILES,
        "anchors": written(tmp_path / "a.csv", "\n".join(["anchor,x,y,z", *many])),
    }
    option = ",".join(f"anchors.{axis}=NAME[mm]" for axis in "xyz")
    with pytest.raises(ValueError, match="cm or mm") as error:
        read_recording(Files(**files))
    assert f'--columns "{option}"' in str(error.value)
    columns = {f"anchors.{axis}": f"{axis}[mm]" for axis in "xyz"}
    mended = read_recording(Files(**files), format=Format(columns=columns))
    np.testing.assert_allclose(mended.anchors, read_recording(Files(**FILES)).anchors, atol=1e-9)


def test_a_heading_of_the_truth_names_the_option(tmp_path):
    truth = written(tmp_path / "truth.csv", "t,x,y,heading\n0,1,1,90\n20,1,2,90\n")
    notes = read_recording(Files(**FILES, truth=truth)).report.notes
    assert any("--columns truth.yaw_deg=heading or" in note for note in notes)
    columns = {"truth.yaw_deg": "heading"}
    log = read_recording(Files(**FILES, truth=truth), format=Format(columns=columns))
    assert log.truth is not None
    assert log.truth.rotation is not None


def test_a_format_as_the_second_argument_is_refused():
    with pytest.raises(TypeError, match=r"run must be .* give the format by name"):
        read_recording(Files(**FILES), Format())  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(TypeError, match=r"format must be recordings.Format"):
        read_recording(Files(**FILES), format={})  # pyrefly: ignore[bad-argument-type]
