"""Building files: walls, mounts, zones, the schema, and errors."""

from __future__ import annotations

import copy
import json
import math
import re
import tomllib
from typing import Any

import numpy as np
import pytest

from rbl_gym.app.cli import main
from rbl_gym.geometry import polygons
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.regions import Box
from rbl_gym.measurements.ranging import RangeNoise
from rbl_gym.placement import building, criteria, scene_files
from rbl_gym.placement.file_keys import FORMAT, MATERIALS
from rbl_gym.placement.file_schema import schema
from rbl_gym.placement.file_tables import read_table
from rbl_gym.placement.wall_lines import wall_pieces
from tests.helpers import ROOT, changed_tables, needs

OFFICE = tomllib.loads((ROOT / "examples" / "office.toml").read_text(encoding="utf-8"))
SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4]]
# A hall without walls, whose anchors stand in a box: needs no shapely.
HALL: dict[str, Any] = {
    "anchors": {"kind": "box", "low": [0, 0, 2], "high": [10, 8, 3], "number": 4},
    "zones": [{"low": [1, 1, 0], "high": [9, 7, 2], "position_m": 0.2}],
    "body": {"shape": "pyramid", "size_m": 0.5},
    "noise": {"floor_m": 0.1},
}


def changed(path: str, value: object, tables: Any = OFFICE) -> dict:
    return changed_tables(tables, path, value)


def anywhere(problem, count=800) -> np.ndarray:
    return problem.mounts.draw(np.random.default_rng(0).random((count, 3)))


# --- what is read ------------------------------------------------------------------------------


@needs("shapely")
def test_the_office_is_read():
    problem = scene_files.problem(str(ROOT / "examples" / "office.toml"))
    assert isinstance(problem, building.Problem)
    assert problem.name == "office"
    assert problem.noise == RangeNoise(0.08, 0.004)
    assert problem.n_anchors == 8
    assert problem.scene.initial_rotation_rad == math.radians(15)
    assert problem.scene.initial_translation_m == 0.5
    assert problem.plan is None
    np.testing.assert_array_equal(problem.fixed, [[23.8, 0.2, 2.6]])
    assert problem.gain.max_range_m == 30
    assert problem.gain.angle_edge_rad == pytest.approx(math.radians(10))
    first, second = problem.zones
    assert (first.name, first.weight, first.attitude) == ("open plan", 2, "level")
    assert (first.position_m, first.heading_deg, first.height_m) == (0.15, 8, None)
    assert (second.share, second.heading_deg) == (0.9, None)
    assert first.has_requirement
    assert {zone.attitude for zone in problem.zones} <= set(building.ATTITUDES)
    # Six pieces of outer wall, three of drywall, the lift shaft and the cupboard.
    assert len(problem.obstacles.prisms) == len(problem.obstacles) == 11
    share = problem.obstacles.prisms.share
    np.testing.assert_array_equal(share[~np.isnan(share)], [0.05, 0.6, 0.6, 0.6])
    assert len(problem.obstacle_names) == 11
    assert problem.obstacle_names[:3] == (
        "lift shaft (15, 4 to 18, 7)", "cupboard (2, 4 to 6, 4.6)", "wall 1 (0, 0 to 24, 0)",
    )  # fmt: skip


@needs("shapely")
def test_mounts_stand_free_and_off_what_is_forbidden():
    problem = scene_files.of_mapping(OFFICE)
    points = anywhere(problem)
    np.testing.assert_allclose(problem.mounts.project(points), points, atol=1e-9)
    ahead = points + 2e-3 * problem.mounts.normal(points)
    assert not problem.obstacles.contain(ahead).any()
    assert not ((points[:, 0] > 23) & (points[:, 1] > 4) & (points[:, 1] < 6)).any()
    names = problem.mounts.names(points)
    assert {name.rstrip(" 123456") for name in names} == {
        "outer wall", "partition", "ceiling", "core",
    }  # fmt: skip
    cost = problem.mounts.cost(points)
    assert all((name == "ceiling") == (c == 1.5) for name, c in zip(names, cost, strict=True))
    # Outer mounts were drawn on the wall's line: they were moved 0.15 m, to its inner face.
    west = [point for point, name in zip(points, names, strict=True) if name == "outer wall 6"]
    np.testing.assert_allclose(np.array(west)[:, 0], 0.15)
    south = [point for point, name in zip(points, names, strict=True) if name == "outer wall 1"]
    np.testing.assert_allclose(np.array(south)[:, 1], 0.15)
    # The two sides of the partition see their own room alone.
    for side, inside, outside in (("partition 2", 5.0, 13.0), ("partition 1", 13.0, 5.0)):
        stand = np.array([p for p, name in zip(points, names, strict=True) if name == side])
        for y, free in ((inside, True), (outside, False)):
            share = problem.obstacles.share(stand, np.array([[8.0, y, 1.0]]))
            assert (share == 1).all() == free
        np.testing.assert_allclose(problem.mounts.normal(stand)[:, 1], np.sign(inside - 10))


