"""All tables of a placement, for the terminal, the page and the report."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from rbl_gym.app.page import digits
from rbl_gym.app.place_answer import WORDS, share_heading, typical, without_name
from rbl_gym.app.place_loss import loss_tables
from rbl_gym.app.place_survey import survey_table

# Fractions of lost bodies above this are mentioned.
_MANY_LOST = 0.01


class Rows(NamedTuple):
    """A table of texts; the first column is text, the others are figures."""

    title: str
    headings: list[str]
    rows: list[list[str]]


def tables(result: dict[str, Any]) -> Iterator[Rows]:
    """Return all tables of a result, starting with the requirements."""
    yield _zones(result)
    yield from (Rows(*one) for one in loss_tables(result["zones"]))
    if "fewest" in result:
        yield from fewest_rows(result["fewest"])
    yield anchor_rows(result)
    yield _without(result)
    if result["next_anchor"] is not None:
        yield _next(result)
    if any(anchor["cost"] != 1 for anchor in result["anchors"]):
        yield _mounts(result)
    yield _worst(result)
    yield _prediction(result)
    yield Rows(*survey_table(result))
    yield layout_rows(result["layouts"])
    yield _check(result["check"])
    if any("within" in row for row in _check_zones(result["check"])):
        yield _check_within(result["check"])
    if "against_number" in result:
        yield _numbers(result["against_number"])


def verdict(result: dict[str, Any]) -> str:
    """Return the answer in one sentence."""
    survives = ", with any one anchor missing" if result["survive"] else ""
    count = f"{result['n_anchors']} anchors{survives}"
    if result["verdict"] == "no requirement":
        return f"{count}: {typical(result['zones'])}. No zone has a requirement."
    words = {"pass": "PASS", "fail": "FAIL", "undecided": "TOO CLOSE TO TELL"}
    zones = [row for row in result["zones"] if row["verdict"] != "no requirement"]
    passed = sum(row["verdict"] == "pass" for row in zones)
    text = f"{words[result['verdict']]}: {count}, {passed} of {len(zones)} zones pass."
    fewest = result.get("fewest")
    if fewest is None:
        how = "--optimise" if "given" in result["layouts"] else "--fewest"
        return f"{text} Try {how}, or more --anchors." if result["verdict"] == "fail" else text
    if not fewest["met"]:
        return f"{text} No layout was found that passes: allow more anchors, or require less."
    less = fewest["one_less"]
    if less is None:
        return f"{text} This is the least number that was allowed."
    count = less["n_anchors"]
    if fewest["proved"]:
        return f"{text} This is the least number: no layout of {count} anchors passes."
    searches = f"{fewest['searches']} search{'es' if fewest['searches'] > 1 else ''}"
    return (
        f"{text} This is the least number found: {searches} found no layout of {count} anchors "
        "that passes."
    )


def notes(result: dict[str, Any]) -> list[str]:
    """Return notes on the tables and warnings, one or two sentences each."""
    criteria, check = result["criteria"], result["check"]
    conditioning, turn = criteria["conditioning"], criteria["rotation_rad"]
    found = [
        "A place meets the requirement if the errors of horizontal position, height and heading "
        "are within their limits. An error is one sigma, from one epoch of ranges (root mean "
        "square over rotations of the body). The interval (95 %) is due to the sampling of places; "
        "a zone passes if the whole interval is above the required share. Margin: limit over the "
        "error at the required share.",
        "Predicted: Cramer-Rao bound of all three axes together; b is the root mean square tag "
        "error.",
        f"Criteria: position {criteria['position_m']:.4g} m, rotation "
        f"{'-' if turn is None else f'{math.degrees(turn):.3g}'} deg, D-optimal "
        f"{criteria['d_optimal_m']:.4g} m, E-optimal {criteria['e_optimal_m']:.4g} m, conditioning "
        + ("infinite (coplanar)." if conditioning is None else f"{conditioning:.3g}."),
        f"Check: {check['trials']} bodies at random poses, equally many in each zone; the EKF "
        f"has a prior of {check['prior_rotation_deg']:g} deg and {check['prior_position_m']:g} m "
        "around the truth. RMSE, ratio and NEES (6 if consistent) are of all bodies that have a "
        "pose; found: share of bodies with an error below the limit that a consistent filter "
        "exceeds once in a million.",
    ]
    found.append(
        "Mounting list: z is above the floor of the building, z = 0; above slab: above the top of "
        "the slab that is named. Left and right are as you face the wall; other distances are at "
        "right angles to the wall. All distances are to points that the anchor sees."
    )
    for name, figures in check["filters"].items():
        if 1 - figures["found"] > _MANY_LOST:
            found.append(
                f"{name}: {100 * (1 - figures['found']):.3g} % of the bodies are not found. For "
                "the others the RMSE of the position is "
                + digits(figures.get("position_rmse_found_m"), 4)
                + " m, "
                + digits(figures.get("position_ratio_found"), 3)
                + " times the predicted one."
            )
    if result["obstacles"]:
        found.append(
            "The filter 'not told' does not know which links are blocked. The other estimators "
            "and the prediction know it, as some radios report it, and weigh these links less. "
            "A 'no' under 'agrees' for 'not told' does not contradict the prediction."
        )
    return found


def _zones(result: dict[str, Any]) -> Rows:
    rows = []
    for row in result["zones"]:
        figures = [
            digits(row[key][what], 3)
            for key in ("position_m", "heading_deg")
            for what in ("median", "at_share")
        ]
        rows.append(
            [row["name"], WORDS[row["verdict"]], *_share(row), *figures, without_name(result, row)]
        )
    what = share_heading(result["zones"])
    headings = [
        "zone", "verdict", "within", "95 % interval", "required", "margin",
        "horizontal median (m)", what, "heading median (deg)", what,
    ]  # fmt: skip
    if any(row[-1] is not None for row in rows):
        return Rows(title(result), [*headings, "worst without"], [_texts(row) for row in rows])
    return Rows(title(result), headings, [_texts(row[:-1]) for row in rows])


def title(result: dict[str, Any]) -> str:
    """Return the name, the number of anchors, and the search that found them."""
    return f"{result['scene']}: {result['n_anchors']} anchors ({result['method']})"


def _texts(row: list[Any]) -> list[str]:
    return ["-" if cell is None else str(cell) for cell in row]


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _share(row: dict[str, Any]) -> list[str]:
    """Return fraction within limits, interval, requirement, margin; dashes without requirement."""
    if "share" not in row:
        return ["-"] * 4
    interval = f"{100 * row['share_low']:.1f} to {100 * row['share_high']:.1f} %"
    return [_percent(row["share"]), interval, required(row["required"]), f"{row['margin']:.3f}"]


def required(asked: dict[str, Any]) -> str:
    """Return a requirement in words: ``0.1 m, 5 deg in 95 %``."""
    parts = []
    if asked["position_m"] is not None:
        parts.append(f"{asked['position_m']:g} m")
    if asked["height_m"] is not None:
        parts.append(f"height {asked['height_m']:g} m")
    if asked["heading_deg"] is not None:
        parts.append(f"{asked['heading_deg']:g} deg")
    return f"{', '.join(parts)} in {100 * asked['share']:g} %"


def fewest_rows(fewest: dict[str, Any]) -> Iterator[Rows]:
    """Yield the table of the requirements that fail with one anchor less."""
    less = fewest["one_less"]
    if less is None:
        return
    rows = []
    for row in (row for row in less["zones"] if "share" in row):
        needs = row["would_pass"]
        values = [digits(needs.get(key), 3) for key in ("position_m", "height_m", "heading_deg")]
        values.append(f"{needs['factor']:.3f}")
        rows.append([row["name"], WORDS[row["verdict"]], *_share(row), *values])
    headings = [
        "zone", "verdict", "within", "95 % interval", "required", "margin",
        "would pass: horizontal (m)", "height (m)", "heading (deg)", "or all limits x",
    ]  # fmt: skip
    yield Rows(f"with one anchor fewer, {less['n_anchors']}", headings, rows)


def anchor_rows(result: dict[str, Any]) -> Rows:
    """Return the positions of the anchors."""
    rows = [
        [
            anchor["name"],
            *(f"{anchor[key]:.3f}" for key in ("x_m", "y_m", "z_m")),
            anchor["mount"] + (", fixed" if anchor["fixed"] else ""),
            f"{100 * anchor['sees']:.0f} %",
        ]
        for anchor in result["anchors"]
    ]
    headings = ["anchor", "x (m)", "y (m)", "z (m)", "mount", "sees (share of the zones)"]
    return Rows("anchors", headings, rows)


def _without(result: dict[str, Any]) -> Rows:
    """Return the effect of each anchor: the result without it."""
    asking = [row["name"] for row in result["zones"] if "share" in row]
    rows = []
    for anchor in result["anchors"]:
        left = anchor["without"]
        shares = [_percent(row["share"]) for row in left["zones"] if "share" in row]
        worst = [
            max((row[key] for row in left["zones"] if row[key] is not None), default=None)
            for key in ("position_m", "heading_deg")
        ]
        rows.append(
            [
                anchor["name"],
                digits(left["score_m"], 4),
                f"{left['ratio']:.3f}",
                *(digits(value, 3) for value in worst),
                *shares,
            ]
        )
    headings = ["without", "b (m)", "b / with all", "horizontal RMS (m)", "heading RMS (deg)"]
    return Rows("what each anchor is for", [*headings, *(f"within {n}" for n in asking)], rows)


def _next(result: dict[str, Any]) -> Rows:
    """Return where one more anchor would help most."""
    more = result["next_anchor"]
    rows = []
    for now, row in zip(more["zones_now"], more["zones"], strict=True):
        rows.append(
            [
                row["name"],
                WORDS[row["verdict"]],
                *(_percent(one["share"]) if "share" in one else "-" for one in (now, row)),
                *(digits(one["rms_position_m"], 3) for one in (now, row)),
                *(digits(one["rms_heading_deg"], 3) for one in (now, row)),
            ]
        )
    where = ", ".join(f"{more[key]:.3f}" for key in ("x_m", "y_m", "z_m"))
    change = f"b is then {more['ratio']:.3f} times as large"
    title = f"one more anchor would help most at ({where}), {more['mount']}: {change}"
    headings = [
        "zone", "verdict", "within now", "then", "horizontal RMS (m) now", "then",
        "heading RMS (deg) now", "then",
    ]  # fmt: skip
    return Rows(title, headings, rows)


def _mounts(result: dict[str, Any]) -> Rows:
    """Return the number of anchors on each mount, and their cost."""
    kinds: dict[tuple[str, float], int] = {}
    for anchor in result["anchors"]:
        key = anchor["mount"], anchor["cost"]
        kinds[key] = kinds.get(key, 0) + 1
    rows = [
        [mount, str(count), f"{cost:g}", f"{count * cost:g}"]
        for (mount, cost), count in sorted(kinds.items())
    ]
    rows.append(["all", str(result["n_anchors"]), "", f"{result['cost']:g}"])
    return Rows("cost of the mounts", ["mount", "anchors", "each", "cost"], rows)


def _worst(result: dict[str, Any]) -> Rows:
    rows = [
        [
            zone["name"],
            *(f"{place[key]:.2f}" for key in ("x_m", "y_m", "z_m")),
            *(digits(place[key], 3) for key in ("position_m", "height_m", "heading_deg")),
        ]
        for zone in result["zones"]
        for place in zone["worst_places"]
    ]
    headings = ["zone", "x (m)", "y (m)", "z (m)", "horizontal (m)", "height (m)", "heading (deg)"]
    return Rows("worst places", headings, rows)


def _prediction(result: dict[str, Any]) -> Rows:
    rows = []
    for key, label in (
        ("position_m", "position (m)"),
        ("rotation_deg", "orientation (deg)"),
        ("score_m", "b (m)"),
    ):
        figures = result["predicted"][key]
        at = figures["worst_at_m"]
        where = "-" if at is None else "(" + ", ".join(f"{x:.3g}" for x in at) + ")"
        rows.append(
            [
                label,
                *(digits(figures[what], 4) for what in ("rms", "median", "p95", "worst")),
                where,
            ]
        )
    headings = ["one sigma", "RMS", "median", "p95", "worst place", "where (m)"]
    return Rows("predicted over the region", headings, rows)


_FIGURES = (
    ("b RMS (m)", "score_m", 4),
    ("position median (m)", "position_median_m", 4),
    ("p95", "position_p95_m", 4),
    ("worst", "position_worst_m", 4),
    ("rotation median (deg)", "rotation_median_deg", 3),
    ("p95", "rotation_p95_deg", 3),
    ("worst", "rotation_worst_deg", 3),
)


def layout_rows(layouts: dict[str, dict[str, Any]], short: bool = False) -> Rows:
    """Return the designed or given layout beside the usual ones.

    With requirements: the verdict, and the margin of the worst zone. `short`: without the errors.
    """
    figures = _FIGURES[:1] if short else _FIGURES
    own = "given" if "given" in layouts else "designed"
    asks = any("margin" in zone for zone in layouts[own]["zones"])
    rows = []
    for name, row in layouts.items():
        cells = [name]
        if asks:
            margin = min(zone["margin"] for zone in row["zones"] if "margin" in zone)
            cells += [WORDS[row["verdict"]], f"{margin:.3f}"]
        cells += [digits(row[key], n) for _, key, n in figures]
        rows.append([*cells, f"{row['ratio']:.3f}"])
    headings = ["layout", *(["verdict", "margin"] if asks else [])]
    headings += [*(heading for heading, _, _ in figures), f"b / {own}"]
    return Rows("the usual layouts, predicted", headings, rows)


def _check(check: dict[str, Any]) -> Rows:
    rows = []
    for name, figures in check["filters"].items():
        row = [name, _percent(figures["found"]), "yes" if figures["holds"] else "no"]
        for quantity, unit, n in (("position", "m", 4), ("rotation", "deg", 3)):
            for key in ("rmse_{}", "p95_{}", "predicted_{}"):
                row.append(digits(figures.get(f"{quantity}_{key.format(unit)}"), n))
            ratio = figures.get(f"{quantity}_ratio")
            row.append("-" if ratio is None else f"{ratio:.3f}")
        rows.append([*row, f"{figures['nees']:.2f}" if "nees" in figures else "-"])
    # Short words: the table must fit into 130 columns.
    headings = [
        "filter", "found", "agrees", "position RMSE (m)", "p95", "bound", "ratio",
        "rotation RMSE (deg)", "p95", "bound", "ratio", "NEES",
    ]  # fmt: skip
    return Rows(f"checked by Monte Carlo with {check['trials']} bodies", headings, rows)


def _check_zones(check: dict[str, Any]) -> list[dict[str, Any]]:
    return [row for figures in check["filters"].values() for row in figures["zones"]]


def _check_within(check: dict[str, Any]) -> Rows:
    """Return bodies within the limits of their zone, by each filter."""
    rows = [
        [
            name,
            row["name"],
            str(row["bodies"]),
            _percent(row["found"]),
            _percent(row["within"]),
            _percent(row["within_predicted"]),
            digits(row.get("position_rmse_m"), 3),
            digits(row.get("position_predicted_m"), 3),
            digits(row.get("heading_rmse_deg"), 3),
            digits(row.get("heading_predicted_deg"), 3),
        ]
        for name, figures in check["filters"].items()
        for row in figures["zones"]
        if "within" in row
    ]
    headings = [
        "filter", "zone", "bodies", "found", "single errors within the limits", "predicted",
        "position RMSE (m)", "predicted", "heading RMSE (deg)", "predicted",
    ]  # fmt: skip
    return Rows("checked in each zone: horizontal position, heading", headings, rows)


def _numbers(numbers: list[dict[str, Any]]) -> Rows:
    rows = [
        [
            str(row["n_anchors"]),
            WORDS[row["verdict"]],
            *(digits(row[key], n) for _, key, n in _FIGURES),
            *(_percent(zone["share"]) for zone in row["zones"] if "share" in zone),
        ]
        for row in numbers
    ]
    zones = [f"within {zone['name']}" for zone in numbers[0]["zones"] if "share" in zone]
    headings = ["anchors", "verdict", *(heading for heading, _, _ in _FIGURES), *zones]
    return Rows("against the number of anchors", headings, rows)
