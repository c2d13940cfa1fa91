"""EstimatePose: run a named filter on the measurements of an environment."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from rbl_gym import estimators, metrics, rendering
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import Filter, PoseBelief
from rbl_gym.estimators.filter import belief_of, check_takes_noise, factory_of, parse_filter, reads
from rbl_gym.measurements.bearing import AngleNoise
from rbl_gym.measurements.noise_laws import LinkNoise, WeakenedNoise
from rbl_gym.worlds.families import SceneFamily
from rbl_gym.worlds.scene import Scene
from rbl_gym.worlds.stacked import StackedScenes
from rbl_gym.wrappers.forms import check_single
from rbl_gym.wrappers.observations import Seen, ViewLike, viewer_of
from rbl_gym.wrappers.rewards import Outcome, RewardLike, paid_of, reward_of

FilterName = str | Callable[..., Filter]
FilterLike = FilterName | Mapping[str, Any]
_FIGURES = metrics.Figures._fields


class EstimatePose(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Estimate a pose belief from the measurements, and compute the reward from the belief.

    Wraps `RBL/Tracking-v0`, or another environment that has a `scene` and observes `ranges`,
    `links`, `anchors` and `twist`. In scenes with obstacles the wrapper also reads `quality`. With
    an inertial sensor the filter ``"iekf-imu"`` reads `inertial`. The wrapper also accepts
    `RBL/BaseStation-v0`, which observes `angles`, `station` and `twist` (filter ``"iekf"``). For
    vector environments use `VectorEstimatePose`.

    The wrapper replaces the reward. Wrappers between the environment and this one still see the
    reward of the environment. If no wrapper needs it, ``gym.make(..., reward="none")`` saves the
    time to compute it.

    Parameters
    ----------
    env
        The environment.
    filter
        Name of a filter (`rbl_gym.estimators.names`), with options as in ``"iekf/robust=true"``
        (`rbl_gym.estimators.parse_filter`); or a dict with its `name` and options, for example
        ``{"name": "iekf", "robust": True}``; or a factory, a class or function with the arguments
        `tags`, `noise`, `process` and its options. A factory cannot be written into the JSON of a
        spec; ``"module:factory"`` can.
    options
        Further options of the filter, a JSON-able dict, for example ``{"robust": True}``.
    reward
        ``"belief"``: ``-log b``, where b is the root mean square error of the tag positions in
        metres that the belief after the update predicts (`rbl_gym.bounds.score`). ``"error"``:
        minus the real root mean square error of the tag positions in metres. For other rewards,
        options and custom functions see `rewards.reward_of`.
    observation
        ``"dict"``: the environment's observation, with `belief_rotation` (3, 3),
        `belief_translation` (3,) and `belief_covariance` (6, 6). ``"flat"``: one float32 vector for
        a policy, see `observations.flat`. ``"tokens"``: a token for each anchor, tag and obstacle,
        see `observations.tokens`. For custom functions see `observations.viewer_of`.

    Info
    ----
    `rotation_error_rad`, `position_error_m`, `tag_error_m`, `nees` (6 degrees of freedom) and
    `score_m` (b of the belief), in addition to the environment's info. The `score_m` of the
    environment, b of the bound, gets the name `bound_m`.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from rbl_gym.wrappers import EstimatePose
    >>> env = gym.make("rbl_gym:RBL/Tracking-v0", scene="drone_yard", reward="none")
    >>> env = EstimatePose(env, "iekf")
    >>> observation, info = env.reset(seed=1)
    >>> observation, reward, terminated, truncated, info = env.step(0)
    >>> info["position_error_m"] < 1.0
    True
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        filter: FilterLike = "iekf",
        options: Mapping[str, Any] | None = None,
        reward: RewardLike = "belief",
        observation: ViewLike = "dict",
    ) -> None:
        RecordConstructorArgs.__init__(
            self, filter=filter, options=options, reward=reward, observation=observation
        )
        check_single(env, "VectorEstimatePose")
        gym.Wrapper.__init__(self, env)
        self._scene = scene_of(env)
        self._reward = reward_of(reward)
        self._viewer = viewer_of(observation)
        self._tags = self._scene.body
        self._rendered = getattr(env.unwrapped, "film", None) is not None
        self._named = named_filter(filter, options)
        self._family = family_of(env)
        if self._family is not None:
            # Check now the options that a scene of the family does not accept.
            self._scene = next((s for s in self._family.corners if s.weakens), self._scene)
        self._filter = make_filter(env, self._scene, *self._named)
        self._state: Any = None
        self.observation_space = self._viewer.space_of(env, self._scene, env.observation_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the filter from the environment's prior and update it with the first epoch."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self._family is not None:
            self._scene = scene_of(self.env)
            self._tags = self._scene.body
            self._filter = make_filter(self.env, self._scene, *self._named)
        prior = (info["prior_rotation"], info["prior_translation"], info["prior_covariance"])
        self._state = self._filter.initial(*prior)
        belief = self._update(observation)
        info, _ = self._judged(belief, info)
        return self._observation(observation, belief), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment, predict with its twist, update with its ranges."""
        observation, _, terminated, truncated, info = self.env.step(action)
        told = observation[reads(self._filter)]
        self._state = self._filter.predict(self._state, told, self._scene.dt)
        belief = self._update(observation)
        info, figures = self._judged(belief, info)
        truth = info["rotation"], info["translation"], info.get("bound_m")
        outcome = Outcome(figures, belief, *truth, action, observation, self._scene)
        reward = float(paid_of(self._reward, outcome))
        return self._observation(observation, belief), reward, terminated, truncated, info

    def _update(self, observation: dict[str, np.ndarray]) -> PoseBelief:
        if self._family is not None:
            observation = unpadded(observation, self._scene)
        self._state = update(self._filter, self._state, observation, self._scene)
        return belief_of(self._filter, self._state)

    def _judged(
        self, belief: PoseBelief, info: dict[str, Any]
    ) -> tuple[dict[str, Any], metrics.Figures]:
        """Return the infos with the errors against the true pose, and these errors."""
        figures = metrics.judge(*belief[:3], info["rotation"], info["translation"], self._tags)
        if self._rendered:
            rendering.tell(self.env, rendering.Pose(*belief[:3]), single=True)
        info = with_bound(info)
        info.update(zip(_FIGURES, map(float, figures), strict=True))
        return info, figures

    def _observation(self, observation: dict[str, np.ndarray], belief: PoseBelief) -> Any:
        return self._viewer(Seen(observation, belief, self._scene))


