"""Files of reference poses: formats of other programs, and errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym.recordings import Files, Truth, read_recording, read_truth, truth_at
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import Source

TIMES = np.array([10.0, 10.5, 11.0])
PLACES = np.array([[1.0, 2.0, 3.0], [1.5, 2.0, 2.5], [2.0, 2.5, 2.0]])
TURNS = Rotation.from_euler("ZYX", [[10, 5, -3], [40, -10, 5], [-170, 20, 80]], degrees=True)


def rows(*columns, between=","):
    table = np.concatenate([np.reshape(column, (3, -1)) for column in columns], axis=1)
    return "".join(between.join(repr(float(x)) for x in row) + "\n" for row in table)


XYZW = TURNS.as_quat()
WXYZ = np.roll(XYZW, 1, axis=-1)
EUROC = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],"
    "q_RS_z [],v_RS_R_x [m s^-1],b_w_RS_S_x [rad s^-1]\n"
)
ROS = "%time,field.header.seq," + ",".join(
    [f"field.pose.position.{a}" for a in "xyz"] + [f"field.pose.orientation.{a}" for a in "xyzw"]
)
EULER = TURNS.as_euler("ZYX", degrees=True)[:, ::-1]
FILES = {
    "TUM, poses": [
        rows(TIMES, PLACES, XYZW, between=" "),
        "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"
        + rows(TIMES, PLACES, XYZW, between=" "),
        rows(TIMES, PLACES, XYZW, between="\t").replace("\n", "\r\n"),
    ],
    "EuRoC/ASL, poses": [
        EUROC + rows(TIMES * 1e9, PLACES, WXYZ, [0, 1, 2], [5, 5, 5]),
        EUROC.replace(" []", "") + rows(TIMES * 1e9, PLACES, WXYZ, [0, 1, 2], [5, 5, 5]),
    ],
    "table, poses": [
        "t,x,y,z,qw,qx,qy,qz\n" + rows(TIMES, PLACES, WXYZ),
        "qx,qy,qz,qw,time [ms],x [cm],y [cm],z [cm]\n" + rows(XYZW, TIMES * 1e3, 100 * PLACES),
        "Timestamp;PX;PY;PZ;Q_W;Q_X;Q_Y;Q_Z\n"
        + rows(TIMES, PLACES, WXYZ, between=";").replace(".", ","),
        ROS + "\n" + rows((TIMES + 1.4e9) * 1e9, [1, 2, 3], PLACES, XYZW),
        "t,x,y,z,roll_deg,pitch_deg,yaw_deg\n" + rows(TIMES, PLACES, EULER),
        "t,x,y,z,roll [rad],pitch [rad],yaw [rad]\n" + rows(TIMES, PLACES, np.radians(EULER)),
    ],
}


@pytest.mark.parametrize(
    ("form", "text"), [(form, text) for form, texts in FILES.items() for text in texts]
)
def test_forms_of_poses(form, text, tmp_path):
    (tmp_path / "truth.txt").write_text(text, newline="")
    found: Any = read_truth(tmp_path / "truth.txt")
    assert found.form == form
    assert not found.planar
    # Stamps of nanoseconds since 1970 are good to half a microsecond.
    np.testing.assert_allclose(found.times % 1e9 % 4e8, TIMES, atol=1e-6)
    np.testing.assert_allclose(found.translation, PLACES, rtol=1e-12)
    np.testing.assert_allclose(found.rotation, TURNS.as_matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("header", "columns", "form", "planar", "heading"),
    [
        ("t,x,y,z", PLACES, "table, positions", False, None),
        ("t,x,y", PLACES[:, :2], "table, positions in x and y", True, None),
        ("t,x,y,yaw_deg", [*np.c_[PLACES[:, :2], [10, 20, 30]]], "table, headings in x and y",
         True, np.radians([10, 20, 30])),
        ("t,x,y,z,yaw_rad", [*np.c_[PLACES, [1, 2, 3]]], "table, headings", False, [1, 2, 3]),
    ],
)  # fmt: skip
def test_positions_and_headings(header, columns, form, planar, heading, tmp_path):
    (tmp_path / "truth.csv").write_text(header + "\n" + rows(TIMES, columns))
    found: Any = read_truth(tmp_path / "truth.csv")
    assert found.form == form
    assert found.planar == planar
    np.testing.assert_array_equal(found.translation, PLACES * (1, 1, not planar))
    if heading is None:
        assert found.rotation is None
        assert truth_at(found, [10.2])[0] is None
    else:
        want = Rotation.from_rotvec(np.outer(heading, [0, 0, 1])).as_matrix()
        np.testing.assert_allclose(found.rotation, want, atol=1e-12)
    np.testing.assert_allclose(truth_at(found, [10.25])[1][0, :2], [1.25, 2.0])


def test_columns_are_mapped_and_what_is_not_read_is_named(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text("when,east,north,up,x\n" + rows(TIMES, PLACES, [7, 7, 7]))
    said = Said()
    names = {"time": "when", "x": "east", "y": "north", "z": "up"}
    found: Any = read_truth(path, Source(names), said)
    np.testing.assert_array_equal(found.translation, PLACES)
    assert isinstance(found, Truth)
    path.write_text("t,x,y,z,speed\n" + rows(TIMES, PLACES, [7, 7, 7]))
    read_truth(path, said=(said := Said()))
    assert said.report().notes == (f"{path}: columns not read: speed.",)


QUATERNION = "t,x,y,z,qw,qx,qy,qz\n"
REFUSED = {
    "no unit of the angle": ("t,x,y,yaw\n1,1,1,1\n", "line 1: column 'yaw' must state its unit"),
    "both units": ("t,x,y,yaw_deg,yaw_rad\n1,1,1,1,1\n", "must have one of the columns"),
    "half a quaternion": ("t,x,y,z,qw,qx\n1,1,1,1,1,0\n", "line 1: missing columns 'qy', 'qz'"),
    "roll alone": ("t,x,y,z,roll_deg\n1,1,1,1,1\n", "missing columns 'pitch_deg', 'yaw_deg'"),
    "no pitch": ("t,x,y,z,roll_deg,yaw_deg\n1,1,1,1,1,1\n", "missing column 'pitch_deg'"),
    "no y": ("t,x,z\n1,1,1\n", "line 1: missing column 'y'"),
    "two places": ("t,px,tx,y\n1,1,1,1\n", "line 1: missing column 'x'"),
    "no time": ("x,y,z\n1,1,1\n", "line 1: missing column 't'"),
    "numbers alone": ("1,1,2,3,0,0,0,1\n2,1,2,3,0,0,0,1\n", "line 1: must have the names"),
    "eleven columns": ("1 1 2 3 0 0 0 1 0 0 0\n" * 2, "line 1: must have the names"),
    "a word in TUM": ("1 1 2 3 0 0 0 1\n2 1 x 3 0 0 0 1\n", r"line 2, column 'y': .* got 'x'"),
    "backwards": ("2 1 2 3 0 0 0 1\n# x\n1 1 2 3 0 0 0 1\n", "line 3, column 't': time must"),
    "long quaternion": (QUATERNION + "1,1,2,3,1,0,0,0.5\n", "line 2, column 'qw': quaternion norm"),
    "wide angle": ("t,x,y,yaw_rad\n1,1,2,1e9\n", "line 2, column 'yaw_rad': must be at most"),
    "nan": (EUROC + "1e9,nan,2,3,1,0,0,0,1,1\n", "line 2, column 'p_RS_R_x': must be a finite"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_is_named(name, tmp_path):
    text, message = REFUSED[name]
    path = tmp_path / "truth.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"truth\.csv, .*{message}"):
        read_truth(path)


def test_the_unit_of_an_angle_is_stated_as_the_error_says(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text("t,x,y,yaw\n1,1,2,0.5\n")
    told = r"--columns truth.yaw_rad=yaw or --columns truth.yaw_deg=yaw$"
    with pytest.raises(ValueError, match=f"yaw_deg or yaw_rad, or state it by {told}"):
        read_truth(path, Source(file="truth"))
    found: Any = read_truth(path, Source({"yaw_rad": "yaw"}, file="truth"))
    np.testing.assert_allclose(found.rotation[0], Rotation.from_euler("z", 0.5).as_matrix())


def test_a_recording_takes_it(tmp_path):
    (tmp_path / "a.csv").write_text("anchor,x,y,z\nA,0,0,1\nB,4,0,1\nC,0,4,2\n")
    (tmp_path / "r.csv").write_text("t,anchor,range\n10,A,2.5\n10,B,3\n10.1,C,2.5\n")
    (tmp_path / "t.tum").write_text(FILES["TUM, poses"][0])
    log = read_recording(Files(tmp_path / "r.csv", tmp_path / "a.csv", truth=tmp_path / "t.tum"))
    assert log.truth is not None
    assert log.truth.form == "TUM, poses"
    (tmp_path / "c.csv").write_text("t,x,y,z\n" + rows(TIMES, PLACES))
    for relative in (False, True):
        with pytest.raises(ValueError, match=r"c\.csv: the poses of a carrier must have rotations"):
            read_recording(
                Files(
                    tmp_path / "r.csv",
                    tmp_path / "a.csv",
                    truth=tmp_path / "t.tum",
                    carrier=tmp_path / "c.csv",
                    relative=relative,
                )
            )
