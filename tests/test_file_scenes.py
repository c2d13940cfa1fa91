"""`scene=` a building file: its walls, body, noise and anchors in every environment."""

from __future__ import annotations

import json
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rbl_gym import placement
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.geometry.obstacles import Prisms
from rbl_gym.placement import scene_files
from rbl_gym.placement.file_lines import line_of
from rbl_gym.placement.file_scenes import scene_of_file
from rbl_gym.rendering import body
from rbl_gym.worlds import scenes
from rbl_gym.wrappers import EstimatePose
from tests.helpers import ROOT, needs
from tests.side_by_side import assert_contract

WAREHOUSE = str(ROOT / "examples" / "warehouse.toml")
# Two walls of different materials, a rack, a limit of range, two fixed anchors of four.
FLOOR = """
name = "floor"

[anchors]
kind = "room"
low = [0.0, 0.0, 0.5]
high = [12.0, 8.0, 3.0]
number = 4
max_range_m = 9.0
range_edge_m = 3.0
half_angle_deg = 80.0
angle_edge_deg = 20.0
fixed = [[0.0, 0.0, 3.0], [12.0, 8.0, 3.0]]

[region]
low = [1.0, 1.0, 0.5]
high = [11.0, 7.0, 2.0]

[materials]
brick = 0.2
glass = 0.8

[[walls]]
line = [[6.0, 0.0], [6.0, 5.0]]
thickness_m = 0.2
low_m = 0.0
high_m = 3.0
material = "brick"

[[walls]]
line = [[6.0, 5.0], [9.0, 5.0]]
thickness_m = 0.1
low_m = 0.0
high_m = 3.0
material = "glass"

[[obstacles]]
low = [2.0, 2.0, 0.0]
high = [3.0, 4.0, 2.0]

[body]
shape = "octahedron"
size_m = 0.8

[noise]
floor_m = 0.05
blocked_information = 0.1

[prior]
rotation_deg = 8.0
position_m = 0.4
"""


@pytest.fixture
def floor(tmp_path):
    path = tmp_path / "floor.toml"
    path.write_text(FLOOR, encoding="utf-8")
    return str(path)


def test_the_scene_is_what_the_file_says(floor):
    scene, problem = scenes.get(floor), scene_files.problem(floor)
    assert scene.name == "floor"
    assert scene.volume.bounds()[1].tolist() == [11.0, 7.0, 2.0]
    np.testing.assert_allclose(scene.body, problem.tags)
    assert scene.noise == problem.noise
    assert (scene.n_anchors, len(scene.fixed), scene.anchors) == (4, 2, None)
    assert scene.initial_rotation_rad == pytest.approx(np.deg2rad(8.0))
    assert scene.initial_translation_m == 0.4
    assert len(scene.prisms) == 2
    assert len(scene.obstacles) == 1
    # What a link keeps, as `rbl-gym place` computes it.
    rng = np.random.default_rng(1)
    anchors = scene.anchor_region.draw(rng.random((40, 3)))
    env = TrackingEnv({"name": floor, "anchors": anchors.tolist()})
    observation, info = env.reset(seed=1)
    want = problem.share(anchors, info["translation"][None])[0]
    np.testing.assert_allclose(observation["quality"], want, rtol=1e-9, atol=1e-12)
    assert len(np.unique(want.round(9))) > 4
    np.testing.assert_array_equal(observation["links"].any(axis=1), want > 0)


def test_fixed_anchors_stay_and_the_others_are_drawn(floor):
    env = TrackingEnv(floor)
    first, second = (env.reset(seed=seed)[0]["anchors"] for seed in (1, 2))
    np.testing.assert_array_equal(first[:2], [[0, 0, 3], [12, 8, 3]])
    np.testing.assert_array_equal(second[:2], first[:2])
    assert (first[2:] != second[2:]).any(axis=1).all()
    region = env.scene.anchor_region
    np.testing.assert_allclose(region.project(first), first, atol=1e-9)


def test_the_filter_is_honest_behind_walls(floor):
    env = EstimatePose(TrackingEnv({"name": floor, "steps": 10, "n_anchors": 8}, "none"))
    nees = []
    for seed in range(40):
        env.reset(seed=seed)
        for _ in range(10):
            nees.append(env.step(0)[-1]["nees"])
    # 400 epochs of 6 degrees of freedom, correlated within 40 episodes.
    assert 4.5 < np.mean(nees) < 7.5