@needs("shapely")
def test_only_the_range_and_the_field_of_view_take_from_a_clear_link():
    problem = scene_files.of_mapping(OFFICE)
    anchor = np.array([[0.15, 1.0, 2.5]])  # on the west wall, looks along x
    for point, wanted in (
        ((10.0, 1.0, 1.0), 1.0),
        ((0.3, 8.0, 2.0), 0.0),  # 89 degrees off its axis
        ((10.15, 1.0, 2.5), 1.0),
    ):
        assert problem.share(anchor, np.array([point]))[0, 0] == pytest.approx(wanted)
    assert 0 < problem.share(anchor, np.array([[23.0, 1.0, 2.5]]))[0, 0] <= 1
    far = scene_files.of_mapping(changed("anchors.max_range_m", 20.0))
    assert far.share(anchor, np.array([[21.0, 1.0, 2.5]]))[0, 0] == 0
    half = far.share(anchor, np.array([[0.15 + 17.5, 1.0, 2.5]]))[0, 0]
    assert half == pytest.approx(0.5)


def test_walls_are_mitred_where_they_meet():
    ring = polygons.check_polygon("ring", SQUARE)
    pieces = wall_pieces(ring, 0.5, closed=True)
    # Together they are the frame: no gap, no overlap.
    assert sum(polygons.area(piece) for piece in pieces) == pytest.approx(5**2 - 3**2)
    for corner in ([-0.4, -0.3], [4.4, 4.3], [-0.4, 2.0]):
        held = [polygons.contains(piece, np.array(corner)) for piece in pieces]
        assert sum(held) == 1
    bent = wall_pieces(np.array([[0.0, 0], [4, 0], [4, 4]]), 0.1, closed=False)
    assert sum(polygons.area(piece) for piece in bent) == pytest.approx(2 * 4 * 0.2)
    # Nor do the mitres of a piece cross that is shorter than they are.
    step = wall_pieces(np.array([[0.0, 0], [4, 0], [4, 0.2], [8, 0.2]]), 0.5, closed=False)
    for piece in step:
        polygons.check_polygon("piece", piece)
    # A hairpin is not drawn out to a needle.
    needle = wall_pieces(np.array([[0.0, 0], [4, 0], [0, 0.1]]), 0.1, closed=False)
    assert np.abs(np.concatenate(needle)).max() < 4.5


def test_openings_leave_the_wall_beside_above_and_below_them():
    wall = {"line": [[5, 0], [5, 8]], "thickness_m": 0.2, "high_m": 3, "information": 0.5}
    door = {"line": [[5.05, 4], [5, 3]]}
    window = {"line": [[5, 6], [5, 7]], "low_m": 1, "high_m": 2}
    problem = scene_files.of_mapping(HALL | {"walls": [wall], "openings": [door, window]})
    for y, z, wanted in (
        (2.5, 1.0, 0.5), (3.5, 1.0, 1.0), (3.5, 2.5, 0.5), (3.5, 2.0, 1.0), (5.0, 1.5, 0.5),
        (6.5, 0.5, 0.5), (6.5, 1.5, 1.0), (6.5, 2.5, 0.5), (7.5, 1.5, 0.5),
    ):  # fmt: skip
        share = problem.obstacles.share(np.array([[4.0, y, z]]), np.array([[6.0, y, z]]))
        assert share[0, 0] == wanted, (y, z)
    prisms = problem.obstacles.prisms
    heights = prisms.high_m - prisms.low_m
    volume = sum(polygons.area(ring) * h for ring, h in zip(prisms.corners, heights, strict=True))
    assert volume == pytest.approx(0.2 * (8 * 3 - 1 * 2.1 - 1 * 1))
    assert set(problem.obstacle_names) == {"wall 1 (5, 0 to 5, 8)"}


def test_an_opening_at_a_corner_leaves_simple_pieces():
    ring = {"line": SQUARE, "closed": True, "thickness_m": 0.4, "high_m": 3}
    # Over two walls of the corner (4, 0), and one over the whole height.
    openings = [{"line": [[3, 0], [4, 0], [4, 1]]}, {"line": [[1, 4], [2, 4]], "high_m": 9}]
    zone = {"low": [1, 1, 0], "high": [3, 3, 1]}
    tables = HALL | {"walls": [ring], "openings": openings, "zones": [zone]}
    prisms = scene_files.of_mapping(tables).obstacles.prisms
    for corners in prisms.corners:
        polygons.check_polygon("piece", corners[np.append(True, np.diff(corners, axis=0).any(1))])
    heights = prisms.high_m - prisms.low_m
    volume = sum(polygons.area(ring) * h for ring, h in zip(prisms.corners, heights, strict=True))
    # On the inside the last 0.2 m of each opening are part of the corner.
    door = 2 * 0.4 * 0.5 * (1 + 0.8)
    assert volume == pytest.approx((4.4**2 - 3.6**2) * 3 - 1 * 0.4 * 3 - door * 2.1)


