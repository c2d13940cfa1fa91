"""Tables of plain numbers, which are not read cell by cell."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.recordings.columns import Columns, plain_numbers
from rbl_gym.recordings.tables import read_table


def test_the_numbers_are_those_of_float():
    rng = np.random.default_rng(0)
    values = rng.normal(0, 10.0 ** rng.integers(-9, 9, (50, 4)))
    cells = [[repr(x) for x in row] for row in values.tolist()]
    cells[3] = ["1", "-2.", "+.5", "1E3"]
    cells[4] = ["", "5e-324", "", ""]
    wanted = [[float(x or "nan") for x in row] for row in cells]
    for mark in ",;\t":
        text = "\n".join(mark.join(row) for row in cells)
        np.testing.assert_array_equal(plain_numbers(text, 4, mark), wanted)


@pytest.mark.parametrize(
    "line",
    ["1,x", "1,2,3", "1", "", "#1,2", "1, 2", "1,nan", "1,1_0", "1,1e999", "1,-", "1,1-2", "1,e5",
     "1,0x1", "1,٣", "1,1e", "1,1.2.3", '"1",2'],
)  # fmt: skip
def test_other_tables_are_read_cell_by_cell(line):
    assert plain_numbers("3,4\n5,6", 2, ",") is not None
    assert plain_numbers(f"3,4\n{line}\n5,6", 2, ",") is None
    assert plain_numbers("3,4\n5,6", 2, None) is None


@pytest.mark.parametrize("other", ["", "# a comment\n"])
def test_the_cells_remain_for_text_and_errors(tmp_path, other):
    path = tmp_path / "log.csv"
    path.write_text(f"t,anchor,range\n0,01,1.50\n{other}1,02,\n2,01,-3\n", encoding="utf-8")
    table = read_table(path)
    assert isinstance(table.columns, Columns)
    assert (table.columns.numbers("t") is None) == bool(other)
    assert [*table.columns] == ["t", "anchor", "range"]
    assert table.text("anchor") == ["01", "02", "01"]
    np.testing.assert_array_equal(table.numbers("range", may_be_missing=True), [1.5, np.nan, -3])
    assert table.empty("range", np.array([0, 1])).tolist() == [False, True]
    with pytest.raises(
        ValueError, match=r"line \d, column 'range': must be a finite number, got ''"
    ):
        table.numbers("range")
    part = table.select(np.array([True, False, True])).select(np.array([False, True]))
    assert part.text("range") == ["-3"]
    assert part.numbers("range").tolist() == [-3]
    assert part.lines.tolist() == [5 if other else 4]
    assert [*part.columns.renamed({"t": "time"})] == ["time", "anchor", "range"]
