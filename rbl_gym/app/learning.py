"""The commands rbl-gym train, evaluate and transfer."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rbl_gym.app.rl_tasks import TASKS, rl_task
from rbl_gym.app.terminal import (
    MissingExtraError,
    add_json,
    natural,
    positive,
    progress,
    require,
    write_json,
)


def add_train(commands: Any) -> None:
    """The parser of ``rbl-gym train``."""
    train = commands.add_parser(
        "train",
        help="learn a policy by PPO (extra rl)",
        description="Train a policy by PPO on a task; the same seed gives the same policy.",
    )
    train.add_argument("task", choices=sorted(TASKS))
    train.add_argument("--steps", type=positive, help="default: what the task's figures took")
    train.add_argument("--seed", type=natural, default=0, help="of all randomness, default 0")
    train.add_argument("--out", metavar="F", help="default out/TASK-SEED.npz")
    add_json(train)
    train.set_defaults(run=_train)


def add_evaluate(commands: Any) -> None:
    """The parser of ``rbl-gym evaluate``."""
    evaluate = commands.add_parser(
        "evaluate",
        help="policies and references on held-out worlds",
        description="Score policies against the references on held-out worlds, with 95 % "
        "intervals of the paired bootstrap.",
    )
    evaluate.add_argument("task", choices=sorted(TASKS))
    evaluate.add_argument("--policy", action="append", default=[], metavar="F",
                          help="of rbl-gym train; may be given again")  # fmt: skip
    evaluate.add_argument("--references", metavar="A,B", help="default all of the task's")
    evaluate.add_argument("--worlds", type=positive, default=256, help="default 256")
    evaluate.add_argument("--seed", type=natural, default=0, help="which worlds, default 0")
    add_json(evaluate)
    evaluate.set_defaults(run=_evaluate)


def add_transfer(commands: Any) -> None:
    """The parser of ``rbl-gym transfer``."""
    transfer = commands.add_parser(
        "transfer",
        help="layouts rolled through real filters",
        description="Track moving bodies among anchors placed by policies and references: does "
        "what is good by the bound track well?",
    )
    placements = [name for name, task in TASKS.items() if task.env_id == "RBL/AnchorPlacement-v0"]
    transfer.add_argument("task", choices=sorted(placements))
    transfer.add_argument("--policy", action="append", default=[], metavar="F",
                          help="of rbl-gym train; may be given again")  # fmt: skip
    transfer.add_argument("--worlds", type=positive, default=48, help="default 48")
    transfer.add_argument("--repeats", type=positive, default=16,
                          help="bodies in each world, default 16")  # fmt: skip
    transfer.add_argument("--seed", type=natural, default=0, help="which worlds, default 0")
    add_json(transfer)
    transfer.set_defaults(run=_transfer)


def _train(options: argparse.Namespace) -> int:
    from rbl_gym.app import policies, training

    task = rl_task(options.task)
    steps = options.steps or task.steps
    path = Path(options.out or f"out/{options.task}-{options.seed}.npz")
    try:
        with progress(f"PPO on {options.task}", steps) as advance:
            policy, result = training.train(options.task, task, steps, options.seed, advance)
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"training needs the extra rl ({error.name} is missing): pip install 'rbl-gym[rl]'"
        ) from error
    policies.save(policy, path)
    result["policy"] = str(path)
    if write_json(result, options.json):
        from rbl_gym.app import reports

        reports.print_training(result)
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    from rbl_gym.app import evaluation

    task = rl_task(options.task)
    loaded = _policies(options.policy)
    names = options.references.split(",") if options.references else evaluation.references(task)
    units = evaluation.work_units(task, names, len(loaded))
    try:
        with progress(options.task, units) as advance:
            result = evaluation.evaluate(task, loaded, names, options.worlds, options.seed, advance)
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error)) from error
    result["task"] = options.task
    if write_json(result, options.json):
        from rbl_gym.app import reports

        reports.print_evaluation(result)
    return 0


def _transfer(options: argparse.Namespace) -> int:
    require("cmaes", "placement")
    from rbl_gym.app import evaluation, transfer

    task = rl_task(options.task)
    loaded = _policies(options.policy)
    filters = transfer.filters(task)
    references = transfer.references(task)
    units = (len(filters) + 1) * (len(references) + len(loaded))
    with progress(options.task, units) as advance:
        problem, contexts, layouts = evaluation.layouts_of(
            task, loaded, references, options.worlds, options.seed, advance
        )
        result = transfer.run(
            problem, contexts, layouts, filters, options.repeats, options.seed, advance
        )
    result |= {"task": options.task, "worlds": options.worlds, "seed": options.seed}
    if write_json(result, options.json):
        from rbl_gym.app import reports

        reports.print_transfer(result)
    return 0


def _policies(paths: list[str]) -> dict[str, Any]:
    """Policies by the names of their files, or a ValueError where two share one."""
    from rbl_gym.app import policies

    loaded: dict[str, Any] = {}
    for path in paths:
        label = Path(path).stem
        if label in loaded:
            raise ValueError(f"--policy: two files are named {label!r}: rename {path}")
        loaded[label] = policies.load(path)
    return loaded
