"""The command rbl-gym studio."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rbl_gym.app.plan_options import add_plan_options, is_plan, read_plan, read_problem
from rbl_gym.app.reading_options import add_reading, read_runs
from rbl_gym.app.terminal import FILTER_HELP, add_seed, names, natural, positive
from rbl_gym.extras import require


def add_studio(commands: Any) -> None:
    """Add the parser of ``rbl-gym studio``."""
    studio = commands.add_parser(
        "studio",
        help="drag anchors, or watch filters, on a page in the browser",
        description="Open a page in the browser. On it you drag anchors, and a map of the accuracy "
        "follows. With --watch, --env or --ranges the page shows filters that track a body. "
        "Everybody who can open the page can change the layout and save files into "
        "--folder.",
    )
    studio.add_argument(
        "scene",
        nargs="?",
        metavar="SCENE|FILE",
        help="a named scene, a building file .toml or .json, or a plan .dxf, .geojson, .png, .jpg",
    )
    studio.add_argument(
        "--anchors",
        type=_count_or_file,
        metavar="N|F",
        help="number of anchors at the start; with --ranges the CSV file anchor,x,y,z",
    )
    studio.add_argument("--layout", metavar="F", help="CSV file of the layout at the start")
    studio.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="H",
        help="address to listen on, default 127.0.0.1: only this machine",
    )
    studio.add_argument(
        "--port",
        type=natural,
        default=8080,
        metavar="N",
        help="first port that is tried, default 8080; 0: any free port",
    )
    studio.add_argument(
        "--folder",
        default=".",
        metavar="D",
        help="folder in which files are saved, default the working directory",
    )
    add_seed(studio, "seed of the searches and of the episodes")
    studio.add_argument(
        "--no-browser", action="store_true", help="print the address and open no browser"
    )
    watch = studio.add_argument_group("watching filters")
    watch.add_argument("--watch", action="store_true", help="show an episode of SCENE|FILE")
    watch.add_argument(
        "--env",
        metavar="ID",
        help="show an episode of an environment, such as RBL/AnchorSelection-v0",
    )
    watch.add_argument(
        "--policy",
        metavar="F",
        help=(
            "show a policy of rbl-gym train in a held-out world of its task, or in an "
            "episode of --env"
        ),
    )
    watch.add_argument(
        "--reference",
        metavar="NAME",
        help="reference to show beside the policy; default the strongest",
    )
    watch.add_argument(
        "--filter",
        type=names,
        default=[],
        metavar="A,B",
        help=f"one or several filters, shown side by side: {FILTER_HELP}. Default: "
        "iekf,iekf/robust=true; for a recording iekf-log",
    )
    add_plan_options(studio)
    add_reading(studio, left_out=("anchors",))
    studio.set_defaults(run=_studio, region=None, racks=0)


def _count_or_file(text: str) -> int | str:
    return positive(text) if text.lstrip("-").isdigit() else text


def _studio(options: argparse.Namespace) -> int:
    require("viser", "studio", "the studio")
    from rbl_gym.app import studio
    from rbl_gym.app.studio.opening import Options

    if options.reference and (options.env or not options.policy):
        raise ValueError("--reference needs --policy without --env: only tasks have references")
    shown = {}
    if any((options.ranges, options.watch, options.env, options.policy)):
        what, beside = _program(options), None
    else:
        _check_scene(options)
        beside = _layout(options)
        count = options.anchors if beside is None else len(beside)
        what = read_problem(options, count)
        shown["tables"] = _tables(options, count)
    page = studio.show(
        what,
        beside,
        **shown,
        options=Options(
            options.host,
            options.port,
            options.folder,
            options.seed,
            not options.no_browser,
            _write_report,
        ),
    )
    print(f"{page.url}   (Ctrl-C ends it)", flush=True)
    if shown:
        print(f"Layouts are saved in {Path(options.folder).resolve()}", flush=True)
    page.wait()
    return 0


def _check_scene(options: argparse.Namespace) -> None:
    if options.scene is None:
        raise ValueError(
            "SCENE|FILE must be given: a named scene, as in rbl-gym studio uwb_room, or a building "
            "file"
        )
    if isinstance(options.anchors, str):
        raise ValueError(f"--anchors must be a number without --ranges, got {options.anchors!r}")


def _layout(options: argparse.Namespace) -> Any:
    """Return anchors (M, 3) of --layout, or None."""
    from rbl_gym.placement.layout_files import read_layout

    return read_layout(options.layout).positions if options.layout else None


def _program(options: argparse.Namespace) -> Any:
    """Return the program to watch."""
    from rbl_gym.studies import replay
    from rbl_gym.studies.watching import program
    from rbl_gym.studies.watching.frames import filter_named
    from rbl_gym.studies.watching.recorded import track_all

    labels = tuple(options.filter)
    if options.policy:
        return _learned(options, labels)
    if options.env:
        return program.env_program(_env(options), labels or None, options.seed)
    if not options.ranges:
        _check_scene(options)
        return _simulation(options, labels or program.LIVE)
    if options.scene is not None:
        raise ValueError(f"SCENE|FILE must be left out with --ranges, got {options.scene!r}")
    if isinstance(options.anchors, int):
        raise ValueError(f"--anchors must be a file with --ranges, got {options.anchors}")
    runs = read_runs(options)
    if len(runs) > 1:
        raise ValueError(f"{options.ranges} has the runs {[*runs]!r:.200}: choose one by --run")
    (recording,) = runs.values()
    settings, named = replay.Settings(), [*map(filter_named, labels or program.RECORDED)]
    tracks = track_all(recording, tuple(named), settings)
    return program.recorded_program(recording, tracks, settings)


def _learned(options: argparse.Namespace, labels: tuple[str, ...]) -> Any:
    """Return a policy in its task, or in the environment of --env; in SCENE if given."""
    from rbl_gym.studies.watching import learned
    from rbl_gym.worlds.scene_source import read_scene

    if options.env:
        env = _env(options)
        return learned.played_program(options.policy, env, labels or None, options.seed)
    scene = read_scene(options.scene) if options.scene else None
    return learned.learned_program(options.policy, options.reference, options.seed, scene)


def _env(options: argparse.Namespace) -> Any:
    """Return the environment of --env, in SCENE if given."""
    import gymnasium as gym

    from rbl_gym.worlds.scene_source import read_scene

    scene = {} if options.scene is None else {"scene": read_scene(options.scene)}
    name = options.env.removeprefix("rbl_gym:")
    try:
        return gym.make(f"rbl_gym:{name}", render_mode="rgb_array", **scene)
    except (gym.error.Error, ModuleNotFoundError, TypeError) as error:
        raise ValueError(f"--env {options.env}: {error}") from error


def _simulation(options: argparse.Namespace, labels: tuple[str, ...]) -> Any:
    """Return an episode of a named scene with the anchors of --layout, or of a building."""
    from rbl_gym.app.studio.state import open_state
    from rbl_gym.studies.watching import live, program
    from rbl_gym.worlds import scenes

    layout = _layout(options)
    if options.scene in scenes.SCENES and layout is None and options.anchors is None:
        scene = scenes.get(options.scene)
        room = program.room_of(scene)
        return program.live_program(live.stage_of_scene(scene), labels, room, options.seed)
    problem = read_problem(options, options.anchors if layout is None else len(layout))
    anchors = open_state(problem, layout).anchors
    stage = live.stage_of_problem(problem, anchors)
    return program.live_program(stage, labels, problem, options.seed)


def _tables(options: argparse.Namespace, count: int | None) -> dict[str, Any] | None:
    """Return the tables of the opened file or plan; None for a named scene."""
    from rbl_gym.placement import scene_files
    from rbl_gym.placement.plans import toml_text

    if is_plan(options.scene):
        return toml_text.plain(read_plan(options.scene, options, count).tables)
    if options.scene.lower().endswith((".toml", ".json")):
        return scene_files.load(options.scene)
    return None


def _write_report(problem: Any, anchors: Any, path: str) -> None:
    """Write the report of a layout, as `rbl-gym place --layout F --report` does."""
    from rbl_gym.app import place_pdf
    from rbl_gym.studies.placing import answer

    count = len(anchors)
    question = answer.Question(range(count, count + 1), layout=anchors)
    place_pdf.write_pdf(answer.place_anchors(problem, question), path)
