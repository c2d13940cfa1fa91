"""ROS 1 and ROS 2 bags and MCAP files, written here by rosbags, as files of a recording."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra bags")

from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rbl_gym import motion, recordings
from rbl_gym.app.cli import main
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.recordings import bag_fields

# Fields of messages that users define themselves.
DEFINITIONS = {
    "my_uwb/msg/Range": "std_msgs/Header header\nuint8 here\nuint8 there\nuint16 range_mm\n"
    "float32 sigma\nbool good\n",
    "my_uwb/msg/Scan": "float64 stamp_s\nmy_uwb/Node[] nodes\nuint8[6] mac\n",
    "my_uwb/msg/Node": "uint8 id\nfloat32 distance\n",
    "uwb_driver/msg/UwbRange": "std_msgs/Header header\nuint8 requester_id\nuint8 responder_id\n"
    "uint8 antenna\nfloat32 distance\ngeometry_msgs/Point responder_location\n"
    "geometry_msgs/Point rqst_antenna_offset\n",
    "uwb_ros/msg/RangeStamped": "std_msgs/Header header\nfloat32 range\nuint8 from_id\n"
    "uint8 to_id\nfloat32 covariance\n",
}
FORMATS = ("ros1", "sqlite3", "mcap")


class Types:
    """Makes messages: ``types("geometry_msgs/msg/Point", x=1.0)``, other fields zero."""

    def __init__(self, store):
        self.store = store

    def __call__(self, name: str, **fields):
        given = dict(fields)
        for field, (kind, of) in self.store.fielddefs[name][1]:
            if field not in given:
                given[field] = self._zero(int(kind), of)
        return self.store.types[name](**given)

    def _zero(self, kind, of):
        if kind == 1:
            return {"string": "", "bool": False}.get(of[0], 0.0 if "float" in of[0] else 0)
        if kind == 2:
            return self(of)
        length = of[1] if kind == 3 else 0
        return np.zeros(length, dtype=of[0][1][0]) if of[0][0] == 1 else [None] * length

    def header(self, time_ns: int, frame: str = "base"):
        sec, nanosec = divmod(time_ns, 10**9)
        stamp = self("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def geometry(self, kind: str, values, names: str = "xyz"):
        numbers = dict(zip(names, map(float, values), strict=True))
        return self(f"geometry_msgs/msg/{kind}", **numbers)

    def sent(self, topic: str, time_ns: int, name: str, **fields):
        """A message of a bag: topic, time of recording, message."""
        return topic, time_ns, self(name, **fields)


def types_of(form: str) -> Types:
    store = get_typestore(Stores.ROS1_NOETIC if form == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return Types(store)


def write_bag(path: Path, form: str, types: Types, messages) -> Path:
    """A bag of (topic, time of recording in ns, message)."""
    store = types.store
    if form == "ros1":
        path = path.with_suffix(".bag")
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if form == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for topic, time_ns, message in messages:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            serialize = store.serialize_ros1 if form == "ros1" else store.serialize_cdr
            writer.write(connections[topic], time_ns, serialize(message, name))
    return path


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


T0 = 1_700_000_000 * 10**9
ROOM = np.array([[0, 0, 0], [8, 0, 3], [8, 8, 0], [0, 8, 3], [4, 0, 3], [4, 8, 0.0]])


def flight(types: Types):
    """The messages of NTU VIRAL, of a flight of 10 s, with its truth, an IMU and odometry."""
    tags = bodies.octahedron(0.8)[:4]
    start = motion.constant_twist(np.eye(3), [2, 2, 1], [0, 0.05, 0.3, 0.2, 0.2, 0.02], 100)
    path = motion.simulate(start, 0.1, motion.ProcessNoise())
    noise = ranging.RangeNoise(0.02)
    rng = np.random.default_rng(1)
    ranges = ranging.simulate(ROOM, tags, *path, noise, rng).ranges
    quaternions, point = rotations.quaternion(path.rotation), types.geometry
    for k in range(101):
        time = T0 + k * 10**8
        header = types.header(time, "world")
        for m in range(6):
            for n in range(4):
                yield types.sent(
                    "/uwb_endorange_info",
                    time + 5_000_000,
                    "uwb_driver/msg/UwbRange",
                    header=header,
                    requester_id=200 + n // 2,
                    antenna=n % 2,
                    responder_id=100 + m,
                    distance=float(ranges[k, m, n]),
                    responder_location=point("Point", ROOM[m]),
                    rqst_antenna_offset=point("Point", tags[n]),
                )
        pose = types(
            "geometry_msgs/msg/Pose",
            position=point("Point", path.translation[k]),
            orientation=point("Quaternion", quaternions[k], "wxyz"),
        )
        kind = "geometry_msgs/msg/PoseStamped"
        yield types.sent("/mocap/pose", time + 1_000_000, kind, header=header, pose=pose)
        turn, force = point("Vector3", (0.1, 0.2, 0.3 + k)), point("Vector3", (0, 0, 9.81))
        moved = {"angular_velocity": turn, "linear_acceleration": force}
        yield types.sent("/imu", time, "sensor_msgs/msg/Imu", header=header, **moved)
        twist = types("geometry_msgs/msg/Twist", linear=force, angular=turn)
        twist = types("geometry_msgs/msg/TwistWithCovariance", twist=twist)
        pose = types("geometry_msgs/msg/PoseWithCovariance", pose=pose)
        moved = {"child_frame_id": "body", "pose": pose, "twist": twist}
        yield types.sent("/odom", time, "nav_msgs/msg/Odometry", header=header, **moved)


@pytest.mark.parametrize("form", FORMATS)
def test_a_flight_goes_from_the_bag_to_its_track(form, tmp_path, capsys):
    log = write_bag(tmp_path / "flight", form, types := types_of(form), flight(types))
    out = tmp_path / "out"
    assert main(["convert", str(log), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "102 404, 103 404" in said
    command = said.strip().splitlines()[-1].split()
    result = json.loads((out / "convert.json").read_text())
    assert result["replay"].split() == command
    assert command[:3] == ["rbl-gym", "replay", "--ranges"]
    kinds = result["kinds"]
    assert {kind: said["rows"] for kind, said in kinds.items()} == {
        "ranges": 2424,
        "truth": 101,
        "imu": 101,
        "odometry": 101,
    }
    assert kinds["ranges"]["rate_hz"] == pytest.approx(10)
    assert kinds["ranges"]["start"] == "1700000000.000000000"
    assert kinds["ranges"]["delay_s"] == pytest.approx(0.005)
    options = ["--range-std-m", "0.02", "--walk-m", "0.4", "--walk-deg", "25"]
    assert main([*command[1:], *options, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["epochs_with_truth"] == 101
    assert figures["position_rmse_m"] < 0.05


def test_every_number_is_in_the_files_as_it_was_sent(tmp_path):
    log = write_bag(tmp_path / "flight", "ros1", types := types_of("ros1"), flight(types))
    recordings.convert_bag(log, tmp_path)
    sent = [message for topic, _, message in flight(types) if topic == "/uwb_endorange_info"]
    rows = read_csv(tmp_path / "ranges.csv")
    assert len(rows) == len(sent)
    for row, message in zip(rows, sent, strict=True):
        assert row["anchor"] == str(message.responder_id)
        assert row["tag"] == f"{message.requester_id}.{message.antenna}"
        assert float(row["range"]) == np.float32(message.distance)
        stamp = message.header.stamp
        assert row["t"] == f"{stamp.sec}.{stamp.nanosec:09d}"
    points = {row["anchor"]: row for row in read_csv(tmp_path / "anchors.csv")}
    np.testing.assert_allclose(
        [[float(points[str(100 + m)][axis]) for axis in "xyz"] for m in range(6)], ROOM
    )
    imu = read_csv(tmp_path / "imu.csv")
    assert list(imu[0]) == ["t", "wx", "wy", "wz", "ax", "ay", "az"]
    assert [float(value) for value in list(imu[7].values())[1:]] == [0.1, 0.2, 7.3, 0, 0, 9.81]
    assert list(read_csv(tmp_path / "odometry.csv")[0]) == ["t", "vx", "vy", "vz", "wx", "wy", "wz"]
    truth = recordings.read_truth(tmp_path / "truth.csv")
    assert len(truth.times) == 101


def own_ranges(types: Types, rows):
    """Messages of a type of one's own: (time, here, there, mm, sigma, good)."""
    names = "here", "there", "range_mm", "sigma", "good"
    for time, *values in rows:
        fields = dict(zip(names, values, strict=True))
        yield types.sent("/uwb", T0, "my_uwb/msg/Range", header=types.header(time), **fields)


