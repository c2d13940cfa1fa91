"""Learning tasks with a filter in the loop: move the anchors, or choose them, for the belief.

`RBL/Tracking-v0`, `EstimatePose`, and a policy's view of both: the policy sees the belief, not the
ranges, and is paid for how good the belief says it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym.checks import FloatArray, check_count, check_number, check_one_of
from rbl_gym.envs.batch import check_actions
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers import views
from rbl_gym.wrappers.compositions import TaskEnv, VectorTaskEnv
from rbl_gym.wrappers.estimate import EstimatePose, check_options_of
from rbl_gym.wrappers.rewards import RewardLike
from rbl_gym.wrappers.select_anchors import SelectAnchors, VectorSelectAnchors
from rbl_gym.wrappers.task_worlds import Usual, family_of_task, made_of, world_of
from rbl_gym.wrappers.vector_estimate import VectorEstimatePose

# An observation is of order one; what is far outside says no more than that.
_LIMIT = 10.0
DIFFICULTIES: dict[str, dict[str, Any]] = {
    "easy": {"n_anchors": 3, "anchor_speed_m_s": 4.0},
    "hard": {"n_anchors": 2, "anchor_speed_m_s": 2.0},
}
SELECTIONS = ("top-k", "priced")
# Iterations of the iterated EKF; two are as good as four here, and faster.
_ITERATIONS = 2


def _options(filter: Any, options: Mapping[str, Any] | None) -> dict[str, Any]:
    """The options of the filter, the tasks' own where none are given."""
    usual = {"iterations": _ITERATIONS} if isinstance(filter, str) and filter == "iekf" else {}
    return {**usual, **check_options_of(options)}


