"""The learning tasks by name: their environments, and the settings PPO learns them with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from rbl_gym.checks import check_one_of

__all__ = [
    "TASKS",
    "RlTask",
    "rl_task",
]

# Worlds of a training, or of an evaluation, have the seeds from SEED_STRIDE times its own seed on;
# those of evaluations begin beyond all of trainings.
SEED_STRIDE = 1_000_000
HELD_OUT_SEED = 1_000_000_000


@dataclass(frozen=True)
class RlTask:
    """An environment with arguments, and how PPO is set for it.

    Parameters
    ----------
    env_id, arguments
        What `gym.make_vec` gets.
    steps
        Environment steps of a training.
    rollout
        Steps of each world between two updates.
    gamma, gae_lambda
        Discount and advantage mixing; 1 where only the end counts.
    num_envs, batch_size, epochs, learning_rate, hidden, log_std_init
        As their names say; the learning rate falls linearly to zero.
    """

    env_id: str
    arguments: dict[str, Any]
    steps: int
    rollout: int
    gamma: float = 1.0
    gae_lambda: float = 1.0
    num_envs: int = 64
    batch_size: int = 512
    epochs: int = 10
    learning_rate: float = 1e-3
    hidden: tuple[int, ...] = (128, 128)
    log_std_init: float = -0.5

    def make(self, num_envs: int, autoreset_mode: str = "SameStep") -> Any:
        """The vector environment."""
        return gym.make_vec(
            f"rbl_gym:{self.env_id}",
            num_envs=num_envs,
            autoreset_mode=autoreset_mode,
            **self.arguments,
        )


def _mobile(steps: int, rollout: int, **arguments: Any) -> RlTask:
    # A step of the filter costs each of 256 worlds a third of what it does each of 64.
    return RlTask(
        "RBL/MobileAnchors-v0", arguments, steps, rollout, gamma=0.95, gae_lambda=0.9, num_envs=256
    )


def _selection(**arguments: Any) -> RlTask:
    # What is chosen now is felt for a few steps only: a short horizon is learned faster.
    return RlTask(
        "RBL/AnchorSelection-v0", arguments, 600_000, 13, gamma=0.8, gae_lambda=0.9, num_envs=256
    )


def _placement(steps: int, n_anchors: int, **arguments: Any) -> RlTask:
    return RlTask("RBL/AnchorPlacement-v0", arguments, steps, 4 * n_anchors)


TASKS: dict[str, RlTask] = {
    "auv_buoys": _placement(300_000, 4, scene="auv_buoys"),
    "drone_yard": _placement(450_000, 6, scene="drone_yard"),
    "uwb_room": _placement(1_200_000, 5, scene="uwb_room", racks=2, sight=True),
    "satellite": _placement(450_000, 5, scene="satellite"),
    "mounts": _placement(1_200_000, 5, scene="uwb_room", racks=2, mode="mounts"),
    "mobile-easy": _mobile(600_000, 50, difficulty="easy"),
    "mobile-hard": _mobile(1_500_000, 13, difficulty="hard"),
    "selection": _selection(k=3),
    "selection-priced": _selection(mode="priced"),
}


def rl_task(name: str) -> RlTask:
    """The named task, or a ValueError."""
    return TASKS[check_one_of("task", name, list(TASKS))]