MINE = {"topic": "/uwb", "anchor": "there", "tag": "here", "range": "range_mm", "unit": "mm"}


@pytest.mark.parametrize("form", FORMATS)
def test_fields_of_an_own_type_are_named(form, tmp_path, capsys):
    types = types_of(form)
    rows = [
        (T0, 7, 1, 2500, 50.0, True),
        (T0, 7, 2, 0, 50.0, True),
        (T0 + 3, 7, 2, 4000, 50.0, False),
        (T0 + 1, 7, 1, 1250, 50.0, True),
        (T0, 7, 1, 2600, 50.0, True),
    ]
    log = write_bag(tmp_path / "own", form, types, own_ranges(types, rows))
    table = tmp_path / "map.toml"
    table.write_text("[ranges]\nstd = 'sigma'\ntopic = '/no'\n[ranges.where]\ngood = 'True'\n")
    given = ",".join(f"{key}={value}" for key, value in MINE.items())
    options = ["--map", str(table), "--ranges", given, "--json"]
    assert main(["convert", str(log), "--out", str(tmp_path / "out"), *options]) == 0
    result = json.loads(capsys.readouterr().out)
    assert read_csv(tmp_path / "out" / "ranges.csv") == [
        {"t": "1700000000.000000000", "anchor": "1", "tag": "7", "range": "2.5", "std": "0.05"},
        {"t": "1700000000.000000001", "anchor": "1", "tag": "7", "range": "1.25", "std": "0.05"},
    ]
    assert result["kinds"]["ranges"]["dropped"] == {
        "good is not True": 1,
        "zero or negative": 1,
        "the same link twice at one time": 1,
    }
    notes = " ".join(result["notes"])
    assert "Write it with the columns anchor,x,y,z in metres, world frame, for 1" in notes
    assert "sorted" in notes


