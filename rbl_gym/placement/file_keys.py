"""The format of a placement file: every table, its keys, and their values.

One table of keys serves the reader, its error messages, and the JSON schema for editors
(`file_schema`).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

from rbl_gym.geometry import bodies
from rbl_gym.measurements.ranging import NOISE_LAWS
from rbl_gym.placement.building import ATTITUDES

# Fewer anchors never determine a pose. Three leave its mirror image in their plane.
MIN_ANCHORS, MAX_ANCHORS = 3, 256
BODIES = {
    "octahedron": bodies.octahedron,
    "pyramid": bodies.pyramid,
    "cube": bodies.cube,
    "plate": lambda size_m: bodies.plate(size_m, size_m),
}
# Limits of the size of a building, metres.
MOST_M, _LEAST_M = 1e6, 1e-3


class Key(NamedTuple):
    """The values of one key.

    Attributes
    ----------
    kind
        ``"number"``, ``"count"``, ``"text"``, ``"flag"``, ``"choice"``; ``"spot"`` and ``"place"``:
        two and three numbers; ``"spots"`` and ``"places"``: lists of them; ``"line"`` and
        ``"polygon"``: checked lists of spots; ``"shares"``: numbers by name; ``"any"``: checked
        elsewhere.
    doc
        One line for the schema and the reference.
    needed, default
        Whether the key is required, and its default otherwise.
    low, high
        Limits of a number. `high` of a spot: of its distance to the origin.
    choices
        Allowed values of a choice.
    """

    kind: str
    doc: str
    needed: bool = False
    default: Any = None
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()


class Form(NamedTuple):
    """One form of a table, used if the table has the key `mark`, with `value` if given."""

    keys: dict[str, Key]
    mark: str = ""
    value: str = ""


class Table(NamedTuple):
    """A table of the file: its forms, whether there may be several, its description."""

    doc: str
    forms: tuple[Form, ...]
    many: bool = False


def _metres(doc: str, low: float = -MOST_M, high: float = MOST_M, **more: Any) -> Key:
    return Key("number", doc, low=low, high=high, **more)


def _size(doc: str, **more: Any) -> Key:
    return _metres(doc, low=_LEAST_M, **more)


_NEEDED: dict[str, Any] = {"needed": True}
_POLYGON = Key(
    "polygon", "corners [[x, y], ...] in the plan, metres, in either direction", **_NEEDED
)
_LINE = Key("line", "points [[x, y], ...] in the plan, metres", **_NEEDED)
_CLOSED = Key("flag", "whether the last point is joined to the first", default=False)
_LOW = _metres("lower height, metres", default=0.0)
_HIGH = _metres("upper height, metres", **_NEEDED)
_LINTEL = _metres("upper height, metres", default=2.1)
_FROM = _metres("lower height, metres", **_NEEDED)
_BOX = {
    "low": Key("place", "lower corner [x, y, z], metres", **_NEEDED),
    "high": Key("place", "upper corner [x, y, z], metres", **_NEEDED),
}
_SHARE: dict[str, Any] = {"low": 0.0, "high": 1.0}
_NAME = Key("text", "name in the results")
_LOSS = {
    "name": _NAME,
    "material": Key(
        "text", "one of [materials] or a standard material; opaque without material and information"
    ),
    "information": Key(
        "number", "share of a link's information that remains; give it or material", **_SHARE
    ),
}
_REACH = {
    "max_range_m": _size("a longer link has no information, metres; default: no limit"),
    "range_edge_m": _metres(
        "width over which the information falls to zero before max_range_m, metres; 0: at once",
        default=0.0,
        low=0.0,
    ),
    "half_angle_deg": Key(
        "number",
        "half angle of view about the mount's normal, degrees; default: all directions",
        low=0.1,
        high=180,
    ),
    "angle_edge_deg": Key(
        "number",
        "width over which the information falls to zero before half_angle_deg, degrees",
        default=0.0,
        low=0.0,
        high=180,
    ),
}
_ANCHORS = {
    "number": Key(
        "count",
        "number of anchors, with the fixed ones; --anchors overrides it",
        low=MIN_ANCHORS,
        high=MAX_ANCHORS,
    ),
    "fixed": Key("places", "anchors [[x, y, z], ...] that are already mounted, metres", default=[]),
    **_REACH,
}
_KIND = Key("choice", "shape of the space for anchors", needed=True)
_ZONE = {
    "name": _NAME,
    "weight": Key("number", "weight in the score", default=1.0, low=1e-6, high=1e6),
    "attitude": Key("choice", "possible rotations of the body", default="free", choices=ATTITUDES),
    "position_m": _size(
        "requirement: largest standard deviation of the horizontal position, metres"
    ),
    "height_m": _size("requirement: largest standard deviation of the height, metres"),
    "heading_deg": Key(
        "number",
        "requirement: largest standard deviation of the heading, degrees",
        low=1e-3,
        high=180.0,
    ),
    "share": Key(
        "number",
        "share of the zone in which the requirements must hold; default 0.95",
        low=0.01,
        high=0.9999,
    ),
}
_MOUNT = {
    "kind": Key("choice", "wall, ceiling, column, area or points", needed=True),
    "name": _NAME,
    "cost": Key("number", "cost of an anchor on this mount", default=1.0, low=0.0, high=1e9),
}
_AXIS = {"axis": Key("place", "direction [x, y, z] in which anchors look; default: all directions")}


_OF_LAWS = {
    "floor_m": "standard deviation of a short range, metres",
    "proportional": "growth of the standard deviation with the range, metres per metre",
    "reference_tag": "index of a tag; the range to this tag sets the noise of all ranges of an "
    "anchor",
    "sigma_m": "standard deviation of a squared range, divided by the range to the first tag, "
    "metres",
}


def _noise_form(kind: str, law: Any) -> Form:
    fields = {
        field.name: Key("any", _OF_LAWS.get(field.name, "see ranging"), default=field.default)
        for field in dataclasses.fields(law)
    }
    return Form(
        {
            **fields,
            "kind": Key("choice", "noise law", default="range"),
            "blocked_information": Key(
                "number",
                "share of a link's information that remains behind opaque obstacles",
                default=0.01,
                **_SHARE,
            ),
        },
        "kind",
        kind,
    )


# Standard materials: share of the information of a link after one crossing, 10^(-loss / 10 dB);
# rough at 6 GHz.
MATERIALS = {
    "drywall": 0.7, "glass": 0.6, "wood": 0.5, "brick": 0.15, "concrete": 0.05, "metal": 0.0,
}  # fmt: skip
MATERIALS_DOC = "share of a link's information that remains after one crossing, by name"
FORMAT: dict[str, Table] = {
    "anchors": Table(
        "the anchors: their number, their range, and without [[mounts]] where they may be mounted",
        (
            Form({"kind": _KIND, **_BOX, **_ANCHORS}, "kind", "room"),
            Form({"kind": _KIND, **_BOX, **_ANCHORS}, "kind", "box"),
            Form(
                {
                    "kind": _KIND,
                    "inner_m": Key("any", "inner radius, metres", **_NEEDED),
                    "outer_m": Key("any", "outer radius, metres", **_NEEDED),
                    **_ANCHORS,
                },
                "kind",
                "shell",
            ),
            Form(_ANCHORS),
        ),
    ),
    "mounts": Table(
        "surfaces, spaces and points where anchors may be mounted",
        (
            Form(
                {
                    **_MOUNT,
                    "line": _LINE,
                    "closed": _CLOSED,
                    "side": Key(
                        "choice",
                        "where to mount anchors; the left of a closed line is its inside",
                        default="left",
                        choices=("left", "right", "both"),
                    ),
                    "offset_m": _metres(
                        "distance in front of the line or of the wall's face, metres",
                        default=0.0,
                        low=0.0,
                    ),
                    "low_m": _LOW,
                    "high_m": _HIGH,
                },
                "kind",
                "wall",
            ),
            Form(
                {**_MOUNT, "polygon": _POLYGON, "height_m": _metres("height, metres", **_NEEDED)},
                "kind",
                "ceiling",
            ),
            Form({**_MOUNT, "polygon": _POLYGON, "low_m": _LOW, "high_m": _HIGH}, "kind", "column"),
            Form(
                {**_MOUNT, "polygon": _POLYGON, "low_m": _LOW, "high_m": _HIGH, **_AXIS},
                "kind",
                "area",
            ),
            Form(
                {
                    **_MOUNT,
                    "points": Key(
                        "places", "possible positions [[x, y, z], ...], metres", **_NEEDED
                    ),
                    **_AXIS,
                },
                "kind",
                "points",
            ),
        ),
        many=True,
    ),
    "forbidden": Table(
        "prisms in which no anchor may be mounted",
        (
            Form(
                {
                    "polygon": _POLYGON,
                    "low_m": _metres("lower height, metres; default: no limit", default=-MOST_M),
                    "high_m": _metres("upper height, metres; default: no limit", default=MOST_M),
                }
            ),
        ),
        many=True,
    ),
    "walls": Table(
        "walls: each straight piece of the line is a prism",
        (
            Form(
                {
                    "line": _LINE,
                    "closed": _CLOSED,
                    "thickness_m": _size(
                        "thickness, half on either side of the line, metres", default=0.1
                    ),
                    "low_m": _LOW,
                    "high_m": _HIGH,
                    **_LOSS,
                }
            ),
        ),
        many=True,
    ),
    "openings": Table(
        "openings in walls: doors, windows, gates",
        (Form({"line": _LINE, "low_m": _LOW, "high_m": _LINTEL}),),
        many=True,
    ),
    "obstacles": Table(
        "obstacles: boxes or prisms that weaken links; the body and the anchors are outside",
        (
            Form({"polygon": _POLYGON, "low_m": _LOW, "high_m": _HIGH, **_LOSS}, "polygon"),
            Form({**_BOX, **_LOSS}),
        ),
        many=True,
    ),
    "slabs": Table(
        "slabs between floors",
        (
            Form(
                {
                    "polygon": _POLYGON,
                    "z_m": _metres("height of the lower side, metres", **_NEEDED),
                    "thickness_m": _size("thickness upwards from z_m, metres", default=0.3),
                    **_LOSS,
                }
            ),
        ),
        many=True,
    ),
    "region": Table("a box in which the body works, in place of [[zones]]", (Form(_BOX),)),
    "zones": Table(
        "zones in which the body works, and the accuracy that each requires",
        (
            Form({"polygon": _POLYGON, "low_m": _FROM, "high_m": _HIGH, **_ZONE}, "polygon"),
            Form({**_BOX, **_ZONE}),
        ),
        many=True,
    ),
    "body": Table(
        "the tags on the body: their positions, or a shape",
        (
            Form({"tags": Key("places", "tags [[x, y, z], ...], metres", **_NEEDED)}, "tags"),
            Form(
                {
                    "shape": Key(
                        "choice", "arrangement of the tags", needed=True, choices=tuple(BODIES)
                    ),
                    "size_m": Key(
                        "any", "size, metres: edge or distance of opposite tags", default=1.0
                    ),
                }
            ),
        ),
    ),
    "noise": Table(
        "noise of the ranges, and the information that remains behind opaque obstacles",
        tuple(_noise_form(kind, law) for kind, law in NOISE_LAWS.items()),
    ),
    "prior": Table(
        "pose before the first epoch: standard deviation of each axis",
        (
            Form(
                {
                    "rotation_deg": Key(
                        "number", "rotation, degrees", default=10.0, low=1e-6, high=180.0
                    ),
                    "position_m": Key("number", "position, metres", default=0.5, low=1e-6),
                }
            ),
        ),
    ),
    "plan": Table(
        "a picture or drawing behind the results",
        (
            Form(
                {
                    "image": Key("text", "path of a picture, relative to the file"),
                    "metres_per_pixel": Key(
                        "number", "scale of the picture; needed with image", low=1e-6, high=1e6
                    ),
                    "origin": Key(
                        "spot",
                        "position [x, y] of the lower left corner of the picture, metres",
                        default=[0, 0],
                    ),
                    "drawing": Key("text", "path of the imported drawing, relative to the file"),
                    "units": Key("text", "units of the drawing", default="m"),
                    "zero": Key(
                        "spot",
                        "point [x, y] of the drawing, in its units, that is the origin of the file",
                        default=[0, 0],
                        high=1e12,  # a national grid in millimetres
                    ),
                }
            ),
        ),
    ),
}
