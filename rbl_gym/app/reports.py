"""Tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rbl_gym.app.consistency import print_consistency
from rbl_gym.app.tables import new_console, new_table
from rbl_gym.studies.replay.overlap import seconds_text

CAMSAP_COLUMNS = (
    ("rotation RMSE", "rotation_rmse", "{:.4f}"),
    ("translation RMSE (m)", "translation_rmse_m", "{:.4f}"),
    ("mean angle (deg)", "mean_angular_error_deg", "{:.3f}"),
    ("rot / bound", "rotation_to_bound", "{:.3f}"),
    ("pos / bound", "translation_to_bound", "{:.3f}"),
    ("NEES (6)", "nees", "{:.2f}"),
    ("reward", "reward", "{:.3f}"),
    ("us / step", "microseconds_per_step", "{:.1f}"),
)


# Our column alone, if a source has neither a table nor a claim in words.
_NO_NUMBERS = {
    "icassp2013": "The paper prints no numbers. Its Figs 2 and 3 show the errors of angle\n"
    "and translation against the reference range; their parts (b) are the settings with 1 mm,\n"
    "the standard deviation of the tag positions. fixed: one draw of the anchors for all trials.\n"
    "CLS and CTLS have the same solution (Lemma 2).",
    "slides2013": "The slides print no numbers and no parameters. The parameters are those of the\n"
    "two papers.",
}


def print_camsap2013(result: dict[str, Any]) -> None:
    """Print the filters in a table, and the claims of the paper with our figures."""
    console = new_console()
    title = f"{result['experiment']}, {result['trials']} trials"
    table = new_table(title, ["filter"], [heading for heading, _, _ in CAMSAP_COLUMNS])
    for label, figures in result["filters"].items():
        table.add_row(label, *(form.format(figures[key]) for _, key, form in CAMSAP_COLUMNS))
    console.print(table)
    for source, heading in (("paper", "claims of the paper"), ("ours", "claims of this package")):
        console.print(f"{heading}:")
        for claim in result["claims"]:
            if claim["source"] == source:
                verdict = "holds" if claim["holds"] else "FAILS"
                console.print(f"  {verdict}  {claim['statement']}  ({claim['figures']})")
    if "trade" in result:
        console.print(
            "ET-KF: "
            + ", ".join(
                f"threshold {row['threshold']:g}: {100 * row['trigger_rate']:.0f} % projected, "
                f"RMSE {row['rotation_rmse']:.4f}"
                for row in result["trade"]
            )
        )
    deviation = 100 / (6 * result["trials"]) ** 0.5
    console.print(
        f"Assumed, as the paper does not print it: {', '.join(result['assumed'])}.\nRatios are to "
        "the posterior Cramer-Rao bound, averaged over the steps; reward = -log b, b the\n"
        "expected RMS error of the tags in metres. KF and ET-KF are scored by their raw matrix,\n"
        f"as in the paper. One standard deviation of an RMSE is about {deviation:.1f} %: with few\n"
        "trials a claim can fail by chance."
    )


def print_static(result: dict[str, Any]) -> None:
    """Print mean ratios to the bound over the reference ranges, one table per setting."""
    console = new_console()
    for label, data in result["settings"].items():
        low, high = data["reference_range_db"][0], data["reference_range_db"][-1]
        table = new_table(
            f"{result['experiment']}, anchors in {label}, {low} to {high} dB, "
            f"{result['trials']} trials",
            ["method"],
            ["angle / bound", "rotation / bound", "translation / bound",
             f"angle at {high} dB (deg)", f"NEES at {high} dB (6)"],
        )  # fmt: skip
        for name, method in data["methods"].items():
            ratios = [f"{ratio:.3f}" for ratio in method["ratio"].values()]
            angle = f"{method['mean_angular_error_deg'][-1]:.5f}"
            table.add_row(name, *ratios, angle, f"{method['nees'][-1]:.2f}")
        table.add_row("bound", "1", "1", "1", f"{data['bound']['mean_angular_error_deg'][-1]:.5f}")
        console.print(table)
    console.print(_NO_NUMBERS[result["experiment"]])


def print_slides2013(result: dict[str, Any]) -> None:
    """Print the static part, then the dynamic one."""
    print_static(result)
    print_camsap2013(result["dynamic"])


def print_replay(result: dict[str, Any]) -> None:
    """Print the figures of a recording, one per line."""
    console = new_console()
    speed = ""
    if "microseconds_per_epoch" in result:
        speed = f", {result['microseconds_per_epoch']:.0f} us an epoch"
    console.print(
        f"{result['epochs']} epochs, {result['links']} ranges in a log of "
        f"{result['duration_s']:.1f} s, filter {result['settings']['filter']}{speed}"
    )
    if "smoothed" in result:
        fit = result["smoothed"]
        unsettled = "" if fit["converged"] else ", NOT converged"
        console.print(
            f"smoothed in {fit['seconds']:.1f} s{unsettled}, NIS per degree of freedom "
            f"{fit['nis']:.2f} (1: consistent)"
        )
    if "epochs_with_truth" not in result:
        console.print("no truth, so no errors")
        for line in sensor_clocks(result):
            console.print(line)
        print_consistency(console, result)
        _print_notes(console, result)
        return
    for line in compared(result):
        console.print(line)
    axes, is_open = result["position_axes"], turn_open(result)
    _print_errors(console, "error", result, axes, is_open)
    if "smoothed" in result:
        _print_errors(console, "smoothed", result["smoothed"], axes, is_open)
    print_consistency(console, result)
    _print_notes(console, result)


def turn_open(result: dict[str, Any]) -> bool:
    """Return whether the body has one tag, and nothing determines its rotation or its yaw."""
    one = "centre_rmse_m" in result and "axis_rmse_deg" not in result
    return one and any(what.startswith("the rotation") for what in result["undetermined"])


def error_rows(result: dict[str, Any], axes: str, is_open: bool) -> Iterator[tuple[str, list[str]]]:
    """Return label, and RMSE, median and p95 of every known error; no angles if the turn is open.

    `is_open` is the result of `turn_open`.
    """
    shown = {
        "position": f"position {axes}",
        "centre": "tags' centre",
        "axis": "line through the tags",
    }
    for name, unit, places in (
        ("position", "m", 4), ("yaw", "deg", 2), ("rotation", "deg", 2), ("centre", "m", 4),
        ("axis", "deg", 2),
    ):  # fmt: skip
        if f"{name}_rmse_{unit}" in result:
            values = [result[f"{name}_{what}_{unit}"] for what in ("rmse", "median", "p95")]
            cells = [f"{value:.{places}f}" for value in values]
            if is_open and unit == "deg":
                cells = ["undetermined", "", ""]
            yield f"{shown.get(name, name)} ({unit})", cells


def _print_errors(
    console: Any, title: str, result: dict[str, Any], axes: str, is_open: bool
) -> None:
    table = new_table(None, [title], ["RMSE", "median", "p95"])
    for label, cells in error_rows(result, axes, is_open):
        table.add_row(label, *cells)
    console.print(table)
    known = "yaw_mean_deg" in result and not is_open
    mean = f"mean yaw error {result['yaw_mean_deg']:.2f} deg, " if known else ""
    console.print(
        f"{mean}NEES per degree of freedom {result['anees']:.2f} (1: consistent; above: "
        "overconfident; below: too cautious)"
    )


_RUN_COLUMNS = (
    ("position_rmse_m", 4),
    ("position_median_m", 4),
    ("yaw_rmse_deg", 2),
    ("yaw_mean_deg", 2),
    ("anees", 2),
)


def print_runs(result: dict[str, Any]) -> None:
    """Print the figures of several runs, a row each, and of all together."""
    console = new_console()
    opened = {run: turn_open(one) for run, one in result["runs"].items()}
    _print_runs(console, "run", result["runs"], result["together"], opened)
    if "smoothed" in result["together"]:
        runs = {run: one["smoothed"] for run, one in result["runs"].items()}
        _print_runs(console, "smoothed", runs, result["together"]["smoothed"], opened)
    notes = [one["notes"] for one in result["runs"].values()]
    common = [note for note in notes[0] if all(note in others for others in notes)]
    _print_notes(console, {"notes": common})
    if own := sum(len(others) > len(common) for others in notes):
        console.print(f"{own} of {len(notes)} runs have other notes: see --run or --json")


def _print_runs(
    console: Any, title: str, runs: dict[str, Any], together: Any, opened: dict[str, bool]
) -> None:
    """Print a table of runs; without angles for those in `opened`, whose turn is open."""
    every = {**runs, "together": together}
    opened = {**opened, "together": any(opened.values())}
    counts = [name for name in ("epochs", "epochs_with_truth") if name in together]
    columns = [(name, places) for name, places in _RUN_COLUMNS if name in together]
    headings = [name.replace("_", " ") for name in (*counts, *(name for name, _ in columns))]
    table = new_table(None, [title], headings)
    for run, one in every.items():
        cells = [str(one.get(name, 0)) for name in counts]
        for name, places in columns:
            cell = f"{one[name]:.{places}f}" if name in one else ""
            if opened[run] and name.endswith("deg"):
                cell = "undetermined" if name == "yaw_rmse_deg" else ""
            cells.append(cell)
        table.add_row(run, *cells)
    console.print(table)


def sensor_clocks(result: dict[str, Any]) -> list[str]:
    """Return the estimated clock offsets of sensors, in lines."""
    parts = []
    for what in ("odometry", "imu"):
        if (found := result.get(f"{what}_clock")) is None:
            continue
        how = f"the likelihood of the ranges (higher by {found['gain']:.1f})"
        if found["correlation"] is not None:
            how = (
                "accelerations of the track of the ranges (correlation "
                f"{found['correlation']:.2f}; log-likelihood higher by {found['gain']:.1f} than "
                "at any other offset)"
            )
        parts.append(
            f"the clock of --{what} is ahead by {found['offset_s']:.3f} s "
            f"+- {found['std_s']:.3f} s by {how}"
        )
    return parts


def compared(result: dict[str, Any]) -> list[str]:
    """Return how the track of a recording was aligned with its truth, in lines."""
    parts = [
        f"{result['epochs_with_truth']} of {result['epochs']} epochs have truth "
        f"({result['truth_format']})"
    ]
    if "epochs_excluded" in result:
        parts.append(f"{result['epochs_excluded']} further epochs are excluded (truth_exclude)")
    parts += sensor_clocks(result)
    if "time_offset" in result:
        found = result["time_offset"]
        parts.append(
            f"the truth's clock is ahead by {found['offset_s']:.4f} s +- {found['std_s']:.4f} s by "
            f"the motion of the {found['track']} track (correlation {found['correlation']:.2f})"
        )
    elif ahead := result["settings"].get("time_offset"):
        parts.append(f"the truth's clock is ahead by {seconds_text(ahead)} s (time_offset)")
    if "alignment" in result:
        found = result["alignment"]
        parts.append(
            f"the truth is aligned ({found['mode']}): turned by {found['turn_deg']:.2f} deg, its "
            f"centre moved by {found['shift_m']:.3f} m"
        )
    return parts


def _print_notes(console: Any, result: dict[str, Any]) -> None:
    for note in result["notes"]:
        console.print(note, soft_wrap=True)


def print_training(result: dict[str, Any]) -> None:
    """Print the learning curve at a few points, the computing times, and the policy's score."""
    console = new_console()
    curve = result["curve"]
    explores = result["env_share"] is not None
    for point in curve[:: max(1, len(curve) // 10)]:
        told = (f"{name.replace('_', ' ')} {value:.4f}" for name, value in point.items())
        next(told)
        console.print(
            f"{point['steps']:>10,} steps  {', '.join(told)}{' while exploring' * explores}"
        )
    share = result["env_share"] if explores else 0.0
    of_it = f"; the environment took {100 * share:.0f} % of the CPU time" * explores
    console.print(
        f"{result['steps']:,} steps in {result['seconds']:.0f} s{of_it}\npolicy: {result['policy']}"
    )
    held_out = result["held_out"]
    returns = {name: held_out[f"{name}_mean_return"] for name in ("policy", "random")}
    console.print(
        f"mean return in {held_out['worlds']} held-out worlds: policy {returns['policy']:.4f} +- "
        f"{held_out['policy_std_error']:.4f} (with its most likely actions), random actions "
        f"{returns['random']:.4f} +- {held_out['random_std_error']:.4f}"
    )
    if returns["policy"] <= returns["random"]:
        console.print("The policy is NO BETTER THAN RANDOM ACTIONS: train longer (--steps).")


def print_evaluation(result: dict[str, Any]) -> None:
    """Print policies and references, the best first."""
    console = new_console()
    title = f"{result['task']}, {result['worlds']} held-out worlds"
    table = new_table(
        title, ["policy"], ["loss (lower is better)", "score b (m)", "normalised", "95 %"]
    )
    for name, row in sorted(result["methods"].items(), key=lambda item: item[1]["loss"]):
        interval = f"{row['normalised_low']:.3f} to {row['normalised_high']:.3f}"
        table.add_row(
            name,
            f"{row['loss']:.4f} +- {row['loss_std_error']:.4f}",
            "-" if row["score_m"] is None else f"{row['score_m']:.4f}",
            f"{row['normalised']:.3f}",
            interval,
        )
    console.print(table)
    best, best_of = result["best_reference"], result["best_of"]
    what = f", the best of {', '.join(best_of)} in each world" if len(best_of) > 1 else ""
    scored = all(row["score_m"] is not None for row in result["methods"].values())
    loss = "the mean of log b, negative for b below 1 m" if scored else "minus the mean reward"
    console.print(f"loss: {loss}")
    console.print(f"normalised: 0 is random, 1 is {best}{what}; 95 %: its confidence interval")


def print_transfer(result: dict[str, Any]) -> None:
    """Print a table per filter: score and actual error, and their correlation."""
    console = new_console()
    for name, rows in result["filters"].items():
        each = f", {result['repeats']} bodies in each" if "repeats" in result else ""
        table = new_table(
            f"{result['task']}, {name}, {result['worlds']} worlds{each}",
            ["layouts" if each else "policy"],
            ["score b (m)", "tag RMSE of the filter (m)", "correlation of their logarithms"],
        )
        for label, row in rows.items():
            alike = row["correlation"]
            table.add_row(
                label,
                f"{row['score_m']:.4f}",
                f"{row['tag_rmse_m']:.4f}",
                "-" if alike is None else f"{alike:.3f}",
            )
        console.print(table)