def test_lists_constants_and_times_of_their_own(tmp_path):
    types = types_of("sqlite3")
    nodes = [types("my_uwb/msg/Node", id=i, distance=1.5 + i) for i in (4, 5)]
    mac = np.array([0xA0, 1, 2, 3, 4, 0xFF], dtype=np.uint8)
    messages = [
        ("/scan", T0, types("my_uwb/msg/Scan", stamp_s=12.25 + k, nodes=nodes, mac=mac))
        for k in range(2)
    ]
    log = write_bag(tmp_path / "scan", "sqlite3", types, messages)
    table = {
        "topic": "/scan",
        "time": "stamp_s",
        "anchor": "nodes[].id",
        "tag": "mac",
        "range": "nodes[].distance",
        "std": "=0.1",
    }
    recordings.convert_bag(log, tmp_path / "out", {"ranges": table})
    rows = read_csv(tmp_path / "out" / "ranges.csv")
    assert [tuple(row.values()) for row in rows] == [
        ("12.250000000", "4", "a001020304ff", "5.5", "0.1"),
        ("12.250000000", "5", "a001020304ff", "6.5", "0.1"),
        ("13.250000000", "4", "a001020304ff", "5.5", "0.1"),
        ("13.250000000", "5", "a001020304ff", "6.5", "0.1"),
    ]
    table |= {"anchor": "a@index", "time": "@bag"}
    with pytest.raises(ValueError, match="not a field path"):
        recordings.convert_bag(log, tmp_path / "out", {"ranges": table})
    table |= {"anchor": "@index", "tag": "{nodes[].id}-{stamp_s}"}
    result = recordings.convert_bag(log, tmp_path / "out", {"ranges": table})
    assert result["kinds"]["ranges"]["anchors"] == {"0": 2, "1": 2}
    assert set(result["kinds"]["ranges"]["tags"]) == {"4-12.25", "5-12.25", "4-13.25", "5-13.25"}


