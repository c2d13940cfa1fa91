"""Frames: their contents, reproducibility and speed."""

from __future__ import annotations

import pickle
import time
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import HumanRendering, RecordVideo

from rbl_gym import rendering
from rbl_gym.geometry import bodies
from rbl_gym.rendering import body, drawing, film
from rbl_gym.worlds.scenes import SCENES
from rbl_gym.wrappers import (
    EstimateNetwork,
    EstimatePose,
    VectorEstimateNetwork,
    VectorEstimatePose,
)

IDS = ("Tracking", "AnchorPlacement", "MobileAnchors", "AnchorSelection", "BaseStation",
       "PlanarNetwork")  # fmt: skip
GREEN = np.array([0x1B, 0x7F, 0x5C])


def make(name: str, **arguments) -> Any:
    return gym.make(f"rbl_gym:RBL/{name}-v0", render_mode="rgb_array", **arguments)


def make_vec(name: str, **arguments) -> Any:
    return gym.make_vec(f"rbl_gym:RBL/{name}-v0", render_mode="rgb_array", **arguments)


def rolled(env, steps: int = 3, seed: int = 4) -> np.ndarray:
    """The frame after some steps with actions of their own generator."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(steps):
        env.step(env.action_space.sample())
    return env.render()


def green(frame: np.ndarray) -> int:
    """Pixels of white with some share of the colour of beliefs in it."""
    share = (255.0 - frame) / (255 - GREEN)
    return int(((np.ptp(share, axis=-1) < 0.03) & (share.min(axis=-1) > 0.15)).sum())


def assert_alike(frame: np.ndarray, other: np.ndarray) -> None:
    """Equal but for what rounding in batched filters does to the edges of lines."""
    assert np.abs(frame.astype(int) - other).max() <= 8


# --- Gymnasium's side ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
def test_the_metadata_name_frames_and_their_rate(name):
    env = gym.make(f"rbl_gym:RBL/{name}-v0")
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert env.metadata["render_fps"] >= 1


@pytest.mark.parametrize("name", IDS)
def test_a_frame_is_an_image_of_its_own_memory_that_follows_the_episode(name):
    env = make(name)
    env.reset(seed=1)
    before = env.render()
    kept = before.copy()
    env.action_space.seed(0)
    env.step(env.action_space.sample())
    after = env.render()
    for frame in (before, after):
        assert frame.shape == (540, 960, 3)
        assert frame.dtype == np.uint8
    np.testing.assert_array_equal(before, kept)
    assert (before != after).any()
    # Not empty: every quarter has something on its white.
    for part in (after[:270, :576], after[270:, :576], after[:270, 576:], after[270:, 576:]):
        assert 0.005 < (part.min(axis=-1) < 250).mean() < 0.7
    again = make(name)
    again.reset(seed=1)
    np.testing.assert_array_equal(again.render(), before)


def test_the_same_episode_gives_the_same_pixels():
    first = rolled(make("MobileAnchors"))
    # In between, another scene and other limits of the axes.
    rolled(make("Tracking", scene="hall"))
    np.testing.assert_array_equal(first, rolled(make("MobileAnchors")))
    assert (first != rolled(make("MobileAnchors"), seed=5)).any()


@pytest.mark.parametrize("name", IDS)
def test_without_a_render_mode_render_warns_and_returns_nothing(name):
    env = gym.make(f"rbl_gym:RBL/{name}-v0")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match='render_mode="rgb_array"'):
        assert env.unwrapped.render() is None


@pytest.mark.parametrize("scene", [*SCENES, {"name": "uwb_room", "tags": [[0, 0, 0]]}])
def test_every_scene_can_be_rendered(scene):
    env = make("Tracking", scene=scene)
    env.reset(seed=0)
    assert (env.render()[:, :576].min(axis=-1) < 250).mean() > 0.01


def test_legends_and_the_path_keep_off_the_edges():
    env = EstimatePose(make("Tracking", scene="auv_buoys", reward="none"), "iekf")
    frame = rolled(env, steps=40)
    dark = frame.min(axis=-1) < 230
    legend = dark[510:535, :576]
    assert legend.any()
    assert not legend[:, :8].any()
    assert not legend[:, -8:].any()
    assert not dark[:5, 576:].any()
    assert not dark[:265, -8:].any()


def test_the_box_of_moving_anchors_fits_where_they_were():
    env = make("MobileAnchors")
    frame = rolled(env)
    red = (frame[:500, :576] == (209, 73, 91)).all(axis=-1)
    assert np.ptp(np.nonzero(red)[1]) > 100  # the region of the craft is six times as wide
    shown = body._around(body._stage(SCENES["auv_craft"]), np.array([[-700.0, 0, 0], [700, 0, 0]]))
    assert (shown.low[0], shown.high[0]) == (-600, 600)
    shown = body._around(body._stage(SCENES["auv_craft"]), np.array([[-10.0, 5, 0], [160, 5, 0]]))
    np.testing.assert_allclose(shown.low, (-150, 0, -80))
    np.testing.assert_allclose(shown.high, (300, 150, 0))
    # Obstacles stay inside the box.
    hall = body._stage(SCENES["hall"])
    assert body._around(hall, np.zeros((1, 3))) is hall


def test_nothing_can_be_rendered_before_the_first_reset():
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        make("Tracking").unwrapped.render()
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        make_vec("BaseStation", num_envs=2).render()


def test_an_environment_that_was_rendered_can_be_pickled():
    env = make("Tracking", scene="drone_yard").unwrapped
    frame = rolled(env)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(env)).render(), frame)


def test_a_list_of_frames_collects_every_step():
    env: Any = gym.make("rbl_gym:RBL/Tracking-v0", render_mode="rgb_array_list")
    env.reset(seed=0)
    for _ in range(3):
        env.step(0)
    frames = env.render()
    assert isinstance(frames, list)
    assert len(frames) == 4
    assert all(frame.shape == (540, 960, 3) for frame in frames)


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
def test_human_rendering_shows_the_frames(monkeypatch):
    pytest.importorskip("pygame", reason="the extra video is not installed")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env: Any = HumanRendering(EstimatePose(make("Tracking"), "iekf"))
    env.reset(seed=0)
    env.step(0)
    import pygame

    shown = pygame.surfarray.array3d(env.window)
    np.testing.assert_array_equal(shown.transpose(1, 0, 2), env.env.render())
    env.close()


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning", "ignore:.*:ResourceWarning")
def test_videos_are_recorded(tmp_path):
    pytest.importorskip("moviepy", reason="the extra video is not installed")
    scene = {"name": "uwb_room", "steps": 4}
    env = RecordVideo(EstimatePose(make("Tracking", scene=scene), "iekf"), str(tmp_path / "new"))
    env.reset(seed=0)
    truncated = False
    while not truncated:
        *_, truncated, _ = env.step(0)
    env.close()
    (video,) = (tmp_path / "new").glob("*.mp4")
    assert video.stat().st_size > 5_000


# --- many worlds --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDS)
def test_worlds_of_a_vector_look_like_scalar_ones(name):
    envs = make_vec(name, num_envs=2)
    envs.reset(seed=7)
    envs.single_action_space.seed(7)
    action = envs.single_action_space.sample()
    envs.step(np.stack([action, action]))
    frames = envs.render()
    assert isinstance(frames, tuple)
    assert len(frames) == 2
    for world, frame in enumerate(frames):
        env = make(name)
        env.reset(seed=7 + world)
        env.step(action)
        assert_alike(frame, env.render())


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("wrapped", [True, False])
def test_a_frame_after_an_autoreset_shows_the_new_episode(mode, wrapped):
    scene = {"name": "uwb_room", "steps": 2}
    envs: Any = make_vec("Tracking", num_envs=2, scene=scene, autoreset_mode=mode)
    if wrapped:
        envs = VectorEstimatePose(envs, "iekf")
    envs.reset(seed=3)
    zeros = np.zeros(2, dtype=int)
    envs.step(zeros)
    envs.step(zeros)
    if mode == "NextStep":
        envs.step(zeros)
    elif mode == "Disabled":
        envs.reset(options={"reset_mask": np.array([True, False])})
    env: Any = make("Tracking", scene=scene)
    if wrapped:
        env = EstimatePose(env, "iekf")
    env.reset(seed=3)
    env.step(0)
    env.step(0)
    env.reset()
    assert_alike(envs.render()[0], env.render())
    if mode == "Disabled":
        env.reset(seed=4)
        env.step(0)
        env.step(0)
        # The world that went on is at its last epoch still.
        assert_alike(envs.render()[1], env.render())


def test_beliefs_of_a_vector_look_like_scalar_ones():
    for lengths in ("none", "all"):
        envs: Any = VectorEstimateNetwork(make_vec("PlanarNetwork", num_envs=2, lengths=lengths))
        env: Any = EstimateNetwork(make("PlanarNetwork", lengths=lengths))
        envs.reset(seed=2)
        env.reset(seed=3)
        assert_alike(envs.render()[1], env.render())


def test_believed_places_of_a_network_are_drawn():
    frames = []
    for lengths in ("none", "one", "all"):
        env: Any = EstimateNetwork(make("PlanarNetwork", lengths=lengths))
        env.reset(seed=3)
        # The plan alone: the legend differs, too.
        frames.append(env.render()[60:, :510])
    bare, one, every = frames
    assert (one != bare).any()
    # Sharper places have smaller rings.
    assert green(one) != green(every)


# --- what is shown ------------------------------------------------------------------------------


def test_the_belief_is_shown_in_place_of_the_bound():
    bound = rolled(make("Tracking", scene="drone_yard"))
    belief = rolled(EstimatePose(make("Tracking", scene="drone_yard"), "iekf"))
    nothing = rolled(make("Tracking", scene="drone_yard", reward="none"))
    assert green(nothing) == 0
    assert green(bound) > 5_000
    assert green(belief) > 5_000
    assert (bound != belief).any()


def test_a_wrapper_in_between_sees_the_last_epoch_of_which_the_belief_is_known():
    class Peeking(gym.Wrapper):
        def step(self, action):
            result = super().step(action)
            self.seen = self.env.render()
            return result

    env: Any = EstimatePose(peeking := Peeking(make("Tracking")), "iekf")
    env.reset(seed=0)
    first = env.render()
    env.step(0)
    np.testing.assert_array_equal(peeking.seen, first)
    assert (env.render() != first).any()


def test_the_curves_are_the_errors_and_three_sigma():
    env: Any = EstimatePose(make("Tracking", scene="uwb_room"), "iekf")
    observation, info = env.reset(seed=0)
    rows = []
    for _ in range(5):
        variance = np.diagonal(observation["belief_covariance"])
        sigma = [np.sqrt(variance[3:].sum()), np.rad2deg(np.sqrt(variance[:3].sum()))]
        rows.append([info["position_error_m"], np.rad2deg(info["rotation_error_rad"]), *sigma])
        observation, *_, info = env.step(0)
    taken = list(env.unwrapped.film._taken)[:5]
    curves = body._curves(0, [shot.truth for _, shot, _ in taken], [last for *_, last in taken])
    expected = np.array(rows).T
    np.testing.assert_allclose(curves[0], expected[:2], rtol=1e-12)
    np.testing.assert_allclose(curves[1], 3 * expected[2:], rtol=1e-12)


@pytest.mark.parametrize(
    ("band", "error", "limits"),
    [
        ([0.91], [0.2], (0.03, 3)), ([0.89], [4.0], (0.01, 10)), ([31.0], [np.nan], (1, 100)),
        ([np.nan], [np.nan], (0.1, 10)), ([np.nan], [3.1], (0.1, 10)), ([2.6], [1.0], (0.03, 10)),
    ],
)  # fmt: skip
def test_the_axes_of_the_curves_hold_them(band, error, limits):
    assert body.limits_of(np.array(band), np.array(error)) == pytest.approx(limits)


def test_only_the_episode_that_runs_is_kept_in_a_frame():
    kept = []

    def paint(world, epochs, *_) -> Any:
        kept.append((world, epochs.tolist()))

    roll = film.Film(paint, steps=3)
    for epochs in ([0, 0], [1, 1], [0, 2], [1, 3]):
        roll.take(epochs, rendering.Pose(*np.zeros((3, 2))))
    roll.frame(0)
    roll.frame(1)
    assert kept == [(0, [0, 1]), (1, [0, 1, 2, 3])]


# --- geometry -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tags", "edges"),
    [(bodies.octahedron(), 12), (bodies.cube(), 12), (bodies.pyramid(), 8), (bodies.plate(), 6),
     (bodies.doa2019(), 6), (np.eye(3), 3), (np.zeros((1, 3)), 0)],
)  # fmt: skip
def test_a_body_is_outlined_by_the_edges_of_its_hull(tags, edges):
    pairs = drawing.body_edges(tags)
    assert len({frozenset(pair) for pair in pairs.tolist()}) == len(pairs) == edges


def test_an_outline_is_where_the_ellipsoid_ends_in_the_picture():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(3, 3))
    covariance = factor @ factor.T
    matrix = drawing.view_at((0, 0), 7.0).matrix
    ends = drawing.outline(matrix, covariance, 2.5)
    # Support function: the outline's reach in a direction is that of the ellipsoid's surface.
    for direction in rng.normal(size=(20, 2)):
        reach = 2.5 * np.linalg.norm(factor.T @ matrix.T @ direction)
        assert (ends @ direction).max() == pytest.approx(reach, rel=3e-3)
    for ring in drawing.rings(covariance, 2.5):
        length = np.einsum("ki,ij,kj->k", ring, np.linalg.inv(covariance), ring)
        np.testing.assert_allclose(length, 2.5**2, rtol=1e-9)


def test_space_has_equal_scales_and_fits_its_panel():
    panel = drawing.Panel(500, 400)
    low, high = np.array([-60, -60, 0.0]), np.array([60, 60, 40.0])
    axes = drawing.space(panel, (0.05, 0.1, 0.95, 0.9), low, high)
    panel.freeze()
    view = drawing.view_of(axes)
    scale = np.linalg.svd(view.matrix, compute_uv=False)
    # Without perspective, and with equal scales, both singular values are the scale.
    assert scale[0] == pytest.approx(scale[1], rel=1e-6)
    direction = drawing.view_at((0, 0), scale[0]).matrix
    np.testing.assert_allclose(view.matrix, direction, rtol=1e-6, atol=1e-6 * scale[0])
    pixels = view(drawing.box_corners(low, high))
    assert (pixels.min(axis=0) > 0).all()
    assert (pixels.max(axis=0) < [500, 400]).all()


@pytest.mark.parametrize(("value", "rounded"), [(1, 1), (1.9, 1), (5, 5), (0.04, 0.02), (777, 500)])
def test_numbers_are_rounded_down_to_handsome_ones(value, rounded):
    assert drawing.round_number(value) == pytest.approx(rounded)


# --- what it costs ------------------------------------------------------------------------------


def test_twenty_frames_a_second():
    env: Any = EstimatePose(make("Tracking", scene="drone_yard"), "iekf")
    env.reset(seed=0)
    env.render()
    seconds = []
    for _ in range(40):
        env.step(0)
        start = time.process_time()
        env.render()
        seconds.append(time.process_time() - start)
    # All but the slowest tenth, which the collection of garbage or other processes may hit.
    assert np.mean(np.sort(seconds)[:36]) < 0.05
