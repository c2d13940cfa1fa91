"""The README: its Python runs as it stands, and its example log gives the figures it states."""

from __future__ import annotations

import json
import re
import shlex

import numpy as np
import pytest

from rbl_gym.app.cli import main
from tests.helpers import ROOT, with_kernels

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_every_python_block_of_the_readme_runs(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert np.isfinite([float(word) for word in capsys.readouterr().out.split()]).all()


@with_kernels
def test_the_example_log_gives_the_figures_of_the_readme(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    command = re.search(r"^rbl-gym (replay .*?)\n```", README, re.DOTALL | re.MULTILINE)
    stated = re.search(r"RMSE of ([\d.]+) m in position and ([\d.]+) degrees in yaw", README)
    assert command
    assert stated
    words = shlex.split(command[1].replace("\\\n", " "))
    assert main([*words, "--json", "figures.json"]) in (0, None)
    found = json.loads((tmp_path / "figures.json").read_text())["smoothed"]
    assert found["position_rmse_m"] == pytest.approx(float(stated[1]), abs=0.002)
    assert found["yaw_rmse_deg"] == pytest.approx(float(stated[2]), abs=0.1)
    assert (tmp_path / "out" / "track.png").stat().st_size > 10_000