def test_milliseconds_are_told_by_their_unit(tmp_path):
    types = types_of("ros1")
    nodes = [types("my_uwb/msg/Node", id=4, distance=1.5)]
    mac = np.zeros(6, dtype=np.uint8)
    scans = [types("my_uwb/msg/Scan", stamp_s=k * 1e3 + 1, nodes=nodes, mac=mac) for k in range(5)]
    messages = [("/scan", T0 + k * 10**9, scan) for k, scan in enumerate(scans)]
    log = write_bag(tmp_path / "scan", "ros1", types, messages)
    table = {
        "topic": "/scan",
        "time": "stamp_s",
        "anchor": "nodes[].id",
        "tag": "=t",
        "range": "nodes[].distance",
    }
    with pytest.raises(ValueError, match=r"span 4000 s, but the recording lasts 4 s: .*time_unit"):
        recordings.convert_bag(log, tmp_path / "out", {"ranges": table})
    table["time_unit"] = "ms"
    result = recordings.convert_bag(log, tmp_path / "out", {"ranges": table})
    assert result["kinds"]["ranges"]["duration_s"] == 4.0


def miluv(types: Types):
    """Both ends of a link may be the robot's: tags 10 and 11, anchors 0 and 1, a robot 20."""
    pairs = [(10, 0), (11, 1), (0, 11), (10, 20), (20, 30), (10, 11)]
    for k, (of, to) in enumerate(pairs):
        fields = {"header": types.header(T0 + k), "range": 2.0, "from_id": of, "to_id": to}
        yield types.sent("/ifo001/uwb/range", T0, "uwb_ros/msg/RangeStamped", **fields)
        # An altimeter is no radio.
        yield types.sent("/ifo001/hrlv", T0, "sensor_msgs/msg/Range", range=1.0)


def test_the_tags_of_the_body_tell_the_ends_of_a_link(tmp_path):
    types = types_of("ros1")
    log = write_bag(tmp_path / "miluv", "ros1", types, miluv(types))
    result = recordings.convert_bag(log, tmp_path / "all")
    assert any("0, 11, 20 are used both as anchors and as tags" in note for note in result["notes"])
    result = recordings.convert_bag(log, tmp_path / "body", {"ranges": {"tags": ["10", "11"]}})
    rows = [(row["anchor"], row["tag"]) for row in read_csv(tmp_path / "body" / "ranges.csv")]
    assert rows == [("0", "10"), ("1", "11"), ("0", "11"), ("20", "10")]
    assert result["kinds"]["ranges"]["dropped"] == {
        "not a tag of the body": 1,
        "between two tags of the body": 1,
    }


def test_ranges_of_sensor_msgs_stand_one_topic_an_anchor(tmp_path):
    types = types_of("mcap")
    messages = [
        types.sent(
            f"/uwb/a{m}",
            T0 + k,
            "sensor_msgs/msg/Range",
            header=types.header(T0 + k, "tag"),
            range=value,
            min_range=0.3,
            max_range=50.0,
        )
        for k, value in enumerate([2.0, 0.1, float("inf"), 60.0, 3.0])
        for m in range(2)
    ]
    log = write_bag(tmp_path / "r", "mcap", types, messages)
    said = recordings.convert_bag(log, tmp_path / "out")["kinds"]["ranges"]
    assert said["anchors"] == {"/uwb/a0": 2, "/uwb/a1": 2}
    assert said["tags"] == {"tag": 4}
    assert said["dropped"] == {"outside the sensor's limits": 4, "not a finite number": 2}


