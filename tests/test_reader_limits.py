"""Numbers and nesting that no file of the kind has are named, and so is what an environment
cannot be made or reset with: what the fuzz tests found, by message."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import checks, wrappers
from rbl_gym.envs import batch
from rbl_gym.envs.network import PlanarNetworkEnv
from rbl_gym.envs.placement import AnchorPlacementEnv
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.placement import scene_files
from rbl_gym.studies.learning import policies
from tests.test_recordings import CALIBRATION, LONG, LONG_STD, PLANAR, TRUTH, write_and_read


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ({"ranges": LONG.replace("0.1,B", "1e12,B")}, "line 5, column 't': must be at most 1e"),
        (
            {"ranges": LONG_STD.replace("2.5,0.1", "2.5,1e9")},
            "line 2, column 'std': must be .*no longer than",
        ),
        (
            {"calibration": CALIBRATION.replace("3.5,0", "-1e300,-0.9999999999")},
            "line 3, column 'bias_m': corrected ranges must be at most 10000 m",
        ),
        ({"truth": PLANAR.replace("180", "1e60")}, "line 3, column 'yaw_deg': must be at most"),
        ({"truth": TRUTH.replace("0.6", "1e200")}, "line 3, column 'qw': .* got inf"),
    ],
)
def test_recordings(tmp_path, texts, message):
    with pytest.raises(ValueError, match=message):
        write_and_read(tmp_path, **texts)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.json", b"[" * 100_000, "a.json: maximum recursion depth"),
        ("a.json", b"9" * 5000, "a.json: Exceeds the limit"),
        ("a.toml", b"a = " + b"[" * 100_000, "a.toml: "),
        ("a.toml", b"\xff", "a.toml: 'utf-8' codec"),
        ("a.json", b"{}", "a.json: the file must have the key 'anchors'"),
    ],
    ids=["nested", "digits", "nested toml", "no text", "empty"],
)
def test_scene_files(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=message):
        scene_files.problem(str(tmp_path / name))


def test_a_policy_whose_archive_points_before_its_begin(tmp_path):
    path = tmp_path / "p.npz"
    policies.save(policies.Policy((np.ones((1, 2)),), (np.ones(1),), "box", {}), path)
    data = path.read_bytes()
    end = data.rindex(b"PK\x05\x06")
    path.write_bytes(data[: end + 16] + b"\xff\xff\xff\x0f" + data[end + 20 :])
    with pytest.raises(ValueError, match=r"p.npz is not a policy of rbl-gym: "):
        policies.load(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PlanarNetworkEnv(n_nodes=10**9), "n_nodes must be an int from 2 to 10000, got 10"),
        (lambda: PlanarNetworkEnv(n_nodes=1), "n_nodes must be an int from 2 to 10000, got 1"),
        (lambda: PlanarNetworkEnv(render_mode=np.ones(2)), "render_mode must be None or"),  # pyrefly: ignore[bad-argument-type]
        (lambda: AnchorPlacementEnv(mirror=np.ones(2)), "mirror must be True or False, got"),  # pyrefly: ignore[bad-argument-type]
        (
            lambda: checks.check_count("num_envs", 10**9, most=9),
            "num_envs must be an int from 1 to 9",
        ),
        (lambda: batch.reset_mask("x", 2), "options must be a dict or None, got 'x'"),  # pyrefly: ignore[bad-argument-type]
        (lambda: batch.reset_mask({"reset_mask": [[1], [1, 2]]}, 2), "reset_mask must be an array"),
        (lambda: batch.seeds_of("ab", 2), "seed must be an int, a list of ints or None, got 'ab'"),  # pyrefly: ignore[bad-argument-type]
        (lambda: batch.seeds_of([1], 2), r"seed must have 2 seeds, .* got \[1\]"),
        (lambda: batch.seeds_of([1, 1.5], 2), "seed must be a non-negative int or None"),  # pyrefly: ignore[bad-argument-type]
        (lambda: batch.seeds_of(-1, 2), "seed must be a non-negative int .* got -1"),
        (
            lambda: wrappers.EstimatePose(TrackingEnv(), options={1: 2}),  # pyrefly: ignore[bad-assignment]
            "options must be a dict of names and values, or None, got {1: 2}",
        ),
    ],
)
def test_environments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_ragged_actions():
    for env in (TrackingEnv(), PlanarNetworkEnv()):
        with pytest.raises(gym.error.ResetNeeded):
            env.step(0)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"action must be an array, got \[\[1\], \[1, 2\]\]"):
            env.step([[1], [1, 2]])
