"""Episodes against naive loops, the stated laws of the draws, and computations by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym import bounds
from rbl_gym.geometry.regions import Box
from rbl_gym.measurements.noise_laws import WeakenedNoise
from rbl_gym.measurements.ranging import LinkModel, RangeNoise, SquaredRangeNoise
from rbl_gym.motion import ProcessNoise
from rbl_gym.worlds import scene_bounds, scenes, simulation
from rbl_gym.worlds.scene import TRAJECTORIES, Scene
from rbl_gym.worlds.scenes import SCENES
from rbl_gym.worlds.simulation import Episode
from tests.helpers import law_by_hand, share_by_hand

NAMES = list(SCENES)
MOVABLE = [name for name, scene in SCENES.items() if scene.anchor_speed_m_s > 0]
ROOMY = [name for name, scene in SCENES.items() if np.ptp(scene.volume.bounds(), axis=0).min() > 0]
BAD_LINKS = LinkModel(drop_probability=0.3, nlos_probability=0.2, nlos_bias_m=4.0)
TRIALS = 2000


def change(name: str, **fields) -> Scene:
    return dataclasses.replace(SCENES[name], **fields)


def without_process(name: str, **fields) -> Scene:
    return change(name, process=ProcessNoise(), **fields)


def draw(scene: Scene, seed: int = 0, batch: tuple[int, ...] = ()) -> Episode:
    return simulation.draw_episode(scene, np.random.default_rng(seed), batch)


def process_covariance(scene: Scene, twist: np.ndarray) -> np.ndarray:
    """What a step adds to the pose error, the left Jacobian by the midpoint rule."""
    turn = twist[:3] * scene.dt
    middles = (np.arange(2000) + 0.5) / 2000
    jacobian = Rotation.from_rotvec(np.outer(middles, turn)).as_matrix().mean(axis=0)
    std = scene.process.std()
    Q = np.zeros((6, 6))
    Q[:3, :3] = scene.dt * jacobian @ np.diag(std[:3] ** 2) @ jacobian.T
    Q[3:, 3:] = scene.dt * np.diag(std[3:] ** 2)
    return Q


def predicted_covariance(scene: Scene, P: np.ndarray, twist: np.ndarray) -> np.ndarray:
    F = np.eye(6)
    F[:3, :3] = Rotation.from_rotvec(twist[:3] * scene.dt).as_matrix()
    return F @ P @ F.T + process_covariance(scene, twist)


def variance_by_hand(scene: Scene, distances: np.ndarray, n: int) -> float:
    """Variance of the range to tag n of one anchor, from the formulas of the laws."""
    law = scene.noise
    if isinstance(law, SquaredRangeNoise):
        return (law.sigma_m * distances[0] / (2 * distances[n])) ** 2
    assert isinstance(law, RangeNoise)
    r = distances[n if law.reference_tag is None else law.reference_tag]
    return law.floor_m**2 + (law.proportional * r) ** 2


def distances_by_hand(scene: Scene, episode: Episode, k: int, anchors: np.ndarray) -> np.ndarray:
    result = np.empty((scene.n_anchors, len(scene.tags)))
    for m, anchor in enumerate(anchors):
        for n, tag in enumerate(scene.tags):
            place = episode.rotation[k] @ np.array(tag) + episode.translation[k]
            result[m, n] = np.linalg.norm(place - anchor)
    return result


def ranges_by_hand(scene: Scene, episode: Episode, k: int, anchors: np.ndarray) -> np.ndarray:
    """Ranges before the links and the limit have their say."""
    distances = distances_by_hand(scene, episode, k, anchors)
    result = np.empty_like(distances)
    for m, n in np.ndindex(distances.shape):
        share = share_by_hand(scene, anchors[m], episode.translation[k])
        z = episode.normals[k, m, n] / share**0.5
        if isinstance(scene.noise, SquaredRangeNoise):
            square = distances[m, n] ** 2 + scene.noise.sigma_m * distances[m, 0] * z
            result[m, n] = max(square, 0.0) ** 0.5
        else:
            result[m, n] = distances[m, n] + variance_by_hand(scene, distances[m], n) ** 0.5 * z
    return result


# --- drawing ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_gives_the_same_bytes_and_another_seed_others(name):
    scene = change(name, links=BAD_LINKS)
    first, second, other = draw(scene, 5), draw(scene, 5), draw(scene, 6)
    for a, b in zip(first, second, strict=True):
        assert (a is None) == (b is None)
        assert a is None or b is None or a.tobytes() == b.tobytes()
    assert first.normals.tobytes() != other.normals.tobytes()
    assert first.rotation.tobytes() != other.rotation.tobytes() or name == "icassp2013"


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("name", NAMES)
def test_every_array_of_a_batch_has_the_stated_shape(name, batch):
    scene = change(name, links=BAD_LINKS, steps=7)
    episode = draw(scene, 0, batch)
    links = (scene.n_anchors, len(scene.tags))
    shapes = {
        "rotation": (8, 3, 3),
        "translation": (8, 3),
        "twists": (8, 6),
        "prior_rotation": (3, 3),
        "prior_translation": (3,),
        "prior_covariance": (6, 6),
        "anchors": (scene.n_anchors, 3),
        "normals": (8, *links),
        "uniforms": (8, 2, *links),
    }
    found = {key: value.shape for key, value in episode._asdict().items() if value is not None}
    assert found == {key: (*batch, *shape) for key, shape in shapes.items()}


@pytest.mark.parametrize("name", NAMES)
def test_perfect_links_draw_no_uniforms(name):
    assert draw(SCENES[name]).uniforms is None


@pytest.mark.parametrize("name", NAMES)
def test_episodes_of_a_batch_differ(name):
    episode = draw(SCENES[name], 0, (2,))
    assert (episode.normals[0] != episode.normals[1]).all()
    assert not np.array_equal(episode.prior_translation[0], episode.prior_translation[1]) or (
        SCENES[name].prior == "start"
    )
    if SCENES[name].anchors is None:
        assert (episode.anchors[0] != episode.anchors[1]).any(axis=-1).all()
    else:
        np.testing.assert_array_equal(episode.anchors[0], SCENES[name].anchors)


def test_craft_start_near_the_body_and_the_body_in_its_start_volume():
    scene = SCENES["auv_craft"]
    episode = draw(scene, 1, (200,))
    gap = episode.anchors - episode.translation[:, :1]
    assert np.abs(gap[..., :2]).max() <= 150
    assert np.abs(gap[..., :2]).max() > 140
    assert (episode.anchors[..., 2] == 0).all()
    start = episode.translation[:, 0]
    assert np.abs(start[:, :2]).max() <= 100
    assert np.abs(episode.translation[..., :2]).max() > 105


def test_drawn_anchors_lie_in_the_region():
    scene = change("uwb_room", anchors=None, n_anchors=9)
    anchors = draw(scene, 1, (50,)).anchors
    np.testing.assert_allclose(scene.anchor_region.project(anchors), anchors, atol=1e-12)


# --- motion -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_poses_follow_the_twists_where_there_is_no_process_noise(name):
    scene = without_process(name)
    episode = draw(scene, 2)
    for k in range(1, scene.steps + 1):
        turn = Rotation.from_rotvec(episode.twists[k, :3] * scene.dt).as_matrix()
        np.testing.assert_allclose(
            episode.rotation[k], turn @ episode.rotation[k - 1], rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(
            episode.translation[k],
            episode.translation[k - 1] + episode.twists[k, 3:] * scene.dt,
            rtol=0,
            atol=1e-9,
        )


@pytest.mark.parametrize("name", [n for n in NAMES if SCENES[n].prior == "drawn"])
def test_twist_of_epoch_0_is_zero_where_the_prior_is_of_epoch_0(name):
    np.testing.assert_array_equal(draw(SCENES[name]).twists[0], np.zeros(6))


@pytest.mark.parametrize("name", ["uwb_room", "drone_yard", "auv_buoys", "satellite"])
def test_process_noise_has_the_stated_variance(name):
    # Steps less their twists, over the standard deviation of a step; 600 x 6 squares of unit
    # normals, so a sum of chi-square 3600, standard deviation sqrt(7200).
    scene = change(name, steps=60, spin_rad_s=0.0)
    episode = draw(scene, 3, (10,))
    turns = episode.rotation[:, 1:] @ np.swapaxes(episode.rotation[:, :-1], -1, -2)
    w = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec()
    shift = np.diff(episode.translation, axis=1) - scene.dt * episode.twists[:, 1:, 3:]
    steps = np.concatenate([w, shift.reshape(-1, 3)], axis=1)
    sums = ((steps / (scene.process.std() * scene.dt**0.5)) ** 2).sum(axis=0)
    np.testing.assert_allclose(sums, 600, atol=4 * 1200**0.5)


@pytest.mark.parametrize("trajectory", ["waypoints", "orbit", "lawn-mower"])
@pytest.mark.parametrize("name", ROOMY)
def test_body_stays_in_its_volume(name, trajectory):
    """Exactly without process noise; with it, within 6 standard deviations of its walk."""
    low, high = SCENES[name].volume.bounds()
    fields = {"trajectory": trajectory, "speed_m_s": max(SCENES[name].speed_m_s, 0.3)}
    exact = draw(
        without_process(name, **fields, start_translation=None, start_rotation=None), 4, (20,)
    ).translation
    assert (exact >= low - 1e-9).all()
    assert (exact <= high + 1e-9).all()
    scene = change(name, **fields, start_translation=None, start_rotation=None)
    margin = 6 * scene.process.std()[3] * (scene.steps * scene.dt) ** 0.5 + 1e-9
    walked = draw(scene, 4, (20,)).translation
    assert (walked >= low - margin).all()
    assert (walked <= high + margin).all()


@pytest.mark.parametrize("name", ROOMY)
def test_random_twist_stays_within_reach_of_its_start(name):
    scene = without_process(name, trajectory="random-twist", speed_m_s=2.0)
    translation = draw(scene, 5, (20,)).translation
    travelled = np.linalg.norm(translation - translation[:, :1], axis=-1)
    assert (travelled <= 2.0 * scene.dt * np.arange(scene.steps + 1) + 1e-9).all()
    assert travelled.max() > 2.0 * scene.dt * 10 - 1e-9  # ten steps straight on, at least


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("start_translation", (5.0, 4.0, 1.0)),
        ("start_rotation", scenes.get("camsap2013").start_rotation),
    ],
)
def test_a_stated_start_is_kept_or_refused_where_the_trajectory_has_its_own(
    trajectory, field, value
):
    overrides = {"name": "uwb_room", "trajectory": trajectory, field: value}
    own = {"orbit": ("start_translation", "start_rotation"), "lawn-mower": ("start_translation",)}
    if field in own.get(trajectory, ()):
        with pytest.raises(ValueError, match=f"{field} must be None for trajectory '{trajectory}'"):
            scenes.get(overrides)
        return
    episode = draw(scenes.get(overrides))
    start = {"start_translation": episode.translation, "start_rotation": episode.rotation}[field]
    np.testing.assert_allclose(start[0], value, atol=1e-12)


@pytest.mark.parametrize("steps", [100, 2000])
@pytest.mark.parametrize("name", ["uwb_room", "drone_yard", "auv_buoys", "satellite"])
def test_body_never_runs_out_of_waypoints(name, steps):
    scene = without_process(name, steps=steps)
    speed = np.linalg.norm(draw(scene, 6, (20,)).twists[:, 1:, 3:], axis=-1)
    assert (speed <= scene.speed_m_s * (1 + 1e-9)).all()
    # Slower only where a step cuts a corner; at rest never, hence also not in the last steps.
    assert (speed[:, -5:].max(axis=-1) > 0.5 * scene.speed_m_s).all()
    assert np.median(speed) == pytest.approx(scene.speed_m_s)


# --- prior ------------------------------------------------------------------------------------


def test_prior_of_the_tracking_paper_is_its_belief_before_epoch_0_predicted_once():
    scene = SCENES["camsap2013"]
    episode = draw(scene)
    twist = np.array([*[np.deg2rad(1.0)] * 3, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(episode.twists, np.tile(twist, (scene.steps + 1, 1)))
    np.testing.assert_allclose(
        episode.prior_rotation, Rotation.from_rotvec(twist[:3]).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(episode.prior_translation, [1, 1, 1])
    # Pose information .02 and .01 is variance 50 and 100.
    before = np.diag([50.0] * 3 + [100.0] * 3)
    want = predicted_covariance(scene, before, twist)
    np.testing.assert_allclose(episode.prior_covariance, want, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(np.diag(want)[3:], 101)


def test_truth_of_the_tracking_paper_starts_exactly_at_its_belief():
    episode = draw(without_process("camsap2013"), 1, (3,))
    np.testing.assert_allclose(episode.rotation[:, 0], episode.prior_rotation, atol=1e-14)
    np.testing.assert_allclose(episode.translation[:, 0], episode.prior_translation, atol=1e-12)


def test_truth_of_the_tracking_paper_leaves_its_belief_by_one_step_of_process_noise():
    scene = SCENES["camsap2013"]
    episode = draw(scene, 2, (TRIALS,))
    turns = episode.rotation[:, 0] @ np.swapaxes(episode.prior_rotation, -1, -2)
    w = Rotation.from_matrix(turns).as_rotvec()
    e = np.concatenate([w, episode.translation[:, 0] - episode.prior_translation], axis=1)
    inverse = np.linalg.inv(process_covariance(scene, np.array(scene.twist)))
    squares = np.einsum("ti,ij,tj->t", e, inverse, e)
    assert squares.sum() == pytest.approx(6 * TRIALS, abs=4 * (12 * TRIALS) ** 0.5)


@pytest.mark.parametrize("name", [n for n in NAMES if SCENES[n].prior == "drawn"])
def test_drawn_prior_has_the_stated_standard_deviation_on_every_axis(name):
    # Every axis is a sum of TRIALS squared unit normals: standard deviation sqrt(2 TRIALS).
    # A rotation beyond pi has no unique vector, hence at most 20 degrees here.
    std_rad = min(SCENES[name].initial_rotation_rad, np.deg2rad(20))
    scene = change(name, steps=1, initial_rotation_rad=std_rad)
    episode = draw(scene, 7, (TRIALS,))
    turns = episode.prior_rotation @ np.swapaxes(episode.rotation[:, 0], -1, -2)
    shift = episode.prior_translation - episode.translation[:, 0]
    e = np.concatenate([Rotation.from_matrix(turns).as_rotvec(), shift], axis=1)
    std = np.array([std_rad] * 3 + [scene.initial_translation_m] * 3)
    np.testing.assert_allclose(episode.prior_covariance[0], np.diag(std**2))
    sums = ((e / std) ** 2).sum(axis=0)
    np.testing.assert_allclose(sums, TRIALS, atol=4 * (2 * TRIALS) ** 0.5)
    # Uncorrelated: a mean product of independent unit normals has deviation 1 / sqrt(TRIALS).
    correlation = np.corrcoef(e.T) - np.eye(6)
    assert np.abs(correlation).max() < 4.5 / TRIALS**0.5


def test_wide_drawn_prior_turns_as_far_as_stated():
    # For w ~ N(0, s^2 I3), E cos|w| = (1 - s^2) exp(-s^2 / 2), wrapped or not.
    scene = change("icassp2013", steps=1)
    s = scene.initial_rotation_rad
    episode = draw(scene, 8, (TRIALS,))
    turns = episode.prior_rotation @ np.swapaxes(episode.rotation[:, 0], -1, -2)
    cosine = (np.trace(turns, axis1=-2, axis2=-1) - 1) / 2
    want = (1 - s**2) * np.exp(-(s**2) / 2)
    assert cosine.mean() == pytest.approx(want, abs=4 * cosine.std() / TRIALS**0.5)


# --- measurements -----------------------------------------------------------------------------


def test_an_epoch_is_what_the_episode_has_at_it():
    episode = draw(change("hall", links=BAD_LINKS), 0, batch=(2,))
    at = simulation.epoch_of(episode, 3)
    for name in simulation.Epoch._fields[:5]:
        of_episode = getattr(episode, {"twist": "twists"}.get(name, name))
        np.testing.assert_array_equal(getattr(at, name), of_episode[:, 3])


@pytest.mark.parametrize("name", NAMES)
def test_measure_equals_a_loop_over_the_links(name):
    scene = change(name, steps=5, links=BAD_LINKS)
    episode = draw(scene, 9)
    assert episode.uniforms is not None
    for k in (0, 3, 5):
        clean = ranges_by_hand(scene, episode, k, episode.anchors)
        got = simulation.measure_epoch(scene, simulation.epoch_of(episode, k), episode.anchors)
        for m, n in np.ndindex(clean.shape):
            dropped = episode.uniforms[k, 0, m, n] < 0.3
            reflected = episode.uniforms[k, 1, m, n] < 0.2
            want = 0.0 if dropped else clean[m, n] + 4.0 * reflected
            assert got.ranges[m, n] == pytest.approx(want, rel=1e-9)
            assert got.links[m, n] == (not dropped)
            assert got.nlos[m, n] == (reflected and not dropped)


@pytest.mark.parametrize("name", NAMES)
def test_measure_of_a_batch_equals_its_episodes_one_by_one(name):
    scene = change(name, steps=4, links=BAD_LINKS)
    batch = draw(scene, 10, (3,))
    together = simulation.measure_epoch(scene, simulation.epoch_of(batch, 2), batch.anchors)
    for b in range(3):
        single = Episode(*(None if array is None else array[b] for array in batch))  # pyrefly: ignore[bad-argument-type]
        alone = simulation.measure_epoch(scene, simulation.epoch_of(single, 2), single.anchors)
        for got, want in zip(together, alone, strict=True):
            np.testing.assert_allclose(got[b], want, rtol=1e-13)


def corners(scene: Scene) -> np.ndarray:
    """Legal places for anchors as far out as the region goes."""
    box = np.array(scene.anchor_region.bounds())
    places = [[box[i, 0], box[j, 1], box[k, 2]] for i, j, k in np.ndindex(2, 2, 2)]
    return scene.anchor_region.project(np.array(places))


@pytest.mark.parametrize(
    ("name", "trajectory"),
    sorted({(n, t) for n in NAMES for t in (SCENES[n].trajectory, "waypoints", "random-twist")}),
)
def test_no_range_needs_the_limit(name, trajectory):
    scene = change(name, trajectory=trajectory)
    places, episode = corners(scene), draw(scene, 0)
    for k in range(0, scene.steps + 1, 25):
        epoch = simulation.epoch_of(episode, k)
        for m in range(8):
            moved = np.roll(places, m, axis=0)[np.arange(scene.n_anchors) % 8]
            assert simulation.measure_epoch(scene, epoch, moved).ranges.max() < scene.range_limit_m


@pytest.mark.parametrize(
    "override",
    [
        {"anchors": [[200, 0, 1], [0, 200, 2], [-200, 0, 1], [0, -200, 2]]},
        {"start_translation": [500, 0, 0], "trajectory": "constant"},
    ],
    ids=["anchors outside their region", "start outside the volume"],
)
def test_limit_of_a_changed_scene_does_not_cut_its_ranges(override):
    scene = scenes.get({"name": "uwb_room", **override})
    episode = draw(scene, 0)
    want = ranges_by_hand(scene, episode, 0, episode.anchors)
    got = simulation.measure_epoch(scene, simulation.epoch_of(episode, 0), episode.anchors).ranges
    np.testing.assert_allclose(got, want)


@pytest.mark.parametrize("name", NAMES)
def test_an_impossible_range_is_cut_to_the_limit(name):
    scene = change(name, steps=2)
    episode = draw(scene, 12)
    wild = episode._replace(normals=np.full_like(episode.normals, 1e12))
    ranges = simulation.measure_epoch(scene, simulation.epoch_of(wild, 1), episode.anchors).ranges
    np.testing.assert_array_equal(ranges, np.full_like(ranges, scene.range_limit_m))


def test_a_range_of_zero_is_no_link():
    scene = change("uwb_room", steps=2)
    episode = draw(scene, 13)
    none = episode._replace(normals=np.full_like(episode.normals, -1e6))
    measured = simulation.measure_epoch(scene, simulation.epoch_of(none, 1), episode.anchors)
    assert not measured.links.any()
    assert not measured.ranges.any()


# --- links ------------------------------------------------------------------------------------


def test_links_end_at_the_reach():
    clean = SCENES["drone_yard"]
    scene = change("drone_yard", links=LinkModel(reach_m=70.0))
    episode = draw(clean, 15)
    seen = []
    for k in range(0, 101, 5):
        distances = distances_by_hand(scene, episode, k, episode.anchors)
        free = simulation.measure_epoch(clean, simulation.epoch_of(episode, k), episode.anchors)
        got = simulation.measure_epoch(scene, simulation.epoch_of(episode, k), episode.anchors)
        np.testing.assert_array_equal(got.links, distances <= 70.0)
        np.testing.assert_array_equal(got.ranges, np.where(distances <= 70.0, free.ranges, 0.0))
        seen.append(got.links)
    assert 0.1 < np.mean(seen) < 0.9


# --- anchors that move ------------------------------------------------------------------------


def test_anchors_that_move_and_stand_outside_their_region_are_refused():
    anchors = [[250, 0, 0], [0, 250, 0], [-250, 0, 0], [0, -250, 5]]
    with pytest.raises(ValueError, match=r"must start in anchor_region, but .* is 50 m outside"):
        scenes.get({"name": "auv_buoys", "anchors": anchors})


@pytest.mark.parametrize("name", MOVABLE)
def test_anchors_move_as_commanded_and_no_faster_than_the_limit(name):
    scene = SCENES[name]
    rng = np.random.default_rng(17)
    box = Box((-1e4, -1e4, -1e4), (1e4, 1e4, 1e4))
    free = dataclasses.replace(scene, anchor_region=box)
    anchors = draw(scene).anchors
    step = scene.anchor_speed_m_s * scene.dt
    for _ in range(50):
        action = rng.uniform(-1, 1, 3 * scene.n_anchors)
        moved = simulation.move_anchors(free, anchors, action)
        for m in range(scene.n_anchors):
            command = action[3 * m : 3 * m + 3]
            length = max(np.linalg.norm(command), 1.0)
            np.testing.assert_allclose(
                moved[m], anchors[m] + step * command / length, rtol=0, atol=1e-10
            )
            assert np.linalg.norm(moved[m] - anchors[m]) <= step * (1 + 1e-9)
    full = simulation.move_anchors(free, anchors, np.ones(3 * scene.n_anchors))
    np.testing.assert_allclose(np.linalg.norm(full - anchors, axis=-1), step)


def test_moved_anchors_stay_on_the_water():
    scene = SCENES["auv_buoys"]
    anchors = np.array([[199.0, 0, 0], [0, -199.0, 0], [0, 0, 0], [50.0, 50.0, 0]])
    action = np.array([1, 0, 0, 0, -1, 0, 0, 0, 1, 0.5, 0, 0.5])
    moved = simulation.move_anchors(scene, anchors, action)
    np.testing.assert_allclose(moved, [[200, 0, 0], [0, -200, 0], [0, 0, 0], [52, 50, 0]])


def test_moved_anchors_stay_in_the_shell():
    scene = SCENES["satellite"]
    anchors = np.array([[50.2, 0, 0], [0, 299.5, 0], [0, 0, 100.0], [0, 60.0, 0], [-70.0, 0, 0]])
    action = np.array([-1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0.5, 0, 0])
    moved = simulation.move_anchors(scene, anchors, action)
    want = [[50, 0, 0], [0, 300, 0], [0, 0, 101], [0, 60, 0], [-69.5, 0, 0]]
    np.testing.assert_allclose(moved, want)


def test_a_batch_of_anchors_moves_one_by_one():
    scene = SCENES["satellite"]
    rng = np.random.default_rng(18)
    anchors = draw(scene, 0, (4,)).anchors + rng.normal(0, 5, (4, 5, 3))
    actions = rng.uniform(-1, 1, (4, 15))
    moved = simulation.move_anchors(scene, anchors, actions)
    for b in range(4):
        alone = simulation.move_anchors(scene, anchors[b], actions[b])
        np.testing.assert_allclose(moved[b], alone, rtol=1e-14)


# --- information ------------------------------------------------------------------------------


def information_by_hand(
    scene: Scene, episode: Episode, k: int, anchors: np.ndarray, links: np.ndarray
) -> np.ndarray:
    """A loop over the links: the gradient of the distance by the pose error, over the noise."""
    distances = distances_by_hand(scene, episode, k, anchors)
    total = np.zeros((6, 6))
    for m, n in zip(*np.nonzero(links), strict=True):
        arm = episode.rotation[k] @ np.array(scene.tags[n])
        unit = (arm + episode.translation[k] - anchors[m]) / distances[m, n]
        gradient = np.concatenate([np.cross(arm, unit), unit])
        share = share_by_hand(scene, anchors[m], episode.translation[k])
        total += share * np.outer(gradient, gradient) / variance_by_hand(scene, distances[m], n)
    return total


@pytest.mark.parametrize("name", NAMES)
def test_posterior_information_equals_a_naive_recursion_and_that_of_bounds(name):
    std = SCENES[name].process.std() * [1, 4, 0.2, 1, 2, 0.5]  # every axis its own
    process = ProcessNoise(tuple(std[:3]), tuple(std[3:]))
    scene = change(name, steps=6, links=LinkModel(drop_probability=0.3), process=process)
    episode = draw(scene, 19)
    rng = np.random.default_rng(19)
    anchors = episode.anchors
    P, J, stepped = episode.prior_covariance, None, None
    for k in range(scene.steps + 1):
        anchors = anchors + rng.normal(0, 0.1, anchors.shape)
        links = simulation.measure_epoch(scene, simulation.epoch_of(episode, k), anchors).links
        twist = episode.twists[k]
        if k > 0:
            P = predicted_covariance(scene, P, twist)
        P = np.linalg.inv(np.linalg.inv(P) + information_by_hand(scene, episode, k, anchors, links))
        pose = episode.rotation[k], episode.translation[k]
        J, _ = scene_bounds.posterior_step(
            scene, simulation.epoch_of(episode, k), anchors, links, J, episode.prior_covariance
        )
        law = law_by_hand(scene, anchors, *pose)
        if stepped is None:
            stepped = np.linalg.inv(episode.prior_covariance) + bounds.range_information(
                anchors, scene.tags, *pose, law, links
            )
        else:
            stepped = bounds.posterior_crb_step(
                stepped, anchors, scene.tags, *pose, law,
                twist, scene.dt, scene.process, links,
            )  # fmt: skip
        np.testing.assert_allclose(J, stepped, rtol=1e-12, atol=1e-12 * np.abs(J).max())
        scale = np.sqrt(np.diag(P))
        got = np.linalg.inv(J) / np.outer(scale, scale)
        np.testing.assert_allclose(got, P / np.outer(scale, scale), rtol=0, atol=1e-6)


def test_a_blocked_link_without_information_gives_no_range():
    """Of two worlds alike, one has dark obstacles: what is in sight measures the same."""
    dim, dark = (
        scenes.get({"name": "hall", "blocked_information": share}) for share in (0.02, 0.0)
    )
    measured = []
    for scene in (dim, dark):
        episode = simulation.draw_episode(scene, np.random.default_rng(5), (50,))
        at = simulation.epoch_of(episode, 3)
        measured.append(simulation.measure_epoch(scene, at, episode.anchors))
        quality = simulation.link_quality(scene, at, episode.anchors)
    assert measured[0].links.all()
    np.testing.assert_array_equal(measured[1].links, np.repeat(quality[..., None] > 0, 6, axis=-1))
    assert 0.1 < measured[1].links.mean() < 0.95
    wanted = np.where(measured[1].links, measured[0].ranges, 0.0)
    np.testing.assert_array_equal(measured[1].ranges, wanted)
    # What is in sight has the noise of the scene, the rest tells nothing.
    law = WeakenedNoise(dark.noise, quality)
    variance, own = (each.variance(*measured[1][:2]) for each in (law, dark.noise))
    np.testing.assert_array_equal(variance, np.where(measured[1].links, own, np.inf))