def transforms(types: Types):
    for k in range(3):
        frames = []
        for child in ("base", "camera"):
            place = types.geometry("Vector3", (k, 1, 0))
            turn = types.geometry("Quaternion", (np.cos(0.1 * k), np.sin(0.1 * k)), "wz")
            transform = types("geometry_msgs/msg/Transform", translation=place, rotation=turn)
            frames.append(
                types(
                    "geometry_msgs/msg/TransformStamped",
                    transform=transform,
                    header=types.header(T0 + k, "/world"),
                    child_frame_id=child,
                )
            )
        yield types.sent("/tf", T0, "tf2_msgs/msg/TFMessage", transforms=frames)


def test_truth_from_a_tree_of_frames(tmp_path, capsys):
    types = types_of("sqlite3")
    log = write_bag(tmp_path / "tf", "sqlite3", types, transforms(types))
    out = tmp_path / "out"
    options = ["--out", str(out), "--ranges", "none", "--truth"]
    assert main(["convert", str(log), *options, "/tf"]) == 2
    assert "/tf has messages of many frames: give parent and child" in capsys.readouterr().err
    assert main(["convert", str(log), *options, "/tf,parent=world,child=base"]) == 0
    rows = read_csv(out / "truth.csv")
    assert list(rows[0]) == ["t", "x", "y", "z", "qw", "qx", "qy", "qz"]
    assert [float(row["x"]) for row in rows] == [0, 1, 2]
    assert float(rows[2]["qz"]) == np.sin(0.2)
    assert main(["convert", str(log), *options, "/tf,parent=world,child=bose"]) == 2
    said = "[truth] no message can be used: 3 dropped, transforms[].child_frame_id is base; "
    assert said + "3 dropped, transforms[].child_frame_id is camera" in capsys.readouterr().err


@pytest.mark.parametrize("keep", [False, True])
def test_a_constant_orientation_is_none(keep, tmp_path):
    """Total stations know places only."""
    types = types_of("ros1")
    pose = types("geometry_msgs/msg/Pose", orientation=types.geometry("Quaternion", (1,), "w"))
    kind = "geometry_msgs/msg/PoseStamped"
    messages = [
        types.sent("/leica", T0, kind, header=types.header(T0 + k), pose=pose) for k in range(3)
    ]
    log = write_bag(tmp_path / "leica", "ros1", types, messages)
    truth = {"orientation": "pose.orientation", "topic": "/leica"} if keep else {}
    mapping = {"ranges": {"topic": "none"}, "truth": truth}
    result = recordings.convert_bag(log, tmp_path / "out", mapping)
    width = 8 if keep else 4
    assert len(read_csv(tmp_path / "out" / "truth.csv")[0]) == width
    assert any("orientation never changes" in note for note in result["notes"]) != keep


def viral(types: Types, places, offsets):
    """Ranges with places of the anchor and of the antenna beside them."""
    for k, (place, offset) in enumerate(zip(places, offsets, strict=True)):
        yield types.sent(
            "/uwb",
            T0,
            "uwb_driver/msg/UwbRange",
            header=types.header(T0 + k),
            requester_id=200,
            antenna=0,
            responder_id=100 + k % 2,
            distance=2.0,
            responder_location=types.geometry("Point", place),
            rqst_antenna_offset=types.geometry("Point", offset),
        )


