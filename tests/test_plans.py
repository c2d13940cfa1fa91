"""Floor plans: DXF, GeoJSON and pictures read to the tables of a building file."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

from rbl_gym.geometry import polygons
from rbl_gym.placement.file_keys import MATERIALS
from rbl_gym.placement.plans import (
    drawing,
    geojson,
    layers,
    pairs,
    pictures,
    reading,
    rings,
    toml_text,
)
from rbl_gym.placement.plans.drawing import Shape
from rbl_gym.placement.plans.uses import KEYS, KINDS, Use, parse_use
from rbl_gym.placement.plans.values import mount_values
from tests.helpers import needs
from tests.plan_files import DESK, INNER, MEETING, OUTER, write_dxf, write_geojson, write_png


def read(path, **options):
    return reading.read_drawing(path, **options)


def uses(*texts):
    return [parse_use(*text.split(" ", 1)) for text in texts]


def on_layer(found, layer):
    return [shape for shape in found.shapes if shape.layer == layer]


def close(points, expected):
    return np.allclose(np.array(points), np.array(expected), atol=1e-6)


# --- DXF -----------------------------------------------------------------------------------------


@needs("ezdxf")
@pytest.mark.parametrize(("insunits", "scale"), [(4, 1000), (5, 100), (6, 1), (1, 1 / 0.0254)])
def test_dxf_in_any_unit_gives_metres(insunits, scale, tmp_path):
    found = read(write_dxf(tmp_path / "x.dxf", insunits, scale))
    assert drawing.UNITS[found.units] == pytest.approx(1 / scale)
    (outer,) = on_layer(found, "A-WALL-EXT")
    assert outer.closed
    assert close(outer.points, OUTER)
    assert [shape.points.tolist() for shape in on_layer(found, "A-WALL-INT")] == pytest.approx(
        np.array(INNER)
    )
    assert any(f"$INSUNITS = {insunits}" in line for line in found.said)
    assert any("12 x 8" in line for line in found.said)


@needs("ezdxf")
def test_bulges_circles_and_blocks_are_lines(tmp_path):
    found = read(write_dxf(tmp_path / "x.dxf"))
    shapes = {shape.kind: shape for shape in on_layer(found, "FURNITURE") if len(shape.points) != 4}
    lens, circle, mark = shapes["LWPOLYLINE"], shapes["CIRCLE"], shapes["INSERT"]
    # Bulge 0.5: sagitta of half the half chord, both ways; within the flattening of 2 cm.
    assert lens.closed
    assert np.abs(lens.points[:, 1] - 6).max() == pytest.approx(0.25, abs=0.02)
    radius = np.linalg.norm(circle.points - (4, 4), axis=-1)
    np.testing.assert_allclose(radius, 0.3, atol=1e-3)
    assert abs(polygons.area(circle.points)) == pytest.approx(np.pi * 0.09, rel=0.1)
    assert close(mark.points, [[9, 6]])
    (desk,) = [s for s in on_layer(found, "FURNITURE") if len(s.points) == 4]
    assert close(desk.points, [(9 - y, 6 + x) for x, y in DESK])


@needs("ezdxf")
def test_a_unit_is_asked_for_and_a_told_one_goes_before(tmp_path):
    path = write_dxf(tmp_path / "x.dxf", 0)
    with pytest.raises(ValueError, match=r"x\.dxf: .* unit \(\$INSUNITS = 0\).*12000 x .*--units"):
        read(path)
    assert read(path, units="mm").bounds()[1].tolist() == pytest.approx([12, 8])
    wide = read(write_dxf(tmp_path / "y.dxf", 4), units="m")
    assert any("the drawing itself states mm" in line for line in wide.said)
    assert any("unusual size" in line for line in wide.said)


@needs("ezdxf")
def test_what_cannot_be_read_is_counted_by_kind(tmp_path):
    found = read(write_dxf(tmp_path / "x.dxf"))
    assert found.unread == {"DIM": {"DIMENSION": 1}}
    assert [label.text for label in found.labels] == ["meeting room", "Office"]


@needs("ezdxf")
def test_hatches_keep_their_holes_and_far_plans_come_near(tmp_path):
    from ezdxf.filemanagement import new

    document = new()
    document.header["$INSUNITS"] = 6
    far = np.array([500_000.3, 5_000_000.7])
    hatch = document.modelspace().add_hatch(dxfattribs={"layer": "ZONES"})
    for size, flags in ((10, 1), (4, 16)):
        ring = far + np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size / 2
        hatch.paths.add_polyline_path(ring.tolist(), is_closed=True, flags=flags)
    path = str(tmp_path / "x.dxf")
    document.saveas(path)
    found = read(path)
    (shape,) = found.shapes
    assert [len(shape.points), *map(len, shape.holes)] == [4, 4]
    assert found.zero == (499_995, 4_999_995)
    assert any("far from its origin" in line for line in found.said)
    assert read(path, zero=tuple(far)).bounds()[1].tolist() == pytest.approx([5, 5])
    (zone,) = layers.building(found).tables["zones"]
    assert polygons.area(np.array(zone["polygon"])) == pytest.approx(100 - 16, abs=0.01)


@needs("ezdxf")
def test_what_is_no_drawing_is_named(tmp_path):
    bad = tmp_path / "bad.dxf"
    bad.write_text("no group codes here\n")
    with pytest.raises(ValueError, match=r"bad\.dxf: not a DXF file"):
        read(str(bad))
    with pytest.raises(ValueError, match="DWG files cannot be read: save the drawing as DXF"):
        read("x.dwg")
    with pytest.raises(FileNotFoundError):
        read(str(tmp_path / "nowhere.dxf"))
    with pytest.raises(ValueError, match=r"units must be one of mm, .* got 'furlong'"):
        read(str(bad), units="furlong")


# --- GeoJSON -------------------------------------------------------------------------------------


def test_geojson_in_metres_goes_by_its_properties(tmp_path):
    found = read(write_geojson(tmp_path / "x.geojson"))
    made = layers.building(found).tables
    outer, *inner = made["walls"]
    assert outer["closed"]
    assert (outer["material"], outer["high_m"]) == ("concrete", 3.2)
    assert [wall["line"] for wall in inner] == np.array(INNER, float).tolist()
    assert inner[0]["thickness_m"] == 0.1
    assert made["materials"] == {"drywall": 0.7, "concrete": 0.05}
    names = {zone["name"]: zone for zone in made["zones"]}
    assert names["open plan"]["position_m"] == 0.2
    assert names["meeting room"]["high_m"] == 1.8
    assert close(names["meeting room"]["polygon"], MEETING)
    assert made["obstacles"][0]["high_m"] == 1.1


def test_degrees_are_refused_and_projected_when_told(tmp_path):
    zero = (11.57, 48.14)

    def place(points):
        return geojson.to_degrees(points, zero)

    path = write_geojson(tmp_path / "x.geojson", place)
    with pytest.raises(ValueError, match=r"x\.geojson: .* are degrees, not metres: give --units"):
        read(path)
    found = read(path, units="degrees")
    np.testing.assert_allclose(found.zero, zero, atol=1e-9)
    (outer,) = [shape for shape in found.shapes if shape.layer == "mounts"]
    # The lowest corner is on another parallel: micrometres.
    np.testing.assert_allclose(outer.points, OUTER, atol=1e-4)


def test_the_tangent_plane_agrees_with_the_ellipsoid():
    """Small steps against the radii of curvature; far ones come back."""
    lon, lat = zero = (-71.1, 42.37)
    a, e2 = 6378137.0, 0.00669437999014
    w = np.sqrt(1 - e2 * np.sin(np.radians(lat)) ** 2)
    step = 1e-6
    east = geojson.from_degrees(np.array([lon + step, lat]), zero)
    north = geojson.from_degrees(np.array([lon, lat + step]), zero)
    radius = a / w * np.cos(np.radians(lat))
    np.testing.assert_allclose(east, [np.radians(step) * radius, 0], atol=1e-7)
    radius = a * (1 - e2) / w**3
    np.testing.assert_allclose(north, [0, np.radians(step) * radius], atol=1e-7)
    far = np.array([[1500.0, -800.0], [-300.0, 2000.0]])
    np.testing.assert_allclose(geojson.from_degrees(geojson.to_degrees(far, zero), zero), far)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "Expecting"),
        ("[1]", "not a GeoJSON file"),
        ('{"type": "FeatureCollection", "features": 3}', "'features' must be a list"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}', "feature 0: a Polygon needs 4"),
        ('{"type": "LineString", "coordinates": [[0, "a"], [1, 1]]}', "lists of \\[x, y\\]"),
        ('{"type": "Blob", "coordinates": []}', "no lines that can be read, only 1 Blob"),
    ],
)
def test_bad_geojson_is_named(text, message, tmp_path):
    path = tmp_path / "bad.geojson"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"bad\.geojson: .*{message}"):
        read(str(path))


# --- layers --------------------------------------------------------------------------------------


def square(x, y, size, layer="A"):
    ring = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * size + np.array([x, y])
    return drawing.Shape(layer, "Polygon", ring.astype(float), True)


def plan_of(*shapes, labels=()):
    return drawing.Drawing("x.dxf", "m", (0.0, 0.0), list(shapes), list(labels), {}, [])


def test_layers_are_mapped_by_patterns_the_first_that_matches():
    found = plan_of(square(0, 0, 9, "A-WALL-EXT"), square(2, 2, 1, "A-WALL-INT"))
    told = uses("walls A-WALL-EXT,material=concrete", "walls a-wall-*,material=drywall")
    made = layers.building(found, told)
    assert [wall["material"] for wall in made.tables["walls"]] == ["concrete", "drywall"]
    assert made.used == {"A-WALL-EXT": ["walls"], "A-WALL-INT": ["walls"]}
    with pytest.raises(ValueError, match=r"no layer is called 'B'; the layers are 'A-WALL-EXT', "):
        layers.building(found, uses("zones B"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("walls ,material=brick", "LAYER,KEY=VALUE"),
        ("walls A,colour=red", "unknown key 'colour'; the keys are name, material"),
        ("walls A,low_m=high", "low_m must be a number, got 'high'"),
        ("walls A,material=cheese", "material must be one of drywall, .* information=SHARE"),
    ],
)
def test_a_bad_option_is_named(text, message):
    with pytest.raises(ValueError, match=message):
        uses(text)


def test_every_kind_says_its_keys_and_every_material_its_share():
    assert set(KINDS) == set(KEYS)
    assert all(0 <= share <= 1 for share in MATERIALS.values())
    told = Use("walls", "A", {"material": "cheese", "information": 0.2})
    assert uses("walls A,material=cheese,information=0.2") == [told]


def test_zones_are_called_by_the_text_in_them_or_by_their_layer():
    labels = [drawing.Label("Z", "lobby", np.array([1.0, 1.0]))]
    made = layers.building(plan_of(square(0, 0, 2, "Z"), square(5, 0, 2, "Z"), labels=labels),
                           uses("zones Z,low_m=0.2,high_m=1.0"))  # fmt: skip
    assert [zone["name"] for zone in made.tables["zones"]] == ["lobby", "Z 2"]
    assert made.tables["zones"][1]["low_m"] == 0.2


def test_open_lines_on_a_layer_of_areas_are_counted():
    line = drawing.Shape("Z", "LINE", np.array([[0.0, 0.0], [3.0, 0.0]]))
    made = layers.building(plan_of(square(0, 0, 2, "Z"), line), uses("zones Z"))
    assert len(made.tables["zones"]) == 1
    assert "layer Z, read as zones: 1 lines that enclose no area were left out" in made.said


def test_what_a_zone_is_asked_holds_for_the_whole_plan_if_the_layer_has_no_area():
    wall, line = square(0, 0, 9, "walls"), np.array([[0.0, 0.0], [3.0, 0.0]])
    found = plan_of(wall, drawing.Shape("Z", "LINE", line))
    (zone,) = layers.building(found, uses("zones Z,attitude=level,low_m=0.2")).tables["zones"]
    assert (zone["name"], zone["attitude"], zone["low_m"]) == ("plan", "level", 0.2)


def test_mounts_on_a_ring_look_inwards_those_on_a_line_both_ways():
    wall = drawing.Shape("M", "LINE", np.array([[0.0, 0.0], [4.0, 0.0]]))
    clockwise = square(0, 2, 4, "M")
    clockwise = clockwise._replace(points=clockwise.points[::-1])
    made = layers.building(plan_of(wall, clockwise), uses("mounts M,low_m=1.5"))
    ring, line = made.tables["mounts"]
    assert (ring["side"], ring["closed"], line["side"]) == ("left", True, "both")
    assert polygons.area(np.array(ring["line"])) == pytest.approx(16)
    assert ring["low_m"] == line["low_m"] == 1.5


def test_marks_are_places_of_mounts_and_of_fixed_anchors():
    marks = [
        drawing.Shape("M", "POINT", np.array([[x, 1.0]]), properties={"z": 2.4}) for x in (1.0, 2.0)
    ]
    made = layers.building(plan_of(*marks, square(0, 0, 9, "Z")), uses("mounts M", "zones Z"))
    assert made.tables["mounts"] == [
        {"#": "layer M", "kind": "points", "points": [[1, 1, 2.4], [2, 1, 2.4]], "name": "M"}
    ]
    made = layers.building(plan_of(*marks, square(0, 0, 9, "Z")), uses("fixed M,height_m=3"))
    assert made.tables["anchors"] == {"number": 8, "fixed": [[1, 1, 3.0], [2, 1, 3.0]]}


def test_a_layer_may_be_called_anything():
    made = layers.building(plan_of(square(0, 0, 9, 'a]\n[[x]]\x07 "q"')), uses("zones a*"))
    text = toml_text.to_toml(made.tables, made.said)
    assert tomllib.loads(text) == toml_text.plain(made.tables)


def test_without_mounts_and_zones_what_was_taken_is_said():
    made = layers.building(plan_of(square(0, 0, 9, "walls")))
    assert isinstance(made, layers.Building)
    assert {mount["kind"] for mount in made.tables["mounts"]} == {"wall"}
    assert any("no layer of mounts" in line for line in made.said)
    assert any("no layer of zones" in line for line in made.said)
    made = layers.building(plan_of(square(0, 0, 9, "0")))
    assert made.used == {}
    assert any("give --walls LAYER" in line for line in made.said)


# --- lines and rings -----------------------------------------------------------------------------


def test_two_lines_of_a_wall_become_its_centre_line():
    """A room of 6 x 4 m with walls of 0.2 m, drawn as two rings; and one that stands alone."""
    outer, inner = square(0, 0, 6).points, square(0.2, 0.2, 5.6).points
    alone = np.array([[3.0, 1.0], [3.0, 3.0]])
    found, single = pairs.centre_lines([(outer, True), (inner, True), (alone, False)], 0.5)
    assert len(found) == 4
    assert all(width == pytest.approx(0.2) for _, width in found)
    # The middles meet at the corners.
    ends = np.concatenate([line for line, _ in found])
    corners = square(0.1, 0.1, 5.8).points
    assert np.linalg.norm(ends[:, None] - corners, axis=-1).min(axis=1).max() < 1e-9
    assert [line.tolist() for line in single] == [alone.tolist()]
    shapes = plan_of(*(drawing.Shape("W", "LINE", ring, True) for ring in (outer, inner)))
    made = layers.building(shapes, uses("walls W,side_by_side_m=0.5,material=brick"))
    assert [wall["thickness_m"] for wall in made.tables["walls"]] == [0.2] * 4
    assert any("4 pairs of lines" in line for line in made.said)


def test_holes_are_cut_open_to_one_simple_ring():
    ring = square(0, 0, 10).points
    holes = (square(2, 2, 2).points, square(6, 5, 2).points[::-1])
    found = rings.opened(ring, holes)
    assert found is not None
    assert polygons.area(found) == pytest.approx(100 - 8, abs=0.02)
    for point, inside in (((3, 3), False), ((7, 6), False), ((5, 5), True), ((9, 1), True)):
        assert polygons.contains(found, np.array([point], float))[0] == inside
    sides = np.stack([found, np.roll(found, -1, axis=0)], axis=1)
    assert not any(crosses(a, b) for k, a in enumerate(sides) for b in sides[k + 2 :])


def crosses(a, b):
    """Whether two segments cross in their inner parts."""

    def side(p, q, r):
        return np.linalg.det([q - p, r - p])

    one = side(a[0], a[1], b[0]) * side(a[0], a[1], b[1])
    other = side(b[0], b[1], a[0]) * side(b[0], b[1], a[1])
    return one < -1e-12 and other < -1e-12


def test_lines_that_meet_two_by_two_are_joined():
    corners = square(0, 0, 2).points
    sides = [corners[[k, (k + 1) % 4]] for k in (2, 0, 3, 1)]
    sides[1] = sides[1][::-1]
    tail = [np.array([[5.0, 0.0], [6.0, 0.0]]), np.array([[7.0, 1.0], [6.0, 0.001]])]
    found = rings.joined([*sides, *tail], 0.01)
    assert sorted((len(points), closed) for points, closed in found) == [(3, False), (4, True)]
    (ring,) = [points for points, closed in found if closed]
    assert abs(polygons.area(ring)) == pytest.approx(4)


# --- pictures, files -----------------------------------------------------------------------------


def test_a_picture_gives_its_rectangle(tmp_path):
    plan = pictures.backdrop(write_png(tmp_path / "x.png"), 0.05, (1.0, 2.0))
    assert pictures.pixels(plan["image"]) == (240, 160)
    made = pictures.of_picture(plan, 2.8)
    assert close(made.tables["mounts"][0]["polygon"], [(1, 2), (13, 2), (13, 10), (1, 10)])
    assert made.tables["mounts"][0]["height_m"] == 2.8
    bad = tmp_path / "bad.png"
    bad.write_text("not a picture")
    with pytest.raises(ValueError, match=r"bad\.png: not a picture"):
        pictures.backdrop(str(bad), 0.05)
    with pytest.raises(ValueError, match="metres_per_pixel must be positive"):
        pictures.backdrop(plan["image"], 0.0)


def test_the_file_reads_as_the_tables_do(tmp_path):
    made = layers.building(read(write_geojson(tmp_path / "x.geojson")))
    tables = made.tables | {"name": 'a "quoted" name \\ ü'}
    text = toml_text.to_toml(tables, ["a remark " * 30])
    assert tomllib.loads(text) == toml_text.plain(tables)
    assert max(map(len, text.splitlines())) <= 100
    assert json.loads(json.dumps(toml_text.plain(tables))) == toml_text.plain(tables)


def test_layers_keep_the_use_of_their_name_beside_options():
    drawing = plan_of(
        square(0, 0, 9, "Walls"),
        square(1, 1, 5, "zones"),
        square(0, 0, 9, "C"),
        square(1, 1, 1, "D"),
    )
    made = layers.building(drawing, uses("mounts C,kind=ceiling"))
    assert made.used == {"C": ["mounts"], "Walls": ["walls"], "zones": ["zones"]}
    assert made.said[-1] == "not used: 1 entity on 1 layer (D)"
    # An option takes the place of the name: that of the kind, and that of the layer.
    assert layers.building(drawing, uses("walls D")).used == {"D": ["walls"], "zones": ["zones"]}
    made = layers.building(drawing, uses("obstacles wall*"))
    assert made.used == {"Walls": ["obstacles"], "zones": ["zones"]}


def test_heights_and_names_of_a_wall_that_also_carries_mounts():
    """The wall's height only limits its mounts; their own high_m counts."""
    own = [
        {"name": "north", "height": 5},
        {"name": "gate", "min_height": 4, "height": 5},
        {"name": "low", "height": 2.5},
        {"name": 7, "height": 5, "high_m": 4.2},
    ]
    shapes = [
        drawing.Shape("W", "LineString", np.array([[0.0, y], [9.0, y]]), False, (), properties)
        for y, properties in enumerate(own)
    ]
    told = uses("walls W", "mounts W,low_m=3,high_m=4.8")
    made = layers.building(plan_of(*shapes), told, 5.0)
    tables = made.tables
    assert [(wall["name"], wall["low_m"], wall["high_m"]) for wall in tables["walls"]] == [
        ("north", 0.0, 5.0), ("gate", 4.0, 5.0), ("low", 0.0, 2.5), ("7", 0.0, 4.2),
    ]  # fmt: skip
    assert [(one["name"], one["low_m"], one["high_m"]) for one in tables["mounts"]] == [
        ("north", 3.0, 4.8), ("gate", 4.0, 4.8), ("7", 3.0, 4.2),
    ]  # fmt: skip
    short = "1 walls end below the lowest height of the mounts, and have no mount"
    assert f"layer W, read as mounts: {short}" in made.said


def test_mounts_of_one_name_are_numbered():
    rings = [np.array(DESK, float) + shift for shift in (0, 4)]
    shapes = [drawing.Shape("COLUMNS", "LWPOLYLINE", ring, True) for ring in rings]
    use = parse_use("mounts", "COLUMNS,kind=column")
    mounts = layers.building(plan_of(*shapes), [use]).tables["mounts"]
    assert [one["name"] for one in mounts] == ["COLUMNS 1", "COLUMNS 2"]


@pytest.mark.parametrize(("wall", "high"), [({"height": 5.0}, 4.8), ({"height": 3.0}, 3.0)])
def test_the_height_of_a_wall_only_limits_that_of_its_mounts(wall, high):
    line = np.array([[0.0, 0.0], [4.0, 0.0]])
    shape = Shape("W", "line", line, False, (), wall)
    use = Use("mounts", "W", {"high_m": 4.8})
    found = mount_values("plan.geojson", shape, use, ("low_m", "high_m"), {"low_m": 2.0})
    assert found == {"low_m": 2.0, "high_m": high}
