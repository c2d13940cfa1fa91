"""Pictures and tables of the network command."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from rbl_gym.app.figures import new_figure, styled
from rbl_gym.app.tables import new_console
from rbl_gym.studies.network import Solved


@styled
def network_figure(solved: Solved) -> Figure:
    """Draw the graph if it has positions, and the residuals of its edges."""
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
    left.set_title(f"{result['nodes']} nodes, {result['edges']} edges")
    right.set_title(f"chordal cost {result['chordal_cost']:.7g}, {proof}")
    return figure


def print_network(result: dict[str, Any]) -> None:
    """Print the figures of a network, one per line."""
    out = new_console()
    proof = (
        "certified: no other orientations cost less"
        if result["certified"]
        else "NOT certified: other orientations may cost less"
    )
    out.print(f"{result['nodes']} nodes, {result['edges']} edges, {result['loops']} loops")
    if result["skipped_lines"]:
        lines = ", ".join(f"{count} {kind}" for kind, count in result["skipped_lines"].items())
        out.print(f"skipped, no planar poses: {lines}")
    without = result["edges_without_weight"]
    left_out = f"; {without} edges without information of theta are left out" if without else ""
    out.print(f"weights: {result['weights']}{left_out}")
    out.print(
        f"cost {result['cost']:.10g}, sum of weight x residual^2 (orientations summed along a "
        f"spanning tree: {result['tree_cost']:.4g})"
    )
    out.print(
        f"residuals {result['residual_rms_deg']:.3f} deg RMS "
        f"({result['residual_weighted_rms_deg']:.3f} weighted), "
        f"{result['residual_max_deg']:.2f} deg at most; largest:"
    )
    for edge in result["worst_edges"]:
        degrees = round(edge["residual_deg"], 3) + 0.0  # avoids "-0.000"
        out.print(f"  edge {edge['i']} {edge['j']}: {degrees:.3f} deg, weight {edge['weight']:g}")
    out.print(f"chordal cost {result['chordal_cost']:.10g}, {proof}")
    out.print(
        f"solved in {1e3 * result['seconds']:.1f} ms, certified in "
        f"{1e3 * result['certificate_seconds']:.1f} ms"
    )