def test_anchors_that_move_and_places_that_nobody_knows(tmp_path):
    types = types_of("ros1")
    offsets = [(0.1, 0, 0)] * 4
    unknown = (99999.0, 99999.0, 99999.0)
    places = [(0, 0, 0), unknown, (0, 0, 0), unknown]
    log = write_bag(tmp_path / "a", "ros1", types, viral(types, places, offsets))
    result = recordings.convert_bag(log, tmp_path / "a")
    assert "anchors: the messages give no position of 101" in result["notes"]
    assert [row["anchor"] for row in read_csv(tmp_path / "a" / "anchors.csv")] == ["100"]
    places = [(0, 0, 0), (5, 0, 0), (1, 0, 0), (5, 0, 0)]
    log = write_bag(tmp_path / "b", "ros1", types, viral(types, places, offsets))
    recordings.convert_bag(log, tmp_path / "b")
    rows = read_csv(tmp_path / "b" / "anchors.csv")
    assert [(row["t"][-1], row["anchor"], row["x"]) for row in rows] == [
        ("0", "100", "0.0"),
        ("1", "101", "5.0"),
        ("2", "100", "1.0"),
        ("3", "101", "5.0"),
    ]
    offsets[2] = (-0.1, 0, 0)
    log = write_bag(tmp_path / "c", "ros1", types, viral(types, places, offsets))
    with pytest.raises(ValueError, match=r"tag '200\.0' has several positions.* 0\.2 m apart"):
        recordings.convert_bag(log, tmp_path / "c")


def test_anchors_that_move_come_back_as_a_recording(tmp_path):
    """0.1 m/s along x, for 10 s."""
    messages, types = [], types_of("mcap")
    for topic, time, message in flight(types):
        if topic == "/uwb_endorange_info" and message.responder_id == 103:
            message.responder_location.x += 1e-10 * (time - 5_000_000 - T0)
        messages.append((topic, time, message))
    log = write_bag(tmp_path / "moving", "mcap", types, messages)
    recordings.convert_bag(log, tmp_path)
    files = (tmp_path / f"{name}.csv" for name in ("ranges", "anchors", "tags"))
    anchors = recordings.read_recording(recordings.Files(*files)).anchors
    want = np.tile(ROOM, (101, 1, 1))
    want[:, 3, 0] = 0.01 * np.arange(101)
    np.testing.assert_allclose(anchors, want, atol=1e-6)


def test_clocks_that_differ_and_stamps_that_are_missing(tmp_path):
    types = types_of("ros1")
    messages = [
        *own_ranges(types, [(T0 + k - 3 * 10**9, 7, 1, 900, 0.1, True) for k in range(3)]),
        *(types.sent("/imu", T0 + k, "sensor_msgs/msg/Imu") for k in range(3)),
    ]
    log = write_bag(tmp_path / "own", "ros1", types, sorted(messages, key=lambda m: m[1]))
    result = recordings.convert_bag(log, tmp_path / "out", {"ranges": MINE})
    notes = " ".join(result["notes"])
    assert "imu: the messages have no stamps, so the times of recording are used" in notes
    assert "stamps are behind the times of recording by ranges 3.000 s, imu 0.000 s" in notes
    assert read_csv(tmp_path / "out" / "imu.csv")[1]["t"] == "1700000000.000000001"


def test_one_of_several_topics_is_not_guessed(tmp_path):
    types = types_of("ros1")
    messages = [
        types.sent(topic, T0 + k, "sensor_msgs/msg/Imu", header=types.header(T0 + k))
        for k in range(3)
        for topic in ("/a/imu", "/b/imu")
    ]
    log = write_bag(tmp_path / "two", "ros1", types, messages)
    none = {"ranges": {"topic": "none"}}
    result = recordings.convert_bag(log, tmp_path / "out", none)
    assert result["notes"] == [
        "imu not written, as several topics are possible, /a/imu, /b/imu: name one by --imu "
        "topic=NAME"
    ]
    result = recordings.convert_bag(log, tmp_path / "out", {**none, "imu": {"topic": "/b/*"}})
    assert result["kinds"]["imu"]["topics"] == ["/b/imu"]
    with pytest.raises(ValueError, match=r"imu\.csv exists and does not come from this log"):
        recordings.convert_bag(log, tmp_path / "out", {**none, "imu": {"topic": "none"}})


