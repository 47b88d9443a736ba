"""Files of paths and trajectories that are refused, each in one line of `cvqmpt certify`."""

import os

import pytest
from command_line import refused

TIMED = '{"points": [{"positions": [1], "time_from_start": %s}]}'
POINT = '{"positions": [1], "accelerations": [%s], "time_from_start": {"sec": 0}}'


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "", "empty"),
        ("a.csv", "1,2\n3\n", "not understood"),
        ("a.csv", "q1,q2\n1,2\n3,4\n", "the robot has panda_joint1"),
        ("a.csv", "time,q1_position,force\n1,2,3\n", "column 'force'"),
        ("a.json", "{", "not json"),
        ("a.json", "{}", "no 'states', 'path' or 'points'"),
        ("a.json", '[["x"]]', "not understood"),
        ("a.json", "[[1, 2], [3]]", "not understood"),
        ("a.json", '[["0.1", 2], [3, 4]]', "not understood"),
        ("a.json", "[[true, 2], [3, 4]]", "not understood"),
        ("a.json", TIMED % '{"sec": true}', "sec True: give a whole number"),
        ("a.json", TIMED % '{"sec": 0.5}', "sec 0.5: give a whole number"),
        ("a.json", TIMED % '{"sec": -1}', "sec -1: give a whole number"),
        ("a.json", TIMED % '{"nanosec": 1}', "sec None: give a whole number"),
        ("a.json", TIMED % '{"sec": 1, "nanosec": 5e9}', "point 0: nanosec 5000000000.0: give a"),
        ("a.json", TIMED % '{"sec": 1, "nanosec": 5000000000}', "from 0 to 999999999"),
        ("a.json", TIMED % '{"sec": 1, "nanosec": -5}', "nanosec -5: give a whole number from 0"),
        ("a.json", TIMED % '{"sec": 1, "nsecs": 5}', "key of time_from_start of point 0 'nsecs'"),
        ("a.json", TIMED % "1.5", "time_from_start of point 0 is 1.5"),
        ("a.json", '{"points": [{"position": [1]}]}', "key of point 0 'position'"),
        ("a.json", '{"points": [], "joint_name": ["a"]}', "key of the trajectory 'joint_name'"),
        ("a.csv", "0.0_9,1\n1,2\n", "'0.0_9': give a decimal number"),
        ("a.csv", "q1,q2\n1,1_0\n", "'1_0': give a decimal number"),
        ("a.csv", "0.1,\u0663\n1,2\n", "'\u0663': give a decimal number"),
        ("a.csv", "1,2\n1,0x1\n", "'0x1': give a decimal number"),
        ("a.json", '{"joint_names": 3, "states": []}', "list of names"),
        ("a.json", '{"points": [{"time_from_start": 3}]}', "no 'positions'"),
        ("a.json", '{"points": 7}', "not understood"),
        ("a.json", f'{{"points": [{POINT % 0}, {POINT % ""}]}}', "point 1 has no 'accelerations'"),
        ("a.json", "[" * 100_000, "not understood"),
        ("a.txt", "", "'.txt'"),
    ],
)
def test_what_is_no_motion_is_one_line(tmp_path, capsys, name, text, words):
    (tmp_path / name).write_text(text)
    assert words in refused(capsys, "certify", tmp_path / name, "place-task")


def test_a_pipe_or_a_device_is_no_motion(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "device.csv").symlink_to("/dev/zero")
    for name in ("pipe.csv", "device.csv"):
        assert "not a regular file" in refused(capsys, "certify", tmp_path / name, "place-task")
