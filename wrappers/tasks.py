"""RBL/MobileAnchors-v0: craft move to improve the belief of a filter in the loop.

The environment consists of `RBL/Tracking-v0`, `EstimatePose`, and an observation for a policy. The
policy observes the belief, not the ranges, and its reward is the accuracy of the belief.
`rbl_gym.wrappers.selection` works the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym.checks import FloatArray, check_one_of
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers import views
from rbl_gym.wrappers.compositions import Task, TaskEnv, VectorTaskEnv
from rbl_gym.wrappers.estimate import FilterLike
from rbl_gym.wrappers.observations import ViewLike
from rbl_gym.wrappers.rewards import RewardLike
from rbl_gym.wrappers.task_worlds import LIMIT, Usual, family_of_task, world_of, worlds_of

# The scene of the levels.
_SCENE = "auv_craft"
DIFFICULTIES: dict[str, dict[str, Any]] = {
    "easy": {"n_anchors": 3, "anchor_speed_m_s": 4.0},
    "hard": {"n_anchors": 2, "anchor_speed_m_s": 2.0},
}
# Inputs of the view of the craft, in the order of its arguments.
_CRAFT_VIEW = ("belief_translation", "belief_rotation", "belief_covariance", "twist", "anchors")


class _MobileAnchors(Task):
    """Craft in the order of the observation, for scalar and vector forms."""

    # Numbers (..., M) of the craft in the order of the last observation and of the actions.
    order: np.ndarray

    @property
    def anchors(self) -> FloatArray:
        """Present positions of the craft, (..., M, 3), in the order of the actions."""
        anchors = self._last_observation()["anchors"]
        return np.take_along_axis(anchors, self.order[..., None], axis=-2)

    def _configure(self, difficulty: str, scene: Any, sort_craft: bool, scenes: Any) -> None:
        level = DIFFICULTIES[check_one_of("difficulty", difficulty, list(DIFFICULTIES))]
        levelled = []

        def defaults(changes: Mapping[str, Any]) -> dict[str, Any]:
            if changes.get("name") != _SCENE:
                return {}
            levelled.append(changes)
            # Positions of the anchors give their number.
            stated = "anchors" in changes or "layout" in changes
            return {key: level[key] for key in level if not (stated and key == "n_anchors")}

        found = family_of_task(scenes, scene, _SCENE, defaults)
        worlds = (world_of(scene, defaults),) if found is None else found.corners
        if difficulty != "easy" and not levelled:
            raise ValueError(
                f"difficulty must be left out without the scene {_SCENE!r}, got {difficulty!r}: "
                f"set n_anchors and anchor_speed_m_s in the scene"
            )
        for one in worlds:
            if one.anchor_speed_m_s <= 0:
                raise ValueError(
                    f"scene must have moving anchors, got anchor_speed_m_s = 0 in {one.name!r}: "
                    "set anchor_speed_m_s above 0"
                )
        if not isinstance(sort_craft, bool):
            raise ValueError(f"sort_craft must be True or False, got {sort_craft!r}")
        self.sort_craft = sort_craft
        self.family, self.scene = found, worlds[0]
        self._n_craft = (found or self.scene).n_anchors
        self._limits = np.full(15 + 3 * self._n_craft, LIMIT)
        self._usual = Usual(*worlds)

    def _spaces(self) -> tuple[spaces.Box, spaces.Box]:
        m = self._n_craft
        size = 15 + 3 * m if self.family is None else 16 + 4 * m
        return (
            spaces.Box(-LIMIT, LIMIT, (size,), np.float32),
            spaces.Box(-1.0, 1.0, (2 * m,), np.float32),
        )

    def _command(self, action: FloatArray) -> FloatArray:
        """Return actions of the world (..., 3 M) from ordered horizontal velocities (..., 2 M)."""
        batch, m = action.shape[:-1], self._n_craft
        velocity = np.zeros((*batch, m, 3))
        # Action k is that of the k-th craft in the observation.
        velocity[(*worlds_of(batch), self.order, slice(2))] = action.reshape(*batch, m, 2)
        return velocity.reshape(*batch, 3 * m)

    def _observe(self, observation: dict[str, np.ndarray], world: Any) -> Any:
        if self._viewer is not None and observation is self.inner_observation:
            # Craft are in the order of their numbers.
            count = np.arange(self._n_craft)
            self.order = np.broadcast_to(count, observation["anchors"].shape[:-1])
        return super()._observe(observation, world)

    def _task_view(self, observation: Mapping[str, np.ndarray], world: Any) -> np.ndarray:
        told = [observation[key] for key in _CRAFT_VIEW]
        if self.family is None:
            order, flat = self._view(*told)
        else:
            reach = views.reach_of_craft(world)
            order, flat = views.padded_craft(self._view, told, observation["anchor_mask"], reach)
        if observation is self.inner_observation:
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
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        scenes: Any = None,
        observation: ViewLike = "flat",
    ) -> None:
        self._configure(difficulty, scene, sort_craft, scenes)
        self._set_viewer(observation)
        self._compose(
            num_envs, filter, options, reward, render_mode, max_episode_steps, autoreset_mode
        )


class MobileAnchorsEnv(_MobileAnchors, TaskEnv):
    """Move surface craft, which measure ranges to a diving vehicle, so that its pose is known well.

    ## Description
    M craft on the water measure ranges to the tags of a vehicle that dives through way-points. A
    filter knows the commanded twist and the noise law, and tracks the pose. ``difficulty="easy"``
    has three craft with up to 4 m/s. ``difficulty="hard"`` has two craft with up to 2 m/s. Two
    craft at rest do not determine the pose, so they must orbit.

    ## Action space
    ``Box(-1, 1, (2 M,))``: horizontal velocity of each craft, in units of its speed limit (longer
    vectors are cut to length 1), in the order of the observation.

    ## Observation space
    ``Box(-10, 10, (15 + 3 M,), float32)``, in this order:

    * estimated depth divided by 50 m (1);
    * commanded horizontal velocity divided by the speed (2);
    * log of the pose error's standard deviations divided by those of the prior (6);
    * first two columns of the estimated rotation (6);
    * horizontal positions of the craft relative to the estimate, divided by 100 m (2 M);
    * log of their distances divided by 100 m (M).

    Craft are sorted by bearing from the estimate; ``sort_craft=False`` keeps the order of their
    numbers. `anchors` has their positions in the order of the actions, and `order` their numbers.

    ## Reward
    ``-log b`` of the belief after every step (`rbl_gym.bounds.score`), or another `reward`.

    ## Episode end
    Never terminates; truncates after 100 steps of 2 s.

    ## Info
    * From `EstimatePose`: `score_m` (b of the belief), the real errors `rotation_error_rad`,
      `position_error_m` and `tag_error_m`, and `nees` (6 degrees of freedom).
    * From `RBL/Tracking-v0`: `epoch`, the true `rotation` and `translation`, `nlos`.

    ## Rendering
    ``render_mode="rgb_array"``: as `RBL/Tracking-v0`, with the beliefs of the filter.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/MobileAnchors-v0", difficulty="hard")
    ```
    `scene`: a name or overrides, see `rbl_gym.worlds.scenes.get`; the anchors must move. The
    `difficulty` gives the defaults of `n_anchors` and `anchor_speed_m_s` in ``"auv_craft"`` only.

    `scenes`: a family of scenes instead of `scene`, see `RBL/Tracking-v0`, for example
    ``scenes=[{"name": "auv_craft", "n_anchors": {"integers": [2, 5]}}]``. M is then the largest
    number of craft. Entries of missing craft are 0. The observation has 1 + M more entries: the
    longest distance that a craft of the drawn scene can move in a step, divided by 10 m, and for
    each craft 1 if it exists.

    `filter`, `options`, `reward`: as in `EstimatePose`. By default ``"iekf"`` has 2 iterations.
    `observation`: ``"flat"`` is the vector above. The other values are those of `EstimatePose`,
    with the craft in the order of their numbers.

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        difficulty: str = "easy",
        scene: str | Mapping[str, Any] | Scene = "auv_craft",
        sort_craft: bool = True,
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        render_mode: str | None = None,
        scenes: Any = None,
        observation: ViewLike = "flat",
    ) -> None:
        self._configure(difficulty, scene, sort_craft, scenes)
        self._set_viewer(observation)
        self._compose(filter, options, reward, render_mode)
