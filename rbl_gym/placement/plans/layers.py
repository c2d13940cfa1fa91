"""Convert layers of a drawing to tables of a building file: walls, obstacles, zones, mounts."""

from __future__ import annotations

import fnmatch
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import did_you_mean
from rbl_gym.geometry.polygons import area, contains, rectangle
from rbl_gym.placement.file_keys import MATERIALS
from rbl_gym.placement.plans.drawing import Drawing, Shape
from rbl_gym.placement.plans.pairs import centre_lines
from rbl_gym.placement.plans.parts import (
    count_blocks,
    lines_of,
    numbered,
    outline_of,
    points_of,
    rounded,
    spots_of,
)
from rbl_gym.placement.plans.uses import KEYS, KINDS, Use
from rbl_gym.placement.plans.values import mount_values, values_of

__all__ = ["Building", "building"]

# Default heights, metres.
ZONE_M, _MOUNT_LOW_M, _BELOW_CEILING_M = (0.5, 2.0), 2.0, 0.2
# Defaults for values that a plan does not contain.
DEVICES: dict[str, Any] = {
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1, "proportional": 0.0},
}
ASSUMED = (
    "A plan states neither the tags of the body nor the noise of the ranges. Assumed: an "
    "octahedron of 6 tags, 0.8 m wide, and a standard deviation of 0.1 m. All predicted errors "
    "depend on them: to state yours, write a building file (rbl-gym plan PLAN -o F.toml) and edit "
    "its tables [body] and [noise]."
)


class Building(NamedTuple):
    """Tables of a building file, and notes on how they were made.

    The key ``#`` of a table is a comment in the file.
    """

    tables: dict[str, Any]
    used: dict[str, list[str]]
    said: list[str]


def building(
    drawing: Drawing, uses: Iterable[Use] = (), height_m: float = 3.0, n_anchors: int = 8
) -> Building:
    """Return the tables of a building file for the layers of a drawing.

    Parameters
    ----------
    drawing
        Drawing from `reading.read_drawing`.
    uses
        Uses of the layers; for several of the same layer and kind, the first counts. For a kind
        without a use, the other layers are used by their names: that of the kind, in upper or lower
        case, singular or plural.
    height_m
        Height of the ceiling above the floor, metres, for walls, obstacles and mounts without their
        own height.
    n_anchors
        Number of anchors to place.

    Raises
    ------
    ValueError
        If a layer does not exist, or a material has no known information fraction.
    """
    uses = list(uses)
    every = [*uses, *_by_name(drawing, uses)]
    made = _Maker(drawing, height_m)
    made.solid = [use.layer for use in every if use.kind in ("walls", "obstacles")]
    for use in every:
        layers = [name for name in drawing.layers() if _matches(name, use.layer)]
        if not layers:
            raise ValueError(
                f"{drawing.path}: no layer is called {use.layer!r}; the layers are "
                f"{', '.join(map(repr, drawing.layers())):.500}"
                f"{did_you_mean(use.layer, drawing.layers())}"
            )
        for layer in layers:
            # The first match counts, so that a name can precede a pattern such as A-*.
            if use.kind not in made.used.get(layer, []):
                made.take(layer, use)
    if not made.used:
        made.said.append(
            "the use of the layers is not given: give --walls LAYER, --obstacles LAYER, --zones "
            "LAYER, --mounts LAYER"
        )
    made.said += _not_used(drawing, made.used)
    made.complete(next((use.values for use in uses if use.kind == "zones"), {}))
    return Building(made.tables(n_anchors), made.used, made.said)


def _matches(name: str, pattern: str) -> bool:
    return name == pattern or fnmatch.fnmatchcase(name.lower(), pattern.lower())


def _by_name(drawing: Drawing, uses: list[Use]) -> list[Use]:
    """Return uses by layer name (wall, walls, WALLS, zone, ...), beside those that are given."""
    given = {use.kind for use in uses}
    return [
        Use(kind, layer, {})
        for kind in KINDS
        for layer in drawing.layers()
        if kind not in given
        and layer.lower() in (kind, kind.removesuffix("s"))
        and not any(_matches(layer, use.layer) for use in uses)
    ]


def _not_used(drawing: Drawing, used: Iterable[str]) -> list[str]:
    """Return a note on the layers with shapes that have no use."""
    counts = Counter(shape.layer for shape in drawing.shapes if shape.layer not in used)
    if not counts:
        return []
    total = counts.total()
    names = ", ".join(layer for layer in drawing.layers() if layer in counts)
    return [
        f"not used: {total} {'entity' if total == 1 else 'entities'} on {len(counts)} "
        f"layer{'s' if len(counts) > 1 else ''} ({names})"
    ]


