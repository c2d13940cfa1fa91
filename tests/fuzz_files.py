"""Readers of files and good files for them, which `test_fuzz_readers.py` and
`benchmarks/fuzz_readers.py` spoil; and what may come of it."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.networks.g2o import read_graph
from rbl_gym.placement.scene_files import problem
from rbl_gym.recordings import Files, Format, Recording, read_recording, read_runs, read_track
from rbl_gym.studies.bench import records, spec_files
from rbl_gym.studies.learning import policies


class Reader(NamedTuple):
    """A reader of one file, good files for it, and words that mutations are made of."""

    file: str
    read: Callable[[Path], Any]
    seeds: tuple[bytes, ...]
    words: tuple[bytes, ...]


AXES = ("rx", "ry", "rz", "x", "y", "z")
ANCHORS = b"anchor,x,y,z\nA,0,0,1\nB,4,0,1\nC,0,4,2\n"
TAGS = b"tag,x,y,z\n1,0.1,0,0\nleft,-0.1,0.1,0\n"
LONG = (
    b"t,anchor,tag,range,std,valid\n0.0,A,1,2.5,0.1,1\n0.0,A,left,2.25,0.1,1\n"
    b"0.0,B,1,-1,,0\n0.0,C,1,3.0,0.2,1\n0.1,A,1,70000,0,0\n0.1,B,left,1.5,0.1,1\n"
)
WIDE = b"# log\nt,aAt1,aAtleft,aCt1,aBtleft\n0.0,2.5,2.25,3.0,\n0.1,,,,1.5\n"
TRUTH = b"t,x,y,z,qw,qx,qy,qz\n0,1,2,3,1,0,0,0\n1,2,2,3,0.6,0,0,0.8\n"
PLANAR = b"t,x,y,yaw_deg\n0,1,2,90\n1,2,2,180\n"
TUM = b"1.0 1 2 3 0 0 0 1\n# x\n2.0 1 2 3 0 0 0.6 0.8\n"
EUROC = (b"#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],"
         b"q_RS_z []\n1403636579000000000,5.5,3.0,1.2,0.6,0.0,0.0,0.8\n"
         b"1403636579050000000,5.5,3.0,1.2,1.0,0.0,0.0,0.0\n")  # fmt: skip
TRACK = (b"t,x,y,z,qw,qx,qy,qz,"
         + ",".join(f"cov_{a}_{b}" for i, a in enumerate(AXES) for b in AXES[i:]).encode()
         + b",nis,dof,rank\n0,1,2,3,1,0,0,0" + b",0.5" * 21 + b",2.5,3,3\n"
         + b"1,1,2,3,0.6,0,0,0.8" + b",0.5" * 21 + b",1,0,0\n")  # fmt: skip
PLACES = b"time;pos_x;pos_y;roll [deg];pitch [deg];yaw [rad];z\n0,5;1;2;3;4;1;0\n1;1;2;3;4;1;0\n"
CALIBRATION = b"anchor,tag,bias_m,slope,sigma_m\nA,1,0.5,0.25,0.01\nC,1,3.5,0,\n"
# Logs in other people's ways.
GERMAN = LONG.replace(b",", b";").replace(b".", b",")
SPACES = (
    b"# Time Anchor Tag Distance\n0 A 1 2.5\n20 A left 2.25\n40 B 1 nan\n60 A 1 3\n60 A 1 3\n"
    b"50 C 1 2\n80 C 1 2\n100 C 1 2\n120 C 1 2"
)
ISO = (
    b"stamp\tanchor_id\ttag_id\trange (cm)\n2024-05-01T12:00:00Z\tA\t1\t250\n"
    b"2024-05-01 12:00:00.5\tB\tLEFT\t150\n2024-05-01T12:00:00.4+00:00\tb\t1.0\t150\n"
)
PATTERN = (
    b"when,r_A_1,r_A_left,r_C_1,sd_A_1,sd_A_left,sd_C_1,x\n0,250,225,300,9,9,9,\n"
    b"0.1,200,,0,10,,5,\n0.2,200,200,200,10,9,5,\n0.2,200,200,200,10,9,5,\n"
)
RUNS = (
    b"run,t,anchor,tag,range,x,y,z\na,0,A,1,2,1,1,1\nb,0,A,1,2,1,1,1\na,0.5,A,left,2,1,1,2\n"
    b"a,1,B,1,3,1,1,1\nb,2,A,1,2,1,1,1\n"
)
DIFFERENCES = (
    b"t,anchor_a,anchor_b,tag,difference,std\n0.0,A,B,1,1.5,0.1\n0.0,C,B,1,-0.5,0.1\n"
    b"0.0,A,B,left,1.25,0.1\n0.1,B,A,1,-1.5,0.1\n0.1,B,C,1,0.25,0.2\n0.1,A,C,1,1.75,0.1\n"
)
CHAIN = b"time_ms,anchor_a,anchor_b,tag,difference_cm\n0,A,B,1,150\n100,A,C,1,-25\n100,C,B,1,70\n"
PSEUDO = (
    b"t,anchor,tag,range\n0.0,A,1,-250.5\n0.0,B,1,-251\n0.0,C,1,-249\n0.0,A,left,30\n"
    b"0.1,B,left,29.5\n0.1,C,left,nan\n0.1,A,left,31\n"
)
ALONE = b"t,d,var,ax,ay\n0.1,2955,0.01,-0.02,-0.01\n0.2,1605,0.01,-0.02,2.365\n" \
        b"0.3,893,0.01,2.385,2.36\n0.4,893,0.01,2.3,2.36\n"  # fmt: skip
ALONE_IDS = b"time_ms,anchor,d,ax,ay,az\n100,5,2955,1,2,3\n200,5,2955,2,2,3\n300,6,955,4,4,3\n"
MOVING = b"anchor,t,x,y,z\nA,0,0,0,1\nA,1,0,0.5,1\nB,0,4,0,1\nC,0,0,4,2\nC,2,1,4,2\n"
CARRIER = b"who,t,A_x,A_y,A_z,A_qw,A_qx,A_qy,A_qz\na,0,1,2,3,1,0,0,0\nb,0,0,0,0,1,0,0,0\n" \
          b"a,1,2,2,3,0.6,0,0,0.8\n"  # fmt: skip
G2O = (
    b"VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1.0 0.0 0.1 500 0 0 500 0 5000\n# x\n"
    b"EDGE_SE2 1 7 1.0 0.5 -3.0 500 0 0 500 0 5000\nFIX 0\n"
)
SCENE = {
    "name": "hall",
    "anchors": {"kind": "room", "low": [0, 0, 0.5], "high": [10, 8, 3], "number": 6},
    "region": {"low": [1, 1, 0.5], "high": [9, 7, 2]},
    "obstacles": [{"low": [4, 3, 0], "high": [5, 5, 2]}],
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1, "proportional": 0.001, "blocked_information": 0.01},
    "prior": {"rotation_deg": 10.0, "position_m": 0.5},
}
SHELL = SCENE | {
    "anchors": {"kind": "shell", "inner_m": 50, "outer_m": 300, "number": 5},
    "body": {"tags": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]},
}
BUILDING = {
    "anchors": {"number": 4, "fixed": [[0.5, 0.5, 2]], "max_range_m": 30, "range_edge_m": 4,
                "half_angle_deg": 80, "angle_edge_deg": 9},
    "materials": {"glass": 0.8},
    "mounts": [
        {"kind": "wall", "line": [[0, 0], [9, 0], [9, 7], [0, 7]], "closed": True, "low_m": 1,
         "high_m": 3, "side": "both", "offset_m": 0.1, "name": "w", "cost": 2},
        {"kind": "ceiling", "polygon": [[1, 1], [8, 1], [8, 6]], "height_m": 3},
        {"kind": "column", "polygon": [[4, 3], [5, 3], [5, 4]], "low_m": 1, "high_m": 3},
        {"kind": "area", "polygon": [[1, 1], [2, 1], [2, 2]], "high_m": 2, "axis": [0, 0, 1]},
        {"kind": "points", "points": [[1, 6, 2], [2, 6, 2]]},
    ],
    "forbidden": [{"polygon": [[3, -1], [4, -1], [4, 1]], "low_m": 2, "high_m": 3}],
    "walls": [{"line": [[0, 0], [9, 0], [9, 7], [0, 7]], "closed": True, "thickness_m": 0.2,
               "high_m": 3, "material": "glass"}, {"line": [[3, 1], [3, 5]], "high_m": 3}],
    "openings": [{"line": [[2, 0], [3, 0]]}],
    "obstacles": [{"polygon": [[4, 3], [5, 3], [5, 4]], "high_m": 3, "information": 0.1},
                  {"low": [6, 3, 0], "high": [7, 5, 2]},
                  {"low": [6, 1, 0], "high": [7, 2, 2], "material": "glass"}],
    "slabs": [{"polygon": [[0, 0], [9, 0], [9, 7], [0, 7]], "z_m": 3, "thickness_m": 0.3}],
    "zones": [
        {"name": "a", "polygon": [[1, 1], [8, 1], [8, 6], [1, 6]], "low_m": 0.5, "high_m": 1.5,
         "weight": 2, "attitude": "level", "position_m": 0.2, "heading_deg": 5, "share": 0.9},
        {"low": [1, 1, 0], "high": [2, 2, 1], "attitude": "heading", "height_m": 0.3},
    ],
    "plan": {"image": "p.png", "metres_per_pixel": 0.1, "origin": [0, 1]},
    "body": {"tags": [[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]]},
    "noise": {"floor_m": 0.1, "blocked_information": 0.01},
}  # fmt: skip
TOML = b"""name = "hall"
[anchors]
kind = "box"
low = [0, 0, 0]
high = [10, 8, 0]
number = 4
[region]
low = [1, 1, -5]
high = [9, 7, -1]
[body]
shape = "plate"
size_m = 1.5
[noise]
floor_m = 0.1
[[obstacles]]
low = [4, 3, -3]
high = [5, 5, -2]
"""
RECORD = {
    "scene": "uwb_room", "spec": "uwb_room", "scene_hash": "0a", "condition": "nominal",
    "filter": "iekf", "filter_source": "rbl-gym", "trials": 2, "seed": 0,
    "versions": {"numpy": "2"}, "nees": 6.0, "per_trial": {"position_m": [0.1, 0.2]},
}  # fmt: skip
NUMBERS = (b"nan", b"inf", b"-1", b"0", b"1e308", b"-1e308", b"1e-320", b"1e400", b"9" * 40, b"",
           b"9" * 5000, b"1_0", b"true", b"\xc3\xa9", b"\xff", b"\0", b"\r", b"\x85")  # fmt: skip
MARKS = (b",", b"\n", b" ", b'"', b"#", b"\xef\xbb\xbf", b"\t", b";", b"-", b".")
JSON = (b"{", b"}", b"[", b"]", b":", b"null", b"NaN", b"Infinity", b"[" * 3000, b'{"a":' * 3000,
        b'"\\ud800"', b'""')  # fmt: skip


def _files(part: str, path: Path, **others: bytes) -> dict[str, Any]:
    """Good files beside the one that is tried."""
    files = {"ranges": LONG, "anchors": ANCHORS, "tags": TAGS, **others}
    for name, data in files.items():
        beside = path.with_name(f"good_{name}.csv")
        if name != part and not beside.exists():
            beside.write_bytes(data)
    return {name: path.with_name(f"good_{name}.csv") for name in files} | {part: path}


def _recording(part: str, path: Path) -> Any:
    return read_recording(Files(**_files(part, path, truth=TRUTH, calibration=CALIBRATION)))


def _runs(path: Path) -> Any:
    return read_runs(Files(**_files("ranges", path), truth=path))


def _differences(path: Path) -> Any:
    return read_recording(Files(**_files("ranges", path)))


def _pseudo(path: Path) -> Any:
    return read_recording(Files(**_files("ranges", path)), format=Format(offset="tag"))


def _pattern(path: Path) -> Any:
    columns = {"time": "when", "range": "r_{anchor}_{tag}", "std": "sd_{anchor}_{tag}"}
    return read_recording(
        Files(**_files("ranges", path)), format=Format(columns=columns, unit="cm")
    )


def _alone(path: Path) -> Any:
    return read_recording(Files(path), format=Format(columns={"range": "d[mm]"}))


def _carrier(relative: bool, path: Path) -> Any:
    arms = Format(columns={"carrier.*": "A_*"}, where={"carrier.who": "a"})
    files = _files("carrier", path, truth=TRUTH)
    return read_recording(Files(**files, relative=relative), format=arms)


def _problem(path: Path) -> Any:
    """All numbers of a placement problem, and places that can be drawn in it."""
    found = problem(str(path))
    prisms, zones = found.obstacles.prisms, [zone.bounds() for zone in found.zones]
    drawn = found.mounts.draw(np.random.default_rng(0).random((50, 3)))
    places = found.free_places(20)
    share = found.share(drawn, places)
    assert ((share >= 0) & (share <= 1)).all()
    np.testing.assert_allclose(found.mounts.project(drawn), drawn, rtol=1e-9, atol=1e-6)
    arrays = found.tags, found.fixed, found.obstacles.boxes, prisms.corners, prisms.low_m
    return (
        *arrays,
        prisms.high_m,
        *zones,
        found.scene.initial_rotation_rad,
        found.scene.initial_translation_m,
        found.gain.numbers[1:],
        drawn,
        places,
        share,
    )


def _policy() -> bytes:
    stream = io.BytesIO()
    meta = np.array(json.dumps({"kind": "box", "task": "mobile", "seed": 0}))
    weights: Any = {"weight_0": np.ones((2, 3), "f4"), "weight_1": np.ones((1, 2), "f4")}
    biases: Any = {"bias_0": np.zeros(2, "f4"), "bias_1": np.zeros(1, "f4")}
    np.savez(stream, **weights, **biases, meta=meta)
    return stream.getvalue()


def _policy_packed() -> bytes:
    stream = io.BytesIO()
    meta = np.array(json.dumps({"kind": "discrete", "task": "mounts"}))
    np.savez_compressed(stream, weight_0=np.ones((4, 2), "f4"), bias_0=np.zeros(4, "f4"), meta=meta)
    return stream.getvalue()


_json = tuple(json.dumps(scene, indent=1).encode() for scene in (SCENE, SHELL))
_lines = "".join(json.dumps(RECORD | {"filter": name}) + "\n" for name in ("kf", "iekf")).encode()
_times = (
    b'{"scene": "u", "scene_hash": "0a", "condition": "nominal", "filter": "kf", '
    b'"microseconds_per_step": 1.5}\n' * 2
)
READERS = {
    "ranges": Reader(
        "ranges.csv", partial(_recording, "ranges"), (LONG, WIDE, GERMAN, SPACES, ISO),
        NUMBERS + MARKS,
    ),
    "differences": Reader("tdoa.csv", _differences, (DIFFERENCES,), NUMBERS + MARKS),
    "pseudo-ranges": Reader("pseudo.csv", _pseudo, (PSEUDO,), NUMBERS + MARKS),
    "ranges-pattern": Reader("wide.csv", _pattern, (PATTERN,), NUMBERS + MARKS),
    "ranges-alone": Reader("alone.csv", _alone, (ALONE, ALONE_IDS), NUMBERS + MARKS),
    "runs": Reader("runs.csv", _runs, (RUNS,), NUMBERS + MARKS),
    **{
        f"carrier-{where}": Reader(
            "carrier.csv", partial(_carrier, where == "relative"), (CARRIER,), NUMBERS + MARKS
        )
        for where in ("world", "relative")
    },
    **{
        part: Reader(f"{part}.csv", partial(_recording, part), seeds, NUMBERS + MARKS)
        for part, seeds in (("anchors", (ANCHORS, MOVING)), ("tags", (TAGS,)),
                            ("truth", (TRUTH, PLANAR, TUM, EUROC, PLACES)),
                            ("calibration", (CALIBRATION,)))
    },
    # A missing NIS is infinite.
    "track": Reader(
        "track.csv", lambda path: read_track(path)._replace(nis=None), (TRACK,), NUMBERS + MARKS
    ),
    "tum": Reader("track.tum", read_track, (TUM,), NUMBERS + MARKS),
    "g2o": Reader("graph.g2o", read_graph, (G2O,), NUMBERS + MARKS),
    "edges": Reader(
        "graph.csv", read_graph, (b"i,j,dtheta\n0,1,0.5\n1,2,0.1\n", b"i,j,a,b\n0,1,0.5,-2\n"),
        NUMBERS + MARKS,
    ),
    "scene-json": Reader("scene.json", _problem, _json, NUMBERS + JSON),
    "scene-toml": Reader("scene.toml", _problem, (TOML,), NUMBERS + MARKS + JSON),
    "policy": Reader("policy.npz", policies.load, (_policy(), _policy_packed()), NUMBERS),
    "bench-spec": Reader(
        "spec.json", spec_files.read_spec,
        (b'{"name": "uwb_room", "steps": 9}', b'{"ranges": "r.csv", "anchors": "a.csv"}'),
        NUMBERS + JSON,
    ),
    "bench-lines": Reader("bench.jsonl", records.read_records, (_lines,), NUMBERS + JSON),
    "bench-timings": Reader(
        "bench.timings.jsonl",
        lambda path: records.read_timings(path.with_name("bench.jsonl")), (_times,),
        NUMBERS + JSON,
    ),
}  # fmt: skip
if find_spec("shapely"):
    _building = (json.dumps(BUILDING).encode(),)
    READERS["building"] = Reader("building.json", _problem, _building, NUMBERS + JSON)


def check(name: str, data: bytes, folder: Path) -> str:
    """What the reader made of the bytes: "read", or the message; an AssertionError if neither."""
    reader = READERS[name]
    path = folder / reader.file
    path.write_bytes(data)
    try:
        found = reader.read(path)
    except ValueError as error:
        text = str(error)
        # Ids that do not fit may be laid to the file that uses them.
        files = [file.name for file in folder.iterdir()]
        assert any(file in text for file in files), f"does not name the file: {text}"
        return re.sub(r"\d+", "0", text.replace(str(folder), ""))
    assert _is_finite(found), "read numbers that are none"
    for log in found.values() if isinstance(found, dict) else [found]:
        if isinstance(log, Recording):
            check_log(log)
    return "read"


def check_log(log: Recording) -> None:
    """A recording is in order, and every range of the file is a link or counted as none."""
    assert (np.diff(log.times) > 0).all()
    assert log.links.any()
    if log.offset is None:
        np.testing.assert_array_equal(log.links, log.ranges > 0)
        assert log.ranges.max() <= 1e4
    else:
        assert not log.ranges[~log.links].any()
    if log.range_std is not None:
        np.testing.assert_array_equal(log.links, log.range_std > 0)
    lost = sum(count for cause, count in log.report.dropped.items() if cause != "empty")
    if log.offset is None:
        assert log.report.ranges == log.links.sum() + lost, log.report
    else:
        # Of n arrivals n - 1 differences tell at least.
        assert 0 < log.links.sum() <= 2 * (log.report.ranges - lost), log.report


def _is_finite(found: Any) -> bool:
    if isinstance(found, dict):
        found = tuple(found.values())
    if isinstance(found, tuple):
        return all(map(_is_finite, found))
    if isinstance(found, np.ndarray) and found.dtype.kind == "f":
        return bool(np.isfinite(found).all())
    return True
