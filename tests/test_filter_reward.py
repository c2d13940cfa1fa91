"""AnchorPlacement with a filter as reward: against a plain loop, errors, the contract."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import estimators, placement
from rbl_gym.envs.placement import AnchorPlacementEnv
from rbl_gym.measurements.ranging import LinkNoise
from rbl_gym.placement import Context
from rbl_gym.wrappers import FilterReward, VectorFilterReward
from rbl_gym.wrappers.filter_reward import anchor_placement, anchor_placement_vector
from rbl_gym.wrappers.filter_tracks import Tracks, track_error, tracks
from tests.side_by_side import episode

ID = "rbl_gym:RBL/AnchorPlacement-v0"
WORLDS: dict[str, dict[str, Any]] = {
    "auv": {"filter": "iekf", "options": {"iterations": 2}},
    "racks": {"scene": "uwb_room", "racks": 2, "filter": "uc-kf"},
    "at once": {"scene": "drone_yard", "mode": "one-shot", "filter": "iekf-bank"},
    "mounts": {"scene": "uwb_room", "mode": "mounts", "n_anchors": 4, "racks": 1},
    "obstacles": {"scene": {"name": "hall", "n_anchors": 5}, "filter": "iekf-cv"},
}


def arguments_of(kind: str) -> dict[str, Any]:
    return {"reward": "filter", **WORLDS[kind]}


# --- the reward by hand -----------------------------------------------------------------------


def error_by_hand(task, context, anchors, filter_of):
    """One problem: each track by itself, epoch by epoch, distances and sight in plain steps."""
    scene, tags = task.scene, np.array(task.scene.tags)
    course = tracks(task, context)
    assert isinstance(course, Tracks)
    centre, half = context.racks[:, :3], context.racks[:, 3:]
    along = np.linspace(0, 1, 4001 if len(centre) else 1)[:, None]
    squares = []
    for track in range(8):
        filter: Any = filter_of(scene.noise)
        state = filter.initial(
            course.prior_rotation[track], course.prior_translation[track], scene.prior_covariance
        )
        for k in range(20):
            if k:
                state = filter.predict(state, course.twists[track, k], scene.dt)
            Q, t = course.rotation[track, k], course.translation[track, k]
            distance = np.linalg.norm((tags @ Q.T + t)[None] - anchors[:, None], axis=-1)
            share = np.ones((len(anchors), 1))
            for m, anchor in enumerate(anchors):
                points = (anchor + along * (t - anchor))[:, None]
                if (np.abs(points - centre) < half).all(axis=-1).any():
                    share[m] = scene.blocked_information
            std = np.sqrt(scene.noise.variance(distance) / share)
            # A range that noise makes negative is lost.
            ranges = np.maximum(distance + std * course.normals[track, k], 0)
            law = LinkNoise(np.sqrt(scene.noise.variance(np.where(ranges > 0, ranges, 1)) / share))
            state = filter_of(law).update(state, ranges, anchors, ranges > 0)
            belief = filter.belief(state)
            moved = tags @ (belief.rotation - Q).T + belief.translation - t
            squares.append((moved**2).sum(axis=-1).mean())
    return np.sqrt(np.mean(squares))


@pytest.mark.parametrize("kind", ["auv", "racks", "obstacles"])
def test_the_last_anchor_is_paid_by_a_plain_loop_over_tracks(kind):
    arguments = arguments_of(kind)
    env = anchor_placement(**arguments)
    task = env.unwrapped.task  # pyrefly: ignore[missing-attribute]
    *steps, last = episode(env, 3)
    assert not any(step[1] for step in steps[1:])
    assert not any(step[-1]["tag_error_m"] for step in steps)
    info = last[-1]
    context = Context(info["region"][:3], info["region"][3:], info["racks"])

    def filter_of(noise):
        return estimators.make(
            arguments.get("filter", "iekf"), tags=np.array(task.scene.tags), noise=noise,
            process=task.scene.process, **arguments.get("options", {}),
        )  # fmt: skip

    want = error_by_hand(task, context, info["anchors"], filter_of)
    np.testing.assert_allclose(info["tag_error_m"], want, rtol=1e-6)
    np.testing.assert_allclose(last[1], -np.log(want), atol=1e-6)


def test_tracks_run_through_the_region_as_the_scene_says_and_belong_to_their_problem():
    task = placement.task("drone_yard")
    context = placement.draw_contexts(task, np.random.default_rng(1), (40,))
    course = tracks(task, context)
    assert course.translation.shape == (40, 8, 20, 3)
    scene = task.scene
    half, centre = context.half[:, None, None], context.centre[:, None, None]
    # The process carries the body out of the region by a few of its standard deviations.
    drift = 5 * scene.process.std()[3:] * np.sqrt(20 * scene.dt)
    assert (np.abs(course.translation - centre) <= half + drift).all()
    # Starts are uniform: 320 of them on each axis, six standard deviations.
    starts = ((course.translation[:, :, 0] - centre[:, :, 0]) / half[:, :, 0]).reshape(320, 3)
    assert np.abs(starts.mean(axis=0)).max() < 6 / np.sqrt(3 * 320)
    speed = np.linalg.norm(course.twists[..., 1:, 3:], axis=-1)
    assert speed.max() <= scene.speed_m_s * (1 + 1e-9)
    assert np.median(speed) > 0.99 * scene.speed_m_s
    shift = course.prior_translation - course.translation[:, :, 0]
    assert np.std(shift) == pytest.approx(scene.initial_translation_m, rel=0.15)
    # A problem alone has the tracks that it has among others, and another problem has others.
    alone = tracks(task, Context(*(field[7] for field in context)))
    for one, all in zip(alone, course, strict=True):
        np.testing.assert_allclose(one, all[7], rtol=1e-12, atol=1e-12)
    assert np.abs(course.normals[0] - course.normals[1]).max() > 1


def test_a_filter_ends_near_the_bound_of_good_layouts_and_a_bad_layout_is_paid_less():
    task = placement.task("drone_yard")
    context = placement.draw_contexts(task, np.random.default_rng(2), (6,))
    filter = estimators.make(
        "iekf", tags=np.array(task.scene.tags), noise=task.scene.noise, process=task.scene.process
    )
    good = task.scene.anchor_region.draw(np.random.default_rng(3).random((6, 6, 3)))
    bad = good.copy()
    bad[:, 1:] = good[:, :1]
    error = track_error(task, context, good, filter)
    # Many epochs together know more than the one of the bound.
    assert (error < 1.2 * placement.score(task, context, good)).all()
    assert (track_error(task, context, bad, filter) > 3 * error).all()


@pytest.mark.parametrize("name", ["kf", "uc-kf", "iekf", "iekf-bank"])
def test_coincident_anchors_are_paid_badly_and_harm_nobody_else(name):
    task = placement.task("uwb_room")
    context = placement.draw_contexts(task, np.random.default_rng(2), (3,))
    filter = estimators.make(
        name, tags=np.array(task.scene.tags), noise=task.scene.noise, process=task.scene.process
    )
    anchors = task.scene.anchor_region.draw(np.random.default_rng(3).random((3, 6, 3)))
    sound = track_error(task, context, anchors, filter)
    anchors[1] = anchors[1, 0]
    error = track_error(task, context, anchors, filter)
    np.testing.assert_allclose(error[[0, 2]], sound[[0, 2]], rtol=1e-9)
    assert np.isfinite(error[1])
    assert error[1] > 2 * sound[1]


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize("make", [anchor_placement, anchor_placement_vector])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"filter": "kf"},
            r"filter 'kf' does not determine z with 4 anchors .* of scene 'auv_buoys'",
        ),
        ({"filter": "uc-kf"}, "does not determine z"),
        ({"scene": "uwb_room", "n_anchors": 3, "filter": "et-kf"}, "3 anchors"),
        ({"scene": {"name": "uwb_room", "tags": [[0, 0, 0], [1, 0, 0]]}}, "the 2 tags"),
        ({"filter": "x"}, "filter must be one of"),
        ({"options": {"colour": 1}}, "has no option 'colour'"),
        ({"reward": "error"}, "reward must be one of 'bound', 'filter', got 'error'; .*Wrapper"),
        ({"reward": abs}, "one of 'bound', 'filter', got .*abs.*; .* write a gymnasium.Wrapper"),
        ({"reward": "bound", "filter": "kf"}, "filter and options need reward='filter'"),
        ({"reward": "bound", "options": {}}, "filter and options need reward='filter'"),
    ],
)
def test_what_does_not_go_with_the_scene_is_refused_when_made(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**{"reward": "filter", **arguments})


def test_other_environments_are_refused():
    with pytest.raises(ValueError, match="env must be RBL/AnchorPlacement-v0"):
        FilterReward(gym.make("rbl_gym:RBL/Tracking-v0"))
    with pytest.raises(ValueError, match="env must be RBL/AnchorPlacement-v0"):
        VectorFilterReward(gym.make_vec("rbl_gym:RBL/Tracking-v0"))


# --- Gymnasium --------------------------------------------------------------------------------


def test_the_bound_is_the_default_and_the_environment_is_the_bare_one():
    assert type(gym.make(ID).env.env) is AnchorPlacementEnv  # pyrefly: ignore[missing-attribute]


def test_frames_can_be_made():
    env = gym.make(ID, render_mode="rgb_array_list", **arguments_of("auv"))
    env.reset(seed=1)
    env.step(env.action_space.sample())
    frames: Any = env.render()
    assert len(frames) == 2