def _worlds(batch: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Indices that stand before those (B, M) of each world's anchors."""
    return tuple(np.arange(n)[:, None] for n in batch)


# What the view of the craft is made of, in the order of its arguments.
_CRAFT_VIEW = ("belief_translation", "belief_rotation", "belief_covariance", "twist", "anchors")


# --- surface craft and a diving vehicle -------------------------------------------------------


class _MobileAnchors:
    """Craft in the order of the observation: what scalar and vector forms share."""

    scene: Scene
    seen: Any
    # Numbers (..., M) of the craft in the order of the last observation.
    order: np.ndarray

    def _configure(self, difficulty: str, scene: Any, sort_craft: bool, scenes: Any) -> None:
        level = DIFFICULTIES[check_one_of("difficulty", difficulty, list(DIFFICULTIES))]
        found = family_of_task(scenes, scene, "auv_craft", **level)
        worlds = (world_of(scene, **level),) if found is None else found.corners
        if any(one.anchor_speed_m_s <= 0 for one in worlds):
            raise ValueError("scene must have anchors that move, got anchor_speed_m_s = 0")
        if not isinstance(sort_craft, bool):
            raise ValueError(f"sort_craft must be True or False, got {sort_craft!r}")
        self.sort_craft = sort_craft
        self.family, self.scene = found, worlds[0]
        self._n_craft = (found or self.scene).n_anchors
        self._limits = np.full(15 + 3 * self._n_craft, _LIMIT)
        self._usual = Usual(*worlds)

    def _spaces(self) -> tuple[spaces.Box, spaces.Box]:
        m = self._n_craft
        size = 15 + 3 * m if self.family is None else 16 + 4 * m
        return (
            spaces.Box(-_LIMIT, _LIMIT, (size,), np.float32),
            spaces.Box(-1.0, 1.0, (2 * m,), np.float32),
        )

    def _velocities(self, level: FloatArray) -> FloatArray:
        """Actions of the world (..., 3 M) of level velocities (..., 2 M) in order."""
        batch, m = level.shape[:-1], self._n_craft
        velocity = np.zeros((*batch, m, 3))
        # Action k is that of the k-th craft in the observation.
        velocity[(*_worlds(batch), self.order, slice(2))] = level.reshape(*batch, m, 2)
        return velocity.reshape(*batch, 3 * m)

    def _show(self, observation: Mapping[str, np.ndarray], world: Any) -> np.ndarray:
        told = [observation[key] for key in _CRAFT_VIEW]
        if self.family is None:
            order, flat = self._view(*told)
        else:
            reach = views.reach_of_craft(world)
            order, flat = views.padded_craft(self._view, told, observation["anchor_mask"], reach)
        if observation is self.seen:
            self.order = order
        return flat.astype(np.float32)

    def _view(self, *told: np.ndarray) -> tuple[np.ndarray, FloatArray]:
        size = 15 + 3 * told[-1].shape[-2]
        usual = self._usual.variance, self._usual.speed
        return views.mobile_anchors(*told, *usual, self.sort_craft, self._limits[:size])


class MobileAnchorsVectorEnv(_MobileAnchors, VectorTaskEnv):
    """`num_envs` independent `MobileAnchorsEnv`; seeding and autoreset as `BatchEnv`."""

    def __init__(
        self,
        num_envs: int = 1,
        difficulty: str = "easy",
        scene: str | Mapping[str, Any] | Scene = "auv_craft",
        sort_craft: bool = True,
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        scenes: Any = None,
    ) -> None:
        self._configure(difficulty, scene, sort_craft, scenes)
        self.single_observation_space, self.single_action_space = self._spaces()
        envs = TrackingVectorEnv(
            num_envs, **made_of(self), render_mode=render_mode,
            max_episode_steps=max_episode_steps, autoreset_mode=autoreset_mode,
        )  # fmt: skip
        self._compose(VectorEstimatePose(envs, filter, _options(filter, options), reward))

    def _command(self, action: Any) -> FloatArray:
        self._told()
        space = self.single_action_space
        return self._velocities(check_actions("actions", action, space, self.num_envs))


class MobileAnchorsEnv(_MobileAnchors, TaskEnv):
    """Surface craft range to a diving vehicle: where do they go, so that its pose is known well?

    ## Description
    M craft on the water measure ranges to the tags of a vehicle that dives through way-points;
    a filter knows the commanded twist and the noise law and tracks its pose.
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
    ``-log b`` of the belief after every step (`rbl_gym.bounds.score`), or another `reward`.

    ## Episode end
    Truncates after 100 steps of 2 s.

    ## Info
    That of `EstimatePose`: `score_m` (b of the belief), real errors `rotation_error_rad`,
    `position_error_m`, `tag_error_m`, `nees` (6 degrees of freedom); and that of
    `RBL/Tracking-v0`: `epoch`, the true `rotation` and `translation`, `nlos`.

    ## Rendering
    ``render_mode="rgb_array"``: as `RBL/Tracking-v0`, with the beliefs of the filter.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/MobileAnchors-v0", difficulty="hard")
    ```
    `scene`: a name or overrides, see `rbl_gym.worlds.scenes.get`; the anchors must move.

    `scenes`: a family of such in its place, see `RBL/Tracking-v0`, as
    ``scenes=[{"name": "auv_craft", "n_anchors": {"integers": [2, 5]}}]``. M is then the largest
    number of craft, and its difficulty stands where a scene says nothing of its own. Entries of
    craft that are not there are 0. The observation has 1 + M more entries: how far the craft of the
    drawn scene go in a step (10 m), and 1 for the craft that are there.

    `filter`, `options`, `reward`: as `EstimatePose`; ``"iekf"`` has 2 iterations unless `options`
    say else.

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        difficulty: str = "easy",
        scene: str | Mapping[str, Any] | Scene = "auv_craft",
        sort_craft: bool = True,
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        scenes: Any = None,
    ) -> None:
        self._configure(difficulty, scene, sort_craft, scenes)
        self.observation_space, self.action_space = self._spaces()
        env = TrackingEnv(**made_of(self), render_mode=render_mode)
        self._compose(EstimatePose(env, filter, _options(filter, options), reward))

    def _command(self, action: Any) -> FloatArray:
        self._told()
        return self._velocities(check_actions("action", action, self.action_space))


# --- choosing anchors in a hall with racks ----------------------------------------------------


class _AnchorSelection:
    """Choices and their price: what scalar and vector forms share."""

    scene: Scene
    seen: Any

    def _configure(self, mode: str, k: int, price: float, scene: Any, scenes: Any) -> None:
        found = family_of_task(scenes, scene, "hall", steps=50)
        worlds = (world_of(scene, steps=50),) if found is None else found.corners
        self.family, self.scene = found, worlds[0]
        self._most = (found or self.scene).n_anchors
        self.mode = check_one_of("mode", mode, SELECTIONS)
        self.k = check_count("k", k, most=min(one.n_anchors for one in worlds))
        self.price = check_number("price", price, low=0.0)
        self._limits = np.full(18, _LIMIT)
        self._usual = Usual(*worlds)
        corners = np.array([one.volume.bounds() for one in worlds])
        low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
        self._centre = 0.5 * (low + high)
        # In a volume without height, deviations count by what the prior leaves open.
        prior = max(one.initial_translation_m for one in worlds)
        self._half = np.maximum(0.5 * (high - low), prior)
        self._extent_m = max(float(one.scales.extent) for one in worlds)

    def _spaces(self) -> tuple[spaces.Box, spaces.Space[Any]]:
        m = self._most
        size = 18 if self.family is None else 21 + 6 * m
        return (
            spaces.Box(-_LIMIT, _LIMIT, (size,), np.float32),
            spaces.Box(-1.0, 1.0, (m,), np.float32)
            if self.mode == "top-k"
            else spaces.MultiBinary(m),
        )

    def _choice(self, action: np.ndarray) -> np.ndarray:
        """Which anchors (..., M) an action chooses, int8; ties go to the lower number."""
        there = None if self.family is None else self.seen["anchor_mask"]
        if self.mode == "priced":
            return action if there is None else action & there
        if there is not None:
            action = np.where(there, action, -np.inf)
        best = (-action).argsort(axis=-1, kind="stable")[..., : self.k]
        chosen = np.zeros(action.shape, dtype=np.int8)
        chosen[(*_worlds(action.shape[:-1]), best)] = 1
        return chosen

    def _price(self, info: dict[str, Any]) -> Any:
        return self.price * info["chosen"].sum(axis=-1) if self.mode == "priced" else 0.0

    def _show(self, observation: Mapping[str, np.ndarray], world: Any) -> np.ndarray:
        middle, half = self._centre, self._half
        if self.family is not None:
            middle, half, *_ = world.scales
        flat = views.anchor_selection(
            observation["belief_translation"], observation["belief_rotation"],
            observation["belief_covariance"], observation["twist"], self._usual.variance,
            self._usual.speed, middle, half, self._limits,
        )  # fmt: skip
        if self.family is not None:
            flat = views.padded_selection(flat, observation, half, self._extent_m)
        return flat.astype(np.float32)


class AnchorSelectionVectorEnv(_AnchorSelection, VectorTaskEnv):
    """`num_envs` independent `AnchorSelectionEnv`; seeding and autoreset as `BatchEnv`."""

    def __init__(
        self,
        num_envs: int = 1,
        mode: str = "top-k",
        k: int = 3,
        price: float = 0.05,
        scene: str | Mapping[str, Any] | Scene = "hall",
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        scenes: Any = None,
    ) -> None:
        self._configure(mode, k, price, scene, scenes)
        self.single_observation_space, self.single_action_space = self._spaces()
        envs = TrackingVectorEnv(
            num_envs, **made_of(self), render_mode=render_mode,
            max_episode_steps=max_episode_steps, autoreset_mode=autoreset_mode,
        )  # fmt: skip
        selected = VectorSelectAnchors(envs, self.family is not None)
        self._compose(VectorEstimatePose(selected, filter, _options(filter, options), reward))

    def _command(self, action: Any) -> np.ndarray:
        self._told()
        space = self.single_action_space
        return self._choice(check_actions("actions", action, space, self.num_envs))


class AnchorSelectionEnv(_AnchorSelection, TaskEnv):
    """Twelve anchors on the walls of a hall, racks between: which ones range to the body now?

    ## Description
    A body with six tags drives through a hall. At every step the policy chooses anchors, the
    body moves, the chosen anchors measure, and a filter updates. Racks block sight: a
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
    ``-log b`` of the belief after every step, or another `reward`; ``"priced"``: minus `price` for
    each anchor.

    ## Episode end
    Truncates after 50 steps of 0.2 s.

    ## Info
    `chosen` (12); that of `EstimatePose`: `score_m`, real errors `rotation_error_rad`,
    `position_error_m`, `tag_error_m`, `nees`; and that of `RBL/Tracking-v0`: `epoch`, the true
    `rotation` and `translation`, `nlos`.

    ## Rendering
    ``render_mode="rgb_array"``: as `RBL/Tracking-v0`, with the beliefs of the filter.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/AnchorSelection-v0", k=3)
    env = gym.make("rbl_gym:RBL/AnchorSelection-v0", mode="priced", price=0.05)
    env = gym.make("rbl_gym:RBL/AnchorSelection-v0", filter="uc-kf", k=6)
    ```
    `scene`: a name or overrides, see `rbl_gym.worlds.scenes.get`.

    `scenes`: a family of such in its place, see `RBL/Tracking-v0`. M is then the largest number of
    anchors; those that a drawn scene does not have cannot be chosen. The observation has 21 + 6 M
    entries: those above, the place scaled to the volume of the drawn scene; half sizes of that
    volume (3) and the anchors relative to the estimate (3 M), both over the extent of the largest
    scene; and M each: what the last choice of an anchor told (1: it saw the body, -1: it did not,
    0: never chosen), ``exp(-steps since then / 10)``, and 1 if there is such an anchor.

    `filter`, `options`, `reward`: as `EstimatePose`; ``"iekf"`` has 2 iterations unless `options`
    say else.

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        mode: str = "top-k",
        k: int = 3,
        price: float = 0.05,
        scene: str | Mapping[str, Any] | Scene = "hall",
        filter: str = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        scenes: Any = None,
    ) -> None:
        self._configure(mode, k, price, scene, scenes)
        self.observation_space, self.action_space = self._spaces()
        world = TrackingEnv(**made_of(self), render_mode=render_mode)
        env = SelectAnchors(world, self.family is not None)
        self._compose(EstimatePose(env, filter, _options(filter, options), reward))

    def _command(self, action: Any) -> np.ndarray:
        self._told()
        return self._choice(check_actions("action", action, self.action_space))
