"""Picture and tables of the experiment of the DOA paper."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rbl_gym.app.figures import new_figure, styled
from rbl_gym.app.tables import new_console, new_table

_COLOURS = {"NIA + UQ": "#2e86ab", "ML": "#1b7f5c", "PSO": "#e8a33d", "PSA": "#d1495b"}
_PAPERS = "R = I"  # the setting of Fig. 2 and Table 1


@styled
def doa2019_figure(result: dict[str, Any]) -> Figure:
    """Draw RMSE of R and t over the noise with the bound (Fig. 2), and successes, per setting."""
    settings = result["settings"]
    figure = new_figure(12, 3.3 * len(settings) + 0.6)
    axes = figure.subplots(len(settings), 3, squeeze=False)
    curves = (("rotation_rmse", "RMSE(R), Frobenius"), ("translation_rmse_m", "RMSE(t) [m]"))
    for row, (label, data) in enumerate(settings.items()):
        sigma = data["sigma_deg"]
        paper = "Fig. 2, " if label == _PAPERS else ""
        for ax, (key, title) in zip(axes[row], curves, strict=False):
            for name, method in data["methods"].items():
                values = np.where(np.array(method["near"]) > 0, method[key], np.nan)
                ax.loglog(sigma, values, "o-", ms=4, lw=1.3, color=_COLOURS[name], label=name)
            ax.loglog(sigma, data["bound"][key], "k+--", ms=8, lw=0.8, label="CCRB")
            ax.set(ylabel=title, title=f"{paper}{label}: trials near the truth")
            ax.grid(True)
        _successes(axes[row, 2], label, data, result["table_1"])
    for ax in axes[-1]:
        ax.set_xlabel("standard deviation of the angles [deg]")
    axes[0, 0].legend()
    return figure


def _successes(ax: Any, label: str, data: dict[str, Any], table_1: dict[str, Any]) -> None:
    methods = data["methods"]
    width = 0.8 / len(methods)
    places = np.arange(len(data["sigma_deg"]))
    for k, (name, method) in enumerate(methods.items()):
        at = places + (k - 0.5 * (len(methods) - 1)) * width
        ax.bar(at, 100 * np.array(method["near"]), width, color=_COLOURS[name])
        ax.plot(at, 100 * np.array(method["within_half_metre"]), "k_", ms=9)
        if label == _PAPERS and name in table_1:
            ax.plot(at, table_1[name]["success_percent"], "D", mfc="w", mec="k", ms=4)
    ax.plot([], [], "k_", label="error of t < 0.5 m")
    if label == _PAPERS:
        ax.plot([], [], "D", mfc="w", mec="k", ms=4, label="Table 1 of the paper")
    ax.set_xticks(places, [f"{sigma:g}" for sigma in data["sigma_deg"]])
    ax.set_title(f"{label}: successes")
    ax.set(ylabel="near the truth [%]", ylim=(0, 122), yticks=range(0, 101, 20))
    ax.legend(loc="upper right", ncols=2)


def print_doa2019(result: dict[str, Any]) -> None:
    """Print Table 1 with ours, then accuracy, success and time of every method and setting."""
    out = new_console()
    _print_table_1(out, result)
    for label, data in result["settings"].items():
        table = new_table(
            f"doa2019, {label}, t = (5, 5, 3) m, {result['trials']} trials",
            ["noise (deg)", "method"],
            ["R RMSE", "R / bound", "t RMSE (m)", "t / bound", "near truth", "t < 0.5 m",
             "converged", "iterations", "us / trial", "time / NIA"],
        )  # fmt: skip
        for k, sigma in enumerate(data["sigma_deg"]):
            for name, method in data["methods"].items():
                row = {key: values[k] for key, values in method.items()}
                shares = (row["near"], row["within_half_metre"], row["converged"])
                table.add_row(
                    f"{sigma:g}",
                    name,
                    f"{row['rotation_rmse']:.5f}",
                    f"{row['rotation_to_bound']:.3f}",
                    f"{row['translation_rmse_m']:.5f}",
                    f"{row['translation_to_bound']:.3f}",
                    *(f"{100 * share:.1f} %" for share in shares),
                    _counted(row),
                    f"{row['microseconds_per_trial']:.0f}",
                    f"{row['time_ratio']:.1f}",
                )
            bound = [data["bound"][key][k] for key in ("rotation_rmse", "translation_rmse_m")]
            table.add_row(f"{sigma:g}", "bound", f"{bound[0]:.5f}", "1", f"{bound[1]:.5f}", "1")
            table.add_section()
        out.print(table)
    out.print(
        "RMSE and ratios are of the trials near the truth: both errors within 6 times the "
        "bound.\nThe paper says neither what a success is nor how its PSO and PSA were set. Here "
        "a\nsuccess is a trial near the truth, or one with an error of t below 0.5 m. At 1 "
        "degree\nthe bound of t itself is 0.41 m for R = I. Iterations: median and largest of "
        "the trials\nthat converged."
    )


def _print_table_1(out: Any, result: dict[str, Any]) -> None:
    data = result["settings"][_PAPERS]
    headings = (
        "noise (deg)", "method", "paper: success", "here: near truth", "here: t < 0.5 m",
        "paper: time (s)", "here: time (s)", "paper: time / NIA", "here: time / NIA",
    )  # fmt: skip
    table = new_table(f"Table 1 of the paper, and the same here, {_PAPERS}", (), headings)
    for k, sigma in enumerate(data["sigma_deg"]):
        for name, paper in result["table_1"].items():
            method = data["methods"][name]
            table.add_row(
                f"{sigma:g}",
                name,
                f"{paper['success_percent'][k]} %",
                f"{100 * method['near'][k]:.1f} %",
                f"{100 * method['within_half_metre'][k]:.1f} %",
                f"{paper['seconds'][k]:g}",
                f"{1e-6 * method['microseconds_per_trial'][k]:.2g}",
                f"{paper['seconds'][k] / result['table_1']['NIA + UQ']['seconds'][k]:.0f}",
                f"{method['time_ratio'][k]:.0f}",
            )
        table.add_section()
    out.print(table)


def _counted(row: dict[str, float]) -> str:
    most = int(row["most_iterations"])
    return f"{row['iterations']:.0f}, {most}" if most else "-"
