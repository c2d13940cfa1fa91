"""Reading planar graphs: g2o and CSV, and what is wrong in them."""

# scipy.sparse comes without stubs, and pyright's guesses of it are wrong.
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import g2o

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
    graph = g2o.read_graph(written(G2O, "graph.G2O"))
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
    assert g2o.read_graph(written(full)).information[0].tolist() == [[1, 2, 3], [2, 4, 5],
                                                                     [3, 5, 6]]  # fmt: skip


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
        ("EDGE_SE3 0 1 2\n", "a.g2o", "must be EDGE_SE2, VERTEX_SE2 or FIX .* got 'EDGE_SE3'"),
        ("EDGE_SE2 0 1 2\n", "a.g2o", "line 1: must have 11 values, got 3"),
        ("EDGE_SE2 0 1 1 1 1 -1 0 0 1 0 1\n", "a.g2o", "column 'I11': must not be negative"),
        ("VERTEX_SE2 0 1 1 1\n", "a.g2o", "must have an edge, got none"),
    ],
)
def test_what_is_wrong_is_named(written, text, name, message):
    with pytest.raises(ValueError, match=message):
        g2o.read_graph(written(text, name))


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(ValueError, match="cannot be read"):
        g2o.read_graph(tmp_path / "none.g2o")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\xff")
    with pytest.raises(ValueError, match="must be UTF-8 text"):
        g2o.read_graph(tmp_path / "a.csv")
