"""Checks whether a placement problem is solvable; errors name the table of the file."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.regions import Walls
from rbl_gym.placement.building import Problem, Zone, cube, free_places
from rbl_gym.placement.file_walls import show

# Number of positions of a zone checked for free ones and for the distance to a mount.
_PLACES = 1000
# Points on a line deviate by less than this fraction of their extent.
_FLAT = 1e-9


def check_problem(problem: Problem) -> Problem:
    """Return the problem; raises ValueError if it is not solvable."""
    for zone in problem.zones:
        _check_room(problem, zone)
    _check_tags(problem)
    _check_fixed(problem)
    for index, zone in enumerate(problem.zones):
        name = zone.name if zone.name == "region" else f"zones[{index}] ({zone.name!r})"
        _check_zone(problem, zone, name)
    if problem.obstacles.contain(problem.mounts.draw(cube(4000))).all():
        raise ValueError("no anchor can be mounted: obstacles cover all permitted positions")
    check_numbers(problem)
    return problem


def _check_room(problem: Problem, zone: Zone) -> None:
    """Check that in a room the body works inside; below the lowest mounts is allowed."""
    if not isinstance(problem.mounts, Walls):
        return
    low, high = zone.bounds()
    floor, ceiling = problem.mounts.bounds()
    if (low[:2] < floor[:2]).any() or (high > ceiling).any():
        raise ValueError(
            f"{zone.name} must lie inside the room, got {show(low)} to {show(high)} in a room "
            f"{show(floor)} to {show(ceiling)}"
        )


def _check_tags(problem: Problem) -> None:
    """Check that the tags can determine what each zone requires."""
    tags = problem.tags
    spread = np.linalg.svd(tags - tags.mean(axis=0), compute_uv=False)
    if len(tags) > 2 and spread[1] > _FLAT * max(spread[0], 1e-300):
        return
    flat = np.ptp(tags[:, :2], axis=0).max() > _FLAT
    for zone in problem.zones:
        if zone.attitude == "heading" and (flat or zone.heading_deg is None):
            continue
        if zone.name != "region" and zone.heading_deg is None and zone.position_m is not None:
            continue
        if zone.attitude == "heading":
            raise ValueError(
                f"tags must not all lie on one vertical line, as zone {zone.name!r} requires a "
                "heading"
            )
        raise ValueError(
            f"tags must be at least 3 and not on one line, got {len(tags)}: ranges do not "
            "determine the rotation of such a body. Fewer tags are enough in [[zones]] with "
            'attitude = "heading", or with position_m as the only requirement'
        )


def _check_fixed(problem: Problem) -> None:
    held = problem.obstacles.contain(problem.fixed)
    if held.any():
        index = int(held.argmax())
        raise ValueError(
            f"anchors.fixed[{index}] = {show(problem.fixed[index])} lies inside an obstacle, "
            "which blocks its links: move it in front of the obstacle's face"
        )


def _check_zone(problem: Problem, zone: Zone, name: str) -> None:
    """Check that a zone has free positions, and mounts within reach."""
    low, high = zone.bounds()
    for index, (centre, half) in enumerate(problem.obstacles.boxes.reshape(-1, 2, 3)):
        if (centre - half <= low).all() and (centre + half >= high).all():
            raise ValueError(f"obstacles[{index}] covers the whole {name}")
    places = free_places(zone, problem.obstacles, _PLACES)
    if not len(places):
        where = "region" if name == "region" else name
        raise ValueError(f"obstacles leave no free place in {'the ' * (name == 'region')}{where}")
    nearest = np.linalg.norm(problem.mounts.project(places) - places, axis=-1).min()
    for anchor in problem.fixed:
        nearest = min(nearest, np.linalg.norm(anchor - places, axis=-1).min())
    extent = _extent(problem)
    if name != "region" and nearest > extent:
        raise ValueError(
            f"{name} is {nearest:.4g} m from the nearest mount, farther than the size of the "
            f"building ({extent:.4g} m): are its coordinates in metres, and in the axes of this "
            "building?"
        )
    if nearest >= problem.gain.max_range_m:
        raise ValueError(
            f"{name} is {nearest:.4g} m from the nearest mount, beyond anchors.max_range_m = "
            f"{problem.gain.max_range_m:g}"
        )


def _extent(problem: Problem) -> float:
    """Return the diagonal of the box around mounts, obstacles and fixed anchors."""
    prisms = problem.obstacles.prisms
    points: list[FloatArray] = [np.array(problem.mounts.bounds()), problem.fixed]
    points += [
        box[None, :3] + sign * box[None, 3:] for box in problem.obstacles.boxes for sign in (-1, 1)
    ]
    plan = prisms.corners.reshape(-1, 2)
    points.append(np.column_stack([plan, np.repeat(prisms.low_m, prisms.corners.shape[1])]))
    return float(np.linalg.norm(np.ptp(np.concatenate(points), axis=0)))


def check_numbers(problem: Problem) -> None:
    """Check that the fixed anchors fit in the number of anchors, and the others on the mounts."""
    n_fixed = len(problem.fixed)
    if problem.n_anchors < n_fixed:
        raise ValueError(
            f"the number of anchors must be at least {n_fixed}, as it includes those of "
            f"anchors.fixed; got {problem.n_anchors}"
        )
    listed = problem.mounts.listed()
    if listed is not None and len(listed) < problem.n_anchors - n_fixed:
        raise ValueError(
            f"mounts have {len(listed)} permitted points, too few for the "
            f"{problem.n_anchors - n_fixed} anchors that are not fixed"
        )