@needs("shapely")
def test_no_anchor_is_mounted_in_an_opening():
    wall = {"line": [[0, 8], [10, 8]], "thickness_m": 0.2, "high_m": 3}
    mount = {"kind": "wall", "line": [[0, 8], [10, 8]], "side": "both", "low_m": 1, "high_m": 2.5}
    tables = HALL | {"anchors": {"number": 4}, "walls": [wall], "mounts": [mount]}
    tables["openings"] = [{"line": [[4, 8], [6, 8]]}]
    problem = scene_files.of_mapping(tables)
    x, _, z = anywhere(problem).T
    assert not ((x > 4.001) & (x < 5.999) & (z < 2.099)).any()
    assert ((x > 4) & (x < 6) & (z > 2.1)).any()
    assert isinstance(problem.mounts, Mounts)
    assert problem.mounts.measure.sum() == pytest.approx(2 * (10 * 1.5 - 2 * 1.1), abs=0.01)


def test_losses_by_material_multiply_and_opaque_ones_count_once():
    tables = HALL | {
        "materials": {"glass": 0.8},
        "walls": [
            {"line": [[2, 0], [2, 8]], "thickness_m": 0.1, "high_m": 3, "material": "glass"},
            {"line": [[4, 0], [4, 8]], "thickness_m": 0.1, "high_m": 3, "information": 0.5},
            {"line": [[6, 0], [6, 8]], "high_m": 3},
            {"line": [[7, 0], [7, 8]], "high_m": 1.5},
        ],
        "obstacles": [
            {"low": [8, 0, 0], "high": [8.2, 8, 3]},
            {"low": [8.5, 0, 0], "high": [8.6, 8, 3], "material": "glass"},
        ],
    }
    problem = scene_files.of_mapping(tables)
    places = np.array([[x, 4.0, 1.0] for x in (1, 3, 5, 6.5, 7.5, 8.3, 9)])
    share = problem.obstacles.share(np.array([[0.0, 4, 1]]), places)[:, 0]
    np.testing.assert_allclose(share, [1, 0.8, 0.4, 0.004, 0.004, 0.004, 0.0032])


def test_standard_materials_need_no_entry_and_an_entry_overrides_them():
    line = {"line": [[2, 0], [2, 8]], "high_m": 3}

    def share(material, **own):
        tables = HALL | {"walls": [line | {"material": material}], "materials": own}
        if not own:
            del tables["materials"]
        obstacles = scene_files.of_mapping(tables).obstacles
        return float(obstacles.share(np.array([[0.0, 4, 1]]), np.array([[3.0, 4, 1]]))[0, 0])

    # The table of docs/building_files.md.
    text = (ROOT / "docs" / "building_files.md").read_text(encoding="utf-8")
    section = text.split("### `[materials]`")[1].split("###")[0]
    names, _, values = (
        [cell.strip(" `") for cell in row.strip("|").split("|")]
        for row in section.splitlines()
        if row.startswith("|")
    )
    assert names == list(MATERIALS)
    for name, value in zip(names, values, strict=True):
        assert share(name) == pytest.approx(float(value))
    assert share("brick", curtain=0.9) == pytest.approx(0.15)
    assert share("brick", brick=0.4) == pytest.approx(0.4)
    with pytest.raises(ValueError, match=r"has 'curtain', or a standard .*'brick'.*got 'brik'"):
        share("brik", curtain=0.9)


@needs("shapely")
def test_floors_are_parted_by_slabs():
    tables = HALL | {
        "anchors": {"number": 4},
        "materials": {"slab": 0.1},
        "slabs": [{"polygon": SQUARE, "z_m": 3.0, "material": "slab"}],
        "mounts": [
            {"kind": "ceiling", "polygon": SQUARE, "height_m": 3.0},
            {"kind": "ceiling", "polygon": SQUARE, "height_m": 6.0},
        ],
        "zones": [
            {"name": "ground", "polygon": SQUARE, "low_m": 0.5, "high_m": 2},
            {"name": "first", "polygon": SQUARE[::-1], "low_m": 3.5, "high_m": 5},
        ],
    }
    problem = scene_files.of_mapping(tables)
    points = anywhere(problem)
    assert set(points[:, 2]) == {3.0, 6.0}
    up, down = (np.array([[2.0, 2, z]]) for z in (4.0, 1.0))
    share = problem.obstacles.share(points, np.concatenate([up, down]))
    lower = points[:, 2] == 3.0
    np.testing.assert_array_equal(share[0], np.where(lower, 0.1, 1.0))
    np.testing.assert_array_equal(share[1], np.where(lower, 1.0, 0.1))
    places = problem.free_places(400)
    assert abs((places[:, 2] > 3).mean() - 0.5) < 0.01
    assert problem.free(places).all()
    assert not problem.free(np.array([[2.0, 2, 3.1]])).any()
    low, high = problem.corners()
    np.testing.assert_array_equal([low, high], [[0, 0, 0.5], [4, 4, 5]])


