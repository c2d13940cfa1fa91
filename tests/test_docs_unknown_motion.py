"""The Python of docs/unknown_motion.md runs as it stands, block after block."""

from __future__ import annotations

import re

import numpy as np

from tests.helpers import ROOT


def test_every_python_block_of_the_page_runs(capsys):
    text = (ROOT / "docs" / "unknown_motion.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    names: dict = {}
    for block in blocks:
        exec(compile(block, "unknown_motion.md", "exec"), names)
    assert capsys.readouterr().out.startswith("(6,) (12, 12)\n")
    assert names["stream"].refused == 0
    assert np.isfinite(names["links"].belief(names["stream"]).translation).all()
