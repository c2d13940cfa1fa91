"""List the experiments of `rbl-gym reproduce` by name: of the papers, and our own."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from rbl_gym.recordings.writing import write_table


class Experiment(NamedTuple):
    """Title of an experiment, its function, and how its result is drawn and printed."""

    summary: str
    run: Callable[..., dict[str, Any]]  # of trials, seed, advance; `options` are keywords
    figure: Callable[[dict[str, Any], int], Any]  # of the result and the seed
    show: Callable[[dict[str, Any]], None]
    options: tuple[str, ...] = ()  # of the command line, besides trials and seed


def _late(module: str, name: str) -> Callable[..., Any]:
    """Return a function whose module is imported when it is called, as imports are slow."""

    def call(*arguments: Any, **options: Any) -> Any:
        return getattr(importlib.import_module(f"rbl_gym.{module}"), name)(*arguments, **options)

    return call


def _drawn(module: str, name: str) -> Callable[[dict[str, Any], int], Any]:
    """Return a figure function that needs only the result."""
    return lambda result, _: _shown(module, name)(result)


def _shown(module: str, name: str) -> Callable[..., Any]:
    return _late(f"app.{module}", name)


def _camsap2013_figure(result: dict[str, Any], seed: int) -> Any:
    example = _late("studies.papers.camsap2013", "example")(seed)
    return _shown("figures", "camsap2013_figure")(result, example)


def _tracking(trials: int, seed: int, advance: Any) -> dict[str, Any]:
    run = _late("studies.papers.camsap2013", "tracking_experiment")
    return run(trials, seed, advance, trade=True)


def _static(*arguments: Any) -> dict[str, Any]:
    from rbl_gym.studies.papers import icassp2013

    return icassp2013.static_experiment("icassp2013", icassp2013.static_settings(), *arguments)


def experiments() -> dict[str, Experiment]:
    """Return all experiments by name."""
    return {
        "camsap2013": Experiment(
            "tracking: KF, UC-KF, ET-KF, KF-ortho, iterated EKF (Figs 2, 3)",
            _tracking,
            _camsap2013_figure,
            _shown("reports", "print_camsap2013"),
        ),
        "doa2019": Experiment(
            "a pose from angles at one base station (Fig. 2, Table 1)",
            _late("studies.papers.doa2019", "doa_experiment"),
            _drawn("doa_figures", "doa2019_figure"),
            _shown("doa_figures", "print_doa2019"),
        ),
        "hard": Experiment(
            "lost and reflected links, wrong starts, outages (no paper)",
            _late("studies.hard", "compare_hard_conditions"),
            _drawn("hard_figures", "hard_figure"),
            _shown("hard_figures", "print_hard"),
        ),
        "icassp2013": Experiment(
            "one epoch of ranges: LS, CLS, Procrustes, ML (Figs 2, 3)",
            _static,
            _drawn("figures", "static_figure"),
            _shown("reports", "print_static"),
        ),
        "slides2013": Experiment(
            "5 tags, 4 anchors: one epoch, and tracking (slides)",
            _late("studies.papers.slides2013", "slides_experiment"),
            _drawn("figures", "slides2013_figure"),
            _shown("reports", "print_slides2013"),
        ),
        "network2009": Experiment(
            "planar networks, cycle consensus (Figs 3 to 6)",
            _late("studies.papers.network2009", "network_experiment"),
            _drawn("network2009_figures", "network2009_figure"),
            _shown("network2009_figures", "print_network2009"),
            ("positions", "footprints", "variance"),
        ),
    }


def write_csv(result: dict[str, Any], path: str) -> None:
    """Write every figure of a result as a row: its path in the result, then the value."""
    rows = list(_leaves(result, ()))
    width = max(len(place) for place, _ in rows)
    header = [*(f"key{k}" for k in range(1, width + 1)), "value"]
    write_table(path, header, ([*at, *[""] * (width - len(at)), value] for at, value in rows))


def _leaves(node: Any, place: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Any]]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _leaves(value, (*place, key))
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from _leaves(value, (*place, index))
    else:
        yield place, node