@needs("shapely")
def test_every_kind_of_mount():
    mounts = [
        {"kind": "column", "polygon": [[1, 1], [2, 1], [2, 2]], "high_m": 3, "name": "pillar"},
        {"kind": "area", "polygon": SQUARE, "low_m": 1, "high_m": 2, "axis": [0, 0, 2]},
        {"kind": "points", "points": [[9, 7, 3], [9, 1, 3]], "cost": 7},
        {"kind": "wall", "line": [[0, 8], [10, 8]], "side": "right", "low_m": 2, "high_m": 2.5,
         "offset_m": 0.25},
    ]  # fmt: skip
    tables = HALL | {"anchors": {"number": 4}, "mounts": mounts}
    tables["obstacles"] = [
        {"polygon": [[1, 1], [2, 1], [2, 2]], "high_m": 3, "information": 0.5},
        {"low": [3, 3, 0], "high": [5, 5, 1.5]},
    ]
    problem = scene_files.of_mapping(tables)
    points = anywhere(problem, 3000)
    names = np.array(problem.mounts.names(points))
    normal = problem.mounts.normal(points)
    assert set(names) == {"pillar 1", "pillar 2", "pillar 3", "area 2", "points 3", "wall 4"}
    for name, wanted in (
        ("pillar 1", [0, -1, 0]), ("pillar 2", [1, 0, 0]), ("area 2", [0, 0, 1]),
        ("points 3", [0, 0, 0]), ("wall 4", [0, -1, 0]),
    ):  # fmt: skip
        assert (names == name).any()
        assert np.abs(normal[names == name] - wanted).max() < 1e-12
    wall = points[names == "wall 4"]
    np.testing.assert_allclose(wall[:, 1], 7.75)
    # The area without the pillar, and below the top of the box without that.
    area = points[names == "area 2"]
    assert not problem.obstacles.contain(area).any()
    corner = (area[:, :2] > 3.01).all(axis=1)
    assert (area[corner, 2] > 1.5 - 1e-9).all()
    assert problem.mounts.listed() is None
    assert (problem.mounts.cost(points)[names == "points 3"] == 7).all()
    # On an opaque box too.
    rack = tables | {"mounts": [{"kind": "column", "polygon": [[3, 3], [5, 3], [5, 5], [3, 5]],
                                 "high_m": 1.5}]}  # fmt: skip
    problem_of_rack = scene_files.of_mapping(rack)
    assert not problem_of_rack.obstacles.contain(anywhere(problem_of_rack)).any()
    # What stands on the face of the pillar sees past it, not through it.
    west = points[names == "pillar 1"]
    share = problem.obstacles.share(west, np.array([[1.5, -3.0, 1.0], [1.2, 5.0, 1.0]]))
    np.testing.assert_array_equal(share[0], 1)
    assert (share[1] == 0.5).mean() > 0.9
    listed = scene_files.of_mapping(tables | {"mounts": [mounts[2]], "anchors": {
        "number": 3, "fixed": [[0, 0, 3]]}})  # fmt: skip
    np.testing.assert_array_equal(listed.mounts.listed(), [[9, 7, 3], [9, 1, 3]])


@needs("shapely")
def test_a_cupboard_along_a_wall_covers_it_up_to_its_height():
    tables = HALL | {
        "anchors": {"number": 4},
        "obstacles": [{"low": [2, 0, 0], "high": [4, 0.6, 2.0]}],
        "mounts": [{"kind": "wall", "line": [[0, 0], [10, 0]], "low_m": 1, "high_m": 3}],
        "forbidden": [{"polygon": [[8, -1], [9, -1], [9, 1], [8, 1]], "low_m": 2.5}],
    }
    problem = scene_files.of_mapping(tables)
    x, _, z = anywhere(problem, 4000).T
    assert not ((x > 2.001) & (x < 3.999) & (z < 1.999)).any()
    assert ((x > 2) & (x < 4) & (z > 2)).any()
    assert not ((x > 8) & (x < 9) & (z > 2.5)).any()
    assert ((x > 8) & (x < 9) & (z < 2.5)).any()
    area = 20 - 2 * 1 - 1 * 0.5
    assert isinstance(problem.mounts, Mounts)
    assert problem.mounts.measure.sum() == pytest.approx(area, abs=0.02)
    # From behind the cupboard to above it, or to the side.
    np.testing.assert_allclose(
        problem.mounts.project(np.array([[2.5, 0, 1.9], [2.1, 0, 1.1]])),
        [[2.5, 0, 2.0], [2.0, 0, 1.1]],
        atol=1e-5,
    )


