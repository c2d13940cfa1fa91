"""Notes on a placement: the requirement that decides, better usual layouts, weak geometry."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.app.page import digits

NAMES = {
    "position_m": ("horizontal position", "m"),
    "height_m": ("height", "m"),
    "heading_deg": ("heading", "deg"),
}
# A usual layout is mentioned if its b is smaller by this factor.
_MUCH_SMALLER = 2.0
# The lever of the tags is mentioned if the horizontal error without it is smaller by this factor.
_LEVER = 1.5
# The NEES of a consistent filter is 6, the number of unknowns; a note above this multiple of it.
_UNKNOWNS, _HIGH_NEES = 6, 1.5


def deciding_notes(result: dict[str, Any]) -> list[str]:
    """Return which requirement decides, for the zones that fail or would with one anchor less."""
    found = [(zone, "") for zone in result["zones"]]
    less = (result.get("fewest") or {}).get("one_less")
    if less is not None:
        found += [(zone, f"with {less['n_anchors']} anchors, ") for zone in less["zones"]]
    texts, longest = [], 0.0
    for zone, where in found:
        if zone["verdict"] != "fail" or "decides" not in zone:
            continue
        decides = zone["decides"]
        name, unit = NAMES[decides["requirement"]]
        value, limit = decides["value"], decides["limit"]
        reached = (
            "it is not determined"
            if value is None
            else f"{digits(value, 3)} {unit} (required: {limit:g} {unit})"
        )
        if value is not None and value <= limit:
            reached += ", but at other positions other requirements are missed"
        texts.append(
            f"{where}the {name} decides in zone {zone['name']!r}: at "
            f"{100 * zone['required']['share']:g} % of the positions {reached}"
        )
        if decides["requirement"] == "heading_deg" and value is not None:
            longest = max(longest, value / limit)
    if not texts:
        return []
    texts[0] = texts[0][0].upper() + texts[0][1:]
    return [f"{'; '.join(texts)}.{_spacing(result, longest)}"]


def _spacing(result: dict[str, Any], factor: float) -> str:
    """Return what distance of the tags a heading needs; the factor is its error over the limit."""
    if factor <= 1:
        return ""
    tags = [tag[:2] for tag in result["tags_m"]]
    span = max(math.dist(one, other) for one in tags for other in tags)
    if span == 0:
        return ""
    return (
        " The error of the heading is about inversely proportional to the distance between the "
        f"tags: with these anchors that distance would have to be about {span * factor:.2f} m "
        f"instead of {span:.2f} m. More anchors help less: twice the distance is worth about "
        "four times as many anchors."
    )


def lever_notes(result: dict[str, Any]) -> list[str]:
    """Return a note if most of the horizontal error is the tilt times the distance of the tags."""
    found: list[tuple[float, dict[str, Any]]] = []
    for zone in result["zones"]:
        lever = zone.get("lever")
        if lever is None:
            continue
        least = max(lever["at_tags_m"], lever["known_tilt_m"])
        if lever["position_m"] < _LEVER * least:
            continue
        found.append((lever["position_m"] / least, zone))
    if not found:
        return []
    _, zone = max(found, key=lambda row: row[0])
    lever, others = zone["lever"], [repr(row["name"]) for _, row in found if row is not zone]
    also = f" The same holds in {', '.join(others)}." if others else ""
    return [
        f"Most of the horizontal error in zone {zone['name']!r} is the tilt times the distance of "
        f"the body's origin from the tags ({lever['distance_m']:.2f} m). At 95 % of the positions "
        f"the error is {digits(zone['position_m']['p95'], 3)} m; with a known tilt it would be "
        f"{digits(lever['known_tilt_m'], 3)} m, with the origin at the tags "
        f"{digits(lever['at_tags_m'], 3)} m.{also} For a cart that stays upright, use "
        'attitude = "heading" in [[zones]], or put the origin of [body] at the tags. More anchors '
        "help less."
    ]


def usual_notes(result: dict[str, Any]) -> list[str]:
    """Return a note if a usual layout passes more zones than the designed one, or has a small b."""
    rows = dict(result["layouts"])
    own = rows.pop("designed", None)
    if own is None or not rows or own["verdict"] == "no requirement":
        return []
    asked = sum("share" in zone for zone in own["zones"])
    most = max(rows, key=lambda name: _passed(rows[name]))
    least = min(rows, key=lambda name: rows[name]["score_m"])
    small, large = rows[least]["score_m"], own["score_m"]
    found, names = [], []
    if _passed(rows[most]) > _passed(own):
        names.append(most)
        found.append(
            f"The usual layout {most!r} passes more zones: {_passed(rows[most])} of {asked} (the "
            f"designed layout: {_passed(own)})."
        )
    if large >= _MUCH_SMALLER * small:
        names.append(least)
        found.append(
            f"The mean error b of the usual layout {least!r} is {digits(large / small, 2)} times "
            f"smaller, {digits(small, 3)} m against {digits(large, 3)} m; it passes "
            f"{_passed(rows[least])} of {asked} zones."
        )
    if not found:
        return []
    where = " and ".join(f"layouts.{name}.anchors_m" for name in dict.fromkeys(names))
    return [
        f"{' '.join(found)} The search first reduces what all zones together lack of their "
        "requirements, and only then the mean error b. The positions are in the file of --json, "
        f"{where}: to use them, write them to a CSV file with the columns x_m,y_m,z_m for --layout."
    ]


def _passed(row: dict[str, Any]) -> int:
    return sum(zone["verdict"] == "pass" for zone in row["zones"])


def through_walls_notes(result: dict[str, Any]) -> list[str]:
    """Return a note if bodies of the check have tags inside obstacles or behind walls."""
    found = [
        f"{100 * row['share']:.1f} % of the poses in {row['name']!r}"
        for row in result["check"].get("through_walls", [])
        if row["share"] > 0
    ]
    if not found:
        return []
    reach = max(math.hypot(*tag) for tag in result["tags_m"])
    return [
        "Some bodies of the check reach through a wall or an obstacle: a tag is inside it or "
        f"behind it, at {', '.join(found)}. A zone is where the body's origin may be. "
        "Their figures count, but the robot cannot be there. If this matters, keep the zone away "
        f"from walls and obstacles: the farthest tag is {reach:.2f} m from the origin."
    ]


def cause_of(name: str, figures: dict[str, Any]) -> str:
    """Return why the wrong poses of a filter are wrong, as a sentence; ``""`` if there are none."""
    wrong = figures.get("wrong")
    if wrong is None:
        return ""
    bodies, fit = wrong["bodies"], wrong["fit"]
    zones = ", ".join(map(repr, wrong["zones"]))
    parts = [f" Wrong poses of {name!r}: {bodies}, in {zones}."]
    if fit:
        parts.append(
            f"{fit} agree{'s' * (fit == 1)} with the ranges as well as the true pose does."
        )
        if wrong["height_m"] > 2 * wrong["horizontal_m"]:
            parts.append(
                f"The error is mainly in the height ({digits(wrong['height_m'], 3)} m): mirror "
                "images above anchors of nearly one height. Anchors at different heights, or a "
                "filter that is told the height, prevent them."
            )
    if bodies > fit:
        parts.append(
            f"{bodies - fit} do{'es' * (bodies - fit == 1)} not agree with the ranges: false "
            "minima, from a start that is too far away."
        )
    ratio = figures.get("position_ratio_found")
    if ratio is not None:
        parts.append(
            f"Without them the position RMSE is {digits(ratio, 3)} times the predicted one."
        )
    return " ".join(parts)


def nees_notes(result: dict[str, Any]) -> list[str]:
    """Return a note on each filter that agrees with the bound but claims too small errors."""
    trials = result["check"].get("trials", 1)
    most = _HIGH_NEES * _UNKNOWNS + 3 * math.sqrt(2 * _UNKNOWNS / trials)
    found = []
    for name, figures in result["check"]["filters"].items():
        high = figures.get("nees", 0.0) > most and figures["holds"]
        if not high or name.endswith("not told"):
            continue
        lost = 1 - figures["found"]
        cause = (
            f" {100 * lost:.3g} % of the bodies have a pose that is wrong by much more than the "
            f"filter says; the NEES of the others is {figures['nees_found']:.2f}."
            if lost > 0 and "nees_found" in figures
            else ""
        )
        found.append(
            f"The NEES of {name!r} is {figures['nees']:.2f}, and should be near {_UNKNOWNS}: its "
            "errors are larger than its covariance says. The geometry is too weak for this filter."
            f"{cause}"
        )
    return found
