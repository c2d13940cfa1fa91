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

from rbl_gym import bounds, metrics, rendering, scenes, simulation
from rbl_gym.checks import BoolArray, FloatArray, check_number, check_one_of
from rbl_gym.envs.batch import BatchEnv, ScalarEnv
from rbl_gym.envs.episodes import EpisodeStore
from rbl_gym.estimators import PoseBelief
from rbl_gym.estimators.manifold import IteratedEkf, PoseState
from rbl_gym.wrappers.estimate import update

# An observation is of order one; what is far outside says no more than that.
_LIMIT = 10.0
# Iterations of the filter; two are as good as four here, and faster.
_ITERATIONS = 2
DIFFICULTIES: dict[str, dict[str, Any]] = {
    "easy": {"n_anchors": 3, "anchor_speed_m_s": 4.0},
    "hard": {"n_anchors": 2, "anchor_speed_m_s": 2.0},
}
SELECTIONS = ("top-k", "priced")


class FilterLoop(BatchEnv):
    """Worlds of a scene with an iterated EKF behind their ranges.

    Attributes
    ----------
    scene
        The world.
    state
        The filter's state after the last update.
    anchors
        (B, M, 3), where they stand now.
    """

    def _configure_loop(self, scene: scenes.Scene, num_envs: int) -> None:
        self.scene = scene
        self.filter = IteratedEkf(
            np.asarray(scene.tags), scene.noise, scene.process, iterations=_ITERATIONS
        )
        self._tags = np.asarray(scene.tags)
        self._episodes = EpisodeStore(scene, num_envs)
        self.anchors = np.zeros((num_envs, scene.n_anchors, 3))
        self.state = PoseState(
            np.tile(np.eye(3), (num_envs, 1, 1)),
            np.zeros((num_envs, 3)),
            np.tile(np.eye(6), (num_envs, 1, 1)),
        )

    def _start(self, chosen: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        """New episodes of some worlds; their state is the prior."""
        start = self._episodes.begin(chosen, generators)
        self.anchors[chosen] = start["anchors"]
        prior = self.filter.initial(
            *(start[f"prior_{name}"] for name in ("rotation", "translation", "covariance"))
        )
        for field, new in zip(self.state, prior, strict=True):
            field[chosen] = new

    @property
    def at(self) -> simulation.Epoch:
        """The true worlds now: what a policy must not see."""
        return self._episodes.at(self._epochs)

    @property
    def twist(self) -> FloatArray:
        """Known twist (B, 6) of the interval that ended now."""
        return self.at.twist

    def _predict(self, rows: np.ndarray) -> None:
        """Predict some worlds to their epochs."""
        state = PoseState(*(field[rows] for field in self.state))
        self._put(rows, self.filter.predict(state, self.at.twist[rows], self.scene.dt))

    def _update(self, rows: np.ndarray, chosen: BoolArray | None = None) -> None:
        """Update some worlds with their ranges; `chosen` (B, M): which anchors measure."""
        at = simulation.Epoch(*(None if field is None else field[rows] for field in self.at))  # pyright: ignore[reportArgumentType]
        anchors = self.anchors[rows]
        quality = None
        if self.scene.obstacles:
            quality = simulation.link_quality(self.scene, at, anchors)
        measured = simulation.measure(self.scene, at, anchors, quality=quality)
        links = measured.links if chosen is None else measured.links & chosen[rows, :, None]
        epoch = {"ranges": measured.ranges, "links": links, "anchors": anchors}
        if quality is not None:
            epoch["quality"] = quality
        state = PoseState(*(field[rows] for field in self.state))
        self._put(rows, update(self.filter, state, epoch, self.scene))

    def _put(self, rows: np.ndarray, state: PoseState) -> None:
        if len(rows) == self.num_envs:
            self.state = state
        else:
            self.state = PoseState(*(field.copy() for field in self.state))
            for field, new in zip(self.state, state, strict=True):
                field[rows] = new

    @property
    def belief(self) -> PoseBelief:
        """The beliefs now."""
        return self.filter.belief(self.state)

    @property
    def score_m(self) -> FloatArray:
        """b (B,) of the beliefs, metres."""
        return bounds.score(self.state.covariance, self.state.rotation, self._tags)

    def _inform(self) -> dict[str, np.ndarray]:
        at, state = self.at, self.state
        error = metrics.pose_error(state.rotation, state.translation, at.rotation, at.translation)
        truth = at.rotation, at.translation
        return {
            "score_m": self.score_m,
            "rotation_error_rad": np.linalg.norm(error[..., :3], axis=-1),
            "position_error_m": np.linalg.norm(error[..., 3:], axis=-1),
            "tag_error_m": metrics.tag_error(state.rotation, state.translation, *truth, self._tags),
            "nees": metrics.nees(error, state.covariance),
            "epoch": self._epochs.copy(),
        }

    def _measuring(self) -> BoolArray:
        """Which anchors (B, M) measured last."""
        return np.ones(self.anchors.shape[:2], dtype=np.bool_)

    def _shot(self) -> tuple[Any, rendering.Pose]:
        at, links = self.at, self._measuring()[..., None]
        shot = rendering.shot(links, self.anchors, at.rotation, at.translation)
        return shot, rendering.Pose(*self.state[:3])

    def _log_std(self) -> FloatArray:
        """Logarithms (B, 6) of the standard deviations, less that of their usual size."""
        std = np.sqrt(np.diagonal(self.state.covariance, axis1=-2, axis2=-1))
        prior = np.sqrt(np.diagonal(self.scene.prior_covariance))
        return np.log(np.maximum(std, 1e-12) / prior) + 1.0

    def _velocity(self) -> FloatArray:
        """Commanded velocities (B, 3) over the speed."""
        speed = max(self.scene.speed_m_s, float(np.abs(self.scene.twist[3:]).max()), 1e-3)
        return self.twist[:, 3:] / speed

    def _columns(self) -> FloatArray:
        """The first two columns (B, 6) of the estimated rotation."""
        return np.swapaxes(self.state.rotation, -1, -2)[:, :2].reshape(-1, 6)


def _world(scene: Any, **defaults: Any) -> scenes.Scene:
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
    `scene`: a name or overrides, see `rbl_gym.scenes.get`; the anchors must move.

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
        if isinstance(k, bool) or not isinstance(k, int) or not 1 <= k <= world.n_anchors:
            raise ValueError(f"k must be an int from 1 to {world.n_anchors}, got {k!r}")
        self.k = k
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