def test_bodies_of_one_or_two_tags_where_the_question_allows():
    one, two = [[0, 0, 0.5]], [[-0.5, 0, 0], [0.5, 0, 0]]
    for tags, zone in (
        (one, {"position_m": 0.1}),
        (one, {"attitude": "heading"}),
        (two, {"position_m": 0.1}),
        (two, {"attitude": "heading", "position_m": 0.1, "heading_deg": 5}),
    ):
        tables = HALL | {"body": {"tags": tags}}
        tables["zones"] = [{"low": [1, 1, 0], "high": [9, 7, 2], **zone}]
        assert scene_files.of_mapping(tables).tags.shape == (len(tags), 3)
    for tags, zone, message in (
        (two, {}, "tags must be at least 3"),
        (two, {"position_m": 0.1, "heading_deg": 5}, "tags must be at least 3"),
        (two, {"attitude": "level"}, "tags must be at least 3"),
        (
            one,
            {"attitude": "heading", "heading_deg": 5},
            "tags must not all lie on one vertical line",
        ),
    ):
        tables = HALL | {"body": {"tags": tags}}
        tables["zones"] = [{"low": [1, 1, 0], "high": [9, 7, 2], **zone}]
        with pytest.raises(ValueError, match="^" + message):
            scene_files.of_mapping(tables)


def test_the_plan_has_its_paths_from_the_folder_of_the_file(tmp_path):
    tables = HALL | {"plan": {"image": "a/plan.png", "metres_per_pixel": 0.05, "origin": [-1, 2]}}
    path = tmp_path / "hall.json"
    path.write_text(json.dumps(tables))
    plan = scene_files.problem(str(path)).plan
    assert plan == building.Plan(str(tmp_path / "a" / "plan.png"), 0.05, (-1, 2))


def test_a_region_on_the_command_line_goes_before_the_zones():
    problem = scene_files.of_mapping(HALL, region=([1, 1, 0], [2, 2, 1]))
    (zone,) = problem.zones
    assert zone.name == "region"
    assert not zone.has_requirement
    np.testing.assert_array_equal(zone.bounds(), [[1, 1, 0], [2, 2, 1]])
    assert problem.scene.volume == Box((1, 1, 0), (2, 2, 1))


def test_free_places_lie_in_the_zone_and_begin_with_those_of_fewer():
    zone = building.Zone("z", np.array([[0.0, 0], [4, 0], [0, 4]]), 0.0, 1.0)
    empty = scene_files.problem("uwb_room").obstacles
    places = building.free_places(zone, empty, 300)
    assert places.shape == (300, 3)
    assert (places[:, 0] + places[:, 1] <= 4).all()
    assert zone.contains(places).all()
    np.testing.assert_array_equal(building.free_places(zone, empty, 20), places[:20])
    np.testing.assert_allclose(places.mean(axis=0), [4 / 3, 4 / 3, 0.5], atol=0.05)


# --- what is refused ---------------------------------------------------------------------------

