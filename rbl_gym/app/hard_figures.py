"""Picture and tables of the hard conditions."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rbl_gym.app.figures import new_figure, styled
from rbl_gym.app.tables import new_console, new_table

_COLOURS = {
    "iekf": "#d1495b",
    "iekf/robust=true": "#2e86ab",
    "iekf-bank/robust=true": "#1b7f5c",
    "iekf-bank": "#2e86ab",
    "iekf-bank, volume": "#1b7f5c",
}


@styled
def hard_figure(result: dict[str, Any]) -> Figure:
    """Draw translation errors relative to the bound, and recovery after wrong starts."""
    figure = new_figure(12, 8)
    upper, lower = figure.subfigures(2, 1, squeeze=False)[:, 0]
    axes = upper.subplots(1, len(result["links"]), squeeze=False)[0]
    for axis, (name, conditions) in zip(axes, result["links"].items(), strict=True):
        filters = list(next(iter(conditions.values()))["filters"])
        for shift, label in enumerate(filters):
            ratios = [row["filters"][label]["clean"]["translation"] for row in conditions.values()]
            axis.bar(
                np.arange(len(ratios)) + 0.27 * (shift - 1),
                ratios,
                0.25,
                label=label,
                color=_COLOURS[label],
            )
        axis.axhline(1.0, color="k", lw=0.8)
        axis.set(yscale="log", ylabel="translation RMSE / bound of all links")
        axis.set_title(name, fontsize="large")
        axis.set_xticks(
            range(len(conditions)), [label.replace(", ", ",\n") for label in conditions]
        )
    upper.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    after = result["starts"]["after"]
    axes = lower.subplots(1, len(result["starts"]["scenes"]), squeeze=False)[0]
    for axis, (name, starts) in zip(axes, result["starts"]["scenes"].items(), strict=True):
        for label in starts["wrong"]:
            for start, style in (("wrong", "o-"), ("wrong, 10 % NLOS", "s:")):
                axis.plot(
                    after,
                    [100 * share for share in starts[start][label]["back"]],
                    style,
                    label=f"{label}{start[5:]}",
                    color=_COLOURS[label],
                    ms=4,
                )
        axis.set(xlabel="epochs after the start", ylabel="trials recovered [%]", ylim=(-3, 103))
        axis.set_title(f"{name}: start 180 deg, 10 m off")
    handles = axes[-1].get_legend_handles_labels()
    lower.legend(*handles, fontsize=9, loc="outside lower center", ncols=6)
    return figure


def print_hard(result: dict[str, Any]) -> None:
    """Print one table of links for each scene, and one of starts."""
    console = new_console()
    for name, conditions in result["links"].items():
        headings = (
            "rot / clean", "pos / clean", "rot / good", "pos / good", "NEES (6)", "lost at the end",
            "lost ever", "largest (m)", "us / step",
        )  # fmt: skip
        title = f"{name}, {result['trials']} trials"
        table = new_table(title, ["links", "filter"], headings, whole=2)
        for condition, row in conditions.items():
            for label, figures in row["filters"].items():
                ratios = [
                    figures[b][f] for b in ("clean", "good") for f in ("rotation", "translation")
                ]
                table.add_row(
                    condition,
                    label,
                    *(f"{ratio:.3f}" for ratio in ratios),
                    f"{figures['nees']:.2f}",
                    f"{100 * figures['lost_at_the_end']:.1f} %",
                    f"{100 * figures['lost_ever']:.1f} %",
                    f"{figures['largest_error_m']:.2f}",
                    f"{figures['microseconds_per_step']:.0f}",
                )
            table.add_section()
        console.print(table)
    after = result["starts"]["after"]
    title = f"recovered trials (%) after so many epochs, {result['trials']} trials"
    table = new_table(title, ["scene", "start", "filter"], [*map(str, after), "us / step"])
    for name, starts in result["starts"]["scenes"].items():
        for start, rows in starts.items():
            for label, row in rows.items():
                back = [f"{100 * share:.1f} %" for share in row["back"]]
                table.add_row(name, start, label, *back, f"{row['microseconds_per_step']:.0f}")
        table.add_section()
    console.print(table)
    console.print(
        "clean: the posterior Cramer-Rao bound if all links had straight paths.\ngood: the bound "
        "of the links that were measured over straight paths.\nLost: the squared error, normalised "
        "by the bound's covariance, is above 100 (its mean\nis 6). Recovered: it is below 100."
    )
