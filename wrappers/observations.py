"""Observations of `EstimatePose`: a dict, a flat vector, tokens, or a custom view."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from rbl_gym import metrics
from rbl_gym.checks import FloatArray
from rbl_gym.envs.custom import FAR, chosen_view, fitted, space_like
from rbl_gym.estimators import PoseBelief
from rbl_gym.worlds.scene import Scene

__all__ = ["OBSERVATIONS", "Seen", "flat", "tokens", "viewer_of"]

OBSERVATIONS = ("dict", "flat", "tokens")
# Observations of policies are of order one. Values far outside carry no more information.
_LIMIT = 10.0
# Numbers of features of the tokens.
_BODY, _ANCHOR, _TAG, _BOX = 26, 6, 4, 6


class Seen(NamedTuple):
    """An epoch as input of a view. In a vector environment every array has a leading axis (B,).

    Attributes
    ----------
    observation
        The environment's observation: `ranges`, `links`, `anchors`, `twist` and so on. With
        `scenes=` these arrays are padded, and there are also `anchor_mask`, `tag_mask` and `tags`.
    belief
        The belief after the epoch.
    scene
        The world: a `Scene`, or a `StackedScenes` with the same attributes for many drawn worlds.
    """

    observation: Mapping[str, np.ndarray]
    belief: PoseBelief
    scene: Any


View = Callable[[Seen], Any]
ViewLike = str | View


# --- named views ------------------------------------------------------------------------------


def flat(seen: Seen) -> np.ndarray:
    """Return belief and anchors as a float32 vector (..., 21 + 4 M), relative and of order one.

    With `scenes=` the shape is (..., 21 + 5 M), and the anchor mask comes last.

    In this order:

    * estimated position, scaled to the scene's volume (3);
    * angular velocity divided by pi/10 per step, and velocity divided by the speed (6);
    * logarithms of the standard deviations of the pose error (6);
    * first two columns of the estimated rotation (6);
    * anchor positions relative to the estimate, divided by the scene's extent (3 M);
    * logarithms of their distances divided by the extent (M).

    Entries are cut to +-10.
    """
    relative, far = _anchors(seen)
    masks = [seen.observation["anchor_mask"]] if "anchor_mask" in seen.observation else []
    for mask in masks:
        relative, far = relative * mask[..., None], far * mask
    parts = [*_body(seen), relative.reshape(*far.shape[:-1], -1), far, *masks]
    return _cut(np.concatenate(parts, axis=-1))


def tokens(seen: Seen, n_boxes: int = 0) -> dict[str, np.ndarray]:
    """Return tokens of the body and of each anchor, tag and obstacle, with masks; float32.

    For policies with attention. Padded rows are tokens of zeros with a mask of 0. All entries are
    relative, of order one and cut to +-10.

    - `body` (..., 26): the first 21 entries of `flat`; half sizes of the volume divided by the
      scene's extent (3); log10(extent in metres) / 4 and log10(body radius / extent) / 4.
    - `anchor_tokens` (..., M, 6): position relative to the estimate divided by the extent (3); log
      of the distance divided by the extent; fraction of the tags that were measured; `quality`, 1
      without it. With the memory of `SelectAnchors` two more: the result of the last choice (1: in
      sight, -1: not in sight, 0: never chosen) and ``exp(-steps since then / 10)``.
    - `tag_tokens` (..., N, 4): position on the body, rotated by the belief and divided by the
      body's radius (3); fraction of the anchors that measured it.
    - `obstacle_tokens` (..., K, 6), if the scenes have obstacles: centre relative to the estimate,
      and half size, divided by the extent.
    - `anchor_mask` (..., M), `tag_mask` (..., N), `obstacle_mask` (..., K), int8.

    Parameters
    ----------
    seen
        The epoch.
    n_boxes
        Largest number of obstacles of a scene; with 0 there are no obstacle tokens.
    """
    told, belief, scene = seen
    batch, extent = belief.translation.shape[:-1], scene.scales.extent
    half = scene.scales.half / extent[..., None]
    tags = told.get("tags", scene.body)
    tags = np.broadcast_to(tags, (*batch, *tags.shape[-2:]))
    tag_mask = told.get("tag_mask", np.ones(tags.shape[:-1], np.int8))
    relative, far = _anchors(seen)
    anchor_mask = told.get("anchor_mask", np.ones(far.shape, np.int8))
    links = told["links"] if "links" in told else np.ones((*far.shape, tags.shape[-2]))
    counts = tag_mask.sum(axis=-1)[..., None], anchor_mask.sum(axis=-1)[..., None]
    radius = metrics.length(tags).max(axis=-1)
    sizes = np.stack([extent + 0 * radius, radius / extent], axis=-1)
    of_anchors = [
        relative,
        far[..., None],
        (links.sum(axis=-1) / counts[0])[..., None],
        np.asarray(told.get("quality", np.ones(far.shape)))[..., None],
    ]
    if "known" in told:
        heard = np.exp(-told["age"] / 10)
        of_anchors += [np.where(heard > 0, 2 * told["known"] - 1, 0.0)[..., None], heard[..., None]]
    turned = tags @ np.swapaxes(belief.rotation, -1, -2) / radius[..., None, None]
    of_tags = [turned, (links.sum(axis=-2) / counts[1])[..., None]]
    shown = {
        "body": [*_body(seen), np.broadcast_to(half, (*batch, 3)), np.log10(sizes) / 4],
        "anchor_tokens": of_anchors,
        "tag_tokens": of_tags,
    }
    masks = {"anchor_tokens": anchor_mask, "tag_tokens": tag_mask}
    if n_boxes:
        boxes, mask = _boxes(scene, n_boxes, batch)
        size = extent[..., None, None]
        middle = (boxes[..., :3] - belief.translation[..., None, :]) / size
        shown["obstacle_tokens"] = [middle, boxes[..., 3:] / size]
        masks["obstacle_tokens"] = mask
    result = {name: _cut(np.concatenate(parts, axis=-1)) for name, parts in shown.items()}
    for name, mask in masks.items():
        result[name] *= mask[..., None]
        result[name.replace("_tokens", "_mask")] = np.array(mask, np.int8)
    return result


def _body(seen: Seen) -> list[FloatArray]:
    """Return position, twist, log standard deviations, two columns of the rotation: 21 entries."""
    told, belief, scene = seen
    middle, half, _, rates = scene.scales
    std = np.sqrt(np.diagonal(belief.covariance, axis1=-2, axis2=-1))
    columns = np.swapaxes(belief.rotation, -1, -2)[..., :2, :]
    return [
        (belief.translation - middle) / half,
        told["twist"] / rates,
        np.log(np.maximum(std, 1e-12)),
        columns.reshape(*belief.translation.shape[:-1], 6),
    ]


def _anchors(seen: Seen) -> tuple[FloatArray, FloatArray]:
    """Return relative anchor positions (..., M, 3), and the logs of their distances (..., M)."""
    told, belief, scene = seen
    extent = scene.scales.extent
    anchors = told["station"][..., None, :] if "station" in told else told["anchors"]
    relative = anchors - belief.translation[..., None, :]
    far = np.log(np.maximum(metrics.length(relative) / extent[..., None], 1e-6))
    return relative / extent[..., None, None], far


def _boxes(scene: Any, n_boxes: int, batch: tuple[int, ...]) -> tuple[FloatArray, np.ndarray]:
    """Return the obstacles (..., K, 6) of the scenes, and their mask (..., K)."""
    own = scene.obstruction.boxes
    boxes = np.zeros((*batch, n_boxes, 6))
    boxes[..., : own.shape[-2], :] = own
    return boxes, (boxes[..., 3] > 0).astype(np.int8)


def _cut(entries: FloatArray) -> np.ndarray:
    return np.clip(entries, -_LIMIT, _LIMIT).astype(np.float32)


# --- views of an environment ------------------------------------------------------------------


def viewer_of(observation: ViewLike, hides_obstacles: bool = False) -> Viewer:
    """Return the viewer for the argument `observation`.

    Parameters
    ----------
    observation
        A name of `OBSERVATIONS`, or ``"module:function"``, or a function of a `Seen`. A function
        returns an array or a dict of arrays. If the arrays of `Seen` have a leading axis of worlds,
        the result has it, too. The attribute `space` of the function is the Gymnasium space of one
        world. Without this attribute the function is called once, and the space has boxes of the
        shapes and types that it returns.
    hides_obstacles
        Whether ``"tokens"`` leaves obstacles out.

    Raises
    ------
    ValueError
        If the name is unknown, the path cannot be imported, or the type is wrong.
    """
    return Viewer(*chosen_view(observation, OBSERVATIONS), hides_obstacles=hides_obstacles)


@dataclass
class Viewer:
    """Converts the epochs of an environment to observations; call `space_of` first.

    `kind` is a name of `OBSERVATIONS`, or ``"own"`` for the custom view `function`;
    `hides_obstacles` leaves obstacle tokens out.
    """

    kind: str
    function: View | None = None
    hides_obstacles: bool = False
    n_boxes: int = 0
    space: spaces.Space[Any] | None = None

    def space_of(self, env: Any, scene: Any, inner: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the observation space of one world of `env`, whose own space is `inner`."""
        keys = set(inner.keys()) if isinstance(inner, spaces.Dict) else set()
        needed = {"angles", "station"} if "angles" in keys else {"ranges", "links", "anchors"}
        if not isinstance(inner, spaces.Dict) or not {*needed, "twist"} <= keys:
            if getattr(env.unwrapped, "inner", None) is not None:
                raise ValueError(
                    f"env must not run a filter already, got {env.unwrapped.__class__.__name__}: "
                    "leave out the wrapper, and pass filter=, options= and reward= to gym.make"
                )
            raise ValueError(
                "env must observe ranges, links, anchors and twist, or angles, station and "
                f"twist, got the space {inner}"
            )
        m, n = 1, len(scene.body[0] if scene.body.ndim > 2 else scene.body)
        if "ranges" in keys:
            m, n = inner["ranges"].shape or (m, n)
        if self.kind == "tokens":
            family = getattr(env.unwrapped, "family", None)
            most = len(scene.obstacles) if family is None else family.n_boxes
            self.n_boxes = 0 if self.hides_obstacles else most
            self.space = _space_of_tokens(m, n, self.n_boxes, "known" in keys)
        elif self.kind == "flat":
            size = 21 + (5 if "anchor_mask" in keys else 4) * m
            self.space = spaces.Box(-_LIMIT, _LIMIT, (size,), np.float32)
        elif self.kind == "dict":
            self.space = spaces.Dict({**inner.spaces, **_BELIEF})
        else:
            self.space = self._own_space(env, inner)
        return self.space

    def __call__(self, seen: Seen) -> Any:
        """Return the observation of an epoch; the caller may keep it."""
        if self.kind == "flat":
            return flat(seen)
        if self.kind == "tokens":
            return tokens(seen, self.n_boxes)
        if self.kind == "own":
            return self._own(seen)
        told, belief = seen.observation, seen.belief
        return {
            **told,
            "belief_rotation": belief.rotation,
            "belief_translation": belief.translation,
            "belief_covariance": belief.covariance,
        }

    def _own_space(self, env: Any, inner: spaces.Dict) -> spaces.Space[Any]:
        assert self.function is not None
        declared = getattr(self.function, "space", None)
        if isinstance(declared, spaces.Space):
            return declared
        with np.errstate(all="ignore"):
            return space_like(self.function(_example(env, inner)))

    def _own(self, seen: Seen) -> Any:
        assert self.function is not None
        return fitted(self.function(seen), seen.belief.translation.shape[:-1], self.space)