NAN = math.nan
BAD = [
    ("colour", 1, "the file has an unknown key 'colour'; it may have name, anchors, mounts"),
    ("zones", None, "the file must have the key 'region' or [[zones]]"),
    ("region", {"low": [0] * 3, "high": [1] * 3}, "the file must have either [region] or"),
    ("walls", {"a": 1}, "walls must be a list of tables"),
    ("walls.0", 7, "walls[0] must be a table of keys, got 7"),
    ("walls.0.thicknes", 1, "walls[0] has an unknown key 'thicknes'; it may have line, closed"),
    ("walls.0.thickness_m", 0, "walls[0].thickness_m must be a finite number in [0.001"),
    ("walls.0.thickness_m", NAN, "walls[0].thickness_m must be a finite number"),
    ("walls.0.closed", 1, "walls[0].closed must be true or false, got 1"),
    ("walls.1.material", "wool", "walls[1].material must be one of [materials], which has 'dry"),
    ("walls.1.information", 0.5, "walls[1] must have either material or information"),
    ("walls.0.line", [[0, 0], [4, 4], [4, 0], [0, 2]], "walls[0].line must not cross or touch"),
    ("walls.1.line", [[0, 0], [0, 0]], "walls[1].line must have at least 2 different points"),
    ("walls.1.line", [[0, 0], [1, NAN]], "walls[1].line must be finite, got nan at index (1, 1)"),
    ("walls.1.line", [[0, 0], [1, 1e9]], "walls[1].line must lie within 1e+06 m of the origin"),
    ("walls.1.high_m", -1, "walls[1]: low_m must lie below high_m, got 0 and -1"),
    ("walls.1.high_m", None, "walls[1] must have the key 'high_m'"),
    ("materials.drywall", 2, "materials.drywall must be a finite number in [0, 1], got 2"),
    ("materials", "x", "materials must be a table of keys"),
    (
        "obstacles.0.polygon",
        [[15, 4], [18, 7], [18, 4], [15, 8]],
        "obstacles[0].polygon must not cross or touch itself: edge 1, from (15, 4) to (18, 7)",
    ),
    ("obstacles.0.low", [1, 1, 1], "obstacles[0] has an unknown key 'low'; it may have polygon"),
    ("obstacles.0.high_m", 0, "obstacles[0]: low_m must lie below high_m, got 0 and 0"),
    ("obstacles.1.low", None, "obstacles[1] must have the key 'low'"),
    ("openings.0.line", [[5, 12], [6, 12]], "openings[0] must lie in one of [[walls]], along its"),
    ("openings.0.line", [[5, 10], [5, 11]], "openings[0] must lie in one of [[walls]], along its"),
    ("openings.0.low_m", 5, "openings[0]: low_m must lie below high_m, got 5 and 2.1"),
    ("openings.0.width_m", 1, "openings[0] has an unknown key 'width_m'; it may have line, low_m"),
    ("slabs", [{"polygon": SQUARE, "z_m": 3, "material": "x"}], "slabs[0].material must be one"),
    ("mounts.0.kind", "roof", "mounts[0].kind must be one of 'wall', 'ceiling', 'column'"),
    ("mounts.0.kind", None, "mounts[0] must have the key 'kind'"),
    ("mounts.0.side", "up", "mounts[0].side must be one of 'left', 'right', 'both'"),
    ("mounts.2.low_m", 1, "mounts[2] has an unknown key 'low_m'"),
    ("mounts", [], "anchors.kind must be given: one of 'room', 'box', 'shell'; or [[mounts]]"),
    ("mounts", [{"kind": "points", "points": []}], "mounts[0].points must not be empty"),
    ("mounts.0.name", 3, "mounts[0].name must be a printable text"),
    ("forbidden.0.low_m", 2e6, "forbidden[0].low_m must be a finite number"),
    ("anchors.kind", "room", "anchors must have the key 'low'"),
    ("anchors.fixed", [[16, 5, 2]], "anchors.fixed[0] = (16, 5, 2) lies inside an obstacle"),
    (
        "anchors.fixed",
        [[1, 1, 2]] * 9,
        "the number of anchors must be at least 9, as it includes those of anchors.fixed",
    ),
    ("anchors.fixed", [[1, 2]], "anchors.fixed must have shape"),
    ("anchors.half_angle_deg", 200, "anchors.half_angle_deg must be a finite number in [0.1"),
    ("anchors.range_edge_m", 50, "anchors.range_edge_m must be at most anchors.max_range_m = 30"),
    ("anchors.max_range_m", None, "anchors.range_edge_m needs anchors.max_ran"),
    ("zones.0.polygon", [[60, 60], [61, 60], [61, 61]], "zones[0] ('open plan') is 61.9 m from"),
    ("zones.0.polygon", [[15.5, 5], [17, 5], [17, 6]], "obstacles leave no free place in zones[0]"),
    ("zones.0.low_m", 2, "zones[0]: low_m must lie below high_m, got 2 and 1.2"),
    ("zones.0.position_m", 0, "zones[0].position_m must be a finite number"),
    ("zones.0.share", 1, "zones[0].share must be a finite number in [0.01, 0.9999]"),
    ("zones.1.position_m", None, "zones[1].share needs one of position_m, height_m"),
    ("zones.0.attitude", "up", "zones[0].attitude must be one of 'free', 'level', 'heading'"),
    ("zones.1.name", "open plan", "zones[1].name must differ from the names of the other zones"),
    ("body", [{"shape": "cube"}], "body must be one table [body], as a file has one body; got 1"),
    (
        "zones.0.known_height_m",
        2,
        "zones[0] has an unknown key 'known_height_m'; it may have polygon",
    ),
    ("plan", {"images": "x"}, "plan has an unknown key 'images'"),
    ("plan", {"metres_per_pixel": 0}, "plan.metres_per_pixel must be a finite number"),
    ("plan", {"image": "a.png"}, "plan.metres_per_pixel must be given with plan.image"),
    ("plan", {"origin": [0]}, "plan.origin must have shape"),
]


@pytest.mark.parametrize(("path", "value", "message"), BAD)
def test_what_is_wrong_is_named_with_its_table(path, value, message):
    pytest.importorskip("shapely", reason="needs the extra placement")
    with pytest.raises(ValueError, match="^" + re.escape(message)) as error:
        scene_files.of_mapping(changed(path, value))
    assert "\n" not in str(error.value)


