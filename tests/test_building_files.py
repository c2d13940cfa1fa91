"""Buildings from files: walls, mounts, zones, and what is refused."""

from __future__ import annotations

import numpy as np

from rbl_gym.placement import building, scene_files
from rbl_gym.placement.file_schema import schema
from tests.helpers import ROOT, needs

SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])


@needs("shapely")
def test_the_office_is_read():
    problem = scene_files.problem(str(ROOT / "examples" / "office.toml"))
    assert isinstance(problem, building.Problem)
    assert problem.name == "office"
    assert [zone.name for zone in problem.zones] == ["open plan", "meeting room"]
    assert all(zone.attitude in building.ATTITUDES for zone in problem.zones)
    assert problem.n_anchors == 8
    assert isinstance(problem.prior, building.Prior)
    assert problem.plan is None
    assert building.Plan().units == "m"
    points = problem.mounts.draw(np.random.default_rng(0).random((500, 3)))
    assert not problem.obstacles.contain(points).any()


def test_free_places_lie_in_the_zone():
    zone = building.Zone("z", np.array([[0.0, 0], [4, 0], [0, 4]]), 0.0, 1.0)
    empty = scene_files.problem("uwb_room").obstacles
    places = building.free_places(zone, empty, 300)
    assert len(places) == 300
    assert (places[:, 0] + places[:, 1] <= 4).all()
    assert zone.contains(places).all()


def test_the_schema_names_every_table():
    assert {"zones", "mounts", "materials", "name"} <= set(schema()["properties"])
