"""RBL/AnchorSelection-v0: choose the anchors that measure, with a filter in the loop."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym.checks import BoolArray, check_count, check_number, check_one_of
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers import views
from rbl_gym.wrappers.compositions import Task, TaskEnv, VectorTaskEnv
from rbl_gym.wrappers.estimate import FilterLike
from rbl_gym.wrappers.observations import ViewLike
from rbl_gym.wrappers.rewards import RewardLike
from rbl_gym.wrappers.select_anchors import SelectAnchors, VectorSelectAnchors
from rbl_gym.wrappers.task_worlds import LIMIT, Usual, family_of_task, world_of, worlds_of

SELECTIONS = ("top-k", "priced", "subset")
# Limit of the number of subsets.
_MOST_SUBSETS = 10_000


def _defaults(_: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of the task, for scenes that do not set them."""
    return {"steps": 50}


class _AnchorSelection(Task):
    """Choices and their price, for scalar and vector forms."""

    def _configure(self, mode: str, k: int, price: float, scene: Any, scenes: Any) -> None:
        found = family_of_task(scenes, scene, "hall", _defaults)
        worlds = (world_of(scene, _defaults),) if found is None else found.corners
        self.family, self.scene = found, worlds[0]
        self._most = (found or self.scene).n_anchors
        self.mode = check_one_of("mode", mode, SELECTIONS)
        self.k = check_count("k", k, most=min(one.n_anchors for one in worlds))
        self._subsets = _subsets(self._most, self.k) if mode == "subset" else None
        self.price = check_number("price", price, low=0.0)
        self._limits = np.full(18, LIMIT)
        self._usual = Usual(*worlds)
        corners = np.array([one.volume.bounds() for one in worlds])
        low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
        self._centre = 0.5 * (low + high)
        # In a volume without height, use the standard deviations of the prior as the scale.
        prior = max(one.initial_translation_m for one in worlds)
        self._half = np.maximum(0.5 * (high - low), prior)
        self._extent_m = max(float(one.scales.extent) for one in worlds)

    def _spaces(self) -> tuple[spaces.Box, spaces.Space[Any]]:
        m = self._most
        size = 18 if self.family is None else 21 + 6 * m
        action: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (m,), np.float32)
        if self._subsets is not None:
            action = spaces.Discrete(len(self._subsets))
        elif self.mode == "priced":
            action = spaces.MultiBinary(m)
        return spaces.Box(-LIMIT, LIMIT, (size,), np.float32), action

    def _below(self, env: Any) -> Any:
        """Return the environment with a choice of anchors, remembered if the view shows it."""
        remembers = self.family is not None or self._viewer is not None
        form: Any = SelectAnchors if isinstance(env, gym.Env) else VectorSelectAnchors
        return form(env, remembers)

    def _command(self, action: np.ndarray) -> BoolArray:
        """Return whether an action chooses each anchor (..., M); ties go to the lower number."""
        there = (
            None
            if self.family is None
            else self._last_observation()["anchor_mask"].astype(np.bool_)
        )
        if self._subsets is not None:
            chosen = self._subsets[action]
        elif self.mode == "priced":
            chosen = action.view(np.bool_)
        else:
            score = action if there is None else np.where(there, action, -np.inf)
            best = (-score).argsort(axis=-1, kind="stable")[..., : self.k]
            chosen = np.zeros(action.shape, dtype=np.bool_)
            chosen[(*worlds_of(action.shape[:-1]), best)] = True
        return chosen if there is None else chosen & there

    def subset_of(self, chosen: BoolArray) -> np.ndarray:
        """Return the action (...) of ``mode="subset"`` that chooses these k anchors (..., M)."""
        assert self._subsets is not None
        alike = self._subsets == np.asarray(chosen, dtype=np.bool_)[..., None, :]
        return alike.all(axis=-1).argmax(axis=-1)

    def action_masks(self) -> BoolArray:
        """Return the actions that choose only existing anchors, for sb3-contrib's ``MaskablePPO``.

        ``mode="subset"``: (..., n), one entry per action. ``"priced"``: (..., 2 M), for each anchor
        whether it may be left out (always) and whether it may be chosen.

        Raises
        ------
        ValueError
            With ``mode="top-k"``, whose actions are scores.
        """
        if self.mode == "top-k":
            raise ValueError("mode must be 'subset' or 'priced' for action masks, got 'top-k'")
        told = self._last_observation()
        there = np.ones(told["links"].shape[:-1], dtype=np.bool_)
        if self.family is not None:
            there = told["anchor_mask"].astype(np.bool_)
        if self._subsets is not None:
            missing = ~there[..., None, :] & self._subsets
            return np.asarray(~missing.any(axis=-1))
        both = np.stack([np.ones_like(there), there], axis=-1)
        return both.reshape(*there.shape[:-1], -1)

    def _price(self, info: dict[str, Any]) -> Any:
        return self.price * info["chosen"].sum(axis=-1) if self.mode == "priced" else 0.0

    def _task_view(self, observation: Mapping[str, np.ndarray], world: Any) -> np.ndarray:
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
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        scenes: Any = None,
        observation: ViewLike = "flat",
    ) -> None:
        self._configure(mode, k, price, scene, scenes)
        self._set_viewer(observation, hides_obstacles=True)
        self._compose(
            num_envs, filter, options, reward, render_mode, max_episode_steps, autoreset_mode
        )


