"""Read GeoJSON: lengths are kept, degrees are projected to a local tangent plane."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.plans.drawing import Drawing, Shape, scaled

# WGS 84: semi-major axis (m) and squared eccentricity.
_A, _E2 = 6_378_137.0, 6.694379990141316e-3
# A plan in metres is larger than this value, one in degrees is smaller (11 km).
_WIDEST_DEG = 0.1
_LAYER_NAMES = ("layer", "kind", "class")
_DEGREES = ("4326", "CRS84", "4979")


def read_geojson(
    path: str, units: str | None, zero: tuple[float, float] | None, layer_property: str | None
) -> Drawing:
    """Return the shapes of all features. Arguments and errors as in `reading.read_drawing`."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a GeoJSON file: {error}") from error
    shapes, unread = [], {}
    names = _LAYER_NAMES if layer_property is None else (layer_property,)
    for number, (geometry, properties) in enumerate(_features(data, path)):
        layer = next((str(properties[name]) for name in names if properties.get(name)), "0")
        for kind, coordinates in _parts(geometry):
            found = _shape(layer, kind, coordinates, properties, f"{path}: feature {number}")
            if found is None:
                unread.setdefault(layer, Counter())[str(kind)] += 1
            else:
                shapes += found
    if layer_property is not None and {shape.layer for shape in shapes} <= {"0"}:
        raise ValueError(f"{path}: no feature has the property {layer_property!r}")
    drawing = Drawing(path, units or "m", (0.0, 0.0), shapes, [], unread, [])
    if units is None and shapes:
        _check_not_degrees(data, drawing)
        drawing.said.append("coordinates are read as metres")
    elif units is not None:
        drawing.said.append(f"unit of the coordinates: {units}, as given")
    return _projected(drawing, zero) if units == "degrees" else scaled(drawing, zero)


def _check_not_degrees(data: Any, drawing: Drawing) -> None:
    """Raise ValueError if the coordinates are longitudes and latitudes read as lengths."""
    low, high = drawing.bounds()
    named = any(code in json.dumps(data.get("crs", "")) for code in _DEGREES)
    small = np.abs([low, high]).max() <= 180 and (high - low).max() < _WIDEST_DEG
    if named or small:
        raise ValueError(
            f"{drawing.path}: coordinates from ({low[0]:.7g}, {low[1]:.7g}) to "
            f"({high[0]:.7g}, {high[1]:.7g}) are degrees, not metres: give --units degrees to have "
            "them projected to metres east and north of the lower left corner"
        )


