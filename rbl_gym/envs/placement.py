"""RBL/AnchorPlacement-v0: place M anchors for a work region, one by one or all at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from rbl_gym import placement
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.envs.episodes import rows_of
from rbl_gym.envs.placement_batch import PlacementBatchEnv, PlacementScalarEnv, View, is_symmetric
from rbl_gym.envs.placement_views import PlacementViewLike
from rbl_gym.placement.problem import Context, information_of_fixed, score_of_checked


class AnchorPlacementVectorEnv(PlacementBatchEnv):
    """`num_envs` independent `AnchorPlacementEnv` problems in arrays.

    Created by ``gym.make_vec("rbl_gym:RBL/AnchorPlacement-v0", num_envs=64, scene=...)``. The
    arguments are those of `AnchorPlacementEnv`. Seeding and autoreset work as in `BatchEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scene: str | Mapping[str, Any] = "auv_buoys",
        mode: str = "sequential",
        racks: int = 0,
        n_anchors: int | None = None,
        mirror: bool = True,
        sight: bool = False,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        observation: PlacementViewLike = "flat",
    ) -> None:
        self.task = placement.task(scene, n_anchors, racks)
        self._check_flags(mode, mirror, sight)
        if sight and not self.task.racks and not self.task.scene.obstruction:
            raise ValueError(
                "sight must be False with racks=0 in a scene without obstacles: nothing blocks the "
                "line of sight"
            )
        self.mirror = mirror and is_symmetric(self.task)
        self._plan(self.task, self.task.n_anchors, 6 + 6 * self.task.racks)
        # An episode terminates with the last anchor.
        steps = self._placements + 1
        self._configure(num_envs, render_mode, steps, max_episode_steps, autoreset_mode)
        self._counts = np.full(num_envs, self.task.n_anchors)
        uniforms = np.zeros((num_envs, placement.context_uniforms(self.task)))
        self._contexts = placement.build_contexts(self.task, uniforms)
        self._view = View(self.task, *self.task.scene.anchor_region.bounds())
        self._own = len(self.task.scene.obstacles)
        if self.mode == "mounts":
            self._information = np.zeros((num_envs, self.task.n_poses, 6, 6))
        self._look_by(observation)

    def _task_of(self, world: int) -> placement.PlacementTask:
        return self.task

    @property
    def contexts(self) -> Context:
        """The problems of the current episodes."""
        return Context(*(field.copy() for field in self._contexts))

    def _restart(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        size = placement.context_uniforms(self.task)
        uniforms = np.array([generator.random(size) for generator in generators])
        fresh = placement.build_contexts(self.task, uniforms)
        rows = rows_of(chosen)
        for held, new in zip(self._contexts, fresh, strict=True):
            held[rows] = new
        shown = fresh
        if self.mirror:
            self._signs[rows] = signs = self._view.signs(fresh)
            shown = self._view.mirrored(fresh, signs)
        parts = [self._view.region(shown)]
        if self.task.racks:
            parts.append(self._view.boxes(shown.racks[:, self._own :]).reshape(len(parts[0]), -1))
        features = np.concatenate(parts, axis=-1)
        self._features[rows] = np.minimum(np.maximum(features, -1.0), 1.0)
        self._remember(rows, shown, self._view, self.task)
        self._clear(rows)
        if self.sight:
            self._seen[rows] = placement.sight_fractions(self.task, fresh, self._mounts)
        if self.mode == "mounts":
            self._information[rows] = information_of_fixed(self.task, fresh)

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        complete = moving & (self._epochs == self._placements)
        if self.mode == "mounts":
            rows = np.flatnonzero(moving)
            return self._mount(actions, rows, self._epochs[rows] - 1, complete), complete
        # One-shot: all anchors of a world; otherwise the next one.
        rows, step = self._places(moving)
        new = rows if self.mode == "one-shot" else (rows, step)
        placed = np.minimum(np.maximum(actions[rows], -1.0), 1.0)
        signs = self._signs[rows]
        if self.mode == "one-shot":
            placed, signs = placed.reshape((len(placed), -1, 3)), signs[:, None]
        self._actions[new] = placed
        self._anchors[new] = self.task.scene.anchor_region.place(signs * placed)
        reward = np.zeros(self.num_envs)
        if count := np.count_nonzero(complete):
            problems, anchors = self._contexts, self._anchors
            if count < self.num_envs:
                problems = Context(*(field[complete] for field in problems))
                anchors = anchors[complete]
            score_m = score_of_checked(self.task, problems, anchors)
            self._score_m[complete] = score_m
            reward[complete] = -np.log(score_m)
        return reward, complete

    def _places(self, moving: BoolArray) -> tuple[Any, Any]:
        """Return indices of the worlds of the mask, and of the anchor that each places."""
        epochs = self._epochs
        if self.num_envs == 1 or (moving.all() and (epochs == epochs[0]).all()):
            # Views are faster than copies.
            return slice(None), epochs[0] - 1
        rows = np.flatnonzero(moving)
        return rows, epochs[rows] - 1

    def _mount(
        self, actions: np.ndarray, rows: np.ndarray, step: np.ndarray, complete: BoolArray
    ) -> FloatArray:
        """Place anchors on mounts; return the decrease of the log score as reward."""
        # Action k is the k-th mount of the observation.
        chosen = self._shown()[rows, actions[rows].astype(int)]
        anchors = self._mounts[chosen]
        self._anchors[rows, step] = anchors
        self._taken[rows, chosen] = True
        problems = Context(*(field[rows] for field in self._contexts))
        # Information is a sum over the anchors: each step adds that of its anchor.
        self._information[rows] += placement.information(self.task, problems, anchors[:, None])
        log_score = self._log_score.copy()
        log_score[rows] = np.log(placement.score_of(self.task, self._information[rows]))
        reward, self._log_score = self._log_score - log_score, log_score
        self._score_m[complete] = np.exp(log_score[complete])
        return reward


class AnchorPlacementEnv(PlacementScalarEnv):
    """Place anchors so that a body in a given work region is localized well.

    ## Description
    Every episode draws a problem: a work region, which is a box inside the scene's volume. In rooms
    it also draws up to two racks that block the line of sight, besides the scene's own obstacles.
    The agent places M anchors in the scene's permitted region, where anchors may be mounted. The
    score of a layout is the root mean square error of the tag positions in metres. It depends on
    the errors of position and orientation. The Cramer-Rao bound predicts the score for 32 fixed
    poses in the region (`rbl_gym.placement.score`).

    ## Action space
    * ``mode="sequential"``: ``Box(-1, 1, (3,))``, the next anchor, projected onto the
      permitted region (`Region.place`).
    * ``mode="one-shot"``: ``Box(-1, 1, (3 M,))``, all anchors at once.
    * ``mode="mounts"`` (rooms only): ``Discrete(57)``, one of the mount points of
      `rbl_gym.placement.mounts`. A mount that is already taken gets a second anchor.

    ## Observation space
    ``Box(-1, 1, (n,), float32)``, in this order:

    * centre and size of the region, scaled to the volume (6);
    * position and half size of each rack, scaled to the room (6 each);
    * ``"sequential"``: the actions so far (3 M);
    * ``"mounts"``, or ``sight=True``: the fraction of the poses that each mount of
      `rbl_gym.placement.mounts` sees (57);
    * ``"mounts"``: whether each mount is taken (57);
    * except in ``"one-shot"``: which anchor is next, one-hot (M).

    If the permitted region and the volume have the same centre in x and y, and the scene has no
    obstacles of its own, the environment mirrors every problem in x and y so that the region lies
    towards +x and +y. So a policy need not learn mirror images separately. Observations are
    mirrored, racks are sorted by x, and actions are mirrored back.
    ``mirror=False`` turns this off.

    This is the observation with ``observation="flat"``. ``"dict"`` has positions in metres.
    ``"tokens"`` has a token for each anchor, obstacle and mount, with masks. A function gets a
    `Placing`. All observations are mirrored in the same way.

    ## Reward
    ``-log score`` with the last anchor, and 0 before. With ``mode="mounts"`` the reward of every
    step is the decrease of the log score; the score without anchors counts as 3 m. With
    ``gym.make(..., reward="filter")`` the reward is the accuracy of a filter (the wrapper
    `FilterReward`).

    ## Episode end
    Terminates with the last anchor. `env.spec.max_episode_steps` is the number of steps. (In an
    environment that is made from this specification, Gymnasium's `TimeLimit` also truncates the
    episode at its last step.)

    ## Info
    * `anchors` (M, 3): positions, zeros for anchors not yet placed.
    * `region`: centre and half size, metres.
    * `racks` (K, 6): centre and half size, metres; the scene's own obstacles first.
    * `score_m`: score of the complete layout; 0 before the last anchor.
    * `action_mask` (57), with ``mode="mounts"``: the possible actions. `action_masks()` returns it
      as booleans.

    ## Rendering
    ``render_mode="rgb_array"``: the problem and its anchors in 3-D and in plan, the expected tag
    error at the poses of the region, and its root mean square against the number of anchors.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", scene="uwb_room", racks=2, sight=True)
    env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", scene="uwb_room", mode="mounts", n_anchors=4)
    env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", reward="filter", filter="iekf")
    env = gym.make("rbl_gym:RBL/AnchorPlacement-v0", observation="tokens")
    ```

    * `scene`: a name or overrides, see `rbl_gym.worlds.scenes.get`. The fixed anchors of a building
      file keep their positions, and the agent places the others.
    * `scenes`, instead of `scene`: a family of scenes, see `PlacementFamilyEnv`.
    * `mode`: ``"sequential"``, ``"one-shot"`` or ``"mounts"``, see the action space.
    * `racks`: number of racks in a room, 0 to 2.
    * `n_anchors`: number M of anchors to place; None for the default of
      `rbl_gym.placement.task`.
    * `mirror`: whether to mirror the problems of symmetric scenes, see the observation space.
    * `sight`: whether to observe what each mount sees; only with racks or obstacles.
    * `observation`: ``"flat"``, ``"dict"``, ``"tokens"``, ``"module:function"`` or a function, see
      the observation space.
    * `reward`: ``"bound"`` or ``"filter"``.
    * `filter`, `options`: the filter with ``reward="filter"``, as in `EstimatePose`.

    ## Version history
    * v0: first version.
    """

    batch_class = AnchorPlacementVectorEnv

    def __init__(
        self,
        scene: str | Mapping[str, Any] = "auv_buoys",
        mode: str = "sequential",
        racks: int = 0,
        n_anchors: int | None = None,
        mirror: bool = True,
        sight: bool = False,
        render_mode: str | None = None,
        observation: PlacementViewLike = "flat",
    ) -> None:
        self._configure(
            render_mode, scene=scene, mode=mode, racks=racks, n_anchors=n_anchors, mirror=mirror,
            sight=sight, observation=observation,
        )  # fmt: skip

    @property
    def task(self) -> placement.PlacementTask:
        """The family of problems."""
        return self._batch.task