class _Maker:
    """Collects the tables."""

    def __init__(self, drawing: Drawing, height_m: float) -> None:
        self.drawing = drawing
        self.height = height_m
        self.found: dict[str, list[Any]] = {kind: [] for kind in KINDS}
        self.used: dict[str, list[str]] = {}
        self.solid: list[str] = []
        self.said: list[str] = []

    def take(self, layer: str, use: Use) -> None:
        """Add the entries of one layer for one kind of use."""
        shapes = [shape for shape in self.drawing.shapes if shape.layer == layer]
        lines, marks = lines_of(shapes)
        entries, left = getattr(self, f"_{use.kind}")(lines, marks, layer, use)
        self.found[use.kind] += entries
        self.used.setdefault(layer, []).append(use.kind)
        for count, what in left:
            if count:
                self.said.append(f"layer {layer}, read as {use.kind}: {count} {what}")

    # --- kinds: entries, and (count, what) of skipped shapes -------------------------------------

    def _walls(self, lines: list[Shape], marks: list[Shape], layer: str, use: Use) -> Any:
        widest = use.values.get("side_by_side_m")
        keys = [key for key in KEYS["walls"] if key != "side_by_side_m"]
        rows = [
            {"line": points_of(line.points), **({"closed": True} if line.closed else {})}
            | self._values(line, use, keys, {"low_m": 0.0, "high_m": self.height})
            for shape in lines
            for line in (shape, *(shape._replace(points=hole) for hole in shape.holes))
        ]
        twins = []
        if widest is not None:
            rows, twins = self._centred(lines, use, widest)
        note = (
            f"pairs of lines less than {widest:g} m apart, each read as one wall" if twins else ""
        )
        return _commented(rows, layer), [
            (count_blocks(marks), "blocks, of which only the lines are read"),
            (len(marks) - count_blocks(marks), "points left out"),
            (len(twins), note),
        ]

    def _centred(self, lines: list[Shape], use: Use, widest: float) -> Any:
        """Return walls drawn as two lines: their centre lines, and the lines without a partner."""
        rings = [(ring, shape.closed) for shape in lines for ring in (shape.points, *shape.holes)]
        centred, single = centre_lines(rings, widest)
        values = self._values(None, use, KEYS["walls"], {"low_m": 0.0, "high_m": self.height})
        values.pop("side_by_side_m", None)
        rows = [
            {"line": points_of(line), **values, "thickness_m": round(width, 3)}
            for line, width in centred
        ]
        return rows + [{"line": points_of(line), **values} for line in single], centred

    def _obstacles(self, lines: list[Shape], marks: list[Shape], layer: str, use: Use) -> Any:
        heights = {"low_m": 0.0, "high_m": self.height}
        return self._rings(lines, marks, layer, use, heights)

    _forbidden = _obstacles

    def _zones(self, lines: list[Shape], marks: list[Shape], layer: str, use: Use) -> Any:
        heights: dict[str, Any] = dict(zip(("low_m", "high_m"), ZONE_M, strict=True))
        rows, left = self._rings(lines, marks, layer, use, heights)
        texts = [label for label in self.drawing.labels if label.layer == layer]
        for count, row in enumerate(rows, start=1):
            ring = np.array(row["polygon"])
            inside = [
                label.text for label in texts if label.text and contains(ring, label.at[None])[0]
            ]
            plain = layer if len(rows) == 1 else f"{layer} {count}"
            name = str(row.pop("name", inside[0] if len(inside) == 1 else plain))
            rows[count - 1] = {key: row[key] for key in ("#",) if key in row} | {"name": name} | row
        return rows, left

    def _mounts(self, lines: list[Shape], marks: list[Shape], layer: str, use: Use) -> Any:
        rows, left, short, kind = [], [], [], use.values.get("kind")
        top = self.height - _BELOW_CEILING_M
        sides = {"low_m": min(_MOUNT_LOW_M, 0.7 * self.height), "high_m": top}
        name = {"name": layer}
        if kind == "points" or (kind is None and (not lines or not count_blocks(marks))):
            spots = spots_of(marks, lines if kind else [], use)
            lines = [] if kind else lines
            allowed = ("name", "cost")
            if spots:
                values = self._values(None, use, allowed, name)
                rows.append({"kind": "points", "points": spots} | values)
        for line in lines:
            own = kind or line.properties.get("kind")
            own = own if own in ("wall", "ceiling", "column", "area") else "wall"
            if own == "wall":
                allowed = ("name", "low_m", "high_m", "side", "cost")
                side = {"side": "left" if line.closed else "both"}
                ring = {"closed": True} if line.closed else {}
                values = self._mount(line, use, allowed, name | sides | side)
                points = line.points
                if values["high_m"] < values["low_m"]:
                    short.append(line)
                    continue
                if line.closed and area(points) < 0:  # counter-clockwise: left is inside
                    points = points[::-1]
                rows.append({"kind": own, "line": points_of(points), **ring, **values})
            elif not line.closed:
                left.append(line)
            else:
                ring = outline_of(line)
                flat = own == "ceiling"
                allowed = ("name", "cost", *(("height_m",) if flat else ("low_m", "high_m")))
                heights = {"height_m": self.height} if flat else sides
                values = self._mount(line, use, allowed, name | heights)
                rows.append({"kind": own, "polygon": points_of(ring), **values})
        return _commented(rows, layer), [
            (len(left), "shapes that are not closed were left out"),
            (len(short), "walls end below the lowest height of the mounts, and have no mount"),
        ]

    def _fixed(self, lines: list[Shape], marks: list[Shape], layer: str, use: Use) -> Any:
        return spots_of(marks, lines, use), [
            (sum(not line.closed for line in lines), "lines left out")
        ]

    def _rings(
        self, lines: list[Shape], marks: list[Shape], layer: str, use: Use, usual: dict[str, Any]
    ) -> Any:
        rows, failed = [], 0
        for line in lines:
            if not line.closed or abs(area(line.points)) < 1e-6:
                continue
            ring = outline_of(line)
            failed += line.holes != () and len(ring) == len(line.points)
            values = self._values(line, use, KEYS[use.kind], usual)
            rows.append({"polygon": points_of(ring), **values})
        return _commented(rows, layer), [
            (len(lines) - len(rows), "lines that enclose no area were left out"),
            (failed, "holes could not be cut out"),
            (len(marks) - count_blocks(marks), "points left out"),
        ]

    def _values(
        self, shape: Shape | None, use: Use, keys: Iterable[str], usual: dict[str, Any]
    ) -> dict[str, Any]:
        return values_of(self.drawing.path, shape, use, keys, usual)

    def _mount(
        self, shape: Shape, use: Use, keys: Iterable[str], usual: dict[str, Any]
    ) -> dict[str, Any]:
        solid = any(_matches(shape.layer, name) for name in self.solid)
        make = mount_values if solid else values_of
        return make(self.drawing.path, shape, use, keys, usual)

    # --- the whole -------------------------------------------------------------------------------

    def complete(self, asked: dict[str, Any]) -> None:
        """Add default mounts and a default zone if no layer has them; `asked`: keys of a zone."""
        top = rounded(self.height - _BELOW_CEILING_M)
        if not self.found["mounts"]:
            low = min(_MOUNT_LOW_M, 0.7 * self.height)
            self.found["mounts"] = [
                {
                    "#": "no layer of mounts: anchors may be mounted on both sides of every wall",
                    "kind": "wall",
                    **{key: wall[key] for key in ("line", "closed") if key in wall},
                    "low_m": rounded(max(low, wall["low_m"])),
                    "high_m": rounded(min(top, wall["high_m"])),
                    "side": "both",
                }
                for wall in self.found["walls"]
                if wall["high_m"] > low
            ]
            if self.found["mounts"]:
                self.said.append("no layer of mounts: anchors may be mounted on every wall")
            else:
                self.said.append(
                    "no layer of mounts or walls: anchors may be mounted on the ceiling"
                )
                self.found["mounts"] = [
                    {
                        "#": "no layer of mounts: anchors may be mounted on the ceiling",
                        "kind": "ceiling",
                        "polygon": self._outline(),
                        "height_m": rounded(self.height),
                    }
                ]
        if not self.found["zones"]:
            self.said.append("no layer of zones: the body works in the whole rectangle of the plan")
            self.found["zones"] = [
                {
                    "#": "no layer of zones: the whole rectangle of the plan",
                    "polygon": self._outline(),
                    "name": "plan",
                    "low_m": ZONE_M[0],
                    "high_m": ZONE_M[1],
                    **asked,
                }
            ]

        numbered(self.found["mounts"])
        taken: set[str] = set()
        zones: list[dict[str, Any]] = self.found["zones"]
        for zone in zones:
            name, count = zone["name"], 2
            while zone["name"] in taken:
                zone["name"], count = f"{name} {count}", count + 1
            taken.add(zone["name"])

    def _outline(self) -> list[list[float]]:
        """Return the bounding rectangle of the used layers."""
        low, high = self.drawing._replace(
            shapes=[s for s in self.drawing.shapes if s.layer in self.used or not self.used]
        ).bounds()
        return points_of(rectangle(low, high))

    def tables(self, n_anchors: int) -> dict[str, Any]:
        anchors: dict[str, Any] = {"number": n_anchors}
        if self.found["fixed"]:
            anchors["fixed"] = self.found["fixed"]
            anchors["number"] = max(n_anchors, len(self.found["fixed"]))
        materials = {
            row["material"]
            for kind in ("walls", "obstacles")
            for row in self.found[kind]
            if "material" in row
        }
        drawing = self.drawing
        return {
            "name": Path(drawing.path).stem,
            "anchors": anchors,
            "zones": self.found["zones"],
            "mounts": self.found["mounts"],
            **{
                key: self.found[key]
                for key in ("forbidden", "walls", "obstacles")
                if self.found[key]
            },
            **(
                {"materials": {key: MATERIALS[key] for key in MATERIALS if key in materials}}
                if materials
                else {}
            ),
            "plan": {"drawing": drawing.path, "units": drawing.units, "zero": list(drawing.zero)},
            **DEVICES,
        }


def _commented(rows: list[dict[str, Any]], layer: str) -> list[dict[str, Any]]:
    """Return the rows of a layer; a comment on the first names the layer."""
    return [{"#": f"layer {layer}", **row} if k == 0 else row for k, row in enumerate(rows)]
