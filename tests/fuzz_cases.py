"""Good calls of public functions, whose arguments `test_fuzz.py` spoils one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym import bounds, estimators, metrics, motion, placement
from rbl_gym.bounds import doa, links
from rbl_gym.estimators.filter import reads
from rbl_gym.geometry import bodies, obstacles, regions, rotations
from rbl_gym.measurements import bearing, ranging
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.networks import bounds as network_bounds
from rbl_gym.networks import graphs, rigidity, sensing
from rbl_gym.worlds import scenes

TAGS, PYRAMID, CORNER = bodies.octahedron(0.8), bodies.pyramid(), bodies.doa2019()
ANCHORS = np.array([[5, 0, 0], [-5, 0, 0], [0, 5, 3], [0, -5, 3], [4, 4, 0.5]])
Q, T, TWIST = np.eye(3), np.array([0.3, 0.2, 1.0]), np.array([0.1, 0, 0, 1.0, 0, 0])
NOISE, SQUARED = ranging.RangeNoise(0.1), ranging.SquaredRangeNoise(0.05)
ANGLE_NOISE, PROCESS = bearing.AngleNoise(0.01), motion.ProcessNoise(0.1, 0.1)
P = np.diag([0.01] * 3 + [0.1] * 3)
RANGES = ranging.simulate(ANCHORS, TAGS, Q, T, NOISE, np.random.default_rng(0)).ranges
ANGLES = bearing.simulate(CORNER, Q, [5, 5, 3], ANGLE_NOISE, np.random.default_rng(0))
NET = sensing.random_network(12, 8.0, 0.05, np.random.default_rng(0))
EDGE_ANGLES = sensing.edge_angles(NET.bearings)
SQUARE = np.array([[0, 0], [1, 0], [1, 1.2], [0, 1.0]])
TRIANGLES = np.array([[0, 1], [1, 2], [2, 3], [0, 3], [0, 2], [1, 3]])
TRIANGLE_BEARINGS = sensing.true_bearings(SQUARE, np.zeros(4), TRIANGLES)
GRAPH = {"edges": NET.edges, "n_nodes": 12}
POSE = {"rotation": Q, "translation": T}
PAIR = {"rotation_hat": Q, "translation_hat": T, **POSE}
EPOCH = {"ranges": RANGES, "anchors": ANCHORS, "links": np.ones((5, 6), dtype=np.bool_)}


class Rng:
    """Stands for a fresh generator at every call."""


def call(function: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    made = {k: np.random.default_rng(0) if v is Rng else v for k, v in arguments.items()}
    return function(**made)


CASES: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {}


def case(function: Callable[..., Any], label: str = "", **arguments: Any) -> None:
    name = f"{function.__module__}.{function.__qualname__} {label}".replace("rbl_gym.", "")
    CASES[name.strip()] = function, arguments


for _function in (rotations.hat, rotations.exp, rotations.cayley, rotations.left_jacobian,
                  rotations.left_jacobian_inverse):  # fmt: skip
    case(_function, w=T)
for _function in (rotations.log, rotations.quaternion, rotations.yaw):
    case(_function, Q=Q)
case(rotations.vee, W=np.zeros((3, 3)))
case(rotations.from_quaternion, q=np.array([1.0, 0, 0, 0]))
case(rotations.from_euler_zyx, yaw=0.1, pitch=0.1, roll=0.1)
case(rotations.nearest, M=Q)
case(rotations.error, Q_hat=Q, Q=Q)
case(rotations.angle_between, u=T, v=T)
case(bodies.centred, tags=TAGS)
case(bodies.perturb, tags=TAGS, std_m=0.1, rng=Rng)
for _function in (bodies.octahedron, bodies.pyramid, bodies.cube):
    case(_function, size_m=1.0)
case(bodies.plate, length_m=1.0, width_m=1.0)
case(motion.ProcessNoise, rotation_rad=0.1, translation_m=0.1)
case(motion.propagate, **POSE, twist=TWIST, dt=0.1)
case(motion.constant_twist, **POSE, twist=TWIST, steps=3)
case(motion.waypoints, rotation=Q, points=ANCHORS, speed_m_s=1.0, dt=0.1, steps=5)
case(motion.orbit, centre=T, radius_m=2.0, speed_m_s=1.0, dt=0.1, steps=4, phase=0.0)
for _law in ranging.NOISE_LAWS.values():
    case(_law, **{key: value for key, value in vars(_law()).items() if value is not None})
case(ranging.LinkNoise, std_m=np.ones((5, 6)))
case(ranging.LinkModel, drop_probability=0.1, nlos_probability=0.1, nlos_bias_m=1.0, reach_m=3.0)
case(ranging.simulate, anchors=ANCHORS, tags=TAGS, **POSE, noise=NOISE, rng=Rng)
case(ranging.tag_positions, **POSE, tags=TAGS)
case(ranging.distances, anchors=ANCHORS, positions=TAGS)
case(bearing.AngleNoise, std_rad=0.1)
case(bearing.angles, positions=ANCHORS)
case(bearing.simulate, tags=TAGS, **POSE, noise=ANGLE_NOISE, rng=Rng)
case(bounds.pose_crb, anchors=ANCHORS, tags=TAGS, **POSE, noise=NOISE)
case(doa.doa_crb, tags=CORNER, rotation=Q, translation=np.array([5, 5, 3.0]),
     noise=ANGLE_NOISE)  # fmt: skip
case(bounds.posterior_crb_step, J=np.eye(6), anchors=ANCHORS, tags=TAGS, **POSE, noise=NOISE,
     twist=TWIST, dt=0.1, process=PROCESS)  # fmt: skip
case(bounds.score, covariance=P, rotation=Q, tags=TAGS)
case(metrics.pose_error, **PAIR)
case(metrics.tag_error, **PAIR, tags=TAGS)
case(metrics.nees, error=np.ones(6), covariance=P)
case(metrics.mean_angular_error, matrix=Q, rotation=Q)
case(obstacles.check_obstacles, obstacles=np.ones((2, 6)))
case(regions.Box, low=np.zeros(3), high=np.ones(3))
case(regions.Walls, low=np.zeros(3), high=np.ones(3))
case(regions.Shell, inner_m=1.0, outer_m=2.0)
case(scenes.get, scene={"name": "uwb_room", "steps": 5})
case(placement.task, scene="uwb_room", n_anchors=5, racks=1)
for _method in estimators.methods():
    case(estimators.locate, _method, **EPOCH, tags=TAGS, noise=NOISE, method=_method,
         tag_std_m=0.0)  # fmt: skip
for _method in ("ml", "nia"):
    case(estimators.locate_doa, _method, angles=ANGLES, tags=CORNER, noise=ANGLE_NOISE,
         method=_method)  # fmt: skip
case(estimators.make, name="iekf", tags=TAGS, noise=NOISE, process=PROCESS)
for _name in estimators.names():
    _filter = estimators.make(_name, tags=PYRAMID, noise=NOISE, process=PROCESS)
    _state = _filter.initial(Q, T, P)
    _ranges = {**EPOCH, "ranges": RANGES[:, :5], "links": np.ones((5, 5), dtype=np.bool_)}
    case(_filter.initial, _name, **POSE, covariance=P)
    if reads(_filter) == "twist":
        case(_filter.predict, _name, state=_state, twist=TWIST, dt=0.1)
    else:
        case(_filter.predict, _name, state=_state, readings=np.ones((10, 6)), dt=0.1)
    case(_filter.update, _name, state=_state, **_ranges)
case(sensing.proj, angle=T)
case(sensing.unit_disk_edges, positions=NET.positions, radius_m=2.0)
case(sensing.true_bearings, positions=NET.positions, orientations=NET.orientations,
     edges=NET.edges)  # fmt: skip
case(sensing.edge_angles, bearings=NET.bearings)
case(sensing.random_network, n_nodes=12, mean_degree=8.0, bearing_std_rad=0.05, rng=Rng)
for _method in ("ml", "chordal", "cycle", "spectral", "tree"):
    case(estimators.orientations, _method, **GRAPH, y=EDGE_ANGLES, method=_method)
case(estimators.chordal_optimum, **GRAPH, y=EDGE_ANGLES)
case(estimators.orientations, "weighted", **GRAPH, y=EDGE_ANGLES, method="ml",
     weights=np.ones(len(EDGE_ANGLES)))  # fmt: skip
case(estimators.cycle_consensus, **GRAPH, y=EDGE_ANGLES)
case(estimators.ring_least_squares, y=np.array([1.0, 2, 3]))
_cycles = graphs.cycle_matrix(**GRAPH)
case(lambda y, branch: estimators.cycle_projection(_cycles, y, branch), "cycle_projection",
     y=EDGE_ANGLES, branch=np.zeros(len(_cycles.toarray())))  # fmt: skip
_seen = sensing.measure_in_space(
    np.eye(3), np.tile(Q, (3, 1, 1)), [[0, 1], [1, 2], [2, 0]], 0.0, np.random.default_rng(0)
)
case(estimators.triangle_frames, bearings=_seen, length_m=1.0)
case(estimators.frames, edges=TRIANGLES, bearings=TRIANGLE_BEARINGS, n_nodes=4, known_pair=(0, 1),
     length_m=1.0)  # fmt: skip
case(network_bounds.orientation_covariance, **GRAPH, bearing_std_rad=0.1)
case(network_bounds.frame_covariance, positions=SQUARE, edges=TRIANGLES, bearing_std_rad=0.1,
     known_pair=(0, 1))  # fmt: skip
for _function in (graphs.cycle_matrix, graphs.incidence,
                  graphs.spanning_tree):  # fmt: skip
    case(_function, **GRAPH)
case(rigidity.localizability, positions=NET.positions, edges=NET.edges)
case(rigidity.freedom, positions=np.eye(4)[:, :3], edges=TRIANGLES)
PLACES = {"anchors": ANCHORS, "tags": TAGS, **POSE, "noise": NOISE}
LINKS, LINK_MODEL = EPOCH["links"], ranging.LinkModel(0.1, nlos_probability=0.1)
case(bounds.range_information, **PLACES, links=LINKS, tag_std_m=0.01)
case(links.expected_information, **PLACES, link_model=LINK_MODEL, nlos_std_m=1.0)
case(links.realised_crb, **PLACES, link_model=LINK_MODEL, rng=Rng, draws=3,
     prior_information=np.eye(6))  # fmt: skip
case(links.nlos_efficiency, probability=0.1, bias_m=5.0, std_m=0.1, bias_std_m=1.0)
case(bounds.range_information, "anchor_std_m", **PLACES, anchor_std_m=np.full(5, 0.1))
case(bounds.Nuisances, anchor_std_m=0.1)
case(bounds.with_nuisances, information=np.eye(6), count=3)
case(bounds.marginal_information, joint=np.eye(8))


def _step(J, anchors, tags, rotation, translation, noise, links, twist, dt):
    nuisances = bounds.Nuisances(None, 0.1, LinkBias(0.1, 5.0), "anchor")
    epoch = bounds.RangeEpoch(anchors, tags, rotation, translation, noise, links)
    return bounds.posterior_step(J, epoch, bounds.KnownTwist(twist, dt, PROCESS), nuisances)


case(_step, "posterior_step", J=np.eye(26), **PLACES, links=LINKS, twist=TWIST, dt=0.5)
