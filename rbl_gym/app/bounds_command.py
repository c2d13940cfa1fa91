"""The command rbl-gym bounds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rbl_gym.app.page import digits
from rbl_gym.app.tables import new_console, new_table
from rbl_gym.app.terminal import add_json, add_trials, progress, write_json


def add_bounds(commands: Any) -> None:
    """Add the parser of ``rbl-gym bounds``."""
    bounds = commands.add_parser(
        "bounds",
        help="accuracy bounds of a scene with other sensors, anchor surveys and calibrations",
        description="Compute posterior Cramer-Rao bounds along tracks of a scene. One column for "
        "each source of the motion: ranges alone, a known twist, inertial sensors. One row for "
        "each unknown besides the pose: anchor positions (known to 1, 3 and 10 cm), biases of the "
        "links, offsets of the tags. No filter is run. See docs/hard_conditions.md.",
    )
    bounds.add_argument(
        "--scene",
        default="uwb_room",
        metavar="NAME|F",
        help="name of a scene, or a .toml or .json file with a changed scene; default uwb_room",
    )
    add_trials(bounds, 20)
    add_json(bounds)
    bounds.set_defaults(run=_bounds)


def _bounds(options: argparse.Namespace) -> int:
    from rbl_gym.studies import what_if
    from rbl_gym.studies.bench import spec_files

    spec = next(iter(spec_files.scene_specs([options.scene]).values()))
    if isinstance(spec, dict) and "ranges" in spec:
        raise ValueError(
            f"{Path(options.scene)}: must be a scene, got a recording: a bound needs the true "
            "poses and noise of a scene"
        )
    with progress("bounds") as advance:
        result = what_if.what_if(spec, options.trials, options.seed, advance)
    if write_json(result, options.json):
        _print(result)
    return 0


def _print(result: dict[str, Any]) -> None:
    """Print a table for position and one for rotation: unknowns by motion sensor."""
    console = new_console()
    rows = {(row["motion"], row["unknown"]): row for row in result["rows"]}
    motions = list(dict.fromkeys(motion for motion, _ in rows))
    unknowns = list(dict.fromkeys(unknown for _, unknown in rows))
    for key, label, n in (("position_m", "position (m)", 3), ("rotation_deg", "rotation (deg)", 3)):
        table = new_table(
            f"{result['scene']}: bound of {label}, {result['epochs']} epochs, {result['trials']} "
            "trials; in brackets: the second half of the epochs",
            ["unknown besides the pose"],
            motions,
        )
        for unknown in unknowns:
            cells = [
                f"{digits(rows[m, unknown][key], n)} ({digits(rows[m, unknown]['late_' + key], n)})"
                for m in motions
            ]
            table.add_row(unknown, *cells)
        console.print(table)
    law = result["uncalibrated"]
    console.print(
        "One sigma of all three axes together, root mean square over trials and epochs. Ranges "
        "alone: only the distribution of the accelerations is known, not the motion. Biases of "
        f"links are constant: {100 * law['std_m']:g} cm for each link and "
        f"{100 * law['common_std_m']:g} cm common to all (one sigma). Biases and anchor positions "
        "are estimated together with the pose."
    )
