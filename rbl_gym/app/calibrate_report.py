"""Tables of rbl-gym calibrate on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rbl_gym.app.tables import new_console, new_table

_PLACE = ("x", "y", "z", "+-x", "+-y", "+-z")


def print_calibrated(figures: dict[str, Any]) -> None:
    """Print links or anchors, and undetermined quantities."""
    (_print_links if "links" in figures else _print_anchors)(figures)


def _print_anchors(figures: dict[str, Any]) -> None:
    console = new_console()
    title = f"{figures['ranges']} ranges of {figures['epochs']} epochs [m]"
    # Without a table to start from there is no given position.
    given = all(row["moved_m"] is not None for row in figures["anchors"])
    table = new_table(title, ["anchor"], (*_PLACE, *["moved"] * given))
    for row in figures["anchors"]:
        std = ["known"] * 3 if row["known"] else [f"{x:.3f}" for x in row["std_m"]]
        moved = [f"{row['moved_m']:.3f}"] * given
        table.add_row(row["anchor"], *(f"{x:.3f}" for x in row["place_m"]), *std, *moved)
    console.print(table)
    console.print(f"Frame: {figures['frame']}.")
    console.print(
        f"Common bias: {figures['common_bias_m']:.3f} m, +- {figures['common_bias_std_m']:.3f}; "
        f"size of the layout +- {100 * figures['scale_std']:.2g} %, correlation of the two "
        f"{figures['scale_bias_correlation']:.2f}."
    )
    console.print(f"Noise of a range: {figures['noise_std_m']:.3f} m.")
    for what in figures["not_determined"]:
        console.print(f"Not determined: {what}.")


def _print_links(figures: dict[str, Any]) -> None:
    """Print links, tags, clock, and undetermined quantities."""
    console = new_console()
    title = f"{figures['ranges']} ranges, biases by {figures['biases']}"
    headings = "ranges", "bias [m]", "+-", "slope", "+-", "noise [m]"
    table = new_table(title, ["anchor", "tag"], headings)
    for row in figures["links"]:
        table.add_row(
            row["anchor"],
            row["tag"],
            str(row["ranges"]),
            f"{row['bias_m']:.3f}",
            f"{row['bias_std_m']:.3f}",
            f"{row['slope']:.4f}",
            f"{row['slope_std']:.4f}",
            f"{row['noise_std_m']:.3f}",
        )
    console.print(table)
    if "nodes" in figures:
        title = "antenna delays of nodes, those of the tags relative to their mean"
        table = new_table(title, ["node"], ["delay [m]", "+-"])
        for row in figures["nodes"]:
            kind = "anchor" if "anchor" in row else "tag"
            table.add_row(f"{kind} {row[kind]}", f"{row['delay_m']:.3f}", f"{row['std_m']:.3f}")
        console.print(table)
    table = new_table("tags in the truth's body frame [m]", ["tag"], _PLACE)
    for row in figures["tags"]:
        numbers = *row["place_m"], *row["std_m"]
        table.add_row(row["tag"], *("held" if x is None else f"{x:.3f}" for x in numbers))
    console.print(table)
    for line in _sentences(figures):
        console.print(line)


def _sentences(figures: dict[str, Any]) -> list[str]:
    """Return the sentences that accompany the tables."""
    said = []
    if clock := figures["time_offset"]:
        said.append(
            f"The clock of the truth is ahead of that of the ranges by {clock['offset_s']:.4f} s, "
            f"+- {clock['std_s']:.4f} (replay --time-offset {clock['offset_s']:.4f})."
        )
    if sensor := figures.get("inertial"):
        said.append(
            "The axes of the inertial sensor are turned by "
            f"{_three(sensor['rotation_vector_deg'], 2)} deg against the body's, +- "
            f"{_three(sensor['rotation_std_deg'], 2)} (replay --imu-frame); its clock is ahead of "
            f"that of the ranges by {sensor['imu_offset_s']:.4f} s, +- "
            f"{sensor['imu_offset_std_s']:.4f} (replay --time-offset imu=...)."
        )
    if turn := figures.get("turn"):
        text = f"The table of tags is turned by {_three(turn['rotation_vector_deg'], 2)} deg"
        if "std_deg" in turn:
            text += f", +- {_three(turn['std_deg'], 2)},"
        text += f" and shifted by {_three(turn['shift_m'], 3)} m in the truth's body frame."
        said.append(text)
        for row, off in zip(figures["tags"], turn.get("off_table_m", ()), strict=False):
            said.append(f"Tag {row['tag']} is {_three(off, 3)} m off its place in the table.")
    if told := figures.get("directions"):
        kind = told["bias"]
        text = (
            "Bias by the direction of the ray: none, as no harmonic improves the prediction of "
            "held-out ranges."
        )
        if kind["harmonics"]:
            whose = (
                "the same for all antennas of a body"
                if kind["shared"]
                else "separate for each antenna"
            )
            text = (
                f"Bias by the direction of the ray: {kind['harmonics']} harmonics at "
                f"{'both ends' if kind['ends'] == 'both' else 'the tags'}, {whose}; they explain "
                f"{100 * told['explained']:.0f} % of the variance of held-out ranges."
            )
        said.append(text)
    noise = figures["noise"]
    text = f"Noise of a range: {noise['std_m']:.3f} m (median of the links)"
    if noise["slow_time_s"]:
        text += (
            f", {100 * noise['slow_share']:.0f} % of its variance correlated in time (over "
            f"{noise['slow_time_s']:.2g} s)"
        )
    said.append(
        f"{text}; {100 * noise['beyond_3_std']:.1f} % of the ranges are off by more than three "
        "standard deviations."
    )
    said += figures["notes"]
    said += [f"Not determined: {what}." for what in figures["not_determined"]]
    return said


def _three(values: Sequence[float], digits: int) -> str:
    return "(" + ", ".join(f"{x:.{digits}f}" for x in values) + ")"
