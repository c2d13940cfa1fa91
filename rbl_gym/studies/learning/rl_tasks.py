"""The learning tasks by name: their environments and the settings of PPO."""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from rbl_gym.checks import check_one_of
from rbl_gym.worlds.families import SceneFamily, family

__all__ = ["TASKS", "RlTask", "Training", "rl_task", "task_of"]

# Worlds of a training or evaluation have the seeds from SEED_STRIDE times its own seed on. Seeds of
# evaluations lie beyond those of all trainings.
SEED_STRIDE = 1_000_000
HELD_OUT_SEED = 1_000_000_000


@dataclass(frozen=True)
class Training:
    """Settings of the training of a task.

    Parameters
    ----------
    steps
        Environment steps of a training.
    rollout
        Steps of each world between two updates.
    gamma, gae_lambda
        Discount and advantage mixing; 1 if only the end counts.
    num_envs, batch_size, epochs, learning_rate, hidden, log_std_init
        Settings of PPO; the learning rate falls linearly to zero.
    algorithm
        Default algorithm, a name of `training.ALGORITHMS`.
    """

    steps: int = 600_000
    rollout: int = 13
    gamma: float = 1.0
    gae_lambda: float = 1.0
    num_envs: int = 64
    batch_size: int = 512
    epochs: int = 10
    learning_rate: float = 1e-3
    hidden: tuple[int, ...] = (128, 128)
    log_std_init: float = -0.5
    algorithm: str = "ppo"


@dataclass(frozen=True)
class RlTask:
    """An environment with arguments, and the settings of its training.

    Parameters
    ----------
    env_id, arguments
        Arguments of `gym.make_vec`.
    training
        Settings of the training.
    """

    env_id: str
    arguments: dict[str, Any]
    training: Training = Training()

    def make(self, num_envs: int, autoreset_mode: str = "SameStep") -> Any:
        """Return the vector environment."""
        return gym.make_vec(
            f"rbl_gym:{self.env_id}",
            num_envs=num_envs,
            autoreset_mode=autoreset_mode,
            **self.arguments,
        )

    def in_worlds(self, scene: Any = None, scenes: Any = None) -> RlTask:
        """Return the task in another scene, or in a family of scenes.

        Parameters
        ----------
        scene
            Scene as in the environment's argument; it replaces the task's own.
        scenes
            A family of scenes instead, see `rbl_gym.worlds.families.family`.
        """
        if scene is None and scenes is None:
            return self
        if scene is not None and scenes is not None:
            raise ValueError("scene must be left out if scenes is given")
        given = {"scene": scene} if scenes is None else {"scenes": scenes}
        kept = {k: v for k, v in self.arguments.items() if k not in ("scene", "scenes")}
        return dataclasses.replace(self, arguments={**kept, **given})

    def scene_family(self) -> SceneFamily:
        """The scenes of the environment, for a task with a filter in the loop."""
        with contextlib.closing(self.make(1)) as env:
            return env.family or family([env.scene])


def _mobile(steps: int, rollout: int, **arguments: Any) -> RlTask:
    # Per world, a step of the filter with 256 worlds costs a third of that with 64.
    training = Training(steps, rollout, gamma=0.95, gae_lambda=0.9, num_envs=256)
    return RlTask("RBL/MobileAnchors-v0", arguments, training)


def _selection(**arguments: Any) -> RlTask:
    # A choice affects a few steps only, and a short horizon is learned faster.
    training = Training(600_000, 13, gamma=0.8, gae_lambda=0.9, num_envs=256)
    return RlTask("RBL/AnchorSelection-v0", arguments, training)


def _placement(steps: int, n_anchors: int, log_std_init: float = -1.5, **arguments: Any) -> RlTask:
    # With a larger standard deviation of the actions at the start, anchors are apart by chance, and
    # their means do not learn to be. `uwb_room` is an exception: its score is .895 with -1.5, and
    # .912 with -0.5 (docs/learning.md).
    training = Training(steps, 4 * n_anchors, log_std_init=log_std_init)
    return RlTask("RBL/AnchorPlacement-v0", arguments, training)


