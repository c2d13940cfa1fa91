"""The JSON schema of a placement file, for editors."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.placement.file_keys import FORMAT, MATERIALS_DOC, Form, Key

__all__ = ["schema"]

_SPOT = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
_PLACE = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
_TYPES: dict[str, dict[str, Any]] = {
    "number": {"type": "number"},
    "count": {"type": "integer"},
    "text": {"type": "string", "minLength": 1},
    "flag": {"type": "boolean"},
    "choice": {"type": "string"},
    "spot": _SPOT,
    "place": _PLACE,
    "places": {"type": "array", "items": _PLACE},
    "line": {"type": "array", "items": _SPOT, "minItems": 2},
    "polygon": {"type": "array", "items": _SPOT, "minItems": 3},
    "any": {"type": "number"},
}


def schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a file."""
    tables: dict[str, Any] = {
        "name": {"description": "of the problem", **_TYPES["text"]},
        "$schema": {"description": "where this schema is, for editors", **_TYPES["text"]},
    }
    for name, table in FORMAT.items():
        forms = [_form_schema(form) for form in table.forms]
        one = forms[0] if len(forms) == 1 else {"anyOf": forms}
        one = {"description": table.doc, **one}
        tables[name] = {"type": "array", "items": one} if table.many else one
    tables["materials"] = {
        "description": MATERIALS_DOC,
        "type": "object",
        "additionalProperties": {"type": "number", "minimum": 0, "maximum": 1},
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Placement problem of rbl-gym place",
        "type": "object",
        "additionalProperties": False,
        "required": ["body", "noise"],
        "allOf": [
            {"anyOf": [{"required": ["anchors"]}, {"required": ["mounts"]}]},
            {"oneOf": [{"required": ["region"]}, {"required": ["zones"]}]},
        ],
        "properties": tables,
    }


def _form_schema(form: Form) -> dict[str, Any]:
    properties = {name: _key_schema(key) for name, key in form.keys.items()}
    needed = [name for name, key in form.keys.items() if key.needed]
    if form.value:
        if form.keys[form.mark].default != form.value and form.mark not in needed:
            needed.append(form.mark)
        properties[form.mark] = {"const": form.value, "description": form.keys[form.mark].doc}
    return {
        "type": "object",
        "additionalProperties": False,
        "required": needed,
        "properties": properties,
    }


def _key_schema(key: Key) -> dict[str, Any]:
    found: dict[str, Any] = {"description": key.doc, **_TYPES[key.kind]}
    if key.choices:
        found = {"description": key.doc, "enum": list(key.choices)}
    if key.low > -math.inf:
        found["minimum"] = key.low
    if key.high < math.inf and key.kind != "spot":
        found["maximum"] = key.high
    if key.default is not None:
        found["default"] = key.default
    return found
