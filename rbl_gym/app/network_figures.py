"""Pictures and tables of the network commands."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from rich.table import Table

from rbl_gym.app import network2009
from rbl_gym.app.figures import new_figure, styled
from rbl_gym.app.network import Solved
from rbl_gym.app.reports import new_console

_COLOURS = {"bfs": "#d1495b", "paton": "#2e86ab", "minimum": "#1b7f5c"}


@styled
def network2009_figure(result: dict[str, Any]) -> Figure:
    """A network, the error against the loops, convergence, and the factors."""
    figure = new_figure(11, 8)
    axes = figure.subplots(2, 2)
    rng = np.random.default_rng([result["seed"], 1000, 0])
    one = network2009.sample(network2009.EXAMPLE_LOOPS, rng)
    axes[0, 0].add_collection(LineCollection(list(one.positions[one.edges]), colors="0.7", lw=1))
    axes[0, 0].quiver(*one.positions.T, np.cos(one.theta), np.sin(one.theta), scale=18,
                      color="#2e86ab", width=0.006)  # fmt: skip
    axes[0, 0].plot(*one.positions.T, "ko", ms=4)
    axes[0, 0].set_aspect("equal")
    axes[0, 0].set_title(f"a network: {len(one.edges)} edges, {network2009.EXAMPLE_LOOPS} loops")
    rows = result["loops"]
    loops = [row["loops"] for row in rows]
    axes[0, 1].plot(loops, [row["bound"] for row in rows], "k-", label="2 sigma^2 (n - 1) / m")
    for name, mark in (("measured", "x"), ("consensus", "o"), ("ml", "+")):
        axes[0, 1].plot(loops, [row["mse"][name] for row in rows], mark, label=name)
    axes[0, 1].set(xlabel="loops", ylabel="mean square error of an edge [rad^2]", ylim=(0, None))
    axes[0, 1].legend(frameon=False)
    for basis, history in result["history"].items():
        axes[1, 0].semilogy(np.maximum(history, 1e-16), color=_COLOURS[basis], label=basis)
        printed = result["convergence"][basis]["theorem"]["printed_factor_squared"]
        steps = np.arange(len(history))
        axes[1, 0].semilogy(steps, history[0] * printed ** (steps / 2), color=_COLOURS[basis],
                            ls=":", lw=1)  # fmt: skip
    axes[1, 0].set(xlabel="step", ylabel="distance from the limit [rad]", ylim=(1e-13, None))
    axes[1, 0].set_title("dotted: Theorem 19's factor, mean", fontsize=9)
    axes[1, 0].legend(frameon=False)
    rules = list(next(iter(result["convergence"].values())))
    for shift, (basis, table) in enumerate(result["convergence"].items()):
        places = np.arange(len(rules)) + 0.25 * (shift - 1)
        axes[1, 1].bar(places, [table[rule]["true_factor"] for rule in rules], 0.22,
                       color=_COLOURS[basis], label=basis)  # fmt: skip
        axes[1, 1].plot(places, [table[rule]["printed_factor_squared"] ** 0.5 for rule in rules],
                        "k_", ms=14)  # fmt: skip
    axes[1, 1].set_xticks(range(len(rules)), [f"kappa: {rule}" for rule in rules])
    axes[1, 1].set(ylabel="factor of a step", ylim=(0.6, 1.1))
    axes[1, 1].set_title("true (bars), root of Theorem 19's (dashes)", fontsize=9)
    axes[1, 1].legend(frameon=False, ncols=3, loc="upper center")
    return figure


def print_network2009(result: dict[str, Any]) -> None:
    """Accuracy against the bound, then convergence."""
    out = new_console()
    table = Table(title=f"network2009, n = {network2009.N_NODES}, sigma^2 = 0.1, "
                  f"{result['trials']} trials")  # fmt: skip
    for heading in ("loops", "edges", "bound (rad^2)", "consensus / bound", "ml / bound"):
        table.add_column(heading, justify="right")
    for row in result["loops"]:
        ratios = [f"{row['ratio'][name]:.3f} +- {row['ratio_std_error'][name]:.3f}"
                  for name in ("consensus", "ml")]  # fmt: skip
        table.add_row(str(row["loops"]), str(row["edges"]), f"{row['bound']:.5f}", *ratios)
    out.print(table)
    table = Table(title=f"convergence, {network2009.EXAMPLE_LOOPS} loops")
    for heading in ("cycles", "kappa", "steps", "lambda", "measured", "true",
                    "Theorem 19 (squared error)", "holds"):  # fmt: skip
        table.add_column(heading, justify="right")
    for basis, rules in result["convergence"].items():
        for rule, row in rules.items():
            table.add_row(basis, f"{rule} {row['kappa']:.4f}", f"{row['steps']:.0f}",
                          f"{row['lambda_min']:.2f} to {row['lambda_max']:.2f}",
                          f"{row['measured_factor']:.4f}", f"{row['true_factor']:.4f}",
                          f"{row['printed_factor_squared']:.4f}",
                          f"{100 * row['printed_holds']:.0f} %")  # fmt: skip
    out.print(table)
    for row in result["asynchronous"]:
        out.print(f"one cycle at a time, {100 * row['loss']:.0f} % of the messages lost: "
                  f"{row['rounds']:.0f} rounds, {row['largest_error_rad']:.1e} rad from the "
                  "projection")  # fmt: skip


@styled
def network_figure(solved: Solved) -> Figure:
    """The graph where it has places, and the residuals of its edges."""
    figure = new_figure(10, 4.6)
    left, right = figure.subplots(1, 2)
    if solved.positions is not None:
        lines = list(solved.positions[solved.graph.edges])
        left.add_collection(LineCollection(lines, colors="#2e86ab", lw=0.7))
        left.autoscale()
        left.set_aspect("equal")
        left.set(xlabel="x [m]", ylabel="y [m]")
    else:
        left.plot(np.degrees(solved.theta), ".", color="#2e86ab", ms=3)
        left.set(xlabel="node", ylabel="orientation [deg]")
    right.hist(np.degrees(solved.residual), bins=60, color="#2e86ab")
    right.set_yscale("log")
    right.set(xlabel="residual of an edge [deg]", ylabel="edges")
    result = solved.result
    proof = "certified" if result["certified"] else "not certified"
    left.set_title(f"{result['nodes']} nodes, {result['edges']} edges", fontsize=9)
    right.set_title(f"chordal cost {result['chordal_cost']:.7g}, {proof}", fontsize=9)
    return figure


def print_network(result: dict[str, Any]) -> None:
    """The figures of a network, one a line."""
    out = new_console()
    proof = "certified: no other orientations cost less" if result["certified"] else \
        "NOT certified: others may cost less"  # fmt: skip
    out.print(f"{result['nodes']} nodes, {result['edges']} edges, {result['loops']} loops")
    if result["skipped_lines"]:
        lines = ", ".join(f"{count} {kind}" for kind, count in result["skipped_lines"].items())
        out.print(f"skipped, no planar poses: {lines}")
    without = result["edges_without_weight"]
    out.print(f"weights: {result['weights']}"
              + (f"; {without} edges with I33 = 0 are left out" if without else ""))  # fmt: skip
    out.print(f"cost {result['cost']:.10g}, sum of weight x residual^2 (along a tree: "
              f"{result['tree_cost']:.4g})")  # fmt: skip
    out.print(f"residuals {result['residual_rms_deg']:.3f} deg RMS "
              f"({result['residual_weighted_rms_deg']:.3f} weighted), "
              f"{result['residual_max_deg']:.2f} deg at most; largest:")  # fmt: skip
    for edge in result["worst_edges"]:
        degrees = round(edge["residual_deg"], 3) + 0.0  # no "-0.000"
        out.print(f"  edge {edge['i']} {edge['j']}: {degrees:.3f} deg, weight {edge['weight']:g}")
    out.print(f"chordal cost {result['chordal_cost']:.10g}, {proof}")
    out.print(f"solved in {1e3 * result['seconds']:.1f} ms, certified in "
              f"{1e3 * result['certificate_seconds']:.1f} ms")  # fmt: skip
