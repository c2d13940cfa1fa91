"""docs/your_estimator.md: its blocks run, and its filter enters the leaderboard."""

from __future__ import annotations

import json
import re
import shlex
import sys
import types
from functools import partial
from importlib.metadata import EntryPoint

import pytest

from rbl_gym import estimators
from rbl_gym.app.cli import main
from rbl_gym.estimators.locating import localization
from rbl_gym.testing import check_locator
from tests.helpers import ROOT

TEXT = (ROOT / "docs" / "your_estimator.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """The first block as my_filters.py, where Python finds it."""
    (tmp_path / "my_filters.py").write_text(blocks("python")[0])
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("my_filters", None)


def test_every_python_block_runs(package, monkeypatch, capsys):
    page = types.ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", page)  # its classes can be pickled
    names = vars(page)
    for block in blocks("python"):
        exec(compile(block, "docs/your_estimator.md", "exec"), names)
    assert float(capsys.readouterr().out) < 1.0
    entry = EntryPoint("first-guess", "my_locators:first_guess", localization.ENTRY_POINT_GROUP)
    monkeypatch.setitem(localization.METHODS, entry.name, names["first_guess"])
    check_locator(partial(estimators.locate, method="first-guess"))
    assert len(blocks("python")) == 6


def test_the_template_has_ten_lines_to_write():
    body = blocks("python")[0].split("noise=None):\n", 1)[1].strip().splitlines()
    assert len(body) == 10


def test_its_commands_bring_it_into_the_table(package, monkeypatch, capsys):
    # As the installed command starts: its own folder is searched, the working folder is not.
    monkeypatch.setattr(
        sys, "path", [entry for entry in sys.path if entry not in ("", str(package))]
    )
    monkeypatch.delitem(sys.modules, "my_filters", raising=False)
    lines = blocks("sh")[0].splitlines()
    assert len(lines) == 2
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == "rbl-gym"
        few = ["--trials", "64", "--out", "few.jsonl", "--conditions", "nominal,nlos"]
        assert main([*arguments, *few]) == 0
        assert "my_filters:OnePass" in capsys.readouterr().out
    records = [json.loads(text) for text in (package / "few.jsonl").read_text().splitlines()]
    rmse = {r["filter"]: r["tags_m"]["rmse"] for r in records if r["condition"] == "nominal"}
    assert rmse["my_filters:OnePass"] < 1.15 * rmse["iekf"]
    # It is another filter, and not the one that it inherits from.
    assert rmse["my_filters:OnePass"] != rmse["iekf"]
