"""Bounds by motion model and unknowns: the command, and its function."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from rbl_gym import bounds
from rbl_gym.app.cli import main
from rbl_gym.measurements.inertial import SENSORS
from rbl_gym.studies import monte_carlo, what_if
from rbl_gym.worlds import scenes, simulation

SCENE = {"name": "uwb_room", "steps": 8}


@pytest.fixture(scope="module")
def found():
    return what_if.what_if(SCENE, 4, 1)


def row(found, motion, unknown="none"):
    (one,) = [r for r in found["rows"] if (r["motion"], r["unknown"]) == (motion, unknown)]
    return one


def test_rows_with_nothing_unknown_are_the_bounds_of_the_scenes(found):
    scene = scenes.get({**SCENE, "inertial": "consumer"})
    drawn = monte_carlo.simulate_trials(scene, 4, np.random.default_rng(1))
    square = np.diagonal(drawn.bound, axis1=-2, axis2=-1)
    got = row(found, "consumer IMU")
    assert got["position_m"] == pytest.approx(np.sqrt(square[..., 3:].sum(-1).mean()), rel=1e-9)
    late = square[len(square) // 2 :, :, 3:].sum(-1).mean()
    assert got["late_position_m"] == pytest.approx(np.sqrt(late), rel=1e-9)
    # And with the known twist, by the plain recursion.
    J, squares = np.linalg.inv(scene.prior_covariance), []
    for k in range(9):
        at = simulation.epoch_of(drawn.episode, k)
        J = bounds.posterior_crb_step(
            J, drawn.episode.anchors, scene.tags, at.rotation, at.translation, scene.noise,
            at.twist, scene.dt if k else 0.0, scene.process,
        )  # fmt: skip
        squares.append(np.diagonal(np.linalg.inv(J), axis1=-2, axis2=-1))
    turn = np.rad2deg(np.sqrt(np.array(squares)[..., :3].sum(-1).mean()))
    assert row(found, "known twist")["rotation_deg"] == pytest.approx(turn, rel=1e-9)


def test_what_is_not_known_costs_and_what_tells_more_gains(found):
    motions = {r["motion"] for r in found["rows"]}
    assert motions == {"ranges alone", "known twist", *(f"{name} IMU" for name in SENSORS)}
    for motion in motions:
        surveys = [f"anchors to {100 * std:g} cm" for std in what_if.SURVEYS_M]
        errors = [row(found, motion, u)["position_m"] for u in ("none", *surveys)]
        assert (np.diff(errors) > 0).all()
        for unknown in ("biases of links", "offset of each tag"):
            assert row(found, motion, unknown)["tags_m"] > row(found, motion)["tags_m"]
    tactical, consumer = (row(found, f"{name} IMU") for name in ("tactical", "consumer"))
    assert tactical["late_rotation_deg"] < consumer["late_rotation_deg"]
    assert consumer["late_rotation_deg"] < row(found, "ranges alone")["late_rotation_deg"]
    assert found["uncalibrated"]["std_m"] == what_if.UNCALIBRATED.std_m


def test_the_command_prints_the_same(found, capsys, tmp_path):
    file = tmp_path / "short.json"
    file.write_text(json.dumps(SCENE))
    arguments = ["bounds", "--scene", str(file), "--trials", "4", "--seed", "1"]
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found
    assert main(arguments) == 0
    assert "tactical IMU" in capsys.readouterr().out


def test_a_scene_keeps_what_is_its_own():
    own: dict[str, Any] = {**SCENE, "steps": 2, "links": {"offset": "tag"}, "survey_std_m": 0.05}
    own["inertial"] = {"kind": "consumer", "gyro_noise": 1e-3}
    found = what_if.what_if(own, 2, 0)
    unknowns = {r["unknown"] for r in found["rows"]}
    assert unknowns == {"none", "anchors to 10 cm", "biases of links"}
    assert row(found, "own IMU")["rotation_deg"] > row(found, "consumer IMU")["rotation_deg"]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("camsap2013", "prior must be 'drawn' in a scene with an inertial sensor"),
        ({**SCENE, "dt": 0.013}, "rate_hz must give a whole number of samples"),
        ("nowhere", "scene must be one of"),
    ],
)
def test_what_has_no_answer_is_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        what_if.what_if(spec, 2, 0)
