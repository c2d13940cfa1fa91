"""The command rbl-gym network."""

from __future__ import annotations

import argparse
from typing import Any

from rbl_gym.app.terminal import add_json, add_plot, print_files, write_json


def add_network(commands: Any) -> None:
    """Add the parser of ``rbl-gym network``."""
    network = commands.add_parser(
        "network",
        help="estimate the orientations of a planar network or pose graph",
        description="Compute maximum-likelihood orientations from edge angles, and their cost. "
        "Also minimize the chordal cost, the sum of 2 w (1 - cos residual) with the weights w, and "
        "test whether its minimum is global. See docs/networks.md for the file formats.",
    )
    network.add_argument(
        "file", metavar="FILE", help="a .g2o file, or CSV with columns i,j and dtheta (or a,b)"
    )
    network.add_argument(
        "--weights",
        choices=("information", "unit"),
        default="information",
        help="weights of the edges: information of theta in the file (default), or equal weights",
    )
    add_plot(network, "of the graph and of the residuals of its edges")
    add_json(network)
    network.set_defaults(run=_network)


def _network(options: argparse.Namespace) -> int:
    from rbl_gym.studies import network

    solved = network.solve_network(options.file, options.weights)
    if options.plot:
        from rbl_gym.app import figures, network_figures

        figures.save_figure(network_figures.network_figure(solved), options.plot)
    if write_json(solved.result, options.json):
        from rbl_gym.app import network_figures

        network_figures.print_network(solved.result)
        print_files(picture=options.plot)
    return 0
