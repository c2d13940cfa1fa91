"""Export of layouts: mounting list, CSV, GeoJSON, DXF."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rbl_gym.placement import scene_files
from rbl_gym.placement.plans import geojson
from rbl_gym.studies.placing.layout_export import LAYER, SUFFIXES, mounting_list, write_layout
from rbl_gym.studies.placing.tape import measured_from
from tests.helpers import needs
from tests.plan_files import write_dxf

TABLES = {
    "anchors": {"number": 4, "max_range_m": 30.0},
    "mounts": [
        {"kind": "wall", "name": "hall", "line": [[0, 0], [8, 0], [8, 6], [0, 6]], "closed": True,
         "side": "left", "low_m": 2.0, "high_m": 3.0},
        {"kind": "ceiling", "name": "roof", "polygon": [[0, 0], [8, 0], [8, 6], [0, 6]],
         "height_m": 3.5},
    ],
    "slabs": [{"polygon": [[-1, -1], [9, -1], [9, 7], [-1, 7]], "z_m": 1.0, "thickness_m": 0.2}],
    "zones": [{"name": "hall", "polygon": [[1, 1], [7, 1], [7, 5], [1, 5]], "low_m": 1.5,
               "high_m": 2.0}],
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1},
}  # fmt: skip
ANCHORS = np.array([[3.0, 0.0, 2.5], [8.0, 4.5, 2.0], [1.0, 6.0, 3.0], [2.0, 2.0, 3.5]])

pytest.importorskip("shapely", reason="needs the extra placement")


@pytest.fixture(scope="module")
def problem():
    return scene_files.of_mapping(TABLES, name="hall")


def test_the_list_says_how_high_which_way_and_how_far_from_walls(problem):
    rows = mounting_list(problem, ANCHORS)
    assert [row["faces"] for row in rows] == ["+y", "-x", "-y", "down"]
    assert [row["name"] for row in rows] == ["1", "2", "3", "4"]
    # The slab's top is at 1.2 m.
    assert [row["above_floor_m"] for row in rows] == pytest.approx(ANCHORS[:, 2])
    assert [row["above_slab_m"] for row in rows] == pytest.approx([1.3, 0.8, 1.8, 2.3])
    assert [row["slab"] for row in rows] == ["slab 1"] * 4
    (low,) = mounting_list(problem, np.array([[3.0, 0.0, 0.9]]))
    assert (low["above_floor_m"], low["above_slab_m"], low["slab"]) == (0.9, "", "")
    assert rows[0]["mount"].startswith("hall")
    found = [
        [(one["side"], one["to"], one["distance_m"]) for one in row["measured"]] for row in rows
    ]
    # Who faces the wall at y = 0 looks to -y, and has +x on the left.
    assert found == [
        [("left", "wall", 5.0), ("right", "wall", 3.0)],
        [("left", "wall", 1.5), ("right", "wall", 4.5)],
        [("left", "wall", 1.0), ("right", "wall", 7.0)],
        [("-y", "wall", 2.0), ("-x", "wall", 2.0)],
    ]


ROOMS: dict[str, Any] = {
    "anchors": {"number": 4},
    "walls": [
        {"line": [[0, 0], [10, 0], [10, 6], [0, 6]], "closed": True, "high_m": 3.0,
         "thickness_m": 0.2},
        # Two rooms with a door from y = 4 to 5; the second has a low wall, and a pillar.
        {"line": [[4, 0], [4, 4]], "high_m": 3.0, "thickness_m": 0.2},
        {"line": [[4, 5], [4, 6]], "high_m": 3.0, "thickness_m": 0.2},
        {"line": [[7, 0], [7, 3]], "high_m": 1.2},
    ],
    "obstacles": [{"name": "pillar", "low": [8, 4, 0], "high": [8.5, 4.5, 3.0]}],
    "mounts": [
        {"kind": "ceiling", "polygon": [[0, 0], [10, 0], [10, 6], [0, 6]], "height_m": 2.9},
        {"kind": "wall", "line": [[4, 0], [4, 4]], "side": "both", "low_m": 2.0, "high_m": 2.8},
        {"kind": "wall", "line": [[0, 6], [10, 6]], "side": "right", "low_m": 2.0, "high_m": 2.8},
    ],
    "zones": [{"name": "a", "polygon": [[1, 1], [3, 1], [3, 5], [1, 5]], "low_m": 0.5,
               "high_m": 1.5}],
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1},
}  # fmt: skip


@pytest.mark.parametrize(
    ("anchor", "found"),
    [
        # Under the ceiling of the second room: its own walls, not those of the first; over the low
        # wall; but not behind the pillar.
        ([5.0, 2.0, 2.9], [("-x", "wall 2 (4, 0 to 4, 4)", 0.9, 4.1, 2.0),
                           ("-y", "wall 1 (0, 0 to 10, 0)", 1.9, 5.0, 0.1)]),
        ([8.2, 5.0, 2.9], [("-y", "pillar (8, 4 to 8.5, 4.5)", 0.5, 8.2, 4.5),
                           ("+x", "wall 1 (10, 0 to 10, 6)", 1.7, 9.9, 5.0)]),
        # Under the ceiling, at the face of the outer wall, which is 0.2 m thick.
        ([6.0, 5.9, 2.9], [("+y", "wall 1 (10, 6 to 0, 6)", 0.0, 6.0, 5.9),
                           ("-x", "wall 3 (4, 5 to 4, 6)", 1.9, 4.1, 5.9)]),
        # On the inner wall from the first room: the corner to the left, the door to the right.
        ([3.9, 1.0, 2.5], [("left", "end of the wall", 3.0, 3.9, 4.0),
                           ("right", "wall 1 (0, 0 to 10, 0)", 0.9, 3.9, 0.1)]),
        # Near the corner, in it, and at the other end.
        ([3.9, 0.13, 2.5], [("left", "end of the wall", 3.87, 3.9, 4.0),
                            ("right", "wall 1 (0, 0 to 10, 0)", 0.03, 3.9, 0.1)]),
        ([3.9, 0.1, 2.5], [("left", "end of the wall", 3.9, 3.9, 4.0),
                           ("right", "wall 1 (0, 0 to 10, 0)", 0.0, 3.9, 0.1)]),
        ([3.9, 4.0, 2.5], [("left", "end of the wall", 0.0, 3.9, 4.0),
                           ("right", "wall 1 (0, 0 to 10, 0)", 3.9, 3.9, 0.1)]),
        # On the outer wall of the second room: up to the inner wall.
        ([5.0, 5.9, 2.5], [("left", "wall 3 (4, 5 to 4, 6)", 0.9, 4.1, 5.9),
                           ("right", "wall 1 (10, 0 to 10, 6)", 4.9, 9.9, 5.9)]),
    ],
)  # fmt: skip
def test_distances_are_to_walls_that_are_seen_from_the_anchor(anchor, found):
    rooms = scene_files.of_mapping(ROOMS)
    place = np.array(anchor)
    measured = measured_from(rooms, place, rooms.mounts.normal(place))
    assert mounting_list(rooms, place[None])[0]["measured"] == measured
    keys = ("side", "to", "distance_m", "x_m", "y_m")
    assert [tuple(one[key] for key in keys) for one in measured] == found


def test_a_ceiling_without_walls_is_measured_from_its_edges():
    tables: dict[str, Any] = {
        key: value for key, value in ROOMS.items() if key not in ("walls", "obstacles")
    }
    tables["mounts"] = ROOMS["mounts"][:1]
    (row,) = mounting_list(scene_files.of_mapping(tables), np.array([[5.0, 2.0, 2.9]]))
    found = [(one["side"], one["to"], one["distance_m"]) for one in row["measured"]]
    assert found == [("-y", "edge of the mount", 2.0), ("-x", "edge of the mount", 5.0)]


def test_above_a_door_the_wall_goes_on():
    tables: dict[str, Any] = ROOMS | {"openings": [{"line": [[4, 2], [4, 3]]}]}
    rooms = scene_files.of_mapping(tables)
    place = np.array([3.9, 1.0, 2.5])
    measured = measured_from(rooms, place, rooms.mounts.normal(place))
    assert [one["distance_m"] for one in measured] == [3.0, 0.9]


def test_csv_is_a_layout_that_place_and_replay_read(problem, tmp_path):
    from rbl_gym.placement.layout_files import read_layout
    from rbl_gym.recordings.points import read_points
    from rbl_gym.recordings.report import Said
    from rbl_gym.recordings.tables import Source

    path = tmp_path / "new" / "l.csv"
    write_layout(problem, ANCHORS, str(path), ["N", "E", "S", "W"])
    found = read_layout(str(path))
    np.testing.assert_allclose(found.positions, ANCHORS)
    assert list(found.names) == ["N", "E", "S", "W"]
    anchors = read_points(str(path), "anchor", Source(file="anchors"), Said())
    assert anchors.ids == found.names
    np.testing.assert_array_equal(anchors.places, found.positions)
    with path.open(encoding="utf-8") as file:
        row = next(csv.DictReader(file))
    assert row["faces"] == "+y"
    assert float(row["distance_m_1"]) + float(row["distance_m_2"]) == 8


def test_geojson_stands_in_the_coordinates_of_its_plan(problem, tmp_path):
    path = tmp_path / "l.geojson"
    write_layout(problem, ANCHORS, str(path))
    (first, *_) = json.loads(path.read_text())["features"]
    assert first["geometry"] == {"type": "Point", "coordinates": [3.0, 0.0, 2.5]}
    zero = (11.5, 48.1)
    tables = {**TABLES, "plan": {"drawing": "x.geojson", "units": "degrees", "zero": list(zero)}}
    write_layout(scene_files.of_mapping(tables, name="hall"), ANCHORS, str(path))
    features = json.loads(path.read_text())["features"]
    degrees = np.array([feature["geometry"]["coordinates"][:2] for feature in features])
    np.testing.assert_allclose(geojson.from_degrees(degrees, zero), ANCHORS[:, :2], atol=1e-3)


@needs("ezdxf")
def test_dxf_is_a_layer_in_a_copy_of_the_drawing(problem, tmp_path):
    from ezdxf.filemanagement import readfile

    plan = {"drawing": write_dxf(tmp_path / "x.dxf"), "units": "mm", "zero": [100.0, 200.0]}
    tables = {**TABLES, "plan": plan}
    drawn = scene_files.of_mapping(tables, name="hall")
    path = str(tmp_path / "l.dxf")
    for _ in range(2):  # the second replaces the first
        write_layout(drawn, ANCHORS, path)
        write_layout(drawn, ANCHORS, plan["drawing"])
    for name in (path, plan["drawing"]):
        model = readfile(name).modelspace()
        places = [point.dxf.location for point in model.query(f'POINT[layer=="{LAYER}"]')]
        expected = ANCHORS * 1000 + (100, 200, 0)
        np.testing.assert_allclose([tuple(place) for place in places], expected)
        assert len(model.query('LWPOLYLINE[layer=="A-WALL-EXT"]')) == 1


@needs("ezdxf")
def test_without_a_drawing_the_dxf_has_the_building(problem, tmp_path):
    from rbl_gym.placement.plans.reading import read_drawing

    path = str(tmp_path / "l.dxf")
    write_layout(problem, ANCHORS, path)
    found = read_drawing(path)
    assert found.units == "m"
    assert found.layers() == ["OBSTACLES", LAYER, "ZONES"]
    marks = [s.points[0] for s in found.shapes if s.layer == LAYER and s.kind == "POINT"]
    np.testing.assert_allclose(marks, ANCHORS[:, :2])


def test_another_format_is_refused(problem):
    assert all(Path(f"x{suffix}").suffix == suffix for suffix in SUFFIXES)
    with pytest.raises(ValueError, match=r"x\.xls: the name of a layout must end in one of \.csv"):
        write_layout(problem, ANCHORS, "x.xls")
