"""The format of a placement file: every table, its keys, and what they may hold.

One table of keys serves the reader, its messages, and the JSON schema for editors
(`file_schema`).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

from rbl_gym.geometry import bodies
from rbl_gym.measurements.ranging import NOISE_LAWS
from rbl_gym.placement.building import ATTITUDES

# Fewer anchors never tell a pose; three leave its mirror image in their plane.
MIN_ANCHORS, MAX_ANCHORS = 3, 256
BODIES = {
    "octahedron": bodies.octahedron,
    "pyramid": bodies.pyramid,
    "cube": bodies.cube,
    "plate": lambda size_m: bodies.plate(size_m, size_m),
}
# No building is larger or smaller than this, metres.
MOST_M, _LEAST_M = 1e6, 1e-3


class Key(NamedTuple):
    """What one key holds.

    Attributes
    ----------
    kind
        ``"number"``, ``"count"``, ``"text"``, ``"flag"``, ``"choice"``; ``"spot"`` and
        ``"place"``: two and three numbers; ``"spots"`` and ``"places"``: lists of them;
        ``"line"`` and ``"polygon"``: checked lists of spots; ``"shares"``: numbers by name;
        ``"any"``: looked at elsewhere.
    doc
        One line for the schema and the reference.
    needed, default
        Whether it must be there, and what stands for it where it is not.
    low, high
        Limits of a number.
    choices
        Of a choice.
    """

    kind: str
    doc: str
    needed: bool = False
    default: Any = None
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()


class Form(NamedTuple):
    """One form of a table, meant where that has the key `mark`, with `value` if given."""

    keys: dict[str, Key]
    mark: str = ""
    value: str = ""


class Table(NamedTuple):
    """A table of the file: its forms, whether there may be several, what it is for."""

    doc: str
    forms: tuple[Form, ...]
    many: bool = False


def _metres(doc: str, **more: Any) -> Key:
    return Key("number", doc, **{"low": -MOST_M, "high": MOST_M, **more})


def _size(doc: str, **more: Any) -> Key:
    return _metres(doc, low=_LEAST_M, **more)


_NEEDED: dict[str, Any] = {"needed": True}
_POLYGON = Key("polygon", "corners [[x, y], ...] in the plan, metres, in either sense", **_NEEDED)
_LINE = Key("line", "points [[x, y], ...] in the plan, metres", **_NEEDED)
_CLOSED = Key("flag", "whether the last point is joined to the first", default=False)
_LOW = _metres("lower height, metres", default=0.0)
_HIGH = _metres("upper height, metres", **_NEEDED)
_FROM = _metres("lower height, metres", **_NEEDED)
_BOX = {
    "low": Key("place", "lower corner [x, y, z], metres", **_NEEDED),
    "high": Key("place", "upper corner [x, y, z], metres", **_NEEDED),
}
_SHARE = {"low": 0.0, "high": 1.0}
_LOSS = {
    "material": Key("text", "name of one of [materials]"),
    "information": Key(
        "number", "share of a link's information that a crossing leaves, instead", **_SHARE
    ),
}
_NAME = Key("text", "what it is called in answers")
_REACH = {
    "max_range_m": _size("beyond it a link tells nothing; no limit without it"),
    "range_edge_m": _metres(
        "width over which the information falls to zero before max_range_m; 0: at once",
        default=0.0,
        low=0.0,
    ),
    "half_angle_deg": Key(
        "number", "field of view about the mount's normal; all round without it", low=0.1, high=180
    ),
    "angle_edge_deg": Key(
        "number",
        "width over which the information falls to zero before half_angle_deg; 0: at once",
        default=0.0,
        low=0.0,
        high=180,
    ),
}
_ANCHORS = {
    "number": Key(
        "count",
        "how many, the fixed ones included; or --anchors",
        low=MIN_ANCHORS,
        high=MAX_ANCHORS,
    ),
    "fixed": Key("places", "anchors [[x, y, z], ...] that stay, metres", default=[]),
    **_REACH,
}
_KIND = Key("choice", "where they may stand", needed=True)
_ZONE = {
    "name": _NAME,
    "weight": Key("number", "how much it counts in the score", default=1.0, low=1e-6, high=1e6),
    "attitude": Key(
        "choice",
        "free: turned anyhow; level: upright, all of the pose estimated; heading: tilt known",
        default="free",
        choices=ATTITUDES,
    ),
    "position_m": _size("required: one sigma of the horizontal position"),
    "height_m": _size("required: one sigma of the height"),
    "heading_deg": Key("number", "required: one sigma of the heading", low=1e-3, high=180.0),
    "share": Key("number", "in so much of the zone (0.95 without it)", low=0.01, high=0.9999),
}
_MOUNT = {
    "kind": Key("choice", "what it is", needed=True),
    "name": _NAME,
    "cost": Key("number", "of an anchor on it", default=1.0, low=0.0, high=1e9),
}
_AXIS = {
    "axis": Key("place", "direction [x, y, z] in which the anchors look; all round without it")
}


def _noise_form(kind: str, law: Any) -> Form:
    fields = {field.name: Key("any", f"{kind}: see ranging") for field in dataclasses.fields(law)}
    return Form(
        {
            **fields,
            "kind": Key("choice", "law of the ranges", default="range"),
            "blocked_information": Key(
                "number",
                "share that obstacles without a share of their own leave, once",
                default=0.01,
                **_SHARE,
            ),
        },
        "kind",
        kind,
    )


MATERIALS_DOC = "share of a link's information that one crossing leaves, by name"
FORMAT: dict[str, Table] = {
    "anchors": Table(
        "what is placed, and where without [[mounts]]",
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
        "where anchors may stand",
        (
            Form(
                {
                    **_MOUNT,
                    "line": _LINE,
                    "closed": _CLOSED,
                    "side": Key(
                        "choice",
                        "on which side of the line; left of a closed one is inside",
                        default="left",
                        choices=("left", "right", "both"),
                    ),
                    "offset_m": _metres(
                        "how far in front of the wall's face", default=0.0, low=0.0
                    ),
                    "low_m": _LOW,
                    "high_m": _HIGH,
                },
                "kind",
                "wall",
            ),
            Form(
                {**_MOUNT, "polygon": _POLYGON, "height_m": _metres("its height", **_NEEDED)},
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
                    "points": Key("places", "candidates [[x, y, z], ...], metres", **_NEEDED),
                    **_AXIS,
                },
                "kind",
                "points",
            ),
        ),
        many=True,
    ),
    "forbidden": Table(
        "no anchors here",
        (
            Form(
                {
                    "polygon": _POLYGON,
                    "low_m": _metres("from this height; any without it", default=-MOST_M),
                    "high_m": _metres("up to this height; any without it", default=MOST_M),
                }
            ),
        ),
        many=True,
    ),
    "walls": Table(
        "walls that links go through",
        (
            Form(
                {
                    "line": _LINE,
                    "closed": _CLOSED,
                    "thickness_m": _size("about the line", default=0.1),
                    "low_m": _LOW,
                    "high_m": _HIGH,
                    **_LOSS,
                }
            ),
        ),
        many=True,
    ),
    "obstacles": Table(
        "what stands in the way of links, the body and anchors",
        (
            Form({"polygon": _POLYGON, "low_m": _LOW, "high_m": _HIGH, **_LOSS}, "polygon"),
            Form({**_BOX, **_LOSS}),
        ),
        many=True,
    ),
    "slabs": Table(
        "between floors",
        (
            Form(
                {
                    "polygon": _POLYGON,
                    "z_m": _metres("height of its lower side", **_NEEDED),
                    "thickness_m": _size("from there up", default=0.3),
                    **_LOSS,
                }
            ),
        ),
        many=True,
    ),
    "region": Table("a box in which the body works: one zone of that name", (Form(_BOX),)),
    "zones": Table(
        "where the body works",
        (
            Form({"polygon": _POLYGON, "low_m": _FROM, "high_m": _HIGH, **_ZONE}, "polygon"),
            Form({**_BOX, **_ZONE}),
        ),
        many=True,
    ),
    "body": Table(
        "places of the tags on the body",
        (
            Form({"tags": Key("places", "tags [[x, y, z], ...], metres", **_NEEDED)}, "tags"),
            Form(
                {
                    "shape": Key("choice", "of tags", needed=True, choices=tuple(BODIES)),
                    "size_m": Key("any", "its size", default=1.0),
                }
            ),
        ),
    ),
    "noise": Table(
        "of the ranges", tuple(_noise_form(kind, law) for kind, law in NOISE_LAWS.items())
    ),
    "prior": Table(
        "what is known of the pose before the first range, one sigma per axis",
        (
            Form(
                {
                    "rotation_deg": Key("number", "of turn", default=10.0, low=1e-6, high=180.0),
                    "position_m": Key("number", "of place", default=0.5, low=1e-6),
                }
            ),
        ),
    ),
    "plan": Table(
        "a drawing behind the answers",
        (
            Form(
                {
                    "image": Key("text", "path of a picture, from the file's folder"),
                    "metres_per_pixel": Key("number", "its scale", default=1.0, low=1e-6, high=1e6),
                    "origin": Key("spot", "place [x, y] of its lower left corner", default=[0, 0]),
                    "drawing": Key("text", "path of the drawing that was imported"),
                    "units": Key("text", "of the drawing", default="m"),
                    "zero": Key("spot", "its point that is the origin here", default=[0, 0]),
                }
            ),
        ),
    ),
}
