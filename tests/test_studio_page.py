"""The page of the studio, served by viser; and in a browser, where there is one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from rbl_gym import studio
from rbl_gym.placement import scene_files
from rbl_gym.studio import Studio
from tests.helpers import ROOT

pytest.importorskip("viser", reason="needs the extra studio")

WAREHOUSE = str(ROOT / "examples" / "warehouse.toml")


@pytest.fixture
def served(tmp_path) -> Iterator[Studio]:
    options = studio.Options(port=0, folder=tmp_path, browser=False)
    tables = scene_files.load(WAREHOUSE)
    found = studio.show(scene_files.problem(WAREHOUSE), tables=tables, options=options)
    yield found
    found.stop()


def test_a_page_takes_what_it_is_asked_and_saves_it(served, tmp_path):
    page = served.page
    before = page.figures.score_m
    camera = np.array([0.0, -60.0, 50.0])
    for phase, x in (("start", -4.0), ("update", -6.0), ("end", -8.0)):
        page.drag(0, phase, camera, np.array([x, -10.0, 4.0]))
    assert page.settle()
    np.testing.assert_allclose(page.state.anchors[0], [-8.0, -10.0, 4.0])
    assert len(page.state.past) == 1
    assert page.figures.score_m == page.state.score != before
    page.save("hall")
    page.save("../hall")
    assert page.settle()
    saved = scene_files.problem(str(tmp_path / "hall.toml"))
    np.testing.assert_array_equal(saved.fixed, page.state.anchors)
    assert not (tmp_path.parent / "hall.toml").exists()
