"""The command rbl-gym network."""

from __future__ import annotations

import argparse
from typing import Any

from rbl_gym.app.terminal import add_json, print_files, write_json


def add_network(commands: Any) -> None:
    """Add the parser of ``rbl-gym network``."""
    network = commands.add_parser(
        "network",
        help="orientations of a planar network or pose graph",
        description="Maximum-likelihood orientations from edge angles, their cost, and whether "
        "it is proved that none are better. See docs/networks.md for the file formats.",
    )
    network.add_argument("file", metavar="FILE", help=".g2o, or CSV: i,j and dtheta (or a,b)")
    network.add_argument(
        "--weights",
        choices=("information", "unit"),
        default="information",
        help="of the edges: the file's information of theta (default), or all alike",
    )
    network.add_argument("--plot", metavar="F", help="picture: the graph and the residuals")
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
