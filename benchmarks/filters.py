"""The batched Kalman filters against filterpy: time per trial and step, side by side, same results.

One step is predict and update, from ranges to state, weights included; filterpy has a
KalmanFilter per trial and is given the whitened measurement matrix ready-made, (M - 1) N rows.
Process time, one thread, medians over interleaved repeats; the results are checked equal first.

    python benchmarks/filters.py [--json F] [--repeats 7] [--trials 1024] [--seed 0]
"""

from __future__ import annotations

import side_by_side  # isort: skip

from collections.abc import Callable
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from rbl_gym import estimators, motion
from rbl_gym.estimators.linear.engines import transition
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging

SIZES = {(4, 5): 20, (10, 6): 10, (50, 20): 1}  # peer trials for each (M, N)
NOISE, RANGES = ranging.SquaredRangeNoise(0.05), ranging.RangeNoise(0.05, 0.001)
PROCESS = motion.ProcessNoise(0.02, 0.1)
DT = 0.1
STEPS = 5


def main() -> None:
    options = side_by_side.arguments(__doc__, repeats=7, trials=1024, seed=0)
    results = {
        f"{m}x{n}": measure(m, n, options.trials, options.repeats, options.seed) for m, n in SIZES
    }
    side_by_side.print_rows(results, "M x N", "path", "filterpy")
    side_by_side.write(results, options.json)


def measure(m: int, n: int, trials: int, repeats: int, seed: int) -> dict[str, side_by_side.Row]:
    """Medians per path at one number of anchors and tags."""
    rng = np.random.default_rng([seed, m, n])
    worlds = {
        "kf": World(rng, "kf", m, n, trials),
        "kf-ortho": World(rng, "kf-ortho", m, n, trials),
        "et-kf": World(rng, "et-kf", m, n, trials),
        "uc-kf": World(rng, "uc-kf", m, n, trials),
        "kf, one covariance": World(rng, "kf", m, n, trials, fixed=True),
        "kf, noise of each link": World(rng, "kf", m, n, trials, noise=RANGES),
    }
    for path, world in worlds.items():
        world.check(n_trials=SIZES[m, n], path=path)
    peer = worlds["kf"].peer(range(SIZES[m, n]))
    jobs = {"peer": side_by_side.Job(peer, STEPS * SIZES[m, n])}
    jobs |= {path: side_by_side.Job(w.run, STEPS * trials) for path, w in worlds.items()}
    times = side_by_side.interleaved(jobs, repeats)
    return side_by_side.against(times.pop("peer"), times)


class World:
    """Trials of one filter, and the same trials for filterpy."""

    def __init__(
        self,
        rng: np.random.Generator,
        name: str,
        m: int,
        n: int,
        trials: int,
        *,
        fixed: bool = False,
        noise: ranging.NoiseLaw = NOISE,
    ) -> None:
        tags = rng.uniform(-0.5, 0.5, (n, 3))
        tags -= tags.mean(axis=0)
        self.tags, self.name, self.trials, self.noise = tags, name, trials, noise
        # On a shell around the body: no anchor stands on a tag.
        places = rng.standard_normal((m, 3) if fixed else (trials, m, 3))
        self.anchors = 15 * places / np.linalg.norm(places, axis=-1, keepdims=True)
        rotation, translation = rotations.random(rng, (trials,)), rng.uniform(-3, 3, (trials, 3))
        twists = 0.5 * rng.standard_normal((trials, 6))
        self.twist = twists[0] if fixed else twists
        self.ranges = []
        start = rotations.exp(0.1 * rng.standard_normal((trials, 3))) @ rotation, translation
        for _ in range(STEPS):
            rotation, translation = motion.propagate(rotation, translation, self.twist, DT)
            measured = ranging.simulate(self.anchors, tags, rotation, translation, noise, rng)
            self.ranges.append(measured.ranges)
        self.weights = 1 / NOISE.squared_range_variance(self.ranges[0][0])[:, 0] if fixed else None
        self.filter = estimators.make(
            name, tags=tags, noise=noise, process=PROCESS, weights=self.weights
        )
        self.prior = self.filter.initial(*start, np.diag([0.02] * 3 + [1.0] * 3))

    def run(self) -> Any:
        """All steps of all trials."""
        state = self.prior
        for ranges in self.ranges:
            state = self.filter.update(
                self.filter.predict(state, self.twist, DT), ranges, self.anchors
            )
        return state

    def peer(self, which: range) -> Callable[[], list[KalmanFilter]]:
        """filterpy's filters of some trials, their models ready-made; a call runs all steps."""
        inputs = [[self._model(k, ranges[k]) for ranges in self.ranges] for k in which]
        twists = [self.twist if self.twist.ndim == 1 else self.twist[k] for k in which]
        std = PROCESS.std()
        noise = DT * np.diag([std[0] ** 2] * 9 + [std[3] ** 2] * 3)

        def run() -> list[KalmanFilter]:
            filters = []
            for k, models, twist in zip(which, inputs, twists, strict=True):
                kf = KalmanFilter(dim_x=12, dim_z=len(models[0][1]), dim_u=3)
                kf.x, kf.P = self.prior.mean[k][:, None].copy(), self.prior.covariance.copy()
                kf.F, kf.Q = transition(rotations.exp(twist[:3] * DT)), noise
                kf.B = np.vstack([np.zeros((9, 3)), np.eye(3)])
                kf.R = np.eye(len(models[0][1]))
                for H, z in models:
                    kf.predict(u=twist[3:, None] * DT)
                    kf.update(z[:, None], H=H)
                filters.append(kf)
            return filters

        return run

    def check(self, n_trials: int, path: str) -> None:
        """Mean (of KF) and covariance equal filterpy's, or the run stops."""
        state = self.run()
        covariances = np.broadcast_to(state.covariance, (self.trials, 12, 12))
        for k, kf in enumerate(self.peer(range(n_trials))()):
            scale = np.abs(kf.P).max()
            if np.abs(covariances[k] - kf.P).max() > 1e-8 * scale:
                raise AssertionError(f"{path}: covariance differs from filterpy's")
            if self.name == "kf" and np.abs(state.mean[k] - kf.x[:, 0]).max() > 1e-8:
                raise AssertionError(f"{path}: mean differs from filterpy's")

    def _model(self, k: int, ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened H and z of one epoch, ``|s|^2`` projected out by U_M, as in the papers."""
        anchors = self.anchors if self.anchors.ndim == 2 else self.anchors[k]
        weights = self.weights
        if weights is None:
            weights = 1 / self.noise.squared_range_variance(ranges)
        weights = np.broadcast_to(weights.reshape(len(anchors), -1), ranges.shape)
        d = ranges**2 - (anchors**2).sum(axis=1)[:, None]
        H, z = [], []
        for tag, root, told in zip(self.tags, np.sqrt(weights).T, d.T, strict=True):
            basis = np.linalg.svd(root[:, None])[0][:, 1:]
            H.append(np.kron([*tag, 1.0], basis.T @ (root[:, None] * (-2 * anchors))))
            z.append(basis.T @ (root * told))
        return np.concatenate(H), np.concatenate(z)


if __name__ == "__main__":
    main()
