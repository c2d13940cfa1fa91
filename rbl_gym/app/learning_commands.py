"""The commands rbl-gym train, evaluate and transfer."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from rbl_gym.app.terminal import add_json, add_seed, positive, progress, write_json
from rbl_gym.checks import check_one_of
from rbl_gym.extras import installation, require
from rbl_gym.studies.learning.own_policies import OwnPolicy, PolicyLike, policy_like
from rbl_gym.studies.learning.rl_tasks import TASKS, RlTask, rl_task
from rbl_gym.studies.learning.training import ALGORITHMS
from rbl_gym.worlds.scene_source import read_scene, read_scenes

# Number of held-out worlds for the score of a trained policy, as in ``evaluate``.
_WORLDS = 256
_TASK_HELP = f"{', '.join(sorted(TASKS))}: see docs/learning.md"


def add_train(commands: Any) -> None:
    """Add the parser of ``rbl-gym train``."""
    train = commands.add_parser(
        "train",
        help="train a policy (needs the extra rl)",
        description="Train a policy on a task. The same seed gives the same policy. See "
        "docs/learning.md for the tasks.",
    )
    train.add_argument("task", choices=sorted(TASKS), metavar="TASK", help=_TASK_HELP)
    _add_worlds(train)
    train.add_argument(
        "--algorithm",
        choices=list(ALGORITHMS),
        help="learning algorithm; default: that of the task",
    )
    train.add_argument(
        "--steps",
        type=positive,
        metavar="N",
        help="number of steps of training; default: that of the results in docs/learning.md",
    )
    add_seed(train)
    train.add_argument("--out", metavar="F", help="file of the policy, default out/TASK-SEED.npz")
    add_json(train)
    train.set_defaults(run=_train)


def add_evaluate(commands: Any) -> None:
    """Add the parser of ``rbl-gym evaluate``."""
    evaluate = commands.add_parser(
        "evaluate",
        help="compare policies with reference methods on held-out worlds",
        description="Score policies and reference methods (random, greedy, ...) on held-out "
        "worlds, with 95 % intervals of the paired bootstrap. See docs/learning.md.",
    )
    _add_players(evaluate, list(TASKS), worlds=_WORLDS, references="all that the task has")
    add_json(evaluate)
    evaluate.set_defaults(run=_evaluate)


def add_transfer(commands: Any) -> None:
    """Add the parser of ``rbl-gym transfer``."""
    transfer = commands.add_parser(
        "transfer",
        help="check the scores of policies by tracking bodies with filters",
        description="Let policies and reference methods place, move or select anchors. Track "
        "moving bodies with several filters among these anchors. This checks whether a good score "
        "means a small error. See docs/learning.md.",
    )
    defaults = (
        "random, ring, greedy-swaps and hybrid for placement; random and orbit for moving anchors; "
        "all for selection"
    )
    _add_players(transfer, list(TASKS), worlds=48, references=defaults)
    transfer.add_argument(
        "--repeats",
        type=positive,
        default=16,
        metavar="N",
        help="bodies in each world of a placement task, default 16",
    )
    add_json(transfer)
    transfer.set_defaults(run=_transfer)


def _add_worlds(parser: argparse.ArgumentParser) -> None:
    """Add options for the worlds of the task."""
    worlds = parser.add_mutually_exclusive_group()
    worlds.add_argument(
        "--scene",
        metavar="NAME|F",
        help="a scene in place of that of the task or of the policy's training: a name, or a JSON "
        "or TOML file",
    )
    worlds.add_argument(
        "--family",
        metavar="F",
        help="a family of scenes, of which each world draws one: a JSON or TOML file with a list "
        "of scenes, or with a scene whose values are ranges to draw from",
    )


def _worlds(options: argparse.Namespace) -> dict[str, Any]:
    """Return the requested worlds, as arguments of `RlTask.in_worlds`."""
    if options.family:
        return {"scenes": read_scenes(options.family)}
    return {"scene": read_scene(options.scene)} if options.scene else {}


def _title(options: argparse.Namespace, trained: bool = False) -> str:
    """Return a title for the task and its worlds, `trained`: those of the policy's training."""
    worlds = options.scene or options.family or ("the scene of the training" if trained else "")
    return f"{options.task} in {worlds}" if worlds else options.task


def _played(options: argparse.Namespace) -> tuple[RlTask, str, dict[str, PolicyLike]]:
    """Return task, title and policies; the worlds are the requested or those of the policies."""
    from rbl_gym.studies.learning.trained_worlds import common_worlds

    loaded = _policies(options.policy)
    worlds = _worlds(options) or common_worlds(options.task, loaded)
    return rl_task(options.task).in_worlds(**worlds), _title(options, bool(worlds)), loaded


