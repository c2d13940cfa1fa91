"""Layouts of anchors from CSV files, and errors in them."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.placement import layout_files


def read(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(encoding))
    return layout_files.read_layout(str(path))


@pytest.mark.parametrize(
    "text",
    [
        "x_m,y_m,z_m,name\n1,2,3,a\n-4.5,0,1e1,b c\n",
        "name; z_m; note; Y_M; x_m\r\na;3;;2;1\r\n\r\n b c;10;;0;-4.5\r\n",
        '\ufeffname,x_m,y_m,z_m\na,1,2,3\n"b c",-4.5,0,10',
        "anchor,x,y,z\na,1,2,3\nb c,-4.5,0,10\n",
        "X,y,z_m,id\n1,2,3,a\n-4.5,0,10,b c\n",
    ],
)
def test_columns_are_found_by_their_names(tmp_path, text):
    found = read(tmp_path, text)
    assert isinstance(found, layout_files.Layout)
    assert found.names == ("a", "b c")
    np.testing.assert_array_equal(found.positions, [[1, 2, 3], [-4.5, 0, 10]])


def test_anchors_without_names_are_counted(tmp_path):
    assert read(tmp_path, "x_m,y_m,z_m\n0,0,0\n1,1,1\n").names == ("1", "2")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line must name the columns"),
        ("x,y\n1,2\n", "(or x, y, z) and optionally name; z_m not found in 'x,y'"),
        ("x,y,z\n1,2,high\n", "line 2, column z: must be a number, got 'high'"),
        ("x_m,y_m,z_m\n", "must have at least one anchor"),
        ("x_m,y_m,z_m\n1,2,3\n1,2\n", "line 3: must have 3 cells like the header, got 2"),
        ("x_m,y_m,z_m\n1,2,high\n", "line 2, column z_m: must be a number, got 'high'"),
        ("x_m,y_m,z_m\n1,nan,3\n", "line 2, column y_m: must be a number, got 'nan'"),
        ("name,x_m,y_m,z_m\na,1,2,3\na,1,2,4\n", "line 3, column name: every anchor"),
        ('x_m,y_m,z_m\n1,2,"3\n', "line 2: "),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=r"a\.csv") as error:
        read(tmp_path, text)
    assert message in str(error.value)


def test_other_encodings_are_refused(tmp_path):
    with pytest.raises(ValueError, match="must be a text in UTF-8"):
        read(tmp_path, "name,x_m,y_m,z_m\n\u00e4,1,2,3\n", "latin-1")