def _features(data: Any, path: str) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Yield geometry and properties of each feature."""
    if not isinstance(data, dict) or "type" not in data:
        raise ValueError(f"{path}: not a GeoJSON file: it has no 'type' at its top level")
    if data["type"] == "FeatureCollection":
        features = data.get("features")
        if not isinstance(features, list):
            raise ValueError(f"{path}: 'features' must be a list, got {features!r:.80}")
    else:
        features = [data if data["type"] == "Feature" else {"geometry": data}]
    for number, feature in enumerate(features):
        if not isinstance(feature, dict):
            raise ValueError(f"{path}: feature {number} must be an object, got {feature!r:.80}")
        properties = feature.get("properties") or {}
        yield feature.get("geometry"), properties if isinstance(properties, dict) else {}


def _parts(geometry: Any) -> Iterator[tuple[Any, Any]]:
    """Yield kind and coordinates of each simple part of a geometry."""
    if not isinstance(geometry, dict):
        yield "none", None
        return
    kind, coordinates = geometry.get("type"), geometry.get("coordinates")
    if kind == "GeometryCollection":
        for part in geometry.get("geometries") or []:
            yield from _parts(part)
    elif isinstance(kind, str) and kind.startswith("Multi") and isinstance(coordinates, list):
        for part in coordinates:
            yield kind.removeprefix("Multi"), part
    else:
        yield kind, coordinates


def _shape(
    layer: str, kind: Any, coordinates: Any, properties: dict[str, Any], name: str
) -> list[Shape] | None:
    """Return the shapes of one part; None if its kind has no lines or points."""
    if kind not in ("Point", "LineString", "Polygon"):
        return None
    if kind == "Point":
        if isinstance(coordinates, list) and len(coordinates) > 2:
            properties = {"z": coordinates[2], **properties}
        coordinates = [coordinates]
    rings = coordinates if kind == "Polygon" else [coordinates]
    try:
        arrays = [np.array([[float(x), float(y)] for x, y, *_ in ring]) for ring in rings]
    except (TypeError, ValueError):
        raise ValueError(f"{name}: coordinates of a {kind} must be lists of [x, y]") from None
    least = {"Point": 1, "LineString": 2, "Polygon": 4}[kind]
    for array in arrays:
        if len(array) < least or not np.isfinite(array).all():
            raise ValueError(
                f"{name}: a {kind} needs {least} finite points, got {array.tolist()!r:.80}"
            )
    if kind == "Polygon":
        outline, *holes = (ring[:-1] if (ring[0] == ring[-1]).all() else ring for ring in arrays)
        return [Shape(layer, kind, outline, True, tuple(holes), properties)]
    points = arrays[0]
    closed = kind == "LineString" and len(points) > 3 and bool((points[0] == points[-1]).all())
    return [Shape(layer, kind, points[:-1] if closed else points, closed, (), properties)]


# --- degrees ---------------------------------------------------------------------------------


def _projected(drawing: Drawing, zero: tuple[float, float] | None) -> Drawing:
    if not drawing.shapes:
        return scaled(drawing._replace(units="m"), zero)  # raises
    low, high = drawing.bounds()
    if np.abs([low[0], high[0]]).max() > 180 or np.abs([low[1], high[1]]).max() > 90:
        raise ValueError(
            f"{drawing.path}: coordinates up to ({high[0]:.7g}, {high[1]:.7g}) are not longitudes "
            "and latitudes in degrees: give another unit (--units)"
        )
    zero = tuple(low.tolist()) if zero is None else zero
    metres = [
        shape._replace(
            points=from_degrees(shape.points, zero),
            holes=tuple(from_degrees(hole, zero) for hole in shape.holes),
        )
        for shape in drawing.shapes
    ]
    # Check the size as for any drawing in metres.
    checked = scaled(drawing._replace(units="m", shapes=metres), (0.0, 0.0))
    said = f"x is east and y is north of longitude {zero[0]:.9g}, latitude {zero[1]:.9g}"
    return checked._replace(units="degrees", zero=zero, said=[said, *checked.said])


def from_degrees(points: FloatArray, zero: tuple[float, float]) -> FloatArray:
    """Return longitudes and latitudes (..., 2), degrees, as metres east and north of `zero`.

    The plane is tangent to the WGS 84 ellipsoid at `zero` (longitude, latitude). Heights are
    ignored.
    """
    return (_ecef(points) - _ecef(np.array(zero))) @ _axes(zero).T


def to_degrees(points: FloatArray, zero: tuple[float, float]) -> FloatArray:
    """Return longitudes and latitudes of metres (..., 2): `from_degrees` inverted by Newton."""
    found = np.broadcast_to(np.array(zero, float), points.shape).copy()
    step = 1e-4
    for _ in range(4):
        miss = points - from_degrees(found, zero)
        columns = [
            (from_degrees(found + step * e, zero) - from_degrees(found - step * e, zero))
            / (2 * step)
            for e in np.eye(2)
        ]
        found += np.linalg.solve(np.stack(columns, axis=-1), miss[..., None])[..., 0]
    return found


def _ecef(degrees: FloatArray) -> FloatArray:
    """Return earth-fixed coordinates (..., 3), metres, of longitudes and latitudes."""
    lon, lat = np.moveaxis(np.deg2rad(degrees), -1, 0)
    normal = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    return np.stack(
        [
            normal * np.cos(lat) * np.cos(lon),
            normal * np.cos(lat) * np.sin(lon),
            normal * (1 - _E2) * np.sin(lat),
        ],
        axis=-1,
    )


def _axes(zero: tuple[float, float]) -> FloatArray:
    """Return the directions east and north (2, 3) at a longitude and latitude."""
    lon, lat = np.deg2rad(zero)
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
        ]
    )
