"""Recordings of simulated bodies, for tests of replay, and their files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rbl_gym import motion
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.recordings import Recording, Truth
from rbl_gym.studies import replay

ROOM = np.array([[0, 0, 0.3], [8, 0, 2.7], [8, 6, 0.3], [0, 6, 2.7], [4, 0, 2.0], [8, 3, 0.5]])
# Of `honest_track`.
STD_RAD, STD_M = 0.03, 0.03
CORNERS = np.array([[0, 0, 0], [8, 0, 3], [8, 8, 0], [0, 8, 3.0]])


def recording(times, ranges, anchors, tags, truth=None, **more) -> Recording:
    """Ranges (K, M, N), measured where above 0; anchors A0, A1, ..., tags T0, T1, ..."""
    anchor_ids, tag_ids = (
        tuple(f"{letter}{k}" for k in range(ranges.shape[axis]))
        for letter, axis in (("A", 1), ("T", 2))
    )
    return Recording(
        times, ranges, ranges > 0, None, anchors, tags, anchor_ids, tag_ids, truth, **more
    )


def flight(tags, move=lambda times: ROOM, biases=0.0, count=60, shift=0.0) -> Recording:
    """A body that turns and flies through a room, its anchors at ``move(times)``."""
    rng = np.random.default_rng(1)
    twists = motion.constant_twist(np.eye(3), [2, 2, 1.2], [0.0, 0, 0.3, 0.4, 0.1, 0], count - 1)
    path = motion.simulate(twists, 0.1, motion.ProcessNoise())
    times = 0.1 * np.arange(count)
    anchors = np.array(move(times))
    points = ranging.tag_positions(path.rotation, path.translation, tags)
    exact = ranging.distances(anchors, points)
    off = biases * rng.standard_normal(exact.shape[1:])
    ranges = exact + off + 0.05 * rng.standard_normal(exact.shape)
    truth = Truth(times, path.rotation, path.translation + shift)
    return recording(times, ranges, anchors + shift, tags, truth)


def swaying(times: np.ndarray) -> np.ndarray:
    """Each anchor of `flight` on a circle of 1 m."""
    phase = times[:, None] + np.arange(len(ROOM))
    return ROOM + np.stack([np.cos(phase), np.sin(phase), np.zeros_like(phase)], axis=-1)


def curve(times):
    """Poses on a curve that speeds up and slows down, turns and tilts."""
    turn = np.stack([0.3 * np.sin(0.7 * times), 0.2 * np.cos(times), 0.4 * times], axis=-1)
    place = np.stack(
        [3 + 2 * np.sin(0.5 * times), 3 + 1.5 * np.sin(0.8 * times), 1 + 0.4 * np.cos(times)], -1
    )
    return rotations.exp(turn), place


def honest_track(truth, times, tags, seed=0):
    """A recording with this truth, and a track of `curve` with the errors it expects."""
    rng = np.random.default_rng(seed)
    rotation, place = curve(times)
    rotation = rotations.exp(STD_RAD * rng.standard_normal(place.shape)) @ rotation
    place = place + STD_M * rng.standard_normal(place.shape)
    P = np.diag([STD_RAD**2] * 3 + [STD_M**2] * 3)
    track = replay.Track(times, rotation, place, np.tile(P, (len(times), 1, 1)))
    ranges = np.full((len(times), len(CORNERS), len(tags)), 5.0)
    return recording(times, ranges, CORNERS, tags, truth), track


def table(path: Path, header: str, rows) -> str:
    """The path of a file of CSV with these rows; what is NaN has no text."""
    texts = (",".join("" if cell != cell else str(cell) for cell in row) for row in rows)
    path.write_text("\n".join([header, *texts, ""]), encoding="utf-8")
    return str(path)


def points(path: Path, name: str, places) -> str:
    """A file of these places, called 0, 1, ..."""
    return table(path, f"{name},x,y,z", ([i, *place] for i, place in enumerate(places)))


def walk(epochs: int, seed: int):
    """Anchors, tags, times, ranges and path of a body that turns and flies through a room."""
    tags = bodies.octahedron(0.8)
    anchors = np.array([[0, 0, 0], [8, 0, 3], [8, 8, 0], [0, 8, 3], [4, 0, 3], [4, 8, 0.0]])
    twists = motion.constant_twist(np.eye(3), [2, 2, 1], [0, 0.05, 0.3, 0.2, 0.2, 0.02], epochs - 1)
    path = motion.simulate(twists, 0.2, motion.ProcessNoise())
    noise, rng = ranging.RangeNoise(0.03), np.random.default_rng(seed)
    ranges = ranging.simulate(anchors, tags, *path, noise, rng).ranges
    return anchors, tags, 0.2 * np.arange(epochs), ranges, path


def files(folder: Path, anchors, tags, times, ranges, truth=None) -> dict[str, str]:
    """Files of ranges (K, M, N), points and poses, by the names of their options."""
    pairs = np.ndindex(ranges.shape[1:])
    header = ",".join(["t", *(f"a{m}t{n}" for m, n in pairs)])
    written = {
        "ranges": table(folder / "ranges.csv", header, np.c_[times, ranges.reshape(len(times), -1)])
    }
    for name, places in (("anchor", anchors), ("tag", tags)):
        written[f"{name}s"] = points(folder / f"{name}s.csv", name, places)
    if truth is not None:
        rows = np.c_[times, truth[1], rotations.quaternion(truth[0])]
        written["truth"] = table(folder / "truth.csv", "t,x,y,z,qw,qx,qy,qz", rows)
    return written


def options(files: dict) -> list[str]:
    """What tells a command of these files."""
    return [part for name, path in files.items() for part in (f"--{name}", str(path))]
