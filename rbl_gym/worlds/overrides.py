"""Frozen dataclasses changed by plain dicts, as JSON and TOML hold them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from rbl_gym.checks import check_one_of
from rbl_gym.geometry.regions import REGIONS, Box
from rbl_gym.measurements.noise_laws import NOISE_FORMS, NOISE_LAWS

# Fields that take a name or a dict as they are.
_READ_BY_THEMSELVES = ("inertial",)


def replace(base: Any, changes: Mapping[str, Any], path: str) -> Any:
    """A copy of a frozen dataclass with other fields; nested ones take mappings of their own.

    Parameters
    ----------
    base
        The dataclass.
    changes
        Name of a field -> its value, or a mapping of what changes in it. With the key ``"kind"``
        the mapping says all of a region (`REGIONS`) or noise law (`NOISE_FORMS`).
    path
        How errors call it.

    Raises
    ------
    ValueError
        On an unknown field or kind, or a value that its field refuses.
    """
    fields = {entry.name for entry in dataclasses.fields(base)}
    values = {}
    for key, value in changes.items():
        if key not in fields:
            raise ValueError(f"{path} has no field {key!r}; it has {', '.join(sorted(fields))}")
        old = getattr(base, key)
        if key in _READ_BY_THEMSELVES:
            values[key] = value
        elif isinstance(value, Mapping):
            values[key] = _nested(old, value, f"{path}.{key}")
        elif dataclasses.is_dataclass(old) and not dataclasses.is_dataclass(value):
            raise ValueError(f"{path}.{key} must be a dict of its fields, got {value!r:.80}")
        else:
            values[key] = value
    try:
        return dataclasses.replace(base, **values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def _nested(old: Any, value: Mapping[str, Any], path: str) -> Any:
    unset = {"box": Box} if old is None else {}
    kinds = next((k for k in (REGIONS, NOISE_LAWS) if isinstance(old, tuple(k.values()))), unset)
    if "kind" not in value:
        if not dataclasses.is_dataclass(old):
            raise ValueError(f"{path} is not a nested field, got a dict {dict(value)!r:.80}")
        return replace(old, value, path)
    if not kinds:
        raise ValueError(f"{path} comes in one kind only, got kind {value['kind']!r}")
    forms = NOISE_FORMS if kinds is NOISE_LAWS else kinds
    kind = forms[check_one_of(f"{path}.kind", value["kind"], list(forms))]
    try:
        return kind(**{key: item for key, item in value.items() if key != "kind"})
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