# Two slow craft need the most skill: they are drawn in more than half of the worlds. Three slow
# ones are the next.
_SLOW_PAIR = {"name": "auv_craft", "n_anchors": 2, "anchor_speed_m_s": 2.0}
_SLOW_THREE = {**_SLOW_PAIR, "n_anchors": 3}
_DRAWN_CRAFT = {
    "name": "auv_craft",
    "n_anchors": {"integers": [2, 5]},
    "anchor_speed_m_s": {"choice": [2.0, 4.0, 4.0]},
}
CRAFT = (*(_SLOW_PAIR,) * 3, _SLOW_THREE, _DRAWN_CRAFT, _DRAWN_CRAFT)
_RACK = {
    "choice": [
        [{"uniform": [-15, 15]}, {"uniform": [-7, 7]}, 1.5, 0.5, 4.0, 1.5],
        [{"uniform": [-15, 15]}, {"uniform": [-7, 7]}, 1.5, 4.0, 0.5, 1.5],
    ]
}
# Halls 24 to 56 m long with 2 to 6 racks and 6 to 12 anchors; one in four is `hall` itself.
_DRAWN_HALL = {
    "name": "hall",
    "n_anchors": {"integers": [6, 12]},
    "stretch": [{"uniform": [0.6, 1.4]}, {"uniform": [0.6, 1.4]}, 1.0],
    "obstacles": {"repeat": {"count": [2, 6], "of": _RACK}},
}
HALLS = (_DRAWN_HALL, _DRAWN_HALL, _DRAWN_HALL, "hall")

TASKS: dict[str, RlTask] = {
    "auv_buoys": _placement(300_000, 4, scene="auv_buoys"),
    "drone_yard": _placement(450_000, 6, scene="drone_yard"),
    "uwb_room": _placement(1_200_000, 5, -0.5, scene="uwb_room", racks=2, sight=True),
    "satellite": _placement(450_000, 5, scene="satellite"),
    "mounts": _placement(1_200_000, 5, scene="uwb_room", racks=2, mode="mounts"),
    "mobile-easy": _mobile(600_000, 50, difficulty="easy"),
    "mobile-hard": _mobile(1_500_000, 13, difficulty="hard"),
    "craft": RlTask(
        "RBL/MobileAnchors-v0", {"scenes": CRAFT},
        Training(2_500_000, 20, 0.95, 0.9, num_envs=128, algorithm="set-ppo"),
    ),
    "selection": _selection(k=3),
    "selection-priced": _selection(mode="priced"),
    "halls": RlTask(
        "RBL/AnchorSelection-v0", {"k": 3, "scenes": HALLS},
        Training(160_000, 13, 0.8, 0.9, num_envs=256, algorithm="supervised"),
    ),
}  # fmt: skip


def rl_task(name: str) -> RlTask:
    """Return the named task, or raise ValueError."""
    return TASKS[check_one_of("task", name, list(TASKS))]


# Environments with references, and arguments of `gym.make_vec` that are not those of a world.
_REFERRED = ("RBL/AnchorPlacement-v0", "RBL/MobileAnchors-v0", "RBL/AnchorSelection-v0")
_OF_FORM = (
    "num_envs", "vectorization_mode", "autoreset_mode", "max_episode_steps", "render_mode",
)  # fmt: skip


def task_of(given: Any) -> RlTask:
    """Return a task.

    Parameters
    ----------
    given
        A task; its name in `TASKS`; or an environment of `gym.make` or `gym.make_vec`, without
        wrappers. The task has its id and its arguments.

    Raises
    ------
    ValueError
        If it is none of these, or there are no references for the environment.
    """
    if isinstance(given, RlTask):
        return given
    if isinstance(given, str):
        return rl_task(given)
    spec = getattr(given, "spec", None)
    if spec is None:
        raise ValueError(
            f"task must be one of {', '.join(TASKS)}, or an environment of gym.make or "
            f"gym.make_vec, got {given!r:.80}"
        )
    if spec.id not in _REFERRED:
        raise ValueError(
            f"task must be an environment with references, {', '.join(_REFERRED)}, got {spec.id}. "
            "For others compare mean rewards (docs/your_own_task.md)"
        )
    if spec.additional_wrappers:
        names = ", ".join(one.name for one in spec.additional_wrappers)
        raise ValueError(
            f"task must be an environment without wrappers, got {names}. Give env.unwrapped, and "
            "do in the policy what the wrappers do"
        )
    kept = {key: value for key, value in spec.kwargs.items() if key not in _OF_FORM}
    return RlTask(spec.id, kept)