class AnchorSelectionEnv(_AnchorSelection, TaskEnv):
    """Choose which of the twelve anchors in a hall with racks measure ranges in this step.

    ## Description
    A body with six tags drives through a hall. At every step the policy chooses anchors, the body
    moves, the chosen anchors measure, and a filter updates its belief. Racks block the line of
    sight: a blocked range has 2 % of the information. The receiver measures the quality of a link
    together with the range. The policy does not observe the racks. It has to learn where they are.

    ## Action space
    * ``mode="top-k"``: ``Box(-1, 1, (12,))``, a score for each anchor; the `k` anchors with the
      highest scores are chosen.
    * ``mode="priced"``: ``MultiBinary(12)``, any number of anchors; each costs the `price`.
    * ``mode="subset"``: ``Discrete(220)``, one of the subsets of `k` anchors, in lexicographic
      order.

    In the last two modes `action_masks()` returns the actions that choose only existing anchors. If
    an action chooses an anchor that does not exist, this anchor is ignored.

    ## Observation space
    ``Box(-10, 10, (18,), float32)``, in this order:

    * estimated position, scaled to the hall's volume (3);
    * commanded velocity divided by the speed (3);
    * log of the pose error's standard deviations divided by those of the prior (6);
    * first two columns of the estimated rotation (6).

    ## Reward
    ``-log b`` of the belief after every step, or another `reward`. ``mode="priced"``: minus `price`
    for each chosen anchor.

    ## Episode end
    Never terminates; truncates after 50 steps of 0.2 s. Other scenes have 50 steps, too, unless
    they set `steps`.

    ## Info
    * `chosen` (12): the chosen anchors.
    * From `EstimatePose`: `score_m`, the real errors `rotation_error_rad`, `position_error_m` and
      `tag_error_m`, and `nees`.
    * From `RBL/Tracking-v0`: `epoch`, the true `rotation` and `translation`, `nlos`.

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

    `scenes`, instead of `scene`: a family of scenes, see `RBL/Tracking-v0`. M is then the largest
    number of anchors. Anchors that a drawn scene does not have are ignored if an action chooses
    them. The observation has 21 + 6 M entries:

    * those above, with the position scaled to the volume of the drawn scene (18);
    * half sizes of that volume (3) and the anchors relative to the estimate (3 M), both divided by
      the extent of the largest scene;
    * for each anchor the result of its last choice (1: in sight, -1: not in sight, 0: never
      chosen), ``exp(-steps since then / 10)``, and 1 if the anchor exists (M each).

    `filter`, `options`, `reward`: as in `EstimatePose`. By default ``"iekf"`` has 2 iterations.
    `observation`: ``"flat"`` is the vector above. The other values are those of `EstimatePose`,
    with the memory of `SelectAnchors`. Tokens do not include the racks.

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        mode: str = "top-k",
        k: int = 3,
        price: float = 0.05,
        scene: str | Mapping[str, Any] | Scene = "hall",
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        scenes: Any = None,
        observation: ViewLike = "flat",
    ) -> None:
        self._configure(mode, k, price, scene, scenes)
        self._set_viewer(observation, hides_obstacles=True)
        self._compose(filter, options, reward, render_mode)


def _subsets(m: int, k: int) -> BoolArray:
    """Return the subsets of k of M anchors, (n, M)."""
    count = math.comb(m, k)
    if count > _MOST_SUBSETS:
        raise ValueError(
            f"mode 'subset' allows at most {_MOST_SUBSETS} subsets, but {k} of {m} anchors can be "
            f"chosen in {count} ways: use mode 'top-k'"
        )
    found = np.zeros((count, m), np.bool_)
    for row, chosen in zip(found, itertools.combinations(range(m), k), strict=True):
        row[list(chosen)] = True
    return found
