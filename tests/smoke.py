"""What an installed wheel must do, outside the checkout: python -W error tests/smoke.py."""

from __future__ import annotations

import contextlib
import io
import json
import math
import sys
import sysconfig
import tempfile
from pathlib import Path

import gymnasium as gym

import rbl_gym
import rbl_gym.estimators
import rbl_gym.wrappers
from rbl_gym.app import cli


def check_where_it_stands() -> None:
    """All three folders come from the installed package, under their one name."""
    site = Path(sysconfig.get_paths()["purelib"]).resolve()
    for module, place in {
        rbl_gym: "rbl_gym",
        rbl_gym.estimators: "rbl_gym/estimators",
        rbl_gym.wrappers: "rbl_gym/wrappers",
    }.items():
        assert module.__file__ is not None
        assert Path(module.__file__).resolve() == site / place / "__init__.py", module.__file__
    assert list(map(Path, rbl_gym.__path__)) == [Path(rbl_gym.__file__).parent], rbl_gym.__path__
    assert (site / "rbl_gym" / "py.typed").is_file()
    assert not {"estimators", "wrappers"} & sys.modules.keys()


def check_filters() -> None:
    """Every filter tracks an episode."""
    names = rbl_gym.estimators.names()
    assert {"kf", "uc-kf", "et-kf", "kf-ortho", "iekf"} <= set(names)
    for name in names:
        scene = {"name": "uwb_room", "steps": 20}
        if name == "iekf-imu":
            scene["inertial"] = "consumer"
        env = gym.make("rbl_gym:RBL/Tracking-v0", scene=scene)
        env = rbl_gym.wrappers.EstimatePose(env, name)
        _, info = env.reset(seed=0)
        truncated, steps = False, 0
        while not truncated:
            _, reward, _, truncated, info = env.step(0)
            steps += 1
            assert math.isfinite(reward), name
        assert steps == 20, name
        assert info["tag_error_m"] < 0.5, (name, info["tag_error_m"])


def check_demo() -> None:
    """The demo writes its figures and its picture."""
    with tempfile.TemporaryDirectory() as folder:
        plot, figures = Path(folder, "x.png"), Path(folder, "x.json")
        arguments = ["demo", "--trials", "5", "--plot", str(plot), "--json", str(figures)]
        with contextlib.redirect_stdout(io.StringIO()) as table:
            assert cli.main(arguments) == 0
        assert str(plot) in table.getvalue()
        result = json.loads(figures.read_text(encoding="utf-8"))
        assert plot.read_bytes().startswith(b"\x89PNG")
    assert (result["experiment"], result["trials"], result["seed"]) == ("camsap2013", 5, 0)
    assert set(result["filters"]) == {"KF", "KF-ortho", "ET-KF", "UC-KF", "iterated EKF"}
    assert len(result["bound"]["rotation_rmse"]) == 20
    for filter in result["filters"].values():
        assert 0 < filter["rotation_rmse"] < 3
        assert len(filter["per_step"]["translation_rmse_m"]) == 20
    assert {"statement", "holds", "figures"} <= result["claims"][0].keys()


if __name__ == "__main__":
    check_where_it_stands()
    check_filters()
    check_demo()
    sys.stdout.write("smoke: ok\n")
