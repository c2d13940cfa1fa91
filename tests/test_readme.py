"""The README's Python runs as it stands, block after block."""

from __future__ import annotations

import re

import numpy as np

from rbl_gym import estimators
from rbl_gym.estimators import filter as belief
from tests.helpers import ROOT


def test_every_python_block_of_the_readme_runs(monkeypatch, capsys):
    # What a block registers is forgotten after the test.
    monkeypatch.setattr(belief, "_FACTORIES", dict(belief._FACTORIES))
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert "standstill" in estimators.names()
    assert np.isfinite([float(word) for word in capsys.readouterr().out.split()]).all()
    assert names["estimate"].rank == 6
    assert np.linalg.norm(names["belief"].translation) < 0.5
