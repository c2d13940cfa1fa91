"""Learning tasks with a filter in the loop: move the anchors, or choose them, for the belief.

World + iterated EKF + observation + reward. The world is that of `RBL/Tracking-v0`; the policy
sees the belief, not the ranges, and is paid for how good the belief says it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym import rendering
from rbl_gym.checks import BoolArray, FloatArray, check_count, check_number, check_one_of
from rbl_gym.envs.batch import ScalarEnv
from rbl_gym.worlds import scenes, simulation
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers.filter_loop import FilterLoop

# An observation is of order one; what is far outside says no more than that.
_LIMIT = 10.0
DIFFICULTIES: dict[str, dict[str, Any]] = {
    "easy": {"n_anchors": 3, "anchor_speed_m_s": 4.0},
    "hard": {"n_anchors": 2, "anchor_speed_m_s": 2.0},
}
SELECTIONS = ("top-k", "priced")


def _world(scene: Any, **defaults: Any) -> Scene:
    """The scene; `defaults` stand where it says nothing of its own."""
    changes = {"name": scene} if isinstance(scene, str) else scene
    return scenes.get({**defaults, **changes} if isinstance(changes, Mapping) else changes)


def _flat(parts: list[FloatArray]) -> np.ndarray:
    return np.clip(np.concatenate(parts, axis=-1), -_LIMIT, _LIMIT).astype(np.float32)


# --- surface craft and a diving vehicle -------------------------------------------------------


class MobileAnchorsVectorEnv(FilterLoop):
    """`num_envs` independent `MobileAnchorsEnv`; seeding and autoreset as `BatchEnv`."""

    def __init__(
        self,
        num_envs: int = 1,
        difficulty: str = "easy",
        scene: str | Mapping[str, Any] = "auv_craft",
        sort_craft: bool = True,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        level = DIFFICULTIES[check_one_of("difficulty", difficulty, list(DIFFICULTIES))]
        world = _world(scene, **level)
        if world.anchor_speed_m_s <= 0:
            raise ValueError("scene must have anchors that move, got anchor_speed_m_s = 0")
        if not isinstance(sort_craft, bool):
            raise ValueError(f"sort_craft must be True or False, got {sort_craft!r}")
        self.sort_craft = sort_craft
        size = 15 + 3 * world.n_anchors
        self.single_action_space = spaces.Box(-1.0, 1.0, (2 * world.n_anchors,), np.float32)
        self.single_observation_space = spaces.Box(-_LIMIT, _LIMIT, (size,), np.float32)
        self.film = rendering.film_of(render_mode, world)
        self._configure(num_envs, render_mode, world.steps, max_episode_steps, autoreset_mode)
        self._configure_loop(world, num_envs)
        self.order = np.tile(np.arange(world.n_anchors), (num_envs, 1))

    def _restart(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        self._start(chosen, generators)
        self._update(chosen)
        self._sort()

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        rows = np.flatnonzero(moving)
        velocity = np.zeros((len(rows), self.scene.n_anchors, 3))
        level = actions[rows].reshape(len(rows), self.scene.n_anchors, 2)
        # Action k is that of the k-th craft in the observation.
        np.put_along_axis(velocity[..., :2], self.order[rows][..., None], level, axis=1)
        self.anchors[rows] = simulation.move_anchors(
            self.scene, self.anchors[rows], velocity.reshape(len(rows), -1)
        )
        self._predict(rows)
        self._update(rows)
        self._sort()
        return -np.log(self.score_m), np.zeros(self.num_envs, dtype=np.bool_)

    def _sort(self) -> None:
        """Craft by bearing from the estimate, so that equal situations look equal."""
        if self.sort_craft:
            gap = self.anchors - self.state.translation[:, None]
            self.order = np.argsort(np.arctan2(gap[..., 1], gap[..., 0]), axis=-1)

    def _observe(self) -> np.ndarray:
        gap = self.anchors[..., :2] - self.state.translation[:, None, :2]
        gap = np.take_along_axis(gap, self.order[..., None], axis=1)
        depth = self.state.translation[:, 2:]
        distance = np.sqrt((gap**2).sum(axis=-1) + depth**2)
        return _flat([
            depth / 50, self._velocity()[:, :2], self._log_std(), self._columns(),
            gap.reshape(self.num_envs, -1) / 100, np.log(np.maximum(distance, 1e-6) / 100),
        ])  # fmt: skip


class MobileAnchorsEnv(ScalarEnv):
    """Surface craft range to a diving vehicle: where do they go, so that its pose is known well?

    ## Description
    M craft on the water measure ranges to the tags of a vehicle that dives through way-points;
    an iterated EKF knows the commanded twist and the noise law and tracks its pose.
    ``difficulty="easy"``: three craft at up to 4 m/s. ``"hard"``: two at up to 2 m/s, where no
    static layout works and the craft must orbit.

    ## Action space
    ``Box(-1, 1, (2 M,))``: level velocity of each craft in units of its limit (cut to length
    1), in the order in which the observation lists them.

    ## Observation space
    ``Box(-10, 10, (15 + 3 M,), float32)``: estimated depth (50 m), commanded level velocity
    (over the speed), log standard deviations of the pose error over the prior's (6), first two
    columns of the estimated rotation (6), craft relative to the estimate (100 m), log of their
    distances (100 m). Craft are sorted by bearing from the estimate; ``sort_craft=False``
    keeps their numbers.

    ## Reward
    ``-log b`` of the belief after every step (`rbl_gym.bounds.score`).

    ## Episode end
    Truncates after 100 steps of 2 s.

    ## Info
    `score_m` (b of the belief), real errors `rotation_error_rad`, `position_error_m`,
    `tag_error_m`, `nees` (6 degrees of freedom), `epoch`.

    ## Rendering
    ``render_mode="rgb_array"``: as `RBL/Tracking-v0`, with the beliefs of the filter.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/MobileAnchors-v0", difficulty="hard")
    ```
    `scene`: a name or overrides, see `rbl_gym.worlds.scenes.get`; the anchors must move.

    ## Version history
    * v0: first version.
    """

    batch_class = MobileAnchorsVectorEnv

    def __init__(
        self,
        difficulty: str = "easy",
        scene: str | Mapping[str, Any] = "auv_craft",
        sort_craft: bool = True,
        render_mode: str | None = None,
    ) -> None:
        self._configure(render_mode, difficulty=difficulty, scene=scene, sort_craft=sort_craft)


# --- choosing anchors in a hall with racks ----------------------------------------------------


class AnchorSelectionVectorEnv(FilterLoop):
    """`num_envs` independent `AnchorSelectionEnv`; seeding and autoreset as `BatchEnv`."""

    def __init__(
        self,
        num_envs: int = 1,
        mode: str = "top-k",
        k: int = 3,
        price: float = 0.05,
        scene: str | Mapping[str, Any] = "hall",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        world = _world(scene, steps=50)
        self.mode = check_one_of("mode", mode, SELECTIONS)
        self.k = check_count("k", k, most=world.n_anchors)
        self.price = check_number("price", price, low=0.0)
        self.single_action_space = (
            spaces.Box(-1.0, 1.0, (world.n_anchors,), np.float32)
            if mode == "top-k"
            else spaces.MultiBinary(world.n_anchors)
        )
        self.single_observation_space = spaces.Box(-_LIMIT, _LIMIT, (18,), np.float32)
        self.film = rendering.film_of(render_mode, world)
        self._configure(num_envs, render_mode, world.steps, max_episode_steps, autoreset_mode)
        self._configure_loop(world, num_envs)
        self._chosen = np.zeros((num_envs, world.n_anchors), dtype=np.bool_)

    def _restart(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        # The first ranges are those of the first choice.
        self._start(chosen, generators)
        self._chosen[chosen] = False

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        rows = np.flatnonzero(moving)
        self._chosen[rows] = self._choice(actions[rows])
        self._predict(rows)
        # A world that chose nothing has nothing to update with.
        measuring = rows[self._chosen[rows].any(axis=-1)]
        if len(measuring):
            self._update(measuring, self._chosen)
        reward = -np.log(self.score_m)
        if self.mode == "priced":
            reward -= self.price * self._chosen.sum(axis=-1)
        return reward, np.zeros(self.num_envs, dtype=np.bool_)

    def _choice(self, actions: np.ndarray) -> BoolArray:
        """Which anchors (B, M) actions choose; ties go to the lower number."""
        if self.mode == "priced":
            return actions.astype(np.bool_)
        best = np.argsort(-actions, axis=-1, kind="stable")[..., : self.k]
        chosen = np.zeros(actions.shape, dtype=np.bool_)
        np.put_along_axis(chosen, best, True, axis=-1)
        return chosen

    def _observe(self) -> np.ndarray:
        low, high = self.scene.volume.bounds()
        # In a volume without height, deviations count by what the prior leaves open.
        half = np.maximum(0.5 * (high - low), self.scene.initial_translation_m)
        place = (self.state.translation - 0.5 * (low + high)) / half
        return _flat([place, self._velocity(), self._log_std(), self._columns()])

    def _measuring(self) -> BoolArray:
        return self._chosen

    def _inform(self) -> dict[str, np.ndarray]:
        return {**super()._inform(), "chosen": self._chosen.astype(np.int8)}


class AnchorSelectionEnv(ScalarEnv):
    """Twelve anchors on the walls of a hall, racks between: which ones range to the body now?

    ## Description
    A body with six tags drives through a hall. At every step the policy chooses anchors, the
    body moves, the chosen anchors measure, and an iterated EKF updates. Racks block sight: a
    range without it carries 2 % of the information. The receiver learns a link's quality with
    the range; the policy does not see the racks and has to learn where they are.

    ## Action space
    ``mode="top-k"``: ``Box(-1, 1, (12,))``, scores; the `k` highest are chosen.
    ``"priced"``: ``MultiBinary(12)``, any number, each at its `price`.

    ## Observation space
    ``Box(-10, 10, (18,), float32)``: estimated place (scaled to the hall's volume), commanded
    velocity (over the speed), log standard deviations of the pose error over the prior's (6),
    first two columns of the estimated rotation (6).

    ## Reward
    ``-log b`` of the belief after every step; ``"priced"``: minus `price` for each anchor.

    ## Episode end
    Truncates after 50 steps of 0.2 s.

    ## Info
    `chosen` (12), `score_m`, real errors `rotation_error_rad`, `position_error_m`,
    `tag_error_m`, `nees`, `epoch`.

    ## Rendering
    ``render_mode="rgb_array"``: as `RBL/Tracking-v0`, with the beliefs of the filter.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/AnchorSelection-v0", k=3)
    env = gym.make("rbl_gym:RBL/AnchorSelection-v0", mode="priced", price=0.05)
    ```

    ## Version history
    * v0: first version.
    """

    batch_class = AnchorSelectionVectorEnv

    def __init__(
        self,
        mode: str = "top-k",
        k: int = 3,
        price: float = 0.05,
        scene: str | Mapping[str, Any] = "hall",
        render_mode: str | None = None,
    ) -> None:
        self._configure(render_mode, mode=mode, k=k, price=price, scene=scene)