ENVS: dict[str, tuple[str, dict[str, Any]]] = {
    "tracking": ("Tracking", {}),
    "selection": ("AnchorSelection", {"k": 2, "observation": "tokens"}),
    "craft": ("MobileAnchors", {"anchor_speed_m_s": 1.0, "fixed": []}),
    "shared": ("SharedAnchors", {}),
    "placement": ("AnchorPlacement", {}),
    "mounts": ("AnchorPlacement", {"mode": "mounts"}),
    "one-shot": ("AnchorPlacement", {"mode": "one-shot"}),
    "filter": ("AnchorPlacement", {"reward": "filter"}),
}
SCENE = ("anchor_speed_m_s", "fixed")


@pytest.mark.parametrize("kind", ENVS)
def test_every_environment_takes_a_file(kind, floor):
    name, arguments = ENVS[kind]
    changes = {key: value for key, value in arguments.items() if key in SCENE}
    arguments = {key: value for key, value in arguments.items() if key not in SCENE}
    arguments["scene"] = {"name": floor, "steps": 4, **changes}
    name = f"rbl_gym:RBL/{name}-v0"
    assert_contract(name, **arguments)
    env: Any = gym.make(name, render_mode="rgb_array", **arguments)
    env.reset(seed=3)
    assert np.shape(env.render())[2] == 3


@pytest.mark.parametrize("mode", ["sequential", "mounts"])
def test_placement_counts_the_fixed_anchors_and_the_walls(mode, floor):
    """The score by hand: information of all four anchors, each by its share."""
    env: Any = gym.make("rbl_gym:RBL/AnchorPlacement-v0", scene=floor, mode=mode)
    task, problem = env.unwrapped.task, scene_files.problem(floor)
    assert task.n_anchors == 2
    env.reset(seed=3)
    for _ in range(2):
        *_, info = env.step(env.action_space.sample())
    places = info["region"][:3] + task.poses[1] * info["region"][3:]
    anchors = np.concatenate([problem.fixed, info["anchors"]])
    share = problem.share(anchors, places)
    total = 0.0
    for rotation, place, shares in zip(task.poses[0], places, share, strict=True):
        information = task.prior_information.copy()
        J = []
        for tag in task.scene.body:
            x, y, z = rotation @ tag
            J.append(np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)]))
        for anchor, one in zip(anchors, shares, strict=True):
            for tag, jacobian in zip(task.scene.body, J, strict=True):
                gap = rotation @ tag + place - anchor
                row = gap / np.linalg.norm(gap) @ jacobian
                information += one / 0.05**2 * np.outer(row, row)
        P = np.linalg.inv(information)
        total += np.mean([np.trace(one @ P @ one.T) for one in J])
    assert info["score_m"] == pytest.approx(np.sqrt(total / len(places)), rel=1e-9)


