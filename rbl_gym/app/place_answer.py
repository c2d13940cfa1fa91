"""Question and answer of a placement in words, for titles, the first page and the page."""

from __future__ import annotations

from typing import Any, NamedTuple

from rbl_gym.app.place_notes import (
    NAMES,
    cause_of,
    deciding_notes,
    lever_notes,
    nees_notes,
    through_walls_notes,
    usual_notes,
)

# Verdicts also have a sign and a word, because not everyone can distinguish colours.
SIGNS = {"pass": "✓ PASS", "fail": "✗ FAIL", "undecided": "? TOO CLOSE", "no requirement": "-"}
# Verdicts as tables show them.
WORDS = {name: name for name in SIGNS} | {"undecided": "too close"}
HOW_TO_ASK = (
    "For a verdict, state requirements: use [[zones]] in the file, in place of [region], each with "
    "low, high, position_m or heading_deg, and share."
)


class ZoneAnswer(NamedTuple):
    """Requirement and result of a zone in words."""

    name: str
    verdict: str
    asks: str
    reached: str
    figures: str


def headline(result: dict[str, Any]) -> str:
    """Return one line: the number of anchors, and whether they suffice."""
    missing = ", with any one anchor missing" if result["survive"] else ""
    count = f"{result['n_anchors']} anchors{missing}"
    zones = result["zones"]
    asked = [zone for zone in zones if zone["verdict"] != "no requirement"]
    overall = result["verdict"]
    if overall == "no requirement":
        return f"{count}: {typical(zones)}"
    met = sum(zone["verdict"] == "pass" for zone in asked)
    if len(asked) == 1:
        words = {
            "pass": "the zone meets its requirement",
            "fail": "the zone does not meet its requirement",
            "undecided": "too close to the requirement to tell",
        }[overall]
        return f"{count}: {words}"
    if met == len(asked):
        every = "both" if met == 2 else f"all {met}"
        return f"{count}: {every} zones meet their requirements"
    return f"{count}: {met} of {len(asked)} zones meet their requirements"


def case_of_maps(result: dict[str, Any]) -> str:
    """Return which anchors the maps assume, if any one anchor may fail; else ``""``."""
    return "after the loss of the anchor that hurts most at each place" if result["survive"] else ""


def warnings(result: dict[str, Any]) -> list[str]:
    """Return what a reader has to know beside the verdict.

    Notes on the file, the requirement that decides, usual layouts that are better in a part, a
    mirror image, zones that are too close to tell, a check that contradicts the prediction.
    """
    found = [*result["notes"], *deciding_notes(result), *lever_notes(result), *usual_notes(result)]
    if result["coplanar"]:
        found.append(
            "All anchors lie in one plane. A body on the other side of the plane (for anchors on a "
            "ceiling: above it) has almost the same ranges. This is harmless if the body cannot be "
            "there and the filter is told so (rbl-gym replay --below-anchors or --volume). Without "
            "this, a filter may follow the wrong side, and the linear filters (kf, uc-kf, et-kf, "
            f"kf-ortho) do not work. {_way_out(result)}"
        )
    for zone in result["zones"]:
        if zone["verdict"] == "undecided":
            found.append(
                f"{zone['name']} is too close to tell: {percent(zone['share'])} of "
                f"{zone['places']} places are within the limits (95 % interval "
                f"{100 * zone['share_low']:.2f} to {100 * zone['share_high']:.2f} %), and "
                f"{percent(zone['required']['share'])} must be. Treat it as not met: add an "
                "anchor, or require a little less."
            )
    return found + _contradictions(result) + nees_notes(result) + through_walls_notes(result)


def _way_out(result: dict[str, Any]) -> str:
    """Return what removes the ambiguity of coplanar anchors."""
    if result["n_anchors"] < 4:
        return "Three anchors always lie in one plane: add a fourth outside it."
    move = result["out_of_plane"]
    if move is None:
        return (
            "Mount at least two anchors outside the plane, or allow mounts at another height: no "
            "exchange of one anchor removes the ambiguity."
        )
    where = ", ".join(f"{move[key]:.3f}" for key in ("x_m", "y_m", "z_m"))
    return (
        f"Anchor {move['anchor']} moved to ({where}), {move['mount']}, removes the ambiguity; "
        f"the tag error b is then {digits(move['ratio'])} times as large."
    )


