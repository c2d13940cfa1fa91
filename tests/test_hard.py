"""rbl-gym reproduce hard, a part of it, run in this process."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from rbl_gym import metrics
from rbl_gym.app.cli import main
from rbl_gym.studies import hard, monte_carlo
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scenes import SCENES
from tests.helpers import Told, assert_table_holds


@pytest.fixture
def part(monkeypatch):
    """One scene, shorter, one condition; two starts of the scene whose anchors lie in a plane."""
    room = dataclasses.replace(SCENES["uwb_room"], steps=25)
    monkeypatch.setitem(SCENES, "uwb_room", room)
    monkeypatch.setattr(hard, "LINK_SCENES", ("uwb_room",))
    kept = ("10 % NLOS",)
    monkeypatch.setattr(hard, "CONDITIONS", {name: hard.CONDITIONS[name] for name in kept})
    monkeypatch.setattr(hard, "START_SCENES", ("auv_buoys",))
    monkeypatch.setattr(hard, "STARTS", ("wrong", "wrong, 10 % NLOS"))
    monkeypatch.setattr(hard, "_START_STEPS", max(hard.AFTER) + 1)


def test_reproduce_prints_plots_and_writes_the_same_figures_everywhere(part, tmp_path, capsys):
    picture, table, figures = (tmp_path / f"x.{kind}" for kind in ("png", "csv", "json"))
    arguments = ["reproduce", "hard", "--trials", "4", "--plot", str(picture)]
    assert main([*arguments, "--csv", str(table), "--json", str(figures)]) == 0
    text = capsys.readouterr().out
    assert "iekf-bank, volume" in text
    assert "10 % NLOS" in text
    assert picture.stat().st_size > 20_000
    result = json.loads(figures.read_text())
    assert_table_holds(table, result, least=50)
    told = Told()
    again = hard.compare_hard_conditions(4, 0, told)
    assert told.done == told.announced > 0
    for one in (result, again):
        for row in one["links"]["uwb_room"].values():
            for figure in row["filters"].values():
                assert figure.pop("microseconds_per_step") > 0
        for rows in one["starts"]["scenes"]["auv_buoys"].values():
            for row in rows.values():
                assert row.pop("microseconds_per_step") > 0
    assert result == again
    of_nlos = result["links"]["uwb_room"]["10 % NLOS"]
    assert of_nlos["share_good"] == pytest.approx(0.9, abs=0.02)
    assert of_nlos["filters"]["iekf"]["lost_ever"] == 1.0
    assert of_nlos["filters"]["iekf/robust=true"]["lost_ever"] == 0.0
    assert result["starts"]["scenes"]["auv_buoys"]["wrong"]["iekf-bank"]["back"][-1] == 1.0


def test_the_bound_of_good_links_by_hand():
    """An episode whose bound is taken with its own links has the bound of its world."""
    scene = hard.scenes.get({"name": "uwb_room", "steps": 5, "links": {"drop_probability": 0.4}})
    world = monte_carlo.simulate_trials(scene, 3, np.random.default_rng(1))
    links = np.array([m.links for m in world.measurements])
    np.testing.assert_allclose(monte_carlo.bound_of(scene, world.episode, links), world.bound)
    error = np.random.default_rng(2).standard_normal((6, 3, 6))
    np.testing.assert_allclose(
        hard._squared_distance(error, world.bound), metrics.nees(error, world.bound)
    )


def test_in_an_outage_filters_hear_and_know_nothing():
    case = hard._start("uwb_room", "outage", 2, np.random.default_rng(3))
    gone = hard._GONE
    for epoch, measured in enumerate(case.trials.measurements):
        assert measured.links.any() == (epoch not in gone)
    twists = case.trials.episode.twists
    # The interval that ends at the first epoch with links belongs to the outage too.
    assert not twists[:, gone.start : gone.stop + 1].any()
    assert twists[:, gone.start - 1].any()
    assert twists[:, gone.stop + 1].any()
    truth = simulation.epoch_of(case.trials.episode, gone.stop).translation
    before = simulation.epoch_of(case.trials.episode, gone.start - 1).translation
    assert np.linalg.norm(truth - before, axis=-1).max() > 1.0
