"""Picture and tables of the experiment of the network paper."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from rbl_gym.app.figures import new_figure, styled
from rbl_gym.app.tables import new_console, new_table
from rbl_gym.studies.papers import network2009

_COLOURS = {"bfs": "#d1495b", "paton": "#2e86ab", "minimum": "#1b7f5c"}
_RULE_COLOURS = {"theorem": "#2e86ab", "best": "#1b7f5c", "trace": "#d1495b", "rows": "#e8a33d"}
# Fig. 6: solid, dotted, dashed.
_FRAMES = (
    ("theta", "-", "k", "true"),
    ("theta_measured", ":", "#d1495b", "measured"),
    ("theta_estimated", "--", "#2e86ab", "estimated"),
)


@styled
def network2009_figure(result: dict[str, Any]) -> Figure:
    """Draw Figs 3 to 6 of the paper, kappa against n, the speed of (14), three nodes in 3-D."""
    figure = new_figure(17, 11)
    axes = figure.subplots(3, 4)
    _networks(axes[0, :3], result)
    _frames(axes[0, 3], result)
    _accuracy(axes[1, 0], result)
    _over_steps(axes[1, 1:3], result)
    _space(axes[1, 3], result["space"])
    for ax, name in zip(axes[2, :2], ("worst", "triangulation"), strict=True):
        _growth(ax, name, result["growth"][name])
    _distance(axes[2, 2], result)
    _factors(axes[2, 3], result["convergence"])
    return figure


def _networks(axes: Any, result: dict[str, Any]) -> None:
    """Draw Fig. 3: points, the largest footprint, and that of ten loops or the smallest."""
    data = result["networks"]
    places = np.array(data["positions"])
    loops = [row["loops"] for row in result["accuracy"]]
    chosen = loops.index(10) if 10 in loops else 0
    for ax, letter, k in zip(axes, "abc", (None, len(loops) - 1, chosen), strict=True):
        title = f"Fig. 3 ({letter}): {len(places)} points"
        if k is not None:
            lines = list(places[np.array(data["edges"][k])])
            ax.add_collection(LineCollection(lines, colors="0.6", lw=0.8))
            complete = 2 * len(lines) == len(places) * (len(places) - 1)
            title = (
                f"Fig. 3 ({letter}): {'complete, ' if complete else ''}{loops[k]} loops, "
                f"footprint {data['footprints'][k]:.3g}"
            )
        ax.plot(*places.T, "ko", ms=4)
        ax.margins(0.08)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel="x", ylabel="y")
        ax.set_title(title)


def _frames(ax: Axes, result: dict[str, Any]) -> None:
    """Draw Fig. 6: both axes of every frame at its true position."""
    places, run = np.array(result["networks"]["positions"]), result["run"]
    length = 0.14 * np.ptp(places, axis=0).max()
    for key, style, colour, label in _FRAMES:
        angle = np.array(run[key])[:, None] + [0, np.pi / 2]
        tips = places[:, None] + length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        lines = np.stack([np.broadcast_to(places[:, None], tips.shape), tips], axis=2)
        pairs = list(lines.reshape(-1, 2, 2))
        ax.add_collection(LineCollection(pairs, colors=colour, ls=style, lw=1.4, label=label))
    ax.plot(*places[0], "ks", ms=5)
    ax.plot(*places.T, "k.", ms=4)
    ax.margins(0.15)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x", ylabel="y")
    ax.set_title(f"Fig. 6: frames, sigma^2 = {result['variance'][1]:g}, reference square")
    ax.legend(ncols=3, loc="lower center")


def _accuracy(ax: Axes, result: dict[str, Any]) -> None:
    """Draw Fig. 4."""
    rows = result["accuracy"]
    edges = [row["edges"] for row in rows]
    ax.plot(edges, [row["mse"]["measured"] for row in rows], "k--x", ms=4, label="y, measured")
    ax.plot(edges, [row["mse"]["consensus"] for row in rows], "k-o", ms=4, label="psi, estimated")
    ax.plot(
        edges,
        [row["bound"] for row in rows],
        color="#2e86ab",
        lw=0.8,
        label="bound, 2 sigma^2 (n - 1) / m",
    )
    ax.set(xlabel="number of edges", ylabel="mean square error [rad^2]", ylim=(0, None))
    ax.set_title(f"Fig. 4: sigma^2 = {result['variance'][0]:g}, {result['trials']} trials")
    ax.legend()


def _over_steps(axes: Any, result: dict[str, Any]) -> None:
    """Draw Fig. 5."""
    run = result["run"]
    axes[0].plot(run["edge_angles"], lw=0.7)
    axes[0].set(xlabel="iteration", ylabel="angle estimate of every edge [rad]")
    axes[0].set_title(f"Fig. 5: kappa = {run['kappa']:.4f}, sigma^2 = {result['variance'][1]:g}")
    if run["loop_errors"]:
        axes[1].plot(run["loop_errors"], lw=0.7)
    axes[1].set(xlabel="iteration", ylabel="error of every loop [rad]")
    axes[1].set_title("Fig. 5")


def _growth(ax: Axes, name: str, data: dict[str, Any]) -> None:
    nodes = [row["nodes"] for row in data["rows"]]
    for rule, slope in data["slope"].items():
        # "best" coincides with "theorem" if lambda_min is 1.
        ax.loglog(
            nodes,
            [row["kappa"][rule] for row in data["rows"]],
            "o--" if rule == "best" else "o-",
            ms=3 if rule == "best" else 5,
            lw=1.2,
            color=_RULE_COLOURS[rule],
            label=f"{rule}: n^{slope:.2f}",
        )
    ax.minorticks_off()
    ax.set_xticks(nodes, [str(n) for n in nodes])
    ax.set(xlabel="n", ylabel="kappa")
    title = {"worst": "complete graph, cycles of a path", "triangulation": "triangulation"}[name]
    ax.set_title(f"Section IV-E: {title}")
    ax.legend()


def _distance(ax: Axes, result: dict[str, Any]) -> None:
    for basis, history in result["history"].items():
        distance = np.maximum(history["distance"], 1e-16)
        ax.semilogy(distance, color=_COLOURS[basis], label=basis)
        ax.semilogy(history["printed_distance"], color=_COLOURS[basis], ls=":", lw=2)
    ax.set(xlabel="iteration", ylabel="distance from the limit [rad]", ylim=(1e-13, None))
    ax.set_title(f"{network2009.EXAMPLE_LOOPS} loops; dotted: predicted by Theorem 19")
    ax.legend()


def _factors(ax: Axes, convergence: dict[str, Any]) -> None:
    rules = list(next(iter(convergence.values())))
    for shift, (basis, table) in enumerate(convergence.items()):
        places = np.arange(len(rules)) + 0.25 * (shift - 1)
        ax.bar(
            places,
            [table[rule]["true_factor_squared"] for rule in rules],
            0.22,
            color=_COLOURS[basis],
            label=basis,
        )
        ax.plot(places, [table[rule]["printed_factor_squared"] for rule in rules], "k_", ms=10)
    ax.set_xticks(range(len(rules)), rules)
    ax.set(xlabel="rule for kappa", ylabel="factor of the squared error", ylim=(0.4, 1.12))
    ax.set_title("bars: true factor, dashes: (1 - kappa)^2; means")
    ax.legend(ncols=3, loc="upper center")


def _space(ax: Axes, rows: list[dict[str, Any]]) -> None:
    for shape, mark in (("equilateral", "o"), ("flat", "s")):
        chosen = [row for row in rows if row["shape"] == shape]
        sigma = [row["bearing_std_rad"] for row in chosen]
        (line,) = ax.loglog(sigma, [row["rmse_rad"] for row in chosen], mark, ms=5, label=shape)
        ax.loglog(sigma, [row["bound_rad"] for row in chosen], color=line.get_color(), lw=0.8)
    ax.set(xlabel="sigma of a bearing [rad]", ylabel="RMS turn against node 0 [rad]")
    ax.set_title("three nodes in space; lines: bound")
    ax.legend()


def print_network2009(result: dict[str, Any]) -> None:
    """Print accuracy against the bound, growth, convergence, three nodes in 3-D."""
    out = new_console()
    _print_accuracy(out, result)
    for name, data in result["growth"].items():
        slopes = ", ".join(f"{rule} n^{slope:.2f}" for rule, slope in data["slope"].items())
        out.print(f"kappa, {name}: {slopes}")
    out.print("Section IV-E: the trace's kappa is O(1 / n^3) at worst, O(1 / n) in triangulations.")
    headings = (
        "cycles", "kappa", "steps", "lambda", "measured factor", "true factor", "squared",
        "(1 - kappa)^2", "kappa <= Theorem 19's", "(1 - kappa)^2 holds",
    )  # fmt: skip
    table = new_table(f"convergence, {network2009.EXAMPLE_LOOPS} loops", (), headings)
    for basis, rules in result["convergence"].items():
        for rule, row in rules.items():
            table.add_row(
                basis,
                f"{rule} {row['kappa']:.4f}",
                f"{row['steps']:.0f}",
                f"{row['lambda_min']:.2f} to {row['lambda_max']:.2f}",
                f"{row['measured_factor']:.4f}",
                f"{row['true_factor']:.4f}",
                f"{row['true_factor_squared']:.4f}",
                f"{row['printed_factor_squared']:.4f}",
                f"{100 * row['within_theorem']:.0f} %",
                f"{100 * row['printed_holds']:.0f} %",
            )
    out.print(table)
    for row in result["asynchronous"]:
        out.print(
            f"one cycle at a time, {100 * row['loss']:.0f} % of the messages lost: "
            f"{row['rounds']:.0f} rounds, {row['largest_error_rad']:.1e} rad from the "
            "projection"
        )
    headings = "triangle", "sigma (rad)", "RMS turn (rad)", "/ bound", "misfit / (6^.5 sigma)"
    table = new_table(f"three nodes in space, {result['trials']} trials", (), headings)
    for row in result["space"]:
        table.add_row(
            row["shape"],
            f"{row['bearing_std_rad']:g}",
            f"{row['rmse_rad']:.5f}",
            f"{row['ratio']:.3f}",
            f"{row['misfit']:.3f}",
        )
    out.print(table)


def _print_accuracy(out: Any, result: dict[str, Any]) -> None:
    places = result["networks"]["positions"]
    title = f"Fig. 4: {len(places)} points, sigma^2 = {result['variance'][0]:g}"
    headings = (
        "footprint", "edges", "loops", "MSE of y", "MSE of psi", "bound (rad^2)", "psi / bound",
        "ml / bound",
    )  # fmt: skip
    table = new_table(f"{title}, {result['trials']} trials", (), headings)
    for row in result["accuracy"]:
        ratios = [
            f"{row['ratio'][name]:.3f} +- {row['ratio_std_error'][name]:.3f}"
            for name in ("consensus", "ml")
        ]
        table.add_row(
            f"{row['footprint']:.4g}",
            str(row["edges"]),
            str(row["loops"]),
            f"{row['mse']['measured']:.5f}",
            f"{row['mse']['consensus']:.5f}",
            f"{row['bound']:.5f}",
            *ratios,
        )
    out.print(table)
    run = result["run"]
    out.print(
        f"Figs 5 and 6: kappa {run['kappa']:.4f}, {run['steps']} steps to 1e-12; RMS error "
        f"of an edge {run['rms_measured']:.4f} rad measured, {run['rms_estimated']:.4f} "
        "estimated"
    )
