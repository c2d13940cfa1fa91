"""Write the simulated log in `examples/log/`: a robot with 4 tags in a room with 8 anchors.

    python examples/simulate_log.py --out examples/log

The robot drives an ellipse at about 0.5 m/s for 20 s. Five percent of the ranges are lost and 3 %
are 0.5 to 2 m too long (reflections). The standard deviation of the others is 0.1 m.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rbl_gym.measurements import ranging

ANCHORS = np.array(
    [[0, 0, 2.6], [10, 0, 0.4], [10, 8, 2.4], [0, 8, 0.6],
     [5, 0, 1.2], [10, 4, 2.8], [5, 8, 1.6], [0, 4, 0.2]]
)  # fmt: skip
TAGS = np.array([[0.3, 0.25, 0.1], [0.3, -0.25, 0.1], [-0.3, 0.25, 0.3], [-0.3, -0.25, 0.0]])


def write(path: Path, header: str, rows: list[str]) -> None:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("examples/log"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(args.seed)

    times = np.arange(0, 20, 0.2)
    angle = 2 * np.pi * times / 30
    translation = np.stack(
        [5 + 2.5 * np.cos(angle), 4 + 1.8 * np.sin(angle), np.full_like(angle, 0.3)], axis=-1
    )
    heading = np.arctan2(1.8 * np.cos(angle), -2.5 * np.sin(angle))
    attitude = Rotation.from_euler("z", heading[:, None])

    noise = ranging.RangeNoise(floor_m=0.1)
    ranges = ranging.simulate(
        ANCHORS, TAGS, attitude.as_matrix(), translation, noise, rng
    ).ranges  # (epochs, anchors, tags)
    reflected = rng.random(ranges.shape) < 0.03
    ranges = ranges + reflected * rng.uniform(0.5, 2.0, ranges.shape)
    kept = rng.random(ranges.shape) > 0.05

    rows = [
        f"{times[k]:.1f},{m},{n},{ranges[k, m, n]:.3f}" for k, m, n in np.argwhere(kept).tolist()
    ]
    write(args.out / "ranges.csv", "t,anchor,tag,range", rows)
    for name, places in (("anchor", ANCHORS), ("tag", TAGS)):
        rows = [f"{i},{x:g},{y:g},{z:g}" for i, (x, y, z) in enumerate(places.tolist())]
        write(args.out / f"{name}s.csv", f"{name},x,y,z", rows)
    poses = np.column_stack([times, translation, attitude.as_quat()[:, [3, 0, 1, 2]]])
    rows = [",".join(f"{value:.4f}" for value in pose) for pose in poses.tolist()]
    write(args.out / "truth.csv", "t,x,y,z,qw,qx,qy,qz", rows)


if __name__ == "__main__":
    main()
