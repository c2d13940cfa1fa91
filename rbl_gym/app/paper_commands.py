"""The commands rbl-gym demo and rbl-gym reproduce: experiments of the papers."""

from __future__ import annotations

import argparse
from typing import Any

from rbl_gym.app.terminal import (
    add_html,
    add_json,
    add_plot,
    add_trials,
    check_html,
    print_files,
    progress,
    write_json,
)


def add_demo(commands: Any) -> None:
    """Add the parser of ``rbl-gym demo``."""
    demo = commands.add_parser(
        "demo",
        help="compare five filters with the Cramer-Rao bound in simulation",
        description=(
            "Track a rigid body with five filters in Monte Carlo trials (the experiment of the "
            "tracking paper, CAMSAP 2013). Print a table and draw a picture."
        ),
    )
    add_trials(demo)
    add_plot(demo, "of the errors and a track, default out/demo.png", "out/demo.png")
    add_html(demo, "page with a trial in 3-D, charts and tables")
    add_json(demo)
    demo.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    from rbl_gym.studies.papers import camsap2013

    check_html(options)
    with progress("tracking") as advance:
        result = camsap2013.tracking_experiment(options.trials, options.seed, advance)
    from rbl_gym.app import figures, reports

    example = camsap2013.example(options.seed)
    figures.save_figure(figures.camsap2013_figure(result, example), options.plot)
    if options.html:
        from rbl_gym.app import page, track_pages

        page.write(track_pages.demo_page(result, example), options.html)
    if write_json(result, options.json):
        reports.print_camsap2013(result)
        print_files(picture=options.plot, page=options.html)
    return 0


def add_reproduce(commands: Any) -> None:
    """Add the parser of ``rbl-gym reproduce``."""
    from rbl_gym.app.papers import experiments

    reproduce = commands.add_parser(
        "reproduce",
        help="reproduce an experiment of a paper: tables, figures, CSV",
        description="Run an experiment of a paper again, and print its table.",
        epilog="experiments:\n"
        + "\n".join(f"  {name:<11} {e.summary}" for name, e in experiments().items()),
    )
    reproduce.add_argument(
        "experiment",
        choices=sorted(experiments()),
        metavar="EXPERIMENT",
        help="one of the experiments that are listed below",
    )
    add_trials(reproduce)
    add_plot(reproduce, "of the results, default out/EXPERIMENT.png")
    reproduce.add_argument("--csv", metavar="F", help="CSV file with all results, one on each row")
    network = reproduce.add_argument_group("network2009")
    network.add_argument(
        "--positions",
        metavar="F",
        help="CSV file of the nodes with the header x,y; the first is the reference",
    )
    network.add_argument(
        "--footprint",
        dest="footprints",
        metavar="R",
        type=float,
        nargs="+",
        help="sensing radii, in the unit of the positions",
    )
    network.add_argument(
        "--variance",
        metavar="S2",
        type=float,
        help="variance of a bearing, rad^2; default 0.1, and 0.01 in Figs 5 and 6",
    )
    add_json(reproduce)
    reproduce.set_defaults(run=_reproduce)


def _reproduce(options: argparse.Namespace) -> int:
    from rbl_gym.app import papers

    experiment = papers.experiments()[options.experiment]
    named = {"positions": "--positions", "footprints": "--footprint", "variance": "--variance"}
    given = {name: getattr(options, name) for name in named if getattr(options, name) is not None}
    if wrong := [named[name] for name in given if name not in experiment.options]:
        raise ValueError(f"{options.experiment} has no option {' and no option '.join(wrong)}")
    with progress(options.experiment) as advance:
        result = experiment.run(options.trials, options.seed, advance, **given)
    from rbl_gym.app import figures

    plot = options.plot or f"out/{options.experiment}.png"
    figures.save_figure(experiment.figure(result, options.seed), plot)
    if options.csv:
        papers.write_csv(result, options.csv)
    if write_json(result, options.json):
        experiment.show(result)
        print_files(picture=plot)
    return 0
