"""Read a floor plan from a drawing file."""

from __future__ import annotations

from pathlib import Path

from rbl_gym.placement.plans import dxf, geojson
from rbl_gym.placement.plans.drawing import UNITS, Drawing

__all__ = ["read_drawing"]

_SUFFIXES = (".dxf", ".geojson", ".json")


def read_drawing(
    path: str,
    units: str | None = None,
    zero: tuple[float, float] | None = None,
    layer_property: str | None = None,
) -> Drawing:
    """Read a floor plan from a DXF or GeoJSON file.

    Parameters
    ----------
    path
        The file: `.dxf`, `.geojson` or `.json`.
    units
        Unit of the coordinates: a key of `drawing.UNITS`, or ``degrees`` (GeoJSON only). None: the
        unit that the file states.
    zero
        The point of the file, in its own units, that becomes (0, 0). None: the origin of the file,
        or the lower left corner if the plan is in degrees or far from its origin.
    layer_property
        The property of a GeoJSON feature that names its layer. None: the first of `layer`, `kind`
        and `class` that exists.

    Raises
    ------
    ValueError
        If the file has another type, no unit or no line. The message names the file.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".dwg":
        raise ValueError(f"{path}: DWG files cannot be read: save the drawing as DXF")
    if suffix not in _SUFFIXES:
        raise ValueError(f"{path}: the name of a drawing must end in one of {', '.join(_SUFFIXES)}")
    known = (*UNITS, "degrees")
    if units is not None and units not in known:
        raise ValueError(f"units must be one of {', '.join(known)}, got {units!r}")
    if suffix != ".dxf":
        return geojson.read_geojson(path, units, zero, layer_property)
    if units == "degrees":
        raise ValueError(f"{path}: units of a DXF must be units of length, got degrees")
    if layer_property is not None:
        raise ValueError(f"{path}: layer_property applies to GeoJSON only, got {layer_property!r}")
    return dxf.read_dxf(path, units, zero)