@needs("shapely")
@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("mounts", [{"kind": "points", "points": [[16, 5, 2.5]]}], "mounts have no permitted po"),
        ("mounts", [{"kind": "points", "points": [[1, 1, 2.5]]}], "mounts have 1 permitted points"),
        ("forbidden.0.polygon", [[-9, -9], [99, -9], [99, 99], [-9, 99]], "mounts have no permi"),
        ("mounts.0", {"kind": "points", "points": [[1, 1, 1]], "axis": [0, 0, 0]},
         "mounts[0].axis must not be zero"),
    ],
)  # fmt: skip
def test_mounts_without_a_legal_place(path, value, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        scene_files.of_mapping(changed(path, value))


def test_a_zone_of_another_place_is_refused():
    tables = changed("zones.0", {"low": [500, 1, 0], "high": [505, 7, 2]}, HALL)
    with pytest.raises(ValueError, match=r"^zones\[0\] \('zone 1'\) is 490 m from the nearest"):
        scene_files.of_mapping(tables)
    with pytest.raises(ValueError, match=r"^forbidden has no effect with anchors\.kind = 'box'"):
        scene_files.of_mapping(HALL | {"forbidden": [{"polygon": SQUARE}]})


# --- the schema --------------------------------------------------------------------------------


def faults(value: Any, rule: dict, where: str = "") -> list[str]:
    """What a JSON schema says against a value: the words that ours uses."""
    found: list[str] = []
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
             "number": (int, float)}  # fmt: skip
    kind = rule.get("type")
    if kind and (not isinstance(value, kinds[kind]) or (kind != "boolean" and value is True)):
        return [f"{where}: no {kind}"]
    if isinstance(value, dict):
        found += [f"{where}: no {key}" for key in rule.get("required", ()) if key not in value]
        others = rule.get("additionalProperties", {})
        for key, part in value.items():
            of_key = rule.get("properties", {}).get(key, others)
            if of_key is False:
                found.append(f"{where}: unknown {key}")
            else:
                found += faults(part, of_key, f"{where}.{key}")
    if isinstance(value, list):
        if not rule.get("minItems", 0) <= len(value) <= rule.get("maxItems", math.inf):
            found.append(f"{where}: {len(value)} items")
        for index, part in enumerate(value):
            found += faults(part, rule.get("items", {}), f"{where}[{index}]")
    if isinstance(value, str) and len(value) < rule.get("minLength", 0):
        found.append(f"{where}: short")
    if "enum" in rule and value not in rule["enum"]:
        found.append(f"{where}: not of {rule['enum']}")
    if "const" in rule and value != rule["const"]:
        found.append(f"{where}: not {rule['const']}")
    if isinstance(value, int | float) and not (
        rule.get("minimum", -math.inf) <= value <= rule.get("maximum", math.inf)
    ):
        found.append(f"{where}: out of limits")
    for part in rule.get("allOf", ()):
        found += faults(value, part, where)
    for word, right in (("anyOf", lambda n: n > 0), ("oneOf", lambda n: n == 1)):
        if word in rule:
            of_each = [faults(value, part, where) for part in rule[word]]
            if not right(sum(not one for one in of_each)):
                found += min(of_each, key=len) or [f"{where}: several forms"]
    return found


@pytest.mark.parametrize("name", ["warehouse.toml", "office.toml"])
def test_the_examples_follow_the_schema(name):
    tables = tomllib.loads((ROOT / "examples" / name).read_text(encoding="utf-8"))
    assert faults(tables, schema()) == []


def test_the_schema_refuses_what_the_reader_refuses_by_form():
    rule = schema()
    # What only geometry or other tables can tell.
    deeper = re.compile("cross or touch|different points|one of .materials|either material|lie "
                        "in one|lie below|inside an obst|of anchors.fixed|from|free place|must "
                        "differ|needs|no effect|at most|finite, got|1e\\+06 m|permitted|not be "
                        "empty|axis|either .region|slabs|must be given")  # fmt: skip
    checked = 0
    for path, value, message in BAD:
        if deeper.search(message) or value is NAN:
            continue
        assert faults(changed(path, value), rule), path
        checked += 1
    assert checked > 20
    for good in (HALL, HALL | {"$schema": "building.schema.json"}):
        assert faults(good, rule) == []
        scene_files.of_mapping(good)
    for noise in ({"kind": "squared-range", "sigma_m": 0.1}, {"floor_m": 0.1, "kind": "range"}):
        assert faults(HALL | {"noise": noise}, rule) == []
    assert faults(HALL | {"noise": {"sigma_m": 0.1}}, rule)
    assert faults(HALL | {"region": {"low": [0, 0, 0], "high": [1, 1, 1]}}, rule)


