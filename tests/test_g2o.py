"""Reading planar graphs: g2o and CSV, and what is wrong in them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym.networks import g2o

G2O = """# a small graph
VERTEX_SE2 10 0 0 0
VERTEX_SE2 12 1 0 0.5
FIX 10

EDGE_SE2 10 12 1.0 0.1 0.5 1 2 3 4 5 6
EDGE_SE2 12 40 2.0 0.2 7.0 10 0 0 10 0 10
"""


@pytest.fixture
def written(tmp_path):
    def write(text, name="graph.csv"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_g2o(written):
    graph: Any = g2o.read_graph(written(G2O, "graph.G2O"))
    assert graph.ids.tolist() == [10, 12, 40]
    assert graph.edges.tolist() == [[0, 1], [1, 2]]
    np.testing.assert_allclose(graph.y, [0.5, 7.0 - 2 * np.pi])
    assert graph.displacement.tolist() == [[1.0, 0.1], [2.0, 0.2]]
    assert graph.information[0].tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]


def test_csv_in_all_its_forms(written):
    graph = g2o.read_graph(written("\ufeffi, j,dtheta\r\n0,1,0.5\r\n\r\n# no\r\n1,2,-0.25\r\n"))
    assert graph.edges.tolist() == [[0, 1], [1, 2]]
    assert graph.y.tolist() == [0.5, -0.25]
    assert graph.displacement is None
    assert graph.information is None
    assert g2o.read_graph(written("y,j,i\n0.5,3,1\n")).edges.tolist() == [[0, 1]]
    bearings = g2o.read_graph(written("i,j,a,b\n0,1,0.5,-2.0\n"))
    np.testing.assert_allclose(bearings.y, [0.5 + 2.0 + np.pi - 2 * np.pi])
    full = "i,j,dx,dy,dtheta,I11,I12,I13,I22,I23,I33\n0,1,1,2,3,1,2,3,4,5,6\n"
    whole: Any = g2o.read_graph(written(full))
    assert whole.information[0].tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]


def test_edges_without_information(written):
    mixed = "EDGE_SE2 0 1 1 0 .1\nEDGE_SE2 1 2 1 0 .1 9 0 0 8 0 7\n"
    graph: Any = g2o.read_graph(written(mixed, "a.g2o"))
    assert np.isnan(graph.information[0]).all()
    np.testing.assert_array_equal(graph.information[1], np.diag([9, 8, 7]))
    assert g2o.read_graph(written("EDGE_SE2 0 1 1 0 .1\n", "b.g2o")).information is None
    full = "i,j,dx,dy,dtheta,I11,I12,I13,I22,I23,I33\n0,1,1,2,3,,,,,,\n1,2,1,2,3,9,0,0,8,0,7\n"
    np.testing.assert_array_equal(g2o.read_graph(written(full)).information, graph.information)


def test_keys_beyond_the_whole_numbers_of_floats(written):
    # GTSAM's keys: a letter in the top byte. As floats those of a letter are one and the same.
    keys = [ord("l") * 2**56, ord("x") * 2**56, ord("x") * 2**56 + 1]
    assert float(keys[1]) == float(keys[2])
    text = f"EDGE_SE2 {keys[1]} {keys[2]} 1 0 .1\nEDGE_SE2 {keys[1]} {keys[0]} 1 0 .2\n"
    graph = g2o.read_graph(written(text, "a.g2o"))
    assert graph.ids.tolist() == keys
    assert graph.edges.tolist() == [[1, 2], [1, 0]]
    largest = 2**64 - 1
    table = g2o.read_graph(written(f"i,j,dtheta\n{largest},0,0.5\n"))
    assert table.ids.tolist() == [0, largest]
    assert g2o.read_graph(written("i,j,dtheta\n1.0,2e0,0.5\n")).ids.tolist() == [1, 2]


def test_what_is_no_planar_pose_is_skipped_by_name(written):
    other = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 0 0 0
VERTEX_SE2 7 0 0 0
VERTEX_XY 3 1 2
EDGE_SE2_XY 0 3 1 2 1 0 1
EDGE_SE2_XY 1 3 1 2 1 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1
PARAMS_SE2OFFSET 0 0 0 0
EDGE_SE2 0 1 1 0 0.5 1 0 0 1 0 1
"""
    graph = g2o.read_graph(written(other, "a.g2o"))
    assert graph.ids.tolist() == [0, 1]
    assert graph.skipped == {
        "VERTEX_XY": 1, "EDGE_SE2_XY": 2, "EDGE_SE3:QUAT": 1, "PARAMS_SE2OFFSET": 1,
        "VERTEX_SE2 without an edge": 1,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (
            "i,j,dtheta\n0,1,x\n",
            "a.csv",
            "line 2, column 'dtheta': must be a finite number, got 'x",
        ),
        ("i,j,dtheta\n0,1,nan\n", "a.csv", "got 'nan'"),
        ("i,j,dtheta\n0,1,1_0\n", "a.csv", "got '1_0'"),
        ("i,j,dtheta\n0,1\n", "a.csv", "line 2: must have 3 values, got 2"),
        ("i,j,dtheta\n", "a.csv", "must have an edge, got none"),
        ("", "a.csv", "columns must be i, j and dtheta"),
        ("i,j,angle\n0,1,2\n", "a.csv", "line 1: columns must be .* got 'i, j, angle'"),
        ("i,j,dtheta,dx\n0,1,2,3\n", "a.csv", "columns must be"),
        ("i,j,dtheta\n0.5,1,2\n", "a.csv", "column 'i': must be a whole number.* got 0.5"),
        ("i,j,dtheta\n0,-1,2\n", "a.csv", "column 'j': must be a whole number.* got -1"),
        ("i,j,dtheta\n0,1,2\n3,3,2\n", "a.csv", "line 3, column 'j': must differ from i, got 3"),
        ("EDGE_SE3:QUAT 0 1 2\n", "a.g2o", "a.g2o: must have an edge, .*: 1 EDGE_SE3:QUAT"),
        ("ODOMETRY 0 1 2\n", "a.g2o", "line 1: must start with EDGE_SE2 .* got 'ODOMETRY'"),
        ("EDGE_SE2 0 18446744073709551616 1 0 0\n", "a.g2o", "column 'j': must be a whole number"),
        ("VERTEX_SE2 x 1 1 1\n", "a.g2o", "line 1, column 'id': must be a whole number"),
        ("EDGE_SE2 0 1 1 1 1 1 0 nan 1 0 1\n", "a.g2o", "column 'I13': must be a finite number"),
        ("EDGE_SE2 0 1 2\n", "a.g2o", "line 1: must have 11 values, got 3"),
        ("EDGE_SE2 0 1 1 1 1 -1 0 0 1 0 1\n", "a.g2o", "column 'I11': must not be negative"),
        ("VERTEX_SE2 0 1 1 1\n", "a.g2o", "must have an edge, got no EDGE_SE2"),
    ],
)
def test_what_is_wrong_is_named(written, text, name, message):
    with pytest.raises(ValueError, match=message):
        g2o.read_graph(written(text, name))


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(ValueError, match="No such file"):
        g2o.read_graph(tmp_path / "none.g2o")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\xff")
    with pytest.raises(ValueError, match="must be UTF-8 text"):
        g2o.read_graph(tmp_path / "a.csv")
