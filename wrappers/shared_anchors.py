"""Several bodies with the same anchors, each tracked by its own filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from rbl_gym import rendering
from rbl_gym.checks import BoolArray, FloatArray, check_count, check_one_of
from rbl_gym.envs.batch import (
    MOST_ENVS,
    StatedLength,
    check_actions,
    check_options,
    reset_mask,
    seeds_of,
)
from rbl_gym.envs.scalar import first_of, scalars_of
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds import scenes
from rbl_gym.worlds.families import SceneFamily
from rbl_gym.wrappers.estimate import FilterLike
from rbl_gym.wrappers.observations import ViewLike, viewer_of
from rbl_gym.wrappers.rewards import RewardLike
from rbl_gym.wrappers.vector_estimate import VectorEstimatePose

# Keys that the bodies of a world share, and fields in which they must agree.
_SHARED = ("anchors", "anchor_mask")
_ALIKE = ("n_anchors", "anchors", "anchor_region", "anchor_speed_m_s", "dt", "steps")
# How to combine the rewards of the bodies.
COMBINATIONS = {"mean": np.mean, "worst": np.min, "sum": np.sum}


class _Bodies(TrackingVectorEnv):
    """Worlds of K rows each: a row is a body, and all rows of a world have the same anchors."""

    _in_turn = True

    def _restart(
        self, chosen: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray]:
        start = super()._restart(chosen, generators)
        assert self.family is not None
        k = len(self.family.members)
        self._anchors[chosen] = np.repeat(self._anchors[chosen[::k]], k, axis=0)
        return start


class SharedAnchorsVectorEnv(StatedLength, VectorEnv[Any, Any, Any]):
    """`num_envs` independent `SharedAnchorsEnv`; seeding and autoreset as `BatchEnv`."""

    inner: Any = None

    def __init__(
        self,
        num_envs: int = 1,
        scene: str | Mapping[str, Any] = "auv_buoys",
        bodies: Sequence[Mapping[str, Any]] = ({}, {}),
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        combine: str = "mean",
        observation: ViewLike = "dict",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        num_envs = check_count("num_envs", num_envs, most=MOST_ENVS)
        family = family_of_bodies(scene, bodies)
        self._combine = COMBINATIONS[check_one_of("combine", combine, list(COMBINATIONS))]
        self.n_bodies = k = len(family.members)
        rows = _Bodies(
            num_envs * k, reward="none", render_mode=render_mode,
            max_episode_steps=max_episode_steps, autoreset_mode=autoreset_mode, scenes=family,
        )  # fmt: skip
        self._kind = viewer_of(observation).kind
        self.inner = VectorEstimatePose(rows, filter, options, reward, observation)
        self.num_envs, self.render_mode, self.metadata = num_envs, render_mode, rows.metadata
        self.single_action_space = rows.single_action_space
        self.single_observation_space = self._space(self.inner.single_observation_space)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _space(self, one: Any) -> spaces.Space[Any]:
        if isinstance(one, spaces.Dict):
            return spaces.Dict(
                {
                    key: space if key in _SHARED else batch_space(space, self.n_bodies)
                    for key, space in one.items()
                    if key not in self._left_out
                }
            )
        each = batch_space(one, self.n_bodies)
        if len(one.shape) != 1 or not isinstance(each, spaces.Box):
            return each
        return spaces.Box(each.low.ravel(), each.high.ravel(), dtype=one.dtype)

    @property
    def _left_out(self) -> tuple[str, ...]:
        """Masks that are all ones are left out: only tokens contain the number of anchors."""
        return ("anchor_mask",) if self._kind == "dict" else ()

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode."""
        return self.inner.unwrapped.episode_steps

    @property
    def family(self) -> SceneFamily:
        """The scenes of the bodies, in their order."""
        return self.inner.unwrapped.family

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start all episodes, or with ``options={"reset_mask": mask}`` those of the mask."""
        mask = np.repeat(reset_mask(options, self.num_envs), self.n_bodies)
        seeds = [seed for one in seeds_of(seed, self.num_envs) for seed in self._seeds(one)]
        observation, info = self.inner.reset(
            seed=seeds, options=None if mask.all() else {"reset_mask": mask}
        )
        return self._grouped(observation), self._informed(info)

    def _seeds(self, seed: int | None) -> list[int | None]:
        """Return seeds of the bodies of a world."""
        if seed is None:
            return [None] * self.n_bodies
        return np.random.SeedSequence(seed).generate_state(self.n_bodies).tolist()

    def step(
        self, actions: ArrayLike
    ) -> tuple[Any, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Move the anchors of every world, then all bodies, then measure."""
        actions = check_actions("actions", actions, self.single_action_space, self.num_envs)
        each = np.repeat(actions, self.n_bodies, axis=0)
        observation, reward, terminated, truncated, info = self.inner.step(each)
        together = self._combine(reward.reshape(-1, self.n_bodies), axis=-1)
        ended = (flag[:: self.n_bodies] for flag in (terminated, truncated))
        return self._grouped(observation), together, *ended, self._informed(info)

    def _grouped(self, observation: Any) -> Any:
        """Return observations (B K, ...) as those of B worlds."""
        if not isinstance(observation, dict):
            return observation.reshape(self.observation_space.shape)
        return {
            key: field[:: self.n_bodies] if key in _SHARED else self._split(field)
            for key, field in observation.items()
            if key not in self._left_out
        }

    def _split(self, field: np.ndarray) -> np.ndarray:
        return field.reshape(self.num_envs, self.n_bodies, *field.shape[1:])

    def _informed(self, info: dict[str, Any]) -> dict[str, Any]:
        """Return infos (B K, ...) as those of B worlds: (B, K, ...), with masks (B,)."""
        told: dict[str, Any] = {}
        for key, field in info.items():
            if key == "final_info":
                told[key] = self._informed(field)
            elif key == "final_obs":
                told[key] = self._final(field)
            elif key.startswith("_") or key == "epoch":
                told[key] = field[:: self.n_bodies]
            else:
                told[key] = self._split(field)
        return told

    def _final(self, rows: np.ndarray) -> np.ndarray:
        """Return Gymnasium's ``final_obs``: an object array with the last observations."""
        final = np.full(self.num_envs, None, dtype=object)
        for world in range(self.num_envs):
            group = rows[world * self.n_bodies : (world + 1) * self.n_bodies]
            if group[0] is None:
                continue
            if isinstance(group[0], dict):
                final[world] = {
                    key: group[0][key] if key in _SHARED else np.stack([one[key] for one in group])
                    for key in group[0]
                    if key not in self._left_out
                }
            else:
                final[world] = np.stack(list(group)).reshape(self.single_observation_space.shape)
        return final

    def render(self) -> Any:
        """Return a frame of every world, with its bodies side by side."""
        frames = self.inner.render()
        k = self.n_bodies
        if frames is None:
            return None
        return tuple(np.hstack(frames[i : i + k]) for i in range(0, len(frames), k))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment of the bodies, if it was made."""
        if self.inner is not None:
            self.inner.close(**kwargs)


class SharedAnchorsEnv(StatedLength, gym.Env[Any, Any]):
    """Move the anchors, which several bodies share, so that the poses of all bodies are known well.

    ## Description
    K bodies move among M anchors. Each body has its own tags, speed and noise. Its own filter
    tracks it. An action moves the anchors for all bodies.

    ## Action space
    As `RBL/Tracking-v0`.

    ## Observation space
    * ``observation="dict"``: that of `EstimatePose`, with a leading axis of K bodies for `ranges`,
      `links`, `twist`, `quality`, `belief_rotation`, `belief_translation` and `belief_covariance`.
      Also `tags` (K, N, 3), metres, body frame, and `tag_mask` (K, N), 1 for the tags of a body.
      `anchors` (M, 3) are shared.
    * ``"flat"``: the concatenated flat observations of the bodies, float32.
    * ``"tokens"`` and custom functions: as `EstimatePose`, with a leading axis of K bodies; vectors
      are concatenated.

    ## Reward
    Each body has the `reward` of `EstimatePose`. ``combine="mean"``, ``"worst"`` or ``"sum"``
    combines them.

    ## Starting state
    As in `RBL/Tracking-v0`, for each body. If the scene draws the anchors around a body, they are
    drawn around the first one.

    ## Info
    Infos of `EstimatePose` with an axis of K bodies: `rotation`, `translation`, `nlos`, `score_m`,
    `rotation_error_rad`, `position_error_m`, `tag_error_m`, `nees`. Also `epoch`. The info of a
    reset also has the priors (`prior_...`) and `scene`, the scene overrides of each body as JSON
    text.

    ## Episode end
    Never terminates; truncates after the steps of the scene.

    ## Rendering
    ``render_mode="rgb_array"``: the frames of the bodies side by side.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make(
        "rbl_gym:RBL/SharedAnchors-v0",
        scene={"name": "auv_buoys", "n_anchors": 5},
        bodies=[{"speed_m_s": 1.0}, {"speed_m_s": 3.0}],
        combine="worst",
    )
    ```

    * `scene`: a name or a dict of overrides.
    * `bodies`: overrides of the scene for each body. All bodies must have the same anchors, and the
      same time step and number of steps.
    * `filter`, `options`, `reward`: as in `EstimatePose`.

    ## Version history
    * v0: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own form)
        "render_modes": rendering.RENDER_MODES,
        "render_fps": 20,
    }

    def __init__(
        self,
        scene: str | Mapping[str, Any] = "auv_buoys",
        bodies: Sequence[Mapping[str, Any]] = ({}, {}),
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        combine: str = "mean",
        observation: ViewLike = "dict",
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = render_mode
        self._one = SharedAnchorsVectorEnv(
            1, scene, bodies, filter, options, reward, combine, observation, render_mode,
            autoreset_mode="Disabled",
        )  # fmt: skip
        self.observation_space = self._one.single_observation_space
        self.action_space = self._one.single_action_space
        self._started = False

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode."""
        return self._one.episode_steps

    @property
    def family(self) -> SceneFamily:
        """The scenes of the bodies, in their order."""
        return self._one.family

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; `options` must be empty."""
        check_options(options)
        super().reset(seed=seed)
        observation, info = self._one.reset(seed=None if seed is None else [seed])
        return first_of(observation), _informed(info)

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move the anchors, then all bodies, then measure."""
        action = check_actions("action", action, self.action_space)
        observation, reward, terminated, truncated, info = self._one.step(action[None])
        ended = bool(terminated[0]), bool(truncated[0])
        return first_of(observation), float(reward[0]), *ended, _informed(info)

    def render(self) -> Any:
        """Return the frames of the bodies side by side, (height, K width, 3), uint8."""
        frames = self._one.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Close the environment."""
        self._one.close()


def family_of_bodies(scene: Any, bodies: Any) -> SceneFamily:
    """Return the scenes of the bodies as a family, after a check that they can share anchors."""
    base = {"name": scene} if isinstance(scene, str) else scene
    if not isinstance(base, Mapping):
        raise ValueError(f"scene must be a name or a dict of changes, got {scene!r:.80}")
    if not isinstance(bodies, Sequence) or isinstance(bodies, str) or not bodies:
        raise ValueError(
            "bodies must be a list of dicts, the changes of the scene for each body, such as "
            f"[{{}}, {{'speed_m_s': 2}}]; got {bodies!r:.80}"
        )
    for index, body in enumerate(bodies):
        if not isinstance(body, Mapping):
            raise ValueError(
                f"bodies[{index}] must be a dict of changes of the scene, got {body!r:.80}"
            )
    merged = tuple({**base, **body} for body in bodies)
    made = [scenes.get(one) for one in merged]
    for index, one in enumerate(made):
        if one.survey_std_m > 0:
            raise ValueError(
                f"bodies[{index}] must have survey_std_m = 0, got {one.survey_std_m:g}: all bodies "
                "see the same anchors"
            )
        for name in _ALIKE:
            if getattr(one, name) != getattr(made[0], name):
                raise ValueError(
                    f"bodies[{index}] must have the {name} of the others, got "
                    f"{getattr(one, name)!r:.80} beside {getattr(made[0], name)!r:.80}"
                )
    return SceneFamily(merged)


def _informed(info: dict[str, Any]) -> dict[str, Any]:
    """Return the infos of the only world, without the masks."""
    return scalars_of({key: field for key, field in info.items() if not key.startswith("_")})