def test_a_bag_without_definitions_takes_those_of_a_folder(tmp_path, capsys):
    types = types_of("sqlite3")
    rows = [(T0 + k, 7, 1, 900, 0.1, True) for k in range(3)]
    folder = write_bag(tmp_path / "old", "sqlite3", types, own_ranges(types, rows))
    (database,) = folder.glob("*.db3")
    import sqlite3

    with sqlite3.connect(database) as connection:  # as ROS 2 Humble writes it
        connection.execute("DROP TABLE message_definitions")
        connection.execute("UPDATE schema SET schema_version = 3")
        connection.execute("UPDATE topics SET type_description_hash = ''")
    connection.close()
    given = ",".join(f"{key}={value}" for key, value in MINE.items())
    command = ["convert", str(database), "--out", str(tmp_path / "out"), "--ranges", given]
    assert main(command) == 2
    assert (
        "has no definition of the type my_uwb/msg/Range: give the folder" in capsys.readouterr().err
    )
    definition = tmp_path / "src" / "my_uwb" / "msg" / "Range.msg"
    definition.parent.mkdir(parents=True)
    definition.write_text(DEFINITIONS["my_uwb/msg/Range"])
    assert main([*command, "--messages", str(tmp_path / "src")]) == 0
    assert len(read_csv(tmp_path / "out" / "ranges.csv")) == 3


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    types = types_of("ros1")
    rows = [(T0 + k, 7, 1, 900, 0.1, True) for k in range(3)]
    return write_bag(
        tmp_path_factory.mktemp("small") / "small", "ros1", types, own_ranges(types, rows)
    )


def test_topics_and_fields_are_listed(small, capsys):
    assert main(["convert", str(small), "--list"]) == 0
    shown = capsys.readouterr().out
    assert "/uwb" in shown
    assert "my_uwb/msg/Range" in shown
    assert main(["convert", str(small), "--list", "/uwb", "--json"]) == 0
    fields = json.loads(capsys.readouterr().out)["fields"]
    assert fields["range_mm"] == "900"
    assert fields["header.stamp.sec"] == "1700000000"
    assert recordings.show_message(small, "/uwb")[-1] == ("good", "True")
    (row,) = recordings.list_topics(small, {"ranges": MINE})
    assert (row["messages"], row["read_as"]) == (3, ["ranges"])


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({}, r"no topic has a known type of ranges.*/uwb \(my_uwb/msg/Range\)"),
        (
            {"ranges": {"topic": "/uwb"}},
            "my_uwb/msg/Range: give the field paths of anchor, tag, range",
        ),
        (
            {"ranges": {**MINE, "topic": "/x"}},
            r"topic '/x', which the log does not have; its topics are",
        ),
        (
            {"ranges": {**MINE, "range": "dist"}},
            r"topic /uwb, \[ranges\]: no field 'dist', the fields are header, here, there",
        ),
        ({"ranges": {**MINE, "tag": "header.frame"}}, "no field 'header.frame', the fields are"),
        ({"ranges": {**MINE, "range": "header"}}, "range must be a number, got std_msgs__msg__Hea"),
        ({"ranges": {**MINE, "range": "a b"}}, "'a b' is not a field path"),
        ({"ranges": {**MINE, "anchor": "@node"}}, "'@node' must be one of"),
        ({"ranges": {**MINE, "unit": "ft"}}, "unit must be one of .* got 'ft'"),
        ({"ranges": {**MINE, "time_unit": "min"}}, "time_unit must be one of .* got 'min'"),
        ({"ranges": {**MINE, "time": "header.frame_id"}}, "time must be a stamp or a number"),
        (
            {"ranges": {**MINE, "anchors": "x"}},
            r"\[ranges\] has an unknown key .*did you mean 'anchor'",
        ),
        ({"range": MINE}, r"table \[range\] is unknown.*did you mean 'ranges'"),
        (
            {"ranges": MINE, "truth": {"topic": "/uwb", "position": "header.stamp"}},
            "position must be x, y, z, got",
        ),
        (
            {"ranges": MINE, "truth": {"topic": "/uwb", "position": "here", "child": "b"}},
            "must not have the key child, as messages of type my_uwb/msg/Range",
        ),
    ],
)
def test_what_is_wrong_names_file_topic_and_field(mapping, message, small, tmp_path):
    with pytest.raises(ValueError, match=message) as error:
        recordings.convert_bag(small, tmp_path, mapping)
    assert not list(tmp_path.iterdir())
    if "unknown" not in message:
        assert str(small) in str(error.value)