def test_a_layout_gives_the_anchors(tmp_path):
    layout = tmp_path / "layout.csv"
    layout.write_text("name,x_m,y_m,z_m\na,-20,-10,4\nb,20,10,4\nc,0,10,5\n", encoding="utf-8")
    scene = {"name": WAREHOUSE, "layout": str(layout), "steps": 3}
    env = gym.make("rbl_gym:RBL/Tracking-v0", scene=scene)
    observation, _ = env.reset(seed=1)
    np.testing.assert_array_equal(observation["anchors"], [[-20, -10, 4], [20, 10, 4], [0, 10, 5]])
    assert scenes.get({"name": "hall", "layout": str(layout)}).n_anchors == 3
    with pytest.raises(ValueError, match="either anchors or layout, got both"):
        scenes.get({**scene, "anchors": [[0, 0, 0]]})
    layout.write_text("x_m,y_m,z_m\n1,2,3\n1,two,3\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"layout.csv, line 3, column y_m: must be a number"):
        scenes.get(scene)


def test_files_are_members_of_families():
    family = [{"name": WAREHOUSE, "steps": 3, "n_anchors": {"integers": [3, 5]}}, "uwb_room"]
    env = gym.make("rbl_gym:RBL/Tracking-v0", scenes=family)
    check_env(env.unwrapped, skip_render_check=True)
    _, info = env.reset(seed=3)
    assert json.loads(info["scene"])["name"] in (WAREHOUSE, "uwb_room")


def test_walls_of_different_files_do_not_mix(floor):
    with pytest.raises(
        ValueError, match="must all come from one file, got 'uwb_room' beside 'floor'"
    ):
        gym.make("rbl_gym:RBL/Tracking-v0", scenes=[floor, "uwb_room"])
    with pytest.raises(ValueError, match="scenes must have no walls"):
        gym.make("rbl_gym:RBL/AnchorPlacement-v0", scenes=[floor])
    family = [{"name": floor, "noise": {"floor_m": {"uniform": [0.02, 0.1]}}, "steps": 4}]
    check_env(gym.make("rbl_gym:RBL/Tracking-v0", scenes=family).unwrapped, skip_render_check=True)


def test_a_file_that_changed_is_read_again(floor):
    first = scene_of_file(floor)
    assert scene_of_file(floor) is first
    text = FLOOR.replace("number = 4", "number = 6")
    with open(floor, "w", encoding="utf-8") as file:
        file.write(text)
    assert scene_of_file(floor).n_anchors == 6


@needs("shapely")
def test_the_office_of_the_examples():
    env = gym.make("rbl_gym:RBL/Tracking-v0", scene=str(ROOT / "examples" / "office.toml"))
    check_env(env.unwrapped, skip_render_check=True)
    assert env.unwrapped.scene.n_anchors == 8  # pyrefly: ignore[missing-attribute]


# --- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ('kind = "room"', "kind = room", r"floor.toml: Invalid value \(at line 5"),
        ("floor_m = 0.05", "floor_m = -0.05", r"noise.*-0.05.* \(line 46\)"),
        ("brick = 0.2", "brick = 2.0", r"materials.brick must be .* \(line 20\)"),
        ('material = "glass"', 'material = "tin"', r"walls\[1\].material.*'tin'.*\(line 35\)"),
        ("number = 4", "number = 4\ncolour = 3", r"anchors.*colour.*\(line 9\)"),
    ],
)
def test_errors_name_file_and_line(tmp_path, before, after, named):
    path = tmp_path / "floor.toml"
    path.write_text(FLOOR.replace(before, after), encoding="utf-8")
    with pytest.raises(ValueError, match=r"floor\.toml") as caught:
        gym.make("rbl_gym:RBL/Tracking-v0", scene=str(path))
    with pytest.raises(ValueError, match=named):
        raise caught.value
    line = int(str(caught.value).split("line ")[1].split(",")[0].rstrip(")"))
    assert path.read_text(encoding="utf-8").splitlines()[line - 1] == after.splitlines()[-1]


def test_lines_are_found_by_table_and_key():
    text = "a = 1\n[one]\nx = 1  # y = 2\ny = 2\n[[two]]\nz = 1\n[[two]]\nz = 2\n"
    for message, line in (
        ("one.y must be", 4), ("one has", 2), ("two[1].z", 8), ("two[0]", 5), ("a must", 1),
        ("two[2].z", None), ("three", None), ("[odd", None), ("one.w", 2),
    ):  # fmt: skip
        assert line_of(text, message) == line


def test_what_is_no_file_is_named():
    with pytest.raises(ValueError, match=r"there is no file 'nowhere\.toml'"):
        scenes.get("nowhere.toml")
    with pytest.raises(ValueError, match="scene must be one of 'uwb_room'"):
        scenes.get("nowhere.txt")
    with pytest.raises(ValueError, match="fixed must hold positions of at most n_anchors = 1"):
        scenes.get({"name": "hall", "n_anchors": 1, "fixed": [[0, 0, 1], [1, 1, 1]]})


def test_prisms_are_equal_by_their_numbers():
    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    one, same, other = (Prisms.of([square], 0.0, high) for high in (2.0, 2.0, 3.0))
    assert one == same
    assert hash(one) == hash(same)
    assert one != other
    assert placement.task(WAREHOUSE).scene == placement.task(WAREHOUSE).scene


# --- scene files ------------------------------------------------------------------------------

ROOM = {
    "name": "uwb_room",
    "title": "my room",
    "volume": {"low": [0.5, 0.5, 0.5], "high": [5.5, 4.5, 2.0]},
    "anchors": [[0, 0, 2.4], [6, 0, 0.3], [6, 5, 2.4], [0, 5, 0.3], [3, 0, 2.4]],
    "steps": 5,
}