def test_the_shipped_schema_is_that_of_the_reader(capsys):
    path = ROOT / "rbl_gym" / "placement" / "building.schema.json"
    assert json.loads(path.read_text(encoding="utf-8")) == json.loads(json.dumps(schema()))
    with pytest.raises(SystemExit, match="0"):
        main(["place", "--schema"])
    assert capsys.readouterr().out == path.read_text(encoding="utf-8")


def test_the_reference_has_every_key_of_the_format():
    page = (ROOT / "docs" / "building_files.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^### `\[+(\w+)\]+`[^\n]*\n(.*?)(?=^##|\Z)", page, re.M | re.S))
    for name, table in FORMAT.items():
        rows = re.findall(r"^\| (`[^|]+) \|", sections[name], re.M)
        named = set(re.findall(r"`(\w+)`", " ".join(rows)))
        assert named == {key for form in table.forms for key in form.keys}, name


# --- outside the walls ---------------------------------------------------------------------------


def notes_of(tables) -> str:
    return " ".join(scene_files.of_mapping(tables).notes)


@needs("shapely")
def test_what_lies_outside_the_walls_is_named_with_its_distance():
    assert notes_of(OFFICE) == ""
    # One and a half metres of 16 beyond the face at x = 12.15, and the reentrant corner.
    wide = [[0.6, 10.6], [13.65, 10.6], [13.65, 15.4], [0.6, 15.4]]
    said = notes_of(changed("zones.1.polygon", wide))
    outer = (13.65 - 12.15) * 4.8 / (13.05 * 4.8)
    assert said == (
        f"Zone 'meeting room' lies outside the walls: {100 * outer:.2g} % of its area, up to 1.5 m "
        "away from them."
    )
    away = [[-9, 2], [-3, 2], [-3, 8], [-9, 8]]
    assert "Zone 'meeting room' lies outside the walls: all of it, up to 8.85 m" in notes_of(
        changed("zones.1.polygon", away)
    )
    assert "anchors.fixed[0] lies outside the walls: up to 0.85 m" in notes_of(
        changed("anchors.fixed", [[25.0, 0.2, 2.6]])
    )
    assert "Mount 'partition 1' lies outside the walls" in notes_of(
        changed("mounts.1.line", [[6, 17], [11, 17]])
    )
    assert "Mount 'ceiling' reaches 2 m above the walls, which end at 3 m" in notes_of(
        changed("mounts.2.height_m", 5.0)
    )
    assert "reaches 0.3 m below the walls, which begin at 0 m" in notes_of(
        changed("zones.0.low_m", -0.3)
    )


@needs("shapely")
def test_the_region_of_the_command_is_checked_too():
    problem = scene_files.of_mapping(OFFICE, region=((1, 1, 0.5), (30, 9, 1.5)))
    assert problem.notes[0].startswith("The region lies outside the walls: 20 % of its area, up to")


@needs("shapely")
def test_walls_that_are_no_outline_give_no_notes():
    # Only the meeting room's walls: the building is larger than what they enclose.
    tables = changed("walls.0", None)
    assert notes_of(tables) == ""
    # A door in the outer wall does not open the outline.
    line = [[3, 0], [24, 0], [24, 10], [12, 10], [12, 16], [0, 16], [0, 0], [1.5, 0]]
    tables = changed("walls.0.line", line)
    tables["walls"][0]["closed"] = False
    assert notes_of(tables) == ""
    assert "the walls" in notes_of(changed("anchors.fixed", [[25.0, 0.2, 2.6]], tables))


@needs("shapely")
def test_the_origin_of_a_drawing_may_be_that_of_a_national_grid_in_millimetres():
    tables = changed("plan", {"units": "mm", "zero": [3.45e9, 5.4e9]})
    plan = scene_files.of_mapping(tables).plan
    assert plan is not None
    assert plan.zero == (3.45e9, 5.4e9)
    tables["plan"]["zero"] = [1e13, 0]
    with pytest.raises(ValueError, match=re.escape("plan.zero must have numbers of at most 1e+12")):
        scene_files.of_mapping(tables)


@needs("shapely")
def test_a_layout_without_any_sight_of_some_positions_is_judged():
    tables = copy.deepcopy(OFFICE)
    for wall in tables["walls"]:
        wall["material"] = "metal"
    problem = scene_files.of_mapping(tables)
    # All four are outside, behind metal.
    anchors = np.array([[-2.0, -2, 2], [26, -2, 1], [26, 12, 2], [-2, 12, 1.5]])
    found = criteria.criteria(problem, problem.context, anchors)
    assert found.conditioning >= 1e12 * (1 - 1e-9)
    assert all(np.isfinite(value) for value in found)


def test_a_known_height_is_not_taken_for_a_requirement():
    with pytest.raises(ValueError, match=r"place always estimates the height, .*high_m$"):
        read_table("zones", {"known_height_m": 2.2, "polygon": [[0, 0], [1, 0], [1, 1]]})