@pytest.mark.parametrize("name", ["x.bag", "x.mcap", "x.db3"])
def test_a_file_that_is_no_bag_is_refused_by_name(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(range(200)))
    with pytest.raises(ValueError, match=f"{name}: cannot be read, .+"):
        recordings.list_topics(path)
    with pytest.raises(ValueError, match="no such file or folder"):
        recordings.list_topics(tmp_path / "absent.bag")
    path.rename(tmp_path / "x.csv")
    with pytest.raises(ValueError, match=r"x\.csv: must be a \.bag, \.db3 or \.mcap file"):
        recordings.list_topics(tmp_path / "x.csv")
    with pytest.raises(ValueError, match=r"must have a file metadata\.yaml"):
        recordings.list_topics(tmp_path)


def test_a_bag_cut_short_is_refused_by_name(small, tmp_path):
    path = tmp_path / "cut.bag"
    path.write_bytes(small.read_bytes()[:-300])
    with pytest.raises(ValueError, match=r"cut\.bag: cannot be read"):
        recordings.convert_bag(path, tmp_path / "out", {"ranges": MINE})


def test_options_as_a_table(capsys, small, tmp_path):
    from rbl_gym.app.convert_command import _table

    assert _table("/uwb,/b,tag==t0,tags=1,2") == {
        "topic": ["/uwb", "/b"],
        "tag": "=t0",
        "tags": ["1", "2"],
    }
    with pytest.raises(SystemExit):
        main(["convert", str(small), "--ranges", "tag=a,tag=b"])
    assert "each key once" in capsys.readouterr().err
    assert main(["convert", str(small)]) == 2
    assert "--out DIR must be given" in capsys.readouterr().err
    bad = tmp_path / "bad.toml"
    bad.write_text("[ranges")
    assert main(["convert", str(small), "--list", "--map", str(bad)]) == 2
    assert "bad.toml: must be a TOML file" in capsys.readouterr().err


def test_field_paths_into_lists():
    from types import SimpleNamespace

    message = SimpleNamespace(a=[1, 2, 3], b=[SimpleNamespace(c=5), SimpleNamespace(c=6)], d="x ")
    received = bag_fields.Received(message, "/t", 9)
    paths = ("a[1]", "b[].c", "@topic", "@bag", "@index", "{d}:{b[].c}", "=k")
    getters = [bag_fields.getter(path) for path in paths]
    assert bag_fields.rows(received, getters) == [
        (2, 5, "/t", 9, 0, "x:5", "k"),
        (2, 6, "/t", 9, 1, "x:6", "k"),
    ]
    with pytest.raises(ValueError, match=r"the same length, got \[2, 3\]"):
        bag_fields.rows(received, [bag_fields.getter("a[]"), bag_fields.getter("b[].c")])
    with pytest.raises(KeyError, match="no item 'a\\[7\\]', the list has 3"):
        bag_fields.getter("a[7]")(received)


@pytest.mark.parametrize("form", FORMATS)
def test_a_damaged_log_is_read_or_refused(form, tmp_path):
    types, rng = types_of(form), np.random.default_rng(0)
    rows = [(T0 + k, 7, 1, 900, 0.1, True) for k in range(20)]
    log = write_bag(tmp_path / "log", form, types, own_ranges(types, rows))
    if log.is_dir():
        (log,) = (file for file in log.iterdir() if file.suffix != ".yaml")
    whole, path = log.read_bytes(), tmp_path / f"damaged{log.suffix}"
    refusals = []
    for _ in range(40):
        damaged = bytearray(whole)
        for place in rng.integers(len(whole), size=3):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(whole) // 2, 2 * len(whole))])
        try:
            recordings.convert_bag(path, tmp_path / "out", {"ranges": MINE})
        except ValueError as error:
            refusals.append(str(error))
    assert refusals
    assert all("damaged" in said for said in refusals)
