"""What several tests share: naive oracles and small worlds."""

from __future__ import annotations

import copy
import csv
import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rbl_gym import bounds, estimators, kernels, metrics, motion
from rbl_gym.bounds.smoothing import smoothing_crb
from rbl_gym.estimators import smoothing
from rbl_gym.estimators.filter import reads
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.progress import Advance

DATA = Path(__file__).parent / "data"
ROOT = Path(__file__).resolve().parents[1]


def needs(*packages: str) -> Any:
    """Marks a test of what these packages are for: extras that need not be installed."""
    missing = [name for name in packages if find_spec(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"needs {', '.join(missing)}")


# Whole logs and many filters side by side: minutes without kernels.
with_kernels = pytest.mark.skipif(not kernels.enabled(), reason="slow without kernels")


class Told(Advance):
    """Listens to a study's `advance`."""

    done = announced = 0

    def __call__(self, steps: int = 1, *, more: int = 0) -> None:
        self.done += steps
        self.announced += more


def twist_filters() -> list[str]:
    """Names of the filters whose `predict` is told a twist, not the readings of a sensor."""
    laws = {"noise": ranging.RangeNoise(0.1), "process": motion.ProcessNoise(0.1, 0.1)}
    made = ((n, estimators.make(n, tags=bodies.pyramid(1.0), **laws)) for n in estimators.names())
    return [name for name, filter in made if reads(filter) == "twist"]


def load(name: str) -> Any:
    """A reference file of tests/data."""
    return json.loads((DATA / name).read_text(encoding="utf-8"))


def reference_filter(name: str, track: Any, **options: Any) -> Any:
    """A filter with the laws of the reference file ``track.json``."""
    return estimators.make(
        name,
        tags=np.array(track["C"]).T,
        noise=ranging.SquaredRangeNoise(track["sigma"]),
        process=motion.ProcessNoise(track["sigma_q_rad"], track["sigma_t"]),
        **options,
    )


def over_bound(error: np.ndarray, bound: np.ndarray) -> list[float]:
    """RMSE of rotation and translation (..., 6) over their bound (..., 6, 6), pooled."""
    square, variance = np.square(error), np.diagonal(bound, axis1=-2, axis2=-1)
    pairs = ((square[..., k], variance[..., k]) for k in (slice(0, 3), slice(3, 6)))
    return [float(np.sqrt(a.sum(-1).mean() / b.sum(-1).mean())) for a, b in pairs]


def assert_bound(P: np.ndarray, Q: np.ndarray, want: dict[str, float]) -> None:
    """Assert the three figures of a bound (6, 6) in a reference file."""
    angle = np.rad2deg(metrics.expected_mean_angular_error(P, Q))
    np.testing.assert_allclose(angle, want["mean_angular_error_deg"], rtol=1e-9)
    frobenius = np.sqrt(2 * np.trace(P[:3, :3]))
    np.testing.assert_allclose(frobenius, want["rotation_frobenius_rmse"], rtol=1e-9)
    rmse = np.sqrt(np.trace(P[3:, 3:]))
    np.testing.assert_allclose(rmse, want["translation_rmse_m"], rtol=1e-9)


def changed_tables(tables: Any, path: str, value: object) -> dict:
    """Tables of a file with one entry changed, added at the end of a list, or out for None."""
    tables = copy.deepcopy(tables)
    *parents, key = path.split(".")
    node: Any = tables
    for parent in parents:
        node = node[int(parent)] if isinstance(node, list) else node.setdefault(parent, {})
    index: Any = int(key) if isinstance(node, list) else key
    if value is None:
        del node[index]
    elif isinstance(node, list) and index == len(node):
        node.append(value)
    else:
        node[index] = value
    return tables


def run_python(code: str) -> list[str]:
    """Lines of standard output of a fresh interpreter at the root of the checkout.

    An installed copy or an editable install must not help it.
    """
    keep = "import sys; sys.meta_path[:] = [f for f in sys.meta_path if '__editable__' not in "
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", f"{keep}str(f)]\n{code}"],
        cwd=ROOT,
        env=variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def random_world(rng: np.random.Generator, m: int, n: int, batch: tuple[int, ...] = ()):
    """Anchors in a 20 m cube, tags within a metre, a pose, all of a batch."""
    anchors = rng.uniform(-10, 10, (*batch, m, 3))
    tags = rng.uniform(-0.5, 0.5, (n, 3))
    return anchors, tags, rotations.random(rng, batch), rng.uniform(-3, 3, (*batch, 3))


def textbook_model(ranges, anchors, tags, weights, links=None):
    """Whitened H (K x 12) and z (K) of the squared ranges with |s|^2 projected out by U_M.

    Straight from the papers: per tag the rows W^1/2 (-2 A^T), projected onto the complement
    of W^1/2 1. One trial, plain loops.
    """
    rows, values = [], []
    m, n = ranges.shape
    weights = np.broadcast_to(weights, (m, n))
    for tag in range(n):
        w = weights[:, tag] * (1 if links is None else links[:, tag])
        root = np.sqrt(w)
        # U_M: complement of W^1/2 1; nothing to project where the tag has no link.
        basis = np.linalg.svd(root[:, None])[0][:, 1:] if root.any() else np.eye(m)
        d = ranges[:, tag] ** 2 - (anchors**2).sum(axis=1)
        small = basis.T @ (root[:, None] * (-2 * anchors))
        rows.append(np.kron(np.append(tags[tag], 1.0)[None], small))
        values.append(basis.T @ (root * d))
    return np.concatenate(rows), np.concatenate(values)