def scene_of(env: Any) -> Scene:
    """Return the scene of an environment; raises ValueError without one."""
    unwrapped = env.unwrapped
    scene = getattr(unwrapped, "scene", None)
    if not isinstance(scene, Scene):
        raise ValueError(
            "env must be RBL/Tracking-v0 or another environment with a Scene as its attribute "
            "scene; environments that run a filter themselves, such as RBL/AnchorSelection-v0, "
            f"cannot be wrapped; got {unwrapped}"
        )
    return scene


def family_of(env: Any) -> SceneFamily | None:
    """Return the family of scenes of an environment; None if it has only one scene."""
    return getattr(env.unwrapped, "family", None)


def unpadded(observation: Mapping[str, np.ndarray], scene: Scene) -> dict[str, np.ndarray]:
    """Return the observation of a scene of a family without its padding."""
    if "angles" in observation:
        return measured_of(observation)
    told = {
        key: observation[key]
        for key in ("ranges", "links", "anchors", "quality", "twist")
        if key in observation
    }
    m, n = scene.n_anchors, len(scene.tags)
    for key in ("ranges", "links"):
        told[key] = told[key][..., :m, :n]
    told["anchors"] = told["anchors"][..., :m, :]
    if scene.weakens:
        told["quality"] = told["quality"][..., :m]
    else:
        told.pop("quality", None)
    return told