def test_a_scene_file_is_the_scene_of_its_overrides(tmp_path):
    path = tmp_path / "room.json"
    path.write_text(json.dumps(ROOM))
    made = scenes.get(ROOM)
    assert (made.name, made.n_anchors, made.steps) == ("my room", 5, 5)
    assert scenes.get(str(path)) == made
    assert scenes.get({"name": str(path), "steps": 7}) == scenes.get({**ROOM, "steps": 7})
    assert (
        scenes.get({"name": str(path), "links": {"drop_probability": 0.2}}).anchors == made.anchors
    )
    with pytest.raises(
        ValueError, match=r"n_anchors must be 5, the number of anchors in .*, got 6"
    ):
        scenes.get({"name": str(path), "n_anchors": 6})
    drawn = scenes.get({"name": str(path), "n_anchors": 6, "anchors": None})
    assert (drawn.anchors, drawn.n_anchors) == (None, 6)
    toml = tmp_path / "hall.toml"
    toml.write_text('name = "hall"\nsteps = 3\n')
    assert scenes.get({"name": str(toml), "n_anchors": 6}).anchors is None
    assert scenes.get(str(toml)) == scenes.get({"name": "hall", "steps": 3})
    kinds: dict[str, dict[str, Any]] = {"Tracking": {}, "AnchorSelection": {"k": 2}}
    for name, arguments in kinds.items():
        env: Any = gym.make(f"rbl_gym:RBL/{name}-v0", scene=str(path), **arguments)
        assert env.unwrapped.scene == made
    path.write_text(json.dumps({"name": "auv_craft", "steps": 4}))
    for text in (str(path), {"name": str(path)}):
        craft: Any = gym.make("rbl_gym:RBL/MobileAnchors-v0", scene=text, difficulty="hard")
        assert (craft.unwrapped.scene.n_anchors, craft.unwrapped.scene.steps) == (2, 4)
    path.write_text(json.dumps(ROOM))
    drawn: Any = gym.make("rbl_gym:RBL/Tracking-v0", scenes=[str(path), str(path)])
    drawn.reset(seed=1)
    assert drawn.unwrapped.scene.name == "my room"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ({**ROOM, "anchor": 3}, "has no field 'anchor'"),
        ({**ROOM, "title": 3}, "scene.title must be a text, got 3"),
        ({**ROOM, "name": "my room"}, "must be one of 'uwb_room', "),
        ({**ROOM, "name": "my room"}, "A world of your own changes the values of a named scene"),
        (
            {**ROOM, "name": "itself"},
            "must be a named scene or a building file, got the scene file",
        ),
        (
            {**ROOM, "anchor_speed_m_s": 1.0, "anchors": [[0, 0, 9.0]] * 5},
            "anchors that move must start in anchor_region, but anchors[0] is 6 m outside",
        ),
    ],
)
def test_errors_of_a_scene_file_name_the_file_and_the_field(text, message, tmp_path):
    path = tmp_path / "room.json"
    if text["name"] == "itself":
        text = {**text, "name": str(path)}
    path.write_text(json.dumps(text))
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        scenes.get(str(path))
    assert str(path) in str(caught.value)


def test_a_picture_has_the_title_and_the_room_of_the_scene():
    stage = body._stage(scenes.get(ROOM))
    assert stage.name == "my room"
    assert (stage.low, stage.high) == ((0, 0, 0.3), (6, 5, 2.4))
    moving = {
        **ROOM,
        "anchor_speed_m_s": 1.0,
        "anchor_region": {"kind": "box", "low": [0, 0, 0], "high": [6, 5, 3]},
    }
    assert body._stage(scenes.get(moving)).high == (6, 5, 3)
    racks = scenes.get({**ROOM, "obstacles": [[3, 2, 1, 0.5, 0.5, 1]]})
    assert body._stage(racks).low == (0, 0, 0)


def test_common_errors_of_toml_say_what_to_do(tmp_path):
    path = tmp_path / "room.toml"
    for text, words in (
        ("[walls]\nhigh_m = 3\n[walls]\n", r"twice.*: write \[\[walls\]\] for each"),
        ("[walls]\nhigh_m = 10 cm  # low\n", "line 2.*: values are numbers without units"),
        ("[body]\nsize_m = 0.8\n[body]\n", r"twice.*: a file has one \[body\]$"),
        ("[walls]\nhigh_m = 0,15  # low\n", "line 2.*: numbers have a decimal point, 0.15"),
        ("[walls]\nhigh_m = = 10\n", "line 2, column 10\\)$"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=words):
            scene_files.load(str(path))