def simulate(rng, anchors, tags, rotation, translation, noise):
    """Ranges of one epoch."""
    return ranging.simulate(anchors, tags, rotation, translation, noise, rng).ranges


def draw_biases(law, times, links, rng, batch=()):
    """Biases (..., K, links) of a `LinkBias` at times (K,)."""
    normals = rng.standard_normal((len(times), *batch, links + 1))
    drawn = law.std_m * normals[..., :links] + law.common_std_m * normals[..., links:]
    for k, step in enumerate(np.diff(times)):
        kept = law.decay(step)
        drawn[k + 1] = kept * drawn[k] + (1 - kept**2) ** 0.5 * drawn[k + 1]
    return np.moveaxis(drawn, 0, -2)


def smoothed_trials(scene, trials: int, seed: int, offset: str | None = None):
    """Smoothed episodes of a scene with a known twist: result, pose errors, and their bound."""
    world = monte_carlo.simulate_trials(scene, trials, np.random.default_rng(seed))
    told: Any = monte_carlo.told_readings(scene, world.episode, world.measurements)
    episode = world.episode
    times = np.cumsum([reading.dt for reading in told])
    twists = np.stack([reading.twist for reading in told[1:]], axis=1)
    ranges, anchors = np.stack([r.ranges for r in told], axis=1), episode.anchors[:, None]
    log = smoothing.RangeLog(times, ranges, anchors)
    prior = episode.prior_rotation, episode.prior_translation, episode.prior_covariance
    filter = monte_carlo.scene_filter(scene, "iekf", {})
    start = smoothing.causal_track(filter, log, prior, twists)
    twist = smoothing.KnownTwist(scene.process, twists)
    found = smoothing.smooth(
        log, smoothing.LogModel(scene.body, scene.noise, twist, offset=offset), prior, start
    )
    truth = episode.rotation, episode.translation
    error = metrics.pose_error(found.rotation, found.translation, *truth)
    limit = smoothing_crb(
        bounds.RangeEpoch(anchors, scene.body, *truth, scene.noise),
        bounds.KnownTwist(twists, scene.dt, scene.process),
        episode.prior_covariance,
        offset=offset,
    )
    return found, error, limit


def is_legal(task, anchors):
    """Whether each anchor (..., M) is at a legal position of the scene."""
    return np.abs(task.scene.anchor_region.project(anchors) - anchors).max(axis=-1) <= 1e-6


def assert_same(got: Any, want: Any, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Equal through dicts and sequences, arrays to the tolerances (0: to the last bit)."""
    if isinstance(want, dict):
        assert got.keys() == want.keys()
        for key in want:
            assert_same(got[key], want[key], rtol, atol)
    elif isinstance(want, list | tuple) or getattr(getattr(want, "dtype", None), "kind", "") == "O":
        assert len(got) == len(want)
        for a, b in zip(got, want, strict=True):
            assert_same(a, b, rtol, atol)
    elif want is None or isinstance(want, str):
        assert got == want
    else:
        assert np.asarray(got).dtype.kind == np.asarray(want).dtype.kind
        np.testing.assert_allclose(got, want, rtol=rtol, atol=atol)


def assert_table_holds(table: Path, result: Any, least: int) -> None:
    """Each row of a CSV file is a path in the figures and what stands there."""
    header, *rows = csv.reader(table.read_text(encoding="utf-8").splitlines())
    assert header[-1] == "value"
    assert len(rows) >= least
    for *path, value in rows:
        node = result
        for key in filter(None, path):
            node = node[int(key)] if isinstance(node, list) else node[key]
        assert str(node) == value


def score_by_hand(P: np.ndarray, rotation: np.ndarray, tags: np.ndarray) -> float:
    """b = sqrt(mean_n tr(J_n P J_n^T)), J_n = [-[Q c_n]x, I]: the RMS error of the tags."""
    total = 0.0
    for x, y, z in tags @ rotation.T:
        J = np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)])
        total += np.trace(J @ P @ J.T)
    return (total / len(tags)) ** 0.5


def share_by_hand(scene, anchor: np.ndarray, point: np.ndarray) -> float:
    """Share of a link's information: points along the sight are tried against every obstacle."""
    along = anchor + np.linspace(0, 1, 4001)[:, None] * (np.asarray(point) - anchor)
    for box in np.array(scene.obstacles).reshape(-1, 6):
        if (np.abs(along - box[:3]) <= box[3:]).all(axis=1).any():
            return scene.blocked_information
    return 1.0


def law_by_hand(scene, anchors: np.ndarray, rotation: np.ndarray, translation: np.ndarray):
    """The scene's noise law at a pose, link by link where obstacles change it."""
    if not scene.obstacles:
        return scene.noise
    places = np.array(scene.tags) @ rotation.T + translation
    distances = np.linalg.norm(places - anchors[:, None], axis=-1)
    share = np.array([share_by_hand(scene, anchor, translation) for anchor in anchors])
    return ranging.LinkNoise(np.sqrt(scene.noise.variance(distances) / share[:, None]))