def with_bound(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of an environment's infos with `score_m` of its bound renamed to `bound_m`."""
    told = dict(info)
    for name, bound in (("score_m", "bound_m"), ("_score_m", "_bound_m")):
        if name in told:
            told[bound] = told.pop(name)
    return told


def named_filter(
    filter: FilterLike, options: Mapping[str, Any] | None
) -> tuple[FilterName, Mapping[str, Any] | None]:
    """Return name and options of a filter given by its name and options, or by a dict with both.

    A factory in place of the name is returned as it is.
    """
    if not isinstance(filter, Mapping):
        return parse_filter(filter, check_options_of(options))
    if options is not None:
        raise ValueError(
            "options must be None if filter is a dict, which holds the options; got "
            f"{options!r:.80}"
        )
    told = dict(filter)
    name = told.pop("name", None)
    if not isinstance(name, str) and not callable(name):
        raise ValueError(
            f"filter must be a name, or a dict with the key 'name', got {filter!r:.80}"
        )
    return parse_filter(name, told)


def make_filter(
    env: Any, scene: Scene, name: FilterName, options: Mapping[str, Any] | None
) -> Filter:
    """Return a named filter for the scene's tags and the laws of the measurements of `env`."""
    told = check_options_of(options)
    law = getattr(env.unwrapped, "noise", scene.noise)
    if isinstance(law, AngleNoise):
        told = {"measurement": "doa", **told}
    return scene_filter(scene, name, told, law)


def scene_filter(
    scene: Scene, name: FilterName, options: Mapping[str, Any], noise: Any = None
) -> Filter:
    """Return a named filter with the tags and laws of the scene.

    Parameters
    ----------
    scene
        The scene.
    name, options
        As `estimators.make` takes them.
    noise
        Noise law in place of that of the scene's ranges; None: that law.

    Raises
    ------
    ValueError
        As in `estimators.make`, and if the filter does not support a law per epoch, which scenes
        with obstacles need, or reads an inertial sensor that the scene does not have.
    """
    name, options = parse_filter(name, options)
    filter = estimators.make(
        name,
        tags=scene.body,
        noise=scene.noise if noise is None else noise,
        process=scene.process,
        **{**scene.links.options, **_inertial_options(name, scene), **options},
    )
    if scene.weakens:
        check_takes_noise(
            name, filter, "the scene's obstacles change the noise from epoch to epoch"
        )
    if reads(filter) == "inertial" and scene.inertial is None:
        raise ValueError(
            f"filter {name!r} reads an inertial sensor, scene {scene.name!r} has none: give it "
            'one, scene={"name": ..., "inertial": "consumer"}'
        )
    return filter


def _inertial_options(name: FilterName, scene: Scene) -> dict[str, Any]:
    """Return options for a filter with an inertial sensor, if the scene has one."""
    if scene.inertial is None:
        return {}
    asked = inspect.signature(factory_of(name)).parameters
    known = {"inertial": scene.inertial, "speed_m_s": scene.speed_std_m_s}
    return known if "inertial" in asked else {}


def check_options_of(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return options of a filter as a dict; raises ValueError for anything else."""
    if options is None:
        return {}
    if not isinstance(options, Mapping) or not all(isinstance(key, str) for key in options):
        raise ValueError(
            f"options must be a dict of names and values, or None, got {options!r:.80}"
        )
    for key in ("name", "tags", "noise", "process"):
        if key in options:
            raise ValueError(
                f"options must not have {key!r}, which the wrapper sets, got {options!r:.80}"
            )
    return dict(options)


def measured_of(observation: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the part of an observation that a filter reads."""
    keys = "ranges", "links", "quality", "anchors", "angles", "station", "twist", "inertial"
    return {key: observation[key] for key in keys if key in observation}


def update(filter: Filter, state: Any, observation: Mapping[str, np.ndarray], scene: Scene) -> Any:
    """Return the filter's state after the measurements of an epoch, with `quality` if observed.

    The quality determines the noise law of the epoch, which the filter gets as `noise`.
    """
    if "angles" in observation:
        return filter.update(state, observation["angles"], observation["station"])
    ranges, anchors, links = observation["ranges"], observation["anchors"], observation["links"]
    if isinstance(scene, StackedScenes):
        seen = links.astype(np.bool_, copy=False)
        law = LinkNoise(np.sqrt(_variance(scene, observation, seen)))
        return filter.update(state, ranges, anchors, seen, noise=law)
    if "quality" not in observation:
        every = np.count_nonzero(links) == links.size
        return filter.update(state, ranges, anchors, None if every else links)
    seen = links.astype(np.bool_, copy=False)
    law = WeakenedNoise(scene.noise, observation["quality"])
    return filter.update(state, ranges, anchors, seen, noise=law)


def _variance(
    scene: StackedScenes, observation: Mapping[str, np.ndarray], links: BoolArray
) -> FloatArray:
    """Return variances (B, M, N) of an epoch of many worlds, 1 for missing ranges."""
    variance = scene.noise.variance(observation["ranges"], links)
    if "quality" in observation:
        variance = variance / np.where(links, observation["quality"][..., None], 1.0)
    return np.where(links, variance, 1.0)
