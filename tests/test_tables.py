"""Tables and progress, with and without rich."""

from __future__ import annotations

import sys

import pytest

from rbl_gym.app import tables, terminal
from rbl_gym.app.cli import main
from tests.helpers import needs


@pytest.fixture
def without_rich(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "rich"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rich", None)


def example():
    table = tables.new_table("errors [m]", ["filter"], ["position (m)", "NEES"])
    table.add_row("iekf", "0.0412", "1.02", style="dim")
    table.add_section()
    table.add_row("bound", "0.04")
    table.add_section()
    return table


def test_a_plain_table_has_its_columns_in_line(without_rich, capsys):
    tables.new_console().print(example())
    assert capsys.readouterr().out == (
        "errors [m]\n"
        "filter  position (m)  NEES\n"
        "------  ------------  ----\n"
        "iekf          0.0412  1.02\n"
        "------  ------------  ----\n"
        "bound           0.04\n\n"
    )


@needs("rich")
def test_a_table_by_rich_holds_the_same_text(capsys):
    tables.new_console().print(example())
    shown = capsys.readouterr().out
    for text in ("errors [m]", "filter", "position (m)", "0.0412", "1.02", "bound"):
        assert text in shown


@pytest.mark.parametrize("rich", [pytest.param(True, marks=needs("rich")), False])
def test_a_piped_table_has_the_width_of_the_variable_columns(rich, capsys, monkeypatch, request):
    if not rich:
        request.getfixturevalue("without_rich")
    wide = tables.new_table("wide", ["filter"], [f"figure {k}" for k in range(20)])
    wide.add_row("iekf", *(f"{k}.12345678" for k in range(20)))
    monkeypatch.setenv("COLUMNS", "80")
    tables.new_console().print(wide)
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    assert all(f"{k}.12345678" in shown for k in range(20))
    monkeypatch.delenv("COLUMNS")
    tables.new_console(400).print(wide)
    assert max(map(len, capsys.readouterr().out.splitlines())) > 200


def test_a_plain_table_wider_than_the_terminal_is_split(without_rich, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "21")
    tables.new_console().print(example())
    assert capsys.readouterr().out == (
        "errors [m]\n"
        "filter  position (m)\n"
        "------  ------------\n"
        "iekf          0.0412\n"
        "------  ------------\n"
        "bound           0.04\n\n"
        "filter  NEES\n"
        "------  ----\n"
        "iekf    1.02\n"
        "------  ----\n"
        "bound\n\n"
    )


def test_plain_progress_is_silent_away_from_a_terminal(without_rich, capsys):
    with terminal.progress("replay", 10) as advance:
        advance()
        advance(9)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("rich", [False, True])
def test_long_work_writes_lines_away_from_a_terminal(rich, monkeypatch, capsys):
    known = terminal.has_rich
    monkeypatch.setattr(terminal, "has_rich", lambda: rich and known())
    monkeypatch.setattr(terminal, "_LINE_S", 0.0)
    with terminal.progress("placing", 2) as advance:
        advance(more=1)
        advance()
    assert capsys.readouterr().err.startswith("placing 1/3\nplacing 2/3\n")


def test_plain_progress_counts_on_a_terminal(without_rich, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with terminal.progress("replay") as advance:
        advance(0, more=600)
        advance(0, more=400)
        for _ in range(1000):
            advance()
    shown = capsys.readouterr().err.split("\r")[1:]
    assert len(shown) == 101
    assert shown[1] == "replay 10/1000"
    assert shown[-1] == "replay 1000/1000\n"


@needs("rich")
def test_progress_by_rich_takes_what_is_announced(capsys):
    with terminal.progress("replay", 3) as advance:
        advance(0, more=2)
        advance(4)
    assert "4/5" in capsys.readouterr().err


def test_commands_run_without_rich(without_rich, tmp_path, capsys):
    file = tmp_path / "net.csv"
    file.write_text("i,j,dtheta\n0,1,0.1\n1,2,0.2\n0,2,0.33\n")
    assert main(["network", str(file)]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("edges", "loops"))
