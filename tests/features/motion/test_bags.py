"""Motions in recordings: an MCAP file is written with a message of ROS 2, and read again."""

import sqlite3
from contextlib import closing

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, Header
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.writer import Writer
from refusals import refused

from cvqmpt_lab.features.motion import bags
from cvqmpt_lab.features.motion.trajectory import read_motion

STATES = [[0.0, 1.0], [0.5, 1.5]]


def written(path, topics=("/plan",), states=STATES, time=1):
    """Write a recording with a motion on each topic at a time [ns], and a text on /log."""
    points = [
        {"positions": q, "time_from_start": {"sec": k, "nanosec": 0}} for k, q in enumerate(states)
    ]
    message = {"joint_names": ["first", "second"], "points": points}
    with path.open("wb") as file, Writer(file) as writer:
        text = writer.register_msgdef("std_msgs/msg/String", "string data")
        writer.write_message("/log", text, {"data": "ready"}, 0, 0)
        kind = writer.register_msgdef("trajectory_msgs/msg/JointTrajectory", bags.JOINT_TRAJECTORY)
        for topic in topics:
            writer.write_message(topic, kind, message, time, time)
    return path


def test_a_recording_has_the_motion(tmp_path):
    file = written(tmp_path / "a.mcap")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    for path in (file, tmp_path):  # the folder is that of rosbag2
        motion = read_motion(path, "/plan")
        assert motion.joint_names == ("first", "second") and motion.velocities is None
        np.testing.assert_array_equal(motion.positions, STATES)
        np.testing.assert_array_equal(motion.times, [0.0, 1.0])


def test_the_last_message_of_a_bag_is_that_of_the_latest_time(tmp_path):
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    for k in (2, 10):
        written(tmp_path / f"rec_{k}.mcap", states=[[float(k), 0.0], [0.0, 0.0]], time=k)
    assert read_motion(tmp_path).positions[0, 0] == 10.0


@pytest.mark.parametrize(
    ("topics", "chosen", "told"),
    [
        ((), None, r"has no topic with a JointTrajectory, .* its topics: /log \(String\)"),
        (("/plan", "/other"), None, "has motions on /plan, /other: choose one by --topic"),
        (("/plan",), "/nope", "topic '/nope'; valid choices: /plan"),
    ],
)
def test_a_recording_without_the_topic_is_one_line(tmp_path, topics, chosen, told):
    refused(told, read_motion, written(tmp_path / "a.mcap", topics), chosen)


def test_what_is_no_recording_is_one_line(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"no recording")
    refused("cannot read recording", read_motion, tmp_path / "a.mcap")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("")
    refused("has no file .mcap or .db3", read_motion, tmp_path / "bag")
    refused("topic '/plan' belongs to a recording", read_motion, tmp_path / "a.csv", "/plan")


def in_sqlite(path, definitions=None, kind="JointTrajectory", time=1, states=STATES):
    """Write a sqlite file of rosbag2: of ROS 2 Humble, or with definitions of messages."""
    folder = path.parent / "mcap"
    folder.mkdir(exist_ok=True)
    with written(folder / "a.mcap", states=states).open("rb") as file:
        messages = {
            channel.topic: message.data for _, channel, message in make_reader(file).iter_messages()
        }
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
            "serialization_format TEXT, offered_qos_profiles TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB);"
        )
        kinds = {"/log": "std_msgs/msg/String", "/plan": f"trajectory_msgs/msg/{kind}"}
        for k, (topic, name) in enumerate(kinds.items(), 1):
            base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (k, topic, name))
            row = k, time, messages[topic]
            base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        if definitions is not None:
            base.execute(
                "CREATE TABLE message_definitions(topic_type TEXT, encoded_message_definition TEXT)"
            )
            base.execute("INSERT INTO message_definitions VALUES (?, ?)", definitions)
        base.commit()
    return path


def test_sqlite_files_are_read(tmp_path):
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    in_sqlite(tmp_path / "rec_10.db3", time=10, states=[[10.0, 0.0], [0.0, 0.0]])
    file = in_sqlite(tmp_path / "rec_2.db3", time=2)
    motion = read_motion(file)
    assert motion.joint_names == ("first", "second")
    np.testing.assert_array_equal(motion.positions, STATES)
    assert read_motion(tmp_path, "/plan").positions[0, 0] == 10.0
    assert sorted(path.name for path in tmp_path.glob("rec*")) == ["rec_10.db3", "rec_2.db3"]
    refused("has no topic with a JointTrajectory, .*: /log", read_motion, no_motion(file))


def no_motion(file):
    with closing(sqlite3.connect(file)) as base:
        base.execute("DELETE FROM topics WHERE name = '/plan'")
        base.commit()
    return file


def test_messages_in_sqlite_are_those_that_it_defines(tmp_path, monkeypatch):
    own = "trajectory_msgs/msg/RobotTrajectory", bags.JOINT_TRAJECTORY
    file = in_sqlite(tmp_path / "a.db3", own, "RobotTrajectory")
    np.testing.assert_array_equal(read_motion(file).positions, STATES)
    in_sqlite(file, kind="RobotTrajectory")
    refused("does not say what a trajectory_msgs/msg/RobotTrajectory is", read_motion, file)
    monkeypatch.setattr(bags, "MAX_CHUNK", 100)
    refused(r"a message of it has \d+ bytes, at most 100", read_motion, in_sqlite(file))
    file.write_bytes(b"no base")
    refused("cannot read recording", read_motion, file)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_chunk_larger_than_the_bound_is_refused_before_it_is_unpacked(
    tmp_path, monkeypatch, compression
):
    """The index of the recording and its header of the chunk state a small size."""
    content = b"\0" * 3_000_000
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[compression]
    chunk = Chunk(compression, packed(content), 0, 0, 0, len(content) if not compression else 9)
    told = r"bag.mcap: a chunk of it unpacks to \d+ bytes or more, at most 1000000 are read"
    path = tmp_path / "bag.mcap"
    with path.open("wb") as stream:
        writer = RecordBuilder()
        Header(profile="ros2", library="").write(writer)
        chunk.write(writer)
        stream.write(MCAP0_MAGIC + writer.end())
    monkeypatch.setattr(bags, "MAX_CHUNK", 10**6)
    monkeypatch.setattr(zstandard, "decompress", lambda *_: pytest.fail("unpacked"))
    refused(told, bags.message_of_bag, path)
