"""RBL/BaseStation-v0: one base station measures angles to the tags of one rigid body."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym import rendering
from rbl_gym.bounds import posterior
from rbl_gym.checks import BoolArray, FloatArray, check_number, check_one_of
from rbl_gym.envs.batch import BatchEnv
from rbl_gym.envs.episodes import EpisodeStore, FamilyStore
from rbl_gym.envs.scalar import ScalarEnv
from rbl_gym.envs.tracking import REWARD_ADVICE, REWARDS, action_space, observation_space
from rbl_gym.geometry import bodies
from rbl_gym.measurements import bearing
from rbl_gym.measurements.ranging import LinkModel
from rbl_gym.worlds import families, scenes, simulation
from rbl_gym.worlds.families import SceneFamily
from rbl_gym.worlds.scene import Scene

ANGLE_STD_RAD = math.radians(0.1)
# Additional keys in the info of a reset.
_PRIOR = ("prior_rotation", "prior_translation", "prior_covariance", "scene")
# The world, as overrides of a scene; the body stays on the station's side, y > 0.
WORLD: dict[str, Any] = {
    "name": "drone_yard",
    "volume": {"low": [-12, 8, 2], "high": [12, 30, 12]},
    "anchor_region": {"low": [-20, -6, 0], "high": [20, 0, 6]},
    "n_anchors": 1,
    "anchors": [[0, 0, 3]],
    "anchor_speed_m_s": 3.0,
    "tags": bodies.centred(bodies.doa2019()).tolist(),
    "speed_m_s": 2.0,
}


def world(scene: Mapping[str, Any] | None) -> Scene:
    """Return the scene given by `WORLD` and these overrides.

    Raises ValueError if the scene does not have exactly one base station, or if it has links or
    obstacles, which do not apply to angles.
    """
    changes = {} if scene is None else scene
    if not isinstance(changes, Mapping):
        raise ValueError(
            f"scene must be a dict with changes of the default world, such as {{'dt': 0.5}}, got "
            f"{scene!r:.80}"
        )
    if changes.get("n_anchors", 1) != 1:
        raise ValueError(
            f"scene must have n_anchors = 1, the base station, got {changes['n_anchors']!r:.80}"
        )
    return checked_world(scenes.get({**WORLD, **changes}))


def checked_world(found: Scene) -> Scene:
    """Return the scene; raises ValueError as `world` does."""
    if found.n_anchors != 1:
        raise ValueError(f"scene must have n_anchors = 1, the base station, got {found.n_anchors}")
    if found.links != LinkModel() or found.weakens:
        raise ValueError(
            "scene must have no failing links and no obstacles: angles are measured in every step"
        )
    return found


def family_of_worlds(members: Any) -> SceneFamily:
    """Return the family of worlds given by overrides of `WORLD` with laws; may raise ValueError."""
    changes = families.members_of(members)
    for index, change in enumerate(changes):
        if not isinstance(change, Mapping):
            raise ValueError(
                f"scenes[{index}] must be a dict with changes of the default world, got "
                f"{change!r:.80}"
            )
    found = SceneFamily(tuple({**WORLD, **change} for change in changes))
    counts = {len(checked_world(one).tags) for one in found.corners}
    if len(counts) > 1:
        raise ValueError(
            "scenes must have bodies with the same number of tags, as angles cannot be masked; "
            f"got {sorted(counts)} tags"
        )
    return found


class BaseStationVectorEnv(BatchEnv):
    """`num_envs` independent `BaseStationEnv` worlds; seeding and autoreset as `BatchEnv`.

    Created by ``gym.make_vec("rbl_gym:RBL/BaseStation-v0", num_envs=64)``. The arguments are those
    of `BaseStationEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scene: Mapping[str, Any] | None = None,
        angle_std_rad: float = ANGLE_STD_RAD,
        reward: str = "bound",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        scenes: Any = None,
    ) -> None:
        if scenes is not None and scene is not None:
            raise ValueError(f"scene must be left out if scenes is given, got {scene!r:.80}")
        self.family = None if scenes is None else family_of_worlds(scenes)
        self._scene = world(scene) if self.family is None else self.family.corners[0]
        worlds = self.family or self._scene
        self.noise = bearing.AngleNoise(check_number("angle_std_rad", angle_std_rad, low=1e-12))
        self.reward_mode = check_one_of("reward", reward, REWARDS, REWARD_ADVICE)
        shape = (2, len(self._scene.tags))
        of_ranges = observation_space(worlds)
        place = of_ranges["anchors"]
        assert isinstance(place, spaces.Box)
        observed: dict[str, spaces.Space[Any]] = {
            "angles": spaces.Box(0.0, np.pi, shape, np.float64),
            "station": spaces.Box(place.low[0], place.high[0], dtype=np.float64),
            "twist": of_ranges["twist"],
        }
        if self.family is not None:
            observed["tags"] = of_ranges["tags"]
        self.single_observation_space = spaces.Dict(observed)
        self.single_action_space = action_space(worlds)
        self.film = (
            rendering.film_of(render_mode, self._scene, "base station")
            if self.family is None
            else rendering.film_of_many(render_mode, self._scene_of, worlds.steps)
        )
        self._configure(num_envs, render_mode, worlds.steps, max_episode_steps, autoreset_mode)
        self._longest = self.steps_limit
        self._episodes = (
            EpisodeStore(self._scene, num_envs)
            if self.family is None
            else FamilyStore(self.family, num_envs)
        )
        self._normals = np.zeros((num_envs, worlds.steps + 1, *shape))
        self._stations = np.zeros((num_envs, 1, 3))
        self._angles = np.zeros((num_envs, *shape))
        self._information = np.zeros((num_envs, 6, 6))
        self._score_m = np.zeros(num_envs)
        self._at: simulation.Motion | None = None

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode; of a family, the largest number."""
        return self._longest

    @property
    def scene(self) -> Scene:
        """The scene; of a family, the present scene of world 0."""
        return self._scene if self.family is None else self._scene_of(0)

    @property
    def world(self) -> Any:
        """The scene; of a family, the present scenes of all worlds, stacked."""
        return self._episodes.stack if isinstance(self._episodes, FamilyStore) else self._scene

    def _scene_of(self, row: int) -> Scene:
        return self.world.scenes[row]

    def _restart(
        self, chosen: np.ndarray, generators: Sequence[np.random.Generator]
    ) -> dict[str, np.ndarray]:
        start = self._episodes.begin(chosen, generators)
        if self.family is not None:
            self.steps_limit = np.minimum(self.world.arrays.steps, self._longest)
        for row, generator in zip(chosen, generators, strict=True):
            steps = self._scene.steps if self.family is None else self._scene_of(row).steps
            generator.standard_normal(out=self._normals[row, : steps + 1])
        self._stations[chosen] = start["anchors"]
        self._information[chosen] = np.linalg.inv(start["prior_covariance"])
        self._measure(chosen, 0.0)
        return {name: start[name] for name in _PRIOR if name in start}

    def _advance(self, actions: np.ndarray, moving: BoolArray) -> tuple[FloatArray, BoolArray]:
        rows = slice(None) if moving.all() else np.flatnonzero(moving)
        if self.family is not None and self.family.anchor_speed_m_s > 0:
            self._stations[rows] = self.world.move_anchors(self._stations, actions)[rows]
        elif self.family is None and self._scene.anchor_speed_m_s > 0:
            self._stations[rows] = simulation.move_anchors(
                self._scene, self._stations[rows], actions[rows]
            )
        dt = self.world.dt
        self._measure(rows, dt if self.family is None else dt[rows])
        reward = np.zeros(self.num_envs)
        if self.reward_mode == "bound":
            reward = -np.log(self._score_m)
        return reward, np.zeros(self.num_envs, dtype=np.bool_)

    def _measure(self, rows: np.ndarray | slice, step: Any) -> None:
        """Measure angles of some worlds at their epochs, `step` seconds after the last ones."""
        self._at = self._episodes.motion_at(self._epochs)
        rotation, translation, twist = (field[rows] for field in self._at)
        station, std = self._stations[rows], self.noise.std_rad
        normals = self._normals[np.arange(self.num_envs), self._epochs][rows]
        body, process = self.world.body, self.world.process.std()
        if self.family is not None:
            body, process = body[rows], process[rows]
        self._angles[rows] = bearing.sample(
            rotation, translation, body, station[:, 0], normals, std
        )
        if self.reward_mode == "bound":
            information, score = posterior.step_of_angles(
                self._information[rows], twist, step, process, station[:, 0], body, rotation,
                translation, std,
            )  # fmt: skip
            if not math.isfinite(np.vdot(score, score)):
                raise ValueError(
                    "the information about the pose is singular or not finite: the prior, process "
                    "or noise of the scene is too small or too large"
                )
            self._information[rows], self._score_m[rows] = information, score

    @property
    def _seen(self) -> simulation.Motion:
        """Return the last measurements of all worlds."""
        assert self._at is not None
        return self._at

    def _observe(self) -> dict[str, np.ndarray]:
        told = {
            "angles": self._angles.copy(),
            "station": self._stations[:, 0].copy(),
            "twist": self._seen.twist.copy(),
        }
        return told if self.family is None else {**told, "tags": self.world.body.copy()}

    def _inform(self) -> dict[str, np.ndarray]:
        info = {
            "rotation": self._seen.rotation.copy(),
            "translation": self._seen.translation.copy(),
            "epoch": self._epochs.copy(),
        }
        if self.reward_mode == "bound":
            info["score_m"] = self._score_m.copy()
        return info

    def _shot(self) -> tuple[Any, None]:
        at = self._seen
        bound = np.linalg.inv(self._information) if self.reward_mode == "bound" else None
        seen = np.ones((self.num_envs, 1, 1), dtype=np.bool_)
        return rendering.shot(seen, self._stations, at.rotation, at.translation, bound), None


class BaseStationEnv(ScalarEnv):
    """A rigid body moves, and one base station measures the directions to its tags.

    ## Description
    A body carries N tags at known positions in its frame. At every epoch a base station at a known
    position measures two angles for every tag (`rbl_gym.measurements.bearing`). Alpha is the angle
    between the direction to the tag and the x axis; beta is that to the z axis. The station's axes
    are the world's axes. Distances are not measured. They follow from the known size of the body;
    the farther the body is, the less accurate they are. Order within a step: the station moves, the
    body moves, angles are measured, the bound and the reward are computed.

    ## Action space
    ``Box(-1, 1, (3,), float32)``: velocity of the base station in units of its speed limit (3 m/s;
    longer vectors are cut to length 1). Zero keeps the station where it is. Its position is
    projected onto the scene's anchor region. In a scene with ``anchor_speed_m_s`` 0:
    ``Discrete(1)``.

    ## Observation space
    A ``Dict``, all float64:

    | key | shape | meaning |
    |---|---|---|
    | `angles` | (2, N) | alpha and beta of every tag, radians on [0, pi] |
    | `station` | (3,) | position of the base station at this epoch, metres |
    | `twist` | (6,) | known angular velocity (rad/s) and velocity (m/s) of the interval that ends at this epoch |

    ## Reward
    ``reward="bound"``: ``-log b``, where b is the posterior Cramer-Rao bound of the root mean
    square tag error in metres at the true pose. ``reward="none"``: 0.

    ## Info
    `rotation`, `translation`: the true pose. `epoch`: the epoch. `score_m`: b, with
    ``reward="bound"``. The info of a reset also has the prior (`prior_rotation`,
    `prior_translation`, `prior_covariance`). It refers to epoch 0 before the measurements of that
    epoch.

    ## Episode end
    Never terminates; truncates after `scene.steps` steps (100 of 0.1 s).

    ## Rendering
    ``render_mode="rgb_array"``: as `RBL/Tracking-v0`, with the bound.

    ## Arguments
    ```python
    import gymnasium as gym

    env = gym.make("rbl_gym:RBL/BaseStation-v0", angle_std_rad=0.01)
    env = gym.make("rbl_gym:RBL/BaseStation-v0", scene={"steps": 50, "anchor_speed_m_s": 0})
    ```

    * `scene`: overrides of the default world (`WORLD`), see `rbl_gym.worlds.scenes.get`. The noise
      of ranges is not used.
    * `scenes`, instead of `scene`: such overrides with laws, or a list of them
      (`rbl_gym.worlds.families.SceneFamily`). Every reset draws a world, for example
      ``scenes={"speed_m_s": {"uniform": [1, 4]}}``. All bodies must have the same number of tags.
      The observation then also has `tags` (N, 3), metres, body frame. `info["scene"]` of the reset
      has the drawn overrides as JSON text.
    * `angle_std_rad`: standard deviation of an angle.
    * `reward`: ``"bound"`` or ``"none"``.

    The wrapper `EstimatePose` runs the iterated EKF on the angles.

    ## Version history
    * v0: first version.
    """  # noqa: E501 (a table row cannot be broken)

    batch_class = BaseStationVectorEnv

    def __init__(
        self,
        scene: Mapping[str, Any] | None = None,
        angle_std_rad: float = ANGLE_STD_RAD,
        reward: str = "bound",
        render_mode: str | None = None,
        scenes: Any = None,
    ) -> None:
        self._configure(
            render_mode, scene=scene, angle_std_rad=angle_std_rad, reward=reward, scenes=scenes
        )

    @property
    def family(self) -> SceneFamily | None:
        """The family from which every reset draws a world; None if there is only one world."""
        return self._batch.family

    @property
    def scene(self) -> Scene:
        """The world."""
        return self._batch.scene

    @property
    def noise(self) -> bearing.AngleNoise:
        """Noise law of the angles."""
        return self._batch.noise
