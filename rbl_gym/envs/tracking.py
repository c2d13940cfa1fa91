"""RBL/Tracking-v0: anchors measure ranges to the tags of one rigid body."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from rbl_gym import rendering
from rbl_gym.checks import FloatArray, as_array, check_array, check_one_of
from rbl_gym.envs.batch import StatedLength, check_options
from rbl_gym.worlds import families, scene_bounds, scenes, simulation
from rbl_gym.worlds.families import SceneFamily
from rbl_gym.worlds.scene import Scene

REWARDS = ("bound", "none")
REWARD_ADVICE = (
    "for other rewards, or a function, wrap the environment: EstimatePose(env, filter, reward=...)"
    ", or VectorEstimatePose (docs/environments/wrappers.md)"
)
# Bound of the observations of a family, whose scenes have different bounds.
_FAR = 1e9

# Unlike the other environments, this is not a `ScalarEnv` of one world. A whole episode is drawn at
# reset, and with fixed anchors also measured, which makes an epoch several times as fast. A test
# compares it with world i of the vector environment.


class TrackingEnv(StatedLength, gym.Env[Any, Any]):
    """A rigid body moves, and anchors measure noisy ranges to its tags.

    ## Description
    A body carries N tags at known positions in its frame. At every epoch M anchors at known
    positions measure ranges to the tags. The environment returns the measurements and everything
    else that an estimator may know. It contains no estimator. Order within a step: the anchors
    move, the body moves, ranges are measured, the bound and the reward are computed.

    ## Action space
    Movable anchors (`scene.anchor_speed_m_s` > 0): ``Box(-1, 1, (3 M,), float32)``, a velocity per
    anchor in units of the speed limit (longer vectors are cut to length 1). Zero keeps an anchor
    where it is. Positions are projected onto the scene's anchor region. Fixed anchors:
    ``Discrete(1)``.

    ## Observation space
    A ``Dict``:

    | key | shape | type | meaning |
    |---|---|---|---|
    | `ranges` | (M, N) | float64 | metres, 0 without a link. If the scene has `links.offset`, they may be negative |
    | `links` | (M, N) | int8 | 1 where a range was measured |
    | `anchors` | (M, 3) | float64 | positions of the anchors at this epoch, metres |
    | `twist` | (6,) | float64 | known angular velocity (world frame, rad/s) and velocity (m/s) of the interval that ends at this epoch |
    | `quality` | (M,) | float64 | fraction of the Fisher information that the ranges of an anchor keep: 1 in line of sight, `scene.blocked_information` behind an obstacle. Only in scenes with obstacles |
    | `inertial` | (S, 6) | float64 | S samples of the inertial sensor in that interval, body frame: angular velocity (rad/s) and specific force (m/s^2); zeros at epoch 0. Only in scenes with an inertial sensor |

    ## Reward
    ``reward="bound"``: ``-log b``, where b is the posterior Cramer-Rao bound of the root mean
    square error of the tag positions in metres, at the true pose. This is the accuracy that the
    best estimator can reach with all ranges so far. ``reward="none"``: 0, and no bound is computed.
    This saves time if a wrapper computes the reward.

    ## Starting state
    A reset draws the start pose, way-points, turn rate, and the anchors that the scene does not
    fix. The info of a reset has the prior (`prior_rotation`, `prior_translation`,
    `prior_covariance`). It refers to epoch 0 before the measurements of that epoch.

    ## Info
    * `rotation`, `translation`: the true pose.
    * `nlos` (M, N): which ranges came over a reflected path.
    * `epoch`: number of the epoch.
    * `score_m`: b, with ``reward="bound"``.
    * `velocity` (3,), m/s, and `inertial_bias` (6,): with an inertial sensor.

    ## Episode end
    Never terminates; truncates after `scene.steps` steps (`env.spec.max_episode_steps`). The
    `max_episode_steps` of ``gym.make`` can only shorten an episode.

    ## Rendering
    ``render_mode="rgb_array"``: a frame (540, 960, 3) with the anchors, the body and its path in
    3-D, a close-up of the body with the 95 % region of its position, and the errors with three
    standard deviations. The wrapper `EstimatePose` gives the beliefs. Without this wrapper the
    frame shows the region of the bound.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/Tracking-v0", scene="drone_yard")
    env = gym.make(
        "rbl_gym:RBL/Tracking-v0",
        scene={"name": "uwb_room", "steps": 50, "links": {"drop_probability": 0.2}},
        reward="none",
    )
    ```

    * `scene`: a name of `rbl_gym.worlds.scenes.SCENES` or a dict of overrides, see
      `rbl_gym.worlds.scenes.get`.
    * `reward`: ``"bound"`` or ``"none"``.
    * `scenes`, instead of `scene`: a family of scenes, see below.

    With ``scene={"links": {"offset": "tag"}}`` all ranges of a tag share an unknown offset (time
    differences), see `rbl_gym.measurements.offsets`.

    With ``scene={"survey_std_m": 0.05}`` the observed anchor positions have survey errors with a
    standard deviation of 5 cm on every axis. `info["anchors"]` has the true positions. The bound
    then accounts for the accuracy of the survey.

    With `scenes` every reset draws a scene from a family, see
    `rbl_gym.worlds.families.SceneFamily`:
    ```python
    env = gym.make(
        "rbl_gym:RBL/Tracking-v0",
        scenes=[
            "drone_yard",
            {
                "name": "uwb_room",
                "n_anchors": {"integers": [3, 8]},
                "noise": {"floor_m": {"log-uniform": [0.02, 0.5]}},
            },
        ],
    )
    ```

    M and N are then the largest numbers of anchors and tags in the family. If the drawn scene has
    fewer, the remaining rows and links are zeros. The observation has three more keys:
    `anchor_mask` (M,) and `tag_mask` (N,), int8, 1 for existing anchors and tags; `tags` (N, 3),
    metres, body frame. The observation has `quality` if any scene has obstacles.

    `info["scene"]` of the reset has the drawn overrides as JSON text. `env.unwrapped.scene` is the
    scene of the episode. Actions move only existing anchors. If no scene of the family has movable
    anchors, the action space is ``Discrete(1)``. Families support no inertial sensor and no
    `links.offset`. With `survey_std_m` they support only ``reward="none"``.

    ## Version history
    * v0: first version.
    """  # noqa: E501 (a table row cannot be broken)

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own form)
        "render_modes": rendering.RENDER_MODES,
        "render_fps": 20,
    }

    def __init__(
        self,
        scene: str | Mapping[str, Any] | Scene = "uwb_room",
        reward: str = "bound",
        render_mode: str | None = None,
        scenes: Any = None,
    ) -> None:
        self.family, self.scene = worlds_of(scene, scenes)
        self.film = rendering.film_of(render_mode, self.scene)
        self.reward_mode = check_reward(reward, self.family)
        self.render_mode = render_mode
        self.observation_space = observation_space(self.family or self.scene)
        self.action_space = action_space(self.family or self.scene)
        self._episode: simulation.Episode | None = None
        self._epoch = 0

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode: the scene's; of a family, the largest number."""
        return (self.family or self.scene).steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode and measure epoch 0; `options` must be empty."""
        check_options(options)
        super().reset(seed=seed)
        drawn = None
        if self.family is not None:
            self.scene, drawn = self.family.draw(self.np_random)
            self.film = rendering.film_of(self.render_mode, self.scene)
        episode = simulation.draw_episode(self.scene, self.np_random)
        self._episode = episode
        self._epoch = 0
        self._anchors = episode.anchors.copy()
        self._measured: dict[str, np.ndarray] | None = None
        if self.scene.anchor_speed_m_s == 0:
            # No action can change what fixed anchors will measure.
            self._measured = observed(self.scene, simulation.whole(episode), episode.anchors[None])
        self._information: FloatArray | None = None
        observation, info, _ = self._observe()
        info["prior_rotation"] = episode.prior_rotation.copy()
        info["prior_translation"] = episode.prior_translation.copy()
        info["prior_covariance"] = episode.prior_covariance.copy()
        if drawn is not None:
            info["scene"] = json.dumps(drawn)
        return observation, info

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move the anchors, then the body, then measure."""
        if self._episode is None or self._epoch >= self.scene.steps:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset()")
        if self.scene.anchor_speed_m_s > 0:
            velocities = check_action(action, 3 * (self.family or self.scene).n_anchors)
            velocities = velocities[: 3 * self.scene.n_anchors]
            self._anchors = simulation.move_anchors(self.scene, self._anchors, velocities)
        elif isinstance(self.action_space, spaces.Box):
            check_action(action, 3 * (self.family or self.scene).n_anchors)
        elif not are_zeros(as_array("action", action), ()):
            raise ValueError(f"action must be 0, as the anchors are fixed, got {action!r:.80}")
        self._epoch += 1
        observation, info, reward = self._observe()
        return observation, reward, False, self._epoch >= self.scene.steps, info

    def _observe(self) -> tuple[dict[str, np.ndarray], dict[str, Any], float]:
        assert self._episode is not None
        k, at = self._epoch, simulation.epoch_of(self._episode, self._epoch)
        if self._measured is None:
            observation = observed(self.scene, at, self._anchors)
        else:
            observation = {key: field[k] for key, field in self._measured.items()}
        # Each epoch is returned once: the caller may keep views of the episode.
        info: dict[str, Any] = {
            "rotation": at.rotation,
            "translation": at.translation,
            "epoch": k,
            "nlos": observation.pop("nlos"),
        }
        reward = 0.0
        if self.reward_mode == "bound":
            info["score_m"] = self._carry_bound(at, observation["links"])
            reward = -math.log(info["score_m"])
        if self.film is not None:
            self._shoot(at, observation["links"])
        observation["anchors"] = simulation.surveyed(at, self._anchors)
        surveyed = self.family is not None and self.family.is_surveyed
        if at.survey is not None or surveyed:
            info["anchors"] = self._anchors.copy()
        observation["twist"] = at.twist
        if at.readings is not None and at.velocity is not None and at.bias is not None:
            observation["inertial"] = at.readings.copy()
            info["velocity"], info["inertial_bias"] = at.velocity, at.bias
        if self.family is not None:
            observation = self.family.pad(observation, self.scene)
            info["nlos"] = families.padded(info["nlos"], self.family.fields["links"][0])
            if surveyed:
                info["anchors"] = families.padded(info["anchors"], (self.family.n_anchors, 3))
        return observation, info, reward

    def _shoot(self, at: simulation.Epoch, links: np.ndarray) -> None:
        known = self._information
        bound = None if known is None else scene_bounds.pose_covariance(known)[None]
        world = links.view(np.bool_)[None], self._anchors[None], at.rotation[None]
        shot = rendering.shot(*world, at.translation[None], bound)
        self.film.take([self._epoch], shot)  # pyrefly: ignore[missing-attribute]

    def render(self) -> Any:
        """Return an RGB frame, uint8: the world, a close-up, and the errors (or the bound)."""
        return rendering.picture(self.film)

    def _carry_bound(self, at: simulation.Epoch, links: np.ndarray) -> float:
        """Return the posterior Cramer-Rao bound of this epoch from that of the previous one."""
        assert self._episode is not None
        self._information, score = scene_bounds.posterior_step(
            self.scene, at, self._anchors, links.view(np.bool_), self._information,
            self._episode.prior_covariance,
        )  # fmt: skip
        return float(score)


def check_reward(reward: Any, family: SceneFamily | None) -> str:
    """Return the reward; raises ValueError if the worlds have no such bound."""
    check_one_of("reward", reward, REWARDS, REWARD_ADVICE)
    if reward == "bound" and family is not None and family.is_surveyed:
        raise ValueError(
            "reward must be 'none' if scenes have survey_std_m, as their bounds have different "
            "numbers of states; got 'bound'"
        )
    return reward


def observed(scene: Scene, at: simulation.Epoch, anchors: FloatArray) -> dict[str, np.ndarray]:
    """Return the measurements of an epoch: ranges, links, `nlos`; with obstacles also `quality`."""
    quality = simulation.link_quality(scene, at, anchors) if scene.weakens else None
    measured = simulation.measure_epoch(scene, at, anchors, quality)
    told: dict[str, np.ndarray] = {
        "ranges": measured.ranges,
        "links": measured.links.view(np.int8),
        "nlos": measured.nlos,
    }
    if quality is not None:
        told["quality"] = np.ascontiguousarray(quality)
    return told


def check_action(action: ArrayLike, size: int) -> FloatArray:
    """Return an action as a finite vector of its size; raises ValueError for anything else."""
    if isinstance(action, np.ndarray) and action.shape == (size,) and action.dtype.kind == "f":
        array = action.astype(np.float64)
        # Fast path: only a sum of squares that overflows needs the full check.
        if math.isfinite(array.dot(array)):
            return array
    array = check_array("action", action, (size,))
    if array.ndim != 1:
        raise ValueError(f"action must have shape ({size},), got {array.shape}")
    return array


def are_zeros(action: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Return whether an action is the only one of fixed anchors: zeros of this shape."""
    return action.shape == shape and action.dtype.kind in "iub" and not np.count_nonzero(action)


def worlds_of(scene: Any, family: Any) -> tuple[SceneFamily | None, Scene]:
    """Return the family of `scenes` (None without one) and a scene, the first of the family."""
    if family is None:
        return None, scenes.get(scene)
    if scene != "uwb_room":
        raise ValueError(f"scene must be left out if scenes is given, got {scene!r:.80}")
    found = families.family(family)
    return found, found.corners[0]


def observation_space(scene: Scene | SceneFamily) -> spaces.Dict:
    """Return the observation space of a scene, with finite bounds."""
    if isinstance(scene, SceneFamily):
        return spaces.Dict(
            {
                key: spaces.MultiBinary(shape)
                if dtype is np.int8
                else spaces.Box(-_FAR, _FAR, shape, np.float64)
                for key, (shape, dtype) in scene.fields.items()
            }
        )
    links = (scene.n_anchors, len(scene.tags))
    low, high = scene.anchor_region.bounds()
    if scene.anchors is not None:
        low = np.minimum(low, np.min(scene.anchors, axis=0))
        high = np.maximum(high, np.max(scene.anchors, axis=0))
    # check_env requires different bounds; those of a water surface are equal.
    low, high = np.where(high > low, low, low - 1), np.where(high > low, high, high + 1)
    low, high = low - 6 * scene.survey_std_m, high + 6 * scene.survey_std_m
    twist = np.abs(scene.twist)
    # Ten standard deviations of the drawn turn rate; the tightest orbit has a radius of 1 m.
    twist[:3] = np.maximum(twist[:3], max(10 * scene.spin_rad_s, np.pi / scene.dt, scene.speed_m_s))
    twist[3:] = np.maximum(twist[3:], scene.speed_m_s) + 1e-9
    if scene.inertial is not None:
        # The observed twist includes the process noise.
        twist += 10 * scene.process.std() / math.sqrt(scene.dt)
    low, high = np.tile(low, (scene.n_anchors, 1)), np.tile(high, (scene.n_anchors, 1))
    keys: dict[str, spaces.Space[Any]] = {
        "anchors": spaces.Box(low, high, dtype=np.float64),
        "twist": spaces.Box(-twist, twist, dtype=np.float64),
        "ranges": spaces.Box(*scene.range_bounds_m, links, np.float64),
        "links": spaces.MultiBinary(links),
    }
    if scene.weakens:
        keys["quality"] = spaces.Box(0.0, 1.0, (scene.n_anchors,), np.float64)
    if scene.inertial is not None:
        limits = scene.inertial.gyro_limit_rad_s, scene.inertial.accel_limit_m_s2
        limit = np.tile(np.repeat(limits, 3), (scene.inertial.samples(scene.dt), 1))
        keys["inertial"] = spaces.Box(-limit, limit, dtype=np.float64)
    return spaces.Dict(keys)


def action_space(scene: Scene | SceneFamily) -> spaces.Space[Any]:
    """Return the action space: velocities of movable anchors, or the one action of fixed ones."""
    if scene.anchor_speed_m_s > 0:
        return spaces.Box(-1.0, 1.0, (3 * scene.n_anchors,), np.float32)
    return spaces.Discrete(1)
