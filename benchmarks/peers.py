"""Our estimators beside other libraries on identical inputs: time side by side, same results.

- simdkalman (many trials that share H, F, Q, R) against the batched KF's shared covariance;
- stonesoup (one body) against the KF of one body, and of a batch of bodies of their own;
- gtsam (one epoch: Levenberg-Marquardt on ranges from anchors to tags on a Pose3) against the
  iterated EKF (predict, update and belief), both with a prior of the pose, and without one against
  `locate(method="ml")`, which besides refining a start, as gtsam does, looks for the start and for
  other solutions.

The peers get their models ready-made, whitened matrices or a factor graph, and start from our
start; ours start from ranges. simdkalman starts from ranges too, which one matrix product whitens
and compresses for it; in the rows "ready" it gets the result of that. The results are checked equal
first. Process time, one thread, medians over interleaved repeats. A peer that is not installed is
skipped: pip install '.[peers]'.

    python benchmarks/peers.py [--json F] [--repeats 7] [--seed 0]
"""

from __future__ import annotations

import side_by_side  # isort: skip

import datetime
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators, motion
from rbl_gym.estimators.linear.engines import transition
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging

SIZES = ((4, 5), (10, 6))
SQUARED = ranging.SquaredRangeNoise(0.05)
RANGES = ranging.RangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
DT, STEPS = 0.1, 5
PRIOR_RAD, PRIOR_M = 0.1, 0.5
REST = np.zeros(6)
TRIALS, BODIES, PROBLEMS, PEER_PROBLEMS = 1024, 8, 512, 20


class Duel(NamedTuple):
    """One peer against ours on the same inputs; `check` raises where the results differ."""

    title: str
    peer: side_by_side.Job
    ours: dict[str, side_by_side.Job]
    check: Callable[[], None]


def main() -> None:
    options = side_by_side.arguments(__doc__, repeats=7, seed=0)
    rows = []
    for make in (against_simdkalman, against_stonesoup, against_gtsam):
        for m, n in SIZES:
            rng = np.random.default_rng([options.seed, m, n])
            try:
                duels = make(rng, m, n)
            except ImportError as error:
                print(f"{make.__name__} skipped: {error}; pip install '.[peers]'")
                break
            for duel in duels:
                rows += measure(duel, f"{m}x{n}", options.repeats)
    print(f"{'M x N':<6} {'peer':<30} {'us':>10} {'ours':<24} {'us':>9} {'ratio':>8}")
    for row in rows:
        print(
            f"{row['size']:<6} {row['peer']:<30} {row['peer_microseconds']:10.2f} "
            f"{row['ours']:<24} {row['microseconds']:9.2f} {row['ratio']:8.3g}"
        )
    side_by_side.write(rows, options.json)


def measure(duel: Duel, size: str, repeats: int) -> list[dict[str, Any]]:
    """Check, then medians of interleaved repeats: a row for each way of ours."""
    duel.check()
    times = side_by_side.interleaved({"": duel.peer, **duel.ours}, repeats)
    rows = side_by_side.against(times.pop(""), times)
    return [{"size": size, "peer": duel.title, "ours": name, **row} for name, row in rows.items()]


def require_equal(what: str, got: np.ndarray, want: np.ndarray, tolerance: float) -> None:
    """Stop the run where two results differ."""
    difference = np.abs(got - want).max() / max(1.0, np.abs(want).max())
    if not difference <= tolerance:
        raise AssertionError(f"{what} differs by {difference:.3g}")


# --- Kalman filters of 12 states ---------------------------------------------------------------


