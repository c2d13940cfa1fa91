"""Frames of a rigid body among anchors: the world, a close-up of the body, errors over epochs."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from rbl_gym import metrics
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.rendering import panels
from rbl_gym.rendering.drawing import Image
from rbl_gym.rendering.film import Film, check_mode, mapped
from rbl_gym.rendering.shots import Pose, Shot, Stage
from rbl_gym.worlds.scene import Scene

LABELS = ("position [m]", "rotation [deg]")


def film_of(render_mode: str | None, scene: Scene, title: str | None = None) -> Film | None:
    """Return a film of a scene, titled by its name; None without rendering."""
    if check_mode(render_mode) is None:
        return None
    return Film(functools.partial(frame, _stage(scene, title)), scene.steps)


def film_of_many(
    render_mode: str | None, scene_of: Callable[[int], Scene], steps: int
) -> Film | None:
    """Return a film of worlds with different scenes, whose anchors are padded in the shots."""
    if check_mode(render_mode) is None:
        return None
    return Film(functools.partial(_frame_of_many, scene_of), steps)


def _frame_of_many(
    scene_of: Callable[[int], Scene],
    world: int,
    epochs: np.ndarray,
    shots: Sequence[Shot],
    beliefs: Sequence[Pose | None],
) -> Image:
    scene = scene_of(world)
    m = scene.n_anchors
    own = [
        shot._replace(anchors=shot.anchors[:, :m], measuring=shot.measuring[:, :m])
        for shot in shots
    ]
    return frame(_stage(scene), world, epochs, own, beliefs)


def _stage(scene: Scene, title: str | None = None) -> Stage:
    corners = [*scene.volume.bounds()]
    if scene.anchors is not None:
        corners += list(np.asarray(scene.anchors))
    # Fixed anchors at given positions do not need their region.
    if scene.anchors is None or scene.anchor_speed_m_s > 0 or scene.prisms:
        corners += [*scene.anchor_region.bounds()]
    for box in np.reshape(scene.obstacles, (-1, 2, 3)):
        corners += [box[0] - box[1], box[0] + box[1]]
    return Stage(
        title or scene.name,
        tuple(np.min(corners, axis=0)),
        tuple(np.max(corners, axis=0)),
        scene.tags,
        scene.obstacles,
        scene.steps,
        scene.dt,
        scene.prisms,
    )


def _around(stage: Stage, points: FloatArray) -> Stage:
    """Return the stage with a smaller box, if the points (K, 3) use a small part of it.

    A side keeps a multiple of an eighth of its length, so that the box rarely changes.
    """
    low, high = np.array(stage.low), np.array(stage.high)
    step = np.maximum(high - low, 1e-9) / 8
    first = np.clip(np.floor((np.nanmin(points, axis=0) - low) / step), 0, 7)
    last = np.clip(np.ceil((np.nanmax(points, axis=0) - low) / step), first + 1, 8)
    first[2], last[2] = 0, 8  # heights always show the ground
    if max((last - first)[:2]) > 4 or len(stage.obstacles) or len(stage.prisms.corners):
        return stage
    return dataclasses.replace(stage, low=tuple(low + first * step), high=tuple(low + last * step))


def shot(
    links: BoolArray,
    anchors: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    bound: FloatArray | None = None,
) -> Shot:
    """Return a shot: links (B, M, N), anchors (B, M, 3), poses, optional bounds (B, 6, 6)."""
    return Shot(anchors, np.asarray(links.any(axis=-1)), Pose(rotation, translation, bound))


def frame(
    stage: Stage,
    world: int,
    epochs: np.ndarray,
    shots: Sequence[Shot],
    beliefs: Sequence[Pose | None],
) -> Image:
    """Draw the last epoch of an episode in 3-D and close up, and the errors of all epochs."""
    last, belief = (mapped(lambda field: field[world], part) for part in (shots[-1], beliefs[-1]))
    source = (
        "belief" if belief is not None else "bound" if last.truth.covariance is not None else ""
    )
    shown = {"belief": belief, "bound": last.truth, "": None}[source]
    errors, bands = _curves(world, [shot.truth for shot in shots], beliefs)
    headline = f"epoch {epochs[-1]} of {stage.steps}, {epochs[-1] * stage.dt:.1f} s"
    if source == "belief":
        headline += f"      error {errors[0, -1]:.3f} m, {errors[1, -1]:.2f}°"
    picture, left, upper, lower = panels.empty()
    path = np.array([shot.truth.translation[world] for shot in shots])
    seen = [path, *(shot.anchors[world] for shot in shots)]
    panels.world(_around(stage, np.concatenate(seen))).paint(path, last, shown, headline, left)
    panels.close_up(stage, source).paint(path, last.truth, belief, shown, upper)
    limits = tuple(limits_of(*both) for both in zip(bands, errors, strict=True))
    legend = "error" if source == "belief" else "", rf"3$\sigma$ of the {source}" if source else ""
    strips = panels.strips(stage.steps, limits, LABELS, legend)
    strips.paint(epochs, errors, bands, lower)
    return picture


def _curves(
    world: int, truth: Sequence[Pose], beliefs: Sequence[Pose | None]
) -> tuple[FloatArray, FloatArray]:
    """Return errors and three standard deviations (2, K) of position (m) and rotation (deg)."""
    errors, bands = np.full((2, len(truth)), np.nan), np.full((2, len(truth)), np.nan)
    of_belief = any(belief is not None for belief in beliefs)
    shown = beliefs if of_belief else truth
    rows = [k for k, pose in enumerate(shown) if pose is not None and pose.covariance is not None]
    if not rows:
        return errors, bands
    rotation, translation, covariance = (
        np.array([shown[k][field][world] for k in rows])  # pyrefly: ignore[unsupported-operation]
        for field in range(3)
    )
    bands[:, rows] = 3 * _lengths(np.diagonal(covariance, axis1=-2, axis2=-1))
    if of_belief:
        true = (np.array([truth[k][field][world] for k in rows]) for field in range(2))  # pyrefly: ignore[unsupported-operation]
        errors[:, rows] = _lengths(metrics.pose_error(rotation, translation, *true) ** 2)
    return errors, bands


def _lengths(squares: FloatArray) -> FloatArray:
    """Return roots (2, K) of the sums of squares (K, 6): metres, degrees."""
    return np.sqrt([squares[:, 3:].sum(axis=-1), np.rad2deg(1) ** 2 * squares[:, :3].sum(axis=-1)])


def limits_of(band: FloatArray, error: FloatArray) -> tuple[float, float]:
    """Return limits of a logarithmic axis in steps of 1, 3, 10, so that they rarely change."""
    both = np.concatenate([band, error])
    if not np.isfinite(both).any():
        return 0.1, 10.0
    least = float(np.nanmin(band if np.isfinite(band).any() else error)) / 30
    return _step(least, below=True), _step(1.2 * float(np.nanmax(both)), below=False)


def _step(value: float, below: bool) -> float:
    """Return the next of ..., 1, 3, 10, ... below or above a positive value."""
    decade = 10.0 ** math.floor(math.log10(max(value, 1e-12)))
    if below:
        return decade * (3 if value >= 3 * decade else 1)
    return decade * (1 if value <= decade else 3 if value <= 3 * decade else 10)
