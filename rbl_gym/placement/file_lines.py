"""Find the line of a table's key in a TOML file, for errors."""

from __future__ import annotations

import re

from rbl_gym.placement.file_keys import FORMAT

# Start of an error message: a table, perhaps with an index, perhaps with a key.
_SUBJECT = re.compile(r"^([A-Za-z_]\w*)(?:\[(\d+)\])?(?:(?:\.|: )([A-Za-z_]\w*))?")

# Errors of the TOML parser.
_TWICE = re.compile(r"Cannot declare \('(\w+)',\) twice")
_AT = re.compile(r"at line (\d+)")
# A number that is followed by a unit.
_UNIT = re.compile(r"^\s*\w+\s*=\s*[-+]?[\d.]+\s*[A-Za-z%\u00b0]+\s*(#.*)?$")

# A number with a decimal comma.
_COMMA = re.compile(r"^\s*\w+\s*=\s*[-+]?(\d+),(\d+)\s*(#.*)?$")

_UNKNOWN = re.compile(r"unknown key '(\w+)'")


def line_of(text: str, message: str) -> int | None:
    """Return the line, from 1, of an error message about the tables of a TOML file.

    None if the file does not have the key, or not as tables with keys.
    """
    subject = _SUBJECT.match(message)
    if subject is None:
        return None
    table, index, key = subject.groups()
    unknown = _UNKNOWN.search(message)
    key = unknown[1] if unknown else key
    headers = [f"[[{table}]]"] if index is not None else [f"[{table}]", f"[[{table}]]"]
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    starts = [k for k, line in enumerate(lines) if line.replace(" ", "") in headers]
    which = int(index or 0)
    if which >= len(starts):
        top = [k for k, line in enumerate(lines) if re.match(rf"{table}\s*=", line)]
        return top[0] + 1 if top and index is None else None
    start = starts[which]
    for k in range(start + 1, len(lines)):
        if lines[k].startswith("["):
            break
        if key is not None and re.match(rf"{key}\s*=", lines[k]):
            return k + 1
    return start + 1


def advice(data: bytes, message: str) -> str:
    """Return what to do about an error of the TOML parser, after its message; ``""`` if unknown.

    Parameters
    ----------
    data
        The file.
    message
        The error.
    """
    if twice := _TWICE.search(message):
        table = FORMAT.get(twice[1])
        if table is not None and not table.many:
            return f": a file has one [{twice[1]}]"
        return f": write [[{twice[1]}]] for each"
    lines = data.decode("utf-8", errors="replace").split("\n")
    at = _AT.search(message)
    line = lines[int(at[1]) - 1] if at and int(at[1]) <= len(lines) else ""
    if comma := _COMMA.match(line):
        return f": numbers have a decimal point, {comma[1]}.{comma[2]}"
    if _UNIT.match(line):
        return ": values are numbers without units; the unit is in the name of the key"
    return ""