def _add_players(
    parser: argparse.ArgumentParser, tasks: list[str], worlds: int, references: str
) -> None:
    """Add options for the task, the policies and references, and the worlds."""
    parser.add_argument("task", choices=sorted(tasks), metavar="TASK", help=_TASK_HELP)
    _add_worlds(parser)
    parser.add_argument(
        "--policy",
        action="append",
        default=[],
        metavar="F|MODULE:FUNCTION",
        help="file of a policy, from rbl-gym train, or a function of your own: observations of all "
        "worlds in, actions out; may be given several times",
    )
    parser.add_argument(
        "--references",
        metavar="A,B",
        help=f"reference methods, as in random,greedy; default: {references}",
    )
    parser.add_argument(
        "--worlds",
        type=positive,
        default=worlds,
        metavar="N",
        help=f"number of worlds, default {worlds}",
    )
    add_seed(parser, "seed of the worlds")


def _train(options: argparse.Namespace) -> int:
    from rbl_gym.studies.learning import evaluation, policies, trained_worlds, training

    worlds = _worlds(options)
    task = rl_task(options.task).in_worlds(**worlds)
    steps = options.steps or task.training.steps
    path = Path(options.out or f"out/{options.task}-{options.seed}.npz")
    algorithm = training.check_training(task, options.seed, options.algorithm)
    with progress(f"{algorithm} on {_title(options)}", steps) as advance:
        policy, result = training.train(options.task, task, steps, options.seed, advance, algorithm)
    policy.meta["command"] = _command(options, steps, algorithm)
    policy.meta.update(trained_worlds.worlds_to_keep(worlds))
    policies.save(policy, path)
    result["policy"] = str(path)
    # Of the file, not of the PPO object: others will load the file.
    result["held_out"] = evaluation.held_out_returns(task, policies.load(path), _WORLDS, seed=0)
    if write_json(result, options.json):
        from rbl_gym.app import reports

        reports.print_training(result)
    return 0


def _command(options: argparse.Namespace, steps: int, algorithm: str) -> str:
    """Return the command that trains the policy again."""
    worlds = {"--scene": options.scene, "--family": options.family}
    told = [f"{flag} {value}" for flag, value in worlds.items() if value]
    if algorithm != rl_task(options.task).training.algorithm:
        told.append(f"--algorithm {algorithm}")
    return " ".join(
        ["rbl-gym train", options.task, *told, f"--steps {steps} --seed {options.seed}"]
    )


def _evaluate(options: argparse.Namespace) -> int:
    from rbl_gym.studies.learning import evaluation
    from rbl_gym.studies.learning.left_out import left_out

    task, title, loaded = _played(options)
    named = _references(options, task, [])
    _require_searches({*named})
    if skipped := left_out(evaluation.references(task), named):
        print(f"skipped: {', '.join(skipped)}: {installation('placement')}", file=sys.stderr)
    names = named or None
    with progress(title) as advance:
        result = evaluation.evaluate(task, loaded, names, options.worlds, options.seed, advance)
    result["task"] = title
    if write_json(result, options.json):
        from rbl_gym.app import reports

        reports.print_evaluation(result)
    return 0


def _transfer(options: argparse.Namespace) -> int:
    from rbl_gym.studies.learning import transfer

    task, title, loaded = _played(options)
    names = _references(options, task, transfer.transfer_references(task))
    _require_searches({*names})
    with progress(title) as advance:
        result = transfer.transfer_task(
            task, loaded, names, options.worlds, options.repeats, options.seed, advance
        )
    result["task"] = title
    if write_json(result, options.json):
        from rbl_gym.app import reports

        reports.print_transfer(result)
    return 0


def _references(options: argparse.Namespace, task: RlTask, default: list[str]) -> list[str]:
    """Return unique names of references of the task; without the option, the defaults."""
    from rbl_gym.studies.learning import evaluation

    known = evaluation.references(task)
    names = options.references.split(",") if options.references else default
    return list(dict.fromkeys(check_one_of("reference", name, known) for name in names))


def _require_searches(names: set[str]) -> None:
    """Raise MissingExtraError for a reference whose library is missing, before the others run."""
    for name in ("cma-es", "one-for-all"):
        if name in names:
            require("cmaes", "placement", f"the reference {name}")


def _policies(paths: list[str]) -> dict[str, PolicyLike]:
    """Return policies by name of file or function; raises ValueError if two have the same name."""
    loaded: dict[str, PolicyLike] = {}
    for path in paths:
        policy = policy_like(path)
        label = path.rpartition(":")[2] if isinstance(policy, OwnPolicy) else Path(path).stem
        if label in loaded:
            raise ValueError(f"--policy: two policies are named {label!r}: rename {path}")
        loaded[label] = policy
    return loaded