class Tracks:
    """Trials among the same anchors, with fixed weights and one twist: shared F, H, Q, R."""

    def __init__(self, rng: np.random.Generator, m: int, n: int, trials: int) -> None:
        tags = rng.uniform(-0.5, 0.5, (n, 3))
        self.tags = tags - tags.mean(axis=0)
        places = rng.standard_normal((m, 3))
        self.anchors = 15 * places / np.linalg.norm(places, axis=-1, keepdims=True)
        self.twist = 0.5 * rng.standard_normal(6)
        rotation, translation = rotations.random(rng, (trials,)), rng.uniform(-3, 3, (trials, 3))
        start = rotations.exp(0.1 * rng.standard_normal((trials, 3))) @ rotation, translation
        self.ranges = []
        for _ in range(STEPS):
            rotation, translation = motion.propagate(rotation, translation, self.twist, DT)
            measured = ranging.simulate(
                self.anchors, self.tags, rotation, translation, SQUARED, rng
            )
            self.ranges.append(measured.ranges)
        self.weights = 1 / SQUARED.squared_range_variance(self.ranges[0][0])[:, 0]
        self.filter = estimators.make(
            "kf", tags=self.tags, noise=SQUARED, process=PROCESS, weights=self.weights
        )
        self.prior = self.filter.initial(*start, np.diag([0.02] * 3 + [1.0] * 3))

    def ours(self, trial: int | slice) -> Any:
        """Our filter over all steps of a trial, or of several at once."""
        mean, covariance, constrained = self.prior
        state = type(self.prior)(mean[trial], covariance, constrained[trial])
        for ranges in self.ranges:
            state = self.filter.predict(state, self.twist, DT)
            state = self.filter.update(state, ranges[trial], self.anchors)
        return state

    def apart(self) -> Any:
        """As `ours` of all, with a covariance for each trial, as bodies of their own have."""
        each = np.tile(self.prior.covariance, (len(self.prior.mean), 1, 1))
        state = self.prior._replace(covariance=each)
        for ranges in self.ranges:
            state = self.filter.predict(state, self.twist, DT)
            state = self.filter.update(state, ranges, self.anchors)
        return state

    def transition(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F, Q and the shift of the mean."""
        std = PROCESS.std()
        noise = DT * np.diag([std[0] ** 2] * 9 + [std[3] ** 2] * 3)
        shift = np.concatenate([np.zeros(9), self.twist[3:] * DT])
        return transition(rotations.exp(self.twist[:3] * DT)), noise, shift

    def model(self, *, short: bool) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Whitened H, and a function from ranges (trials, M, N) to z (trials, rows).

        ``|s|^2`` is projected out. Rows of the papers, (M - 1) N, or the twelve that tell as much
        where `short`. One matrix product gives z of all trials.
        """
        m, n = len(self.anchors), len(self.tags)
        root = np.sqrt(self.weights)
        basis = np.linalg.svd(root[:, None])[0][:, 1:]
        rows = basis.T @ (root[:, None] * (-2 * self.anchors))
        extended = np.concatenate([self.tags, np.ones((n, 1))], axis=1)
        H = np.kron(extended, rows)
        # Column m N + n: the effect of link (m, n).
        whitened = np.kron(np.eye(n), basis.T * root).reshape(-1, n, m)
        whitened = np.swapaxes(whitened, -1, -2).reshape(-1, m * n).T
        if short:
            Q, H = np.linalg.qr(H)
            whitened = whitened @ Q
        squares = (self.anchors**2).sum(axis=1)[:, None]

        def measured(ranges: np.ndarray) -> np.ndarray:
            return (ranges**2 - squares).reshape(len(ranges), -1) @ whitened

        return H, measured


def against_simdkalman(rng: np.random.Generator, m: int, n: int) -> list[Duel]:
    """Many trials with common matrices; the peer's covariance is one for all, too."""
    from simdkalman import primitives

    tracks = Tracks(rng, m, n, TRIALS)
    F, noise, shift = tracks.transition()

    def duel(*, short: bool, ready: bool) -> Duel:
        H, measured = tracks.model(short=short)
        unit = np.eye(len(H))
        known = [measured(ranges) for ranges in tracks.ranges]

        def peer() -> tuple[np.ndarray, np.ndarray]:
            mean, P = tracks.prior.mean[..., None], tracks.prior.covariance[None]
            for k, ranges in enumerate(tracks.ranges):
                z = known[k] if ready else measured(ranges)
                mean, P = primitives.predict(mean, P, F, noise)
                mean = mean + shift[:, None]
                mean, P = primitives.update(mean, P, H, unit, z[..., None])
            return mean[..., 0], P

        def check() -> None:
            mean, P = peer()
            state = tracks.ours(slice(None))
            require_equal("simdkalman: mean", state.mean, mean, 1e-8)
            require_equal("simdkalman: covariance", state.covariance, P[0], 1e-8)

        count = TRIALS * STEPS
        return Duel(
            f"simdkalman, {len(H)} rows{' ready' if ready else ''}",
            side_by_side.Job(peer, count),
            {"kf, shared covariance": side_by_side.Job(lambda: tracks.ours(slice(None)), count)},
            check,
        )

    return [duel(short=short, ready=ready) for ready in (False, True) for short in (False, True)]


def against_stonesoup(rng: np.random.Generator, m: int, n: int) -> list[Duel]:
    """One body after the other."""
    from stonesoup.models.control.linear import LinearControlModel
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState, State
    from stonesoup.updater.kalman import KalmanUpdater

    tracks = Tracks(rng, m, n, TRIALS)
    F, noise, shift = tracks.transition()
    H, measured = tracks.model(short=True)
    z = np.array([measured(ranges) for ranges in tracks.ranges])

    class Compressed(LinearGaussian):
        """The twelve rows: stonesoup's own model only selects states."""

        def matrix(self, **kwargs: Any) -> np.ndarray:
            return H

    model = Compressed(ndim_state=12, mapping=tuple(range(12)), noise_covar=np.eye(12))
    predictor = KalmanPredictor(
        LinearGaussianTimeInvariantTransitionModel(transition_matrix=F, covariance_matrix=noise),
        LinearControlModel(np.eye(12), control_noise=np.zeros((12, 12))),
    )
    updater = KalmanUpdater(model)
    control = State(shift[:, None])
    begin = datetime.datetime(2020, 1, 1)
    times = [begin + datetime.timedelta(seconds=DT * (k + 1)) for k in range(STEPS)]
    detections = [
        [Detection(z[k, trial][:, None], timestamp=times[k]) for k in range(STEPS)]
        for trial in range(BODIES)
    ]

    def peer() -> list[Any]:
        states = []
        for trial in range(BODIES):
            state: Any = GaussianState(
                tracks.prior.mean[trial][:, None], tracks.prior.covariance, timestamp=begin
            )
            for detection in detections[trial]:
                prediction = predictor.predict(
                    state, timestamp=detection.timestamp, control_input=control
                )
                state = updater.update(SingleHypothesis(prediction, detection))
            states.append(state)
        return states

    def one_by_one() -> None:
        for trial in range(BODIES):
            tracks.ours(trial)

    def check() -> None:
        together = tracks.apart()
        for trial, state in enumerate(peer()):
            ours = tracks.ours(trial)
            mean, P = np.asarray(state.state_vector, float)[:, 0], np.asarray(state.covar, float)
            for mine in (ours, type(ours)(*(field[trial] for field in together))):
                require_equal("stonesoup: mean", mine.mean, mean, 1e-8)
                require_equal("stonesoup: covariance", mine.covariance, P, 1e-8)

    return [
        Duel(
            "stonesoup, 12 rows",
            side_by_side.Job(peer, BODIES * STEPS),
            {
                "kf, one body": side_by_side.Job(one_by_one, BODIES * STEPS),
                f"kf, {TRIALS} bodies": side_by_side.Job(tracks.apart, TRIALS * STEPS),
            },
            check,
        )
    ]


# --- one epoch of ranges ------------------------------------------------------------------------


class Epochs:
    """One epoch of ranges each of many bodies, with a prior of their poses."""

    def __init__(self, rng: np.random.Generator, m: int, n: int) -> None:
        self.tags = rng.uniform(-0.5, 0.5, (n, 3))
        places = rng.standard_normal((PROBLEMS, m, 3))
        self.anchors = 15 * places / np.linalg.norm(places, axis=-1, keepdims=True)
        rotation = rotations.random(rng, (PROBLEMS,))
        translation = rng.uniform(-3, 3, (PROBLEMS, 3))
        self.ranges = ranging.simulate(
            self.anchors, self.tags, rotation, translation, RANGES, rng
        ).ranges
        self.filter = estimators.make("iekf", tags=self.tags, noise=RANGES, process=PROCESS)
        turned = rotations.exp(PRIOR_RAD * rng.standard_normal((PROBLEMS, 3))) @ rotation
        moved = translation + PRIOR_M * rng.standard_normal((PROBLEMS, 3))
        covariance = np.diag([PRIOR_RAD**2] * 3 + [PRIOR_M**2] * 3)
        self.prior = self.filter.initial(turned, moved, covariance)

    def iekf(self, which: int | slice, filter: Any = None) -> Any:
        """Belief of one body, or of several at once, after predict (at rest) and update."""
        filter = filter or self.filter
        state = type(self.prior)(*(field[which] for field in self.prior))
        state = filter.predict(state, REST, 0.0)
        return filter.belief(filter.update(state, self.ranges[which], self.anchors[which]))

    def locate(self, which: int | slice) -> Any:
        """Maximum likelihood of one epoch, or of several at once, without the prior."""
        return estimators.locate(self.ranges[which], self.anchors[which], self.tags, RANGES, "ml")


def against_gtsam(rng: np.random.Generator, m: int, n: int) -> list[Duel]:
    """Range factors with the tags as sensors on the body.

    Timed is the optimization of a graph that stands, and the same with its building, which every
    new epoch needs.
    """
    import gtsam

    epochs = Epochs(rng, m, n)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, RANGES.floor_m)
    turn = gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_RAD)
    shift = gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_M)
    known = gtsam.noiseModel.Constrained.All(3)
    offsets = [gtsam.Pose3(gtsam.Rot3(), tag) for tag in epochs.tags]
    # Timed with its own tolerances, compared with tight ones.
    usual, tight = gtsam.LevenbergMarquardtParams(), gtsam.LevenbergMarquardtParams()
    tight.setRelativeErrorTol(1e-12)
    tight.setAbsoluteErrorTol(1e-12)

    def build(k: int, start: tuple[np.ndarray, np.ndarray], *, prior: bool) -> tuple[Any, Any]:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3(start[0][k]), start[1][k])
        values.insert(0, pose)
        if prior:
            graph.add(gtsam.PoseRotationPrior3D(0, pose, turn))
            graph.add(gtsam.PoseTranslationPrior3D(0, pose, shift))
        for a, place in enumerate(epochs.anchors[k], start=1):
            values.insert(a, place)
            graph.add(gtsam.PriorFactorPoint3(a, place, known))
            for tag, offset in enumerate(offsets):
                measured = float(epochs.ranges[k, a - 1, tag])
                graph.add(gtsam.RangeFactorWithTransform3D(0, a, measured, noise, offset))
        return graph, values

    def solve(graph: Any, values: Any, options: Any = usual) -> Any:
        return gtsam.LevenbergMarquardtOptimizer(graph, values, options).optimize().atPose3(0)

    def duels(
        title: str,
        start: tuple[np.ndarray, np.ndarray],
        ours: tuple[str, Callable[[int | slice], Any]],
        exact: Callable[[], Any],
        *,
        prior: bool,
    ) -> list[Duel]:
        graphs = [build(k, start, prior=prior) for k in range(PEER_PROBLEMS)]

        def check() -> None:
            found = exact()
            for k, inputs in enumerate(graphs):
                pose = solve(*inputs, tight)
                require_equal("gtsam: rotation", found.rotation[k], pose.rotation().matrix(), 1e-5)
                require_equal("gtsam: translation", found.translation[k], pose.translation(), 1e-5)

        def one_by_one() -> None:
            for k in range(PROBLEMS):
                ours[1](k)

        jobs = {
            f"{ours[0]}, {PROBLEMS} epochs": side_by_side.Job(
                lambda: ours[1](slice(None)), PROBLEMS
            ),
            f"{ours[0]}, one epoch": side_by_side.Job(one_by_one, PROBLEMS),
        }
        ready = side_by_side.Job(lambda: [solve(*inputs) for inputs in graphs], PEER_PROBLEMS)
        built = side_by_side.Job(
            lambda: [solve(*build(k, start, prior=prior)) for k in range(PEER_PROBLEMS)],
            PEER_PROBLEMS,
        )
        return [
            Duel(f"gtsam {title}, graph ready", ready, jobs, check),
            Duel(f"gtsam {title}, graph built", built, jobs, check),
        ]

    everything = slice(None)
    exact = replace(epochs.filter, iterations=30)
    cls = estimators.locate(epochs.ranges, epochs.anchors, epochs.tags, RANGES, "cls")
    return [
        *duels(
            "with prior",
            (epochs.prior.rotation, epochs.prior.translation),
            ("iekf", epochs.iekf),
            lambda: epochs.iekf(everything, exact),
            prior=True,
        ),
        *duels(
            "from CLS",
            (cls.rotation, cls.translation),
            ("ml", epochs.locate),
            lambda: epochs.locate(everything),
            prior=False,
        ),
    ]


if __name__ == "__main__":
    main()