_BELIEF: dict[str, spaces.Space[Any]] = {
    "belief_rotation": spaces.Box(-1.001, 1.001, (3, 3), np.float64),
    "belief_translation": spaces.Box(-FAR, FAR, (3,), np.float64),
    "belief_covariance": spaces.Box(-(FAR**2), FAR**2, (6, 6), np.float64),
}


def _space_of_tokens(m: int, n: int, k: int, memory: bool) -> spaces.Dict:
    shapes = {
        "body": (_BODY,),
        "anchor_tokens": (m, _ANCHOR + 2 * memory),
        "tag_tokens": (n, _TAG),
        **({"obstacle_tokens": (k, _BOX)} if k else {}),
    }
    masks = {
        name.replace("_tokens", "_mask"): spaces.MultiBinary(shape[0])
        for name, shape in shapes.items()
        if name != "body"
    }
    boxes = {name: spaces.Box(-_LIMIT, _LIMIT, s, np.float32) for name, s in shapes.items()}
    return spaces.Dict({**boxes, **masks})


def _example(env: Any, inner: spaces.Dict) -> Seen:
    """Return the first epoch of a copy of the environment, of one world."""
    world = copy.deepcopy(env.unwrapped)
    observation, info = world.reset(seed=0)
    scene = world.scene
    if hasattr(world, "num_envs"):
        observation = {key: field[0] for key, field in observation.items()}
        info = {key: field[0] for key, field in info.items()}
        stack = getattr(world, "world", scene)
        scene = stack if isinstance(stack, Scene) else stack.scenes[0]
    nothing = {key: np.zeros(space.shape or (), space.dtype) for key, space in inner.items()}
    rotation = info["prior_rotation"]
    belief = PoseBelief(rotation, info["prior_translation"], info["prior_covariance"], rotation)
    return Seen({**nothing, **observation}, belief, scene)