def _contradictions(result: dict[str, Any]) -> list[str]:
    """Return one warning if the check does not confirm the prediction.

    The filter that is not told about blocked links does not count: the prediction assumes that they
    are known.
    """
    parts, any_lost, causes = [], False, ""
    for name, figures in result["check"]["filters"].items():
        lost = 100 * (1 - figures["found"])
        if figures["holds"] or name.endswith("not told"):
            continue
        any_lost |= lost > 0
        causes += cause_of(name, figures)
        if lost > 0:
            parts.append(f"{name!r} has no pose or a wrong one for {digits(lost)} % of the bodies")
        else:
            ratio = max(figures["position_ratio"], figures["rotation_ratio"])
            parts.append(f"the errors of {name!r} are {digits(ratio)} times the predicted ones")
    if not parts:
        return []
    cause = " Probable cause: the mirror image behind the plane of the anchors."
    return [
        "The check by Monte Carlo does not confirm the prediction, on which the verdict is based: "
        f"{', '.join(parts)}; see the table 'checked by Monte Carlo'."
        f"{causes}{cause if any_lost and result['coplanar'] else ''}"
    ]


def typical(zones: list[dict[str, Any]]) -> str:
    """Return typical errors of the zones: the smallest and the largest median."""
    parts = []
    for key in ("position_m", "heading_deg"):
        name, unit = NAMES[key]
        found = [zone[key]["median"] for zone in zones]
        if None in found:
            parts.append(f"{name} not determined")
            continue
        medians = sorted(found)
        span = digits(medians[0])
        if digits(medians[-1]) != span:
            span += f" to {digits(medians[-1])}"
        parts.append(f"{name} {span} {unit}")
    return "typical error " + ", ".join(parts)


def question(result: dict[str, Any]) -> list[str]:
    """Return the question, one line per part."""
    count = result["n_anchors"]
    scene = repr(result["scene"])
    if result["method"] == "given":
        fails = ", also if any one fails" if result["survive"] else ""
        lines = [f"How good are these {count} anchors in {scene}{fails}?"]
    else:
        fails = " if any one may fail" if result["survive"] else ""
        lines = [
            f"Where should {count} anchors go in {scene}{fails}, and how accurate is the pose?"
        ]
    for zone in zone_answers(result):
        if zone.asks:
            lines.append(f"{zone.name}: {zone.asks}")
    return lines


def zone_answers(result: dict[str, Any]) -> list[ZoneAnswer]:
    """Return every zone in words."""
    found = []
    for zone in result["zones"]:
        asks = reached = ""
        if zone["verdict"] != "no requirement":
            required = zone["required"]
            limits = [
                f"{name} {required[key]:g} {unit}"
                for key, (name, unit) in NAMES.items()
                if required.get(key) is not None
            ]
            asks = f"{' and '.join(limits)} in {percent(required['share'])} of the zone"
            reached = (
                f"{percent(zone['share'])} within ({percent(zone['share_low'])} to "
                f"{percent(zone['share_high'])})"
            )
        figures = ", ".join(
            f"{name} not determined"
            if zone[key]["median"] is None
            else f"{name} {digits(zone[key]['median'])} {unit} "
            f"({100 * share_of(zone):g} %: {digits(zone[key]['at_share'])})"
            for key, (name, unit) in NAMES.items()
            if key in zone
        )
        found.append(ZoneAnswer(zone["name"], zone["verdict"], asks, reached, figures))
    return found


def share_of(zone: dict[str, Any]) -> float:
    """Return the required share of a zone; 0.95 without a requirement."""
    return zone["required"]["share"] if "required" in zone else 0.95


def share_heading(zones: list[dict[str, Any]]) -> str:
    """Return the heading of the errors that are not exceeded in the required share: ``p95``."""
    shares = {f"p{100 * share_of(zone):g}" for zone in zones}
    return shares.pop() if len(shares) == 1 else "at share"


def only_not_told(check: dict[str, Any]) -> str:
    """Return why a ``no`` of the filter that is not told does not count; ``""`` if others do."""
    wrong = [name for name, figures in check["filters"].items() if not figures["holds"]]
    if len(wrong) != 1 or not wrong[0].endswith("not told"):
        return ""
    return (
        f"The 'no' of {wrong[0]!r} does not contradict the verdict: this filter is not told which "
        "links are blocked, and the prediction assumes that they are known."
    )


def without_name(result: dict[str, Any], row: dict[str, Any]) -> str | None:
    """Return the name of the anchor whose loss hurts a zone most; None if none may fail."""
    number = row.get("without_anchor")
    return None if number is None else str(result["anchors"][number - 1]["name"])


def percent(share: float) -> str:
    """Format a fraction; 100 % only if it is exact."""
    text = f"{100 * share:.1f}"
    if text == "100.0" and share < 1:
        text = "99.9"
    return f"{text.removesuffix('.0')} %"


def digits(value: float | None) -> str:
    """Format three digits, without exponents in the usual range; None: a dash."""
    if value is None:
        return "-"
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
