"""Static localization against scipy: time per problem, side by side, same residuals.

1000 problems of 10 anchors and 6 tags in one call of `locate`, against
`scipy.optimize.least_squares` on the whitened range residuals of each problem, started from the
CLS pose (which favours it). Process time, one thread, medians over interleaved repeats; the
results are checked equal first.

    python benchmarks/static.py [--json F] [--repeats 5] [--seed 0]
"""

from __future__ import annotations

import side_by_side  # isort: skip

import numpy as np
from scipy.optimize import least_squares

from rbl_gym import estimators
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.worlds import scenes

PROBLEMS, PEER_PROBLEMS = 1000, 40
METHODS = ("ls", "cls", "procrustes", "two-step", "ml", "robust")


def main() -> None:
    options = side_by_side.arguments(__doc__, repeats=5, seed=0)
    results = {str(db): measure(db, options.repeats, options.seed) for db in (40, 60, 80)}
    side_by_side.print_rows(results, "dB", "method", "scipy")
    side_by_side.write(results, options.json)


def measure(db: int, repeats: int, seed: int) -> dict[str, side_by_side.Row]:
    """Medians per method at a reference range."""
    rng = np.random.default_rng([seed, db])
    scene = scenes.SCENES["icassp2013"]
    tags = bodies.icassp2013()
    noise = ranging.RangeNoise.from_reference_range_db(db)
    anchors = rng.uniform(-50, 50, (PROBLEMS, 10, 3))
    ranges = ranging.simulate(
        anchors, tags, scene.start_rotation, scene.start_translation, noise, rng
    ).ranges
    starts = estimators.locate(ranges, anchors, tags, noise, "cls")
    root = np.sqrt(1 / np.broadcast_to(noise.variance(ranges), ranges.shape))

    def peer(k: int) -> float:
        def residuals(x: np.ndarray) -> np.ndarray:
            positions = x[3:] + tags @ rotations.exp(x[:3]).T
            difference = positions[None] - anchors[k][:, None]
            distance = np.sqrt(np.einsum("mni,mni->mn", difference, difference))
            return (root[k] * (distance - ranges[k])).ravel()

        start = np.concatenate([rotations.log(starts.rotation[k]), starts.translation[k]])
        return least_squares(residuals, start).cost

    found = estimators.locate(ranges, anchors, tags, noise, "ml")
    costs = [peer(k) for k in range(PEER_PROBLEMS)]
    assert (found.cost[:PEER_PROBLEMS] <= np.array(costs) * (1 + 1e-6)).all()
    jobs = {
        "peer": side_by_side.Job(lambda: [peer(k) for k in range(PEER_PROBLEMS)], PEER_PROBLEMS)
    }
    for method in METHODS:
        jobs[method] = side_by_side.Job(
            lambda method=method: estimators.locate(ranges, anchors, tags, noise, method), PROBLEMS
        )
    times = side_by_side.interleaved(jobs, repeats)
    return side_by_side.against(times.pop("peer"), times)


if __name__ == "__main__":
    main()
