"""Change frozen dataclasses with plain dicts, as in JSON and TOML."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterable, Mapping
from typing import Any

from rbl_gym.checks import check_one_of, did_you_mean
from rbl_gym.geometry.regions import REGIONS, Box
from rbl_gym.measurements.noise_laws import NOISE_FORMS, NOISE_LAWS

# Fields whose value is a name or a dict.
_READ_BY_THEMSELVES = ("inertial",)
# Fields that are a box or None. A dict gives the whole box.
_OPTIONAL_BOXES = ("start_volume",)
# Keys of values to draw from, in scenes of a family (`laws`).
_LAWS = ("uniform", "log-uniform", "integers", "choice", "repeat")


def replace(base: Any, changes: Mapping[str, Any], path: str, others: tuple[str, ...] = ()) -> Any:
    """Return a copy of a frozen dataclass with changed fields; nested ones take mappings.

    Parameters
    ----------
    base
        The dataclass.
    changes
        Names of fields and their new values, or mappings with changes of nested fields. A mapping
        with the key ``"kind"`` gives a complete region (`REGIONS`) or noise law (`NOISE_FORMS`).
    path
        Name of the dataclass in errors.
    others
        Further keys that the caller reads itself; the error of an unknown field lists them, too.

    Raises
    ------
    ValueError
        If a field or kind is unknown, or a value is invalid.
    """
    fields = {entry.name for entry in dataclasses.fields(base)}
    _check_fields(changes, fields, path, others)
    values = {}
    for key, value in changes.items():
        old = getattr(base, key)
        if key in _READ_BY_THEMSELVES:
            values[key] = value
        elif isinstance(value, Mapping):
            values[key] = _nested(old, value, f"{path}.{key}")
        elif dataclasses.is_dataclass(old) and not dataclasses.is_dataclass(value):
            inner = ", ".join(entry.name for entry in dataclasses.fields(old))
            raise ValueError(
                f"{path}.{key} must be a dict of its fields ({inner}), got {value!r:.80}"
            )
        else:
            values[key] = value
    try:
        return dataclasses.replace(base, **values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def _check_fields(
    given: Iterable[str], fields: Iterable[str], path: str, others: Iterable[str] = ()
) -> None:
    known = sorted({*fields, *others})
    for key in given:
        if key not in fields:
            raise ValueError(
                f"{path} has no field {key!r}; its fields are {', '.join(known)}"
                f"{did_you_mean(key, known)}"
            )


def _nested(old: Any, value: Mapping[str, Any], path: str) -> Any:
    kinds = next((k for k in (REGIONS, NOISE_LAWS) if isinstance(old, tuple(k.values()))), {})
    if old is None and path.endswith(_OPTIONAL_BOXES):
        kinds, value = {"box": Box}, {"kind": "box", **value}
    if not kinds and not dataclasses.is_dataclass(old):
        raise ValueError(
            f"{path} must be one value, got the dict {dict(value)!r:.80}. To draw the value at "
            "random, use scenes= in place of scene=, and a dict with one of the keys "
            f"{', '.join(_LAWS)}"
            f"{''.join(did_you_mean(key, _LAWS) for key in [*value][:1])}"
        )
    if "kind" not in value:
        return replace(old, value, path)
    if not kinds:
        raise ValueError(f"{path} has only one kind: leave out kind, got {value['kind']!r}")
    forms = NOISE_FORMS if kinds is NOISE_LAWS else kinds
    kind = forms[check_one_of(f"{path}.kind", value["kind"], list(forms))]
    given: dict[str, Any] = {key: item for key, item in value.items() if key != "kind"}
    fields = inspect.signature(kind).parameters
    _check_fields(given, fields, path)
    missing = [k for k, p in fields.items() if p.default is p.empty and k not in given]
    if missing:
        raise ValueError(f"{path} must have the field {missing[0]!r}, got {given!r:.80}")
    try:
        return kind(**given)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
