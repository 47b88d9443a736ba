"""Motions in ROS messages, yaml, npz and csv are the same; what cannot be judged is refused."""

import json

import numpy as np
import pytest
import yaml
from refusals import refused

from cvqmpt_lab.features.motion.trajectory import read_motion

STATES = [[0.0, 1.0], [0.5, 1.0], [1.0, 2.0]]
NAMES = ["first", "second"]


def message(states, times, names=NAMES):
    """A JointTrajectory without velocities, as MoveIt leaves empty what it does not know."""
    points = [
        {
            "positions": q,
            "velocities": [],
            "accelerations": [],
            "time_from_start": {"sec": int(t), "nanosec": int(1e9 * (t % 1.0))},
        }
        for q, t in zip(states, times, strict=True)
    ]
    return {"header": {"frame_id": ""}, "joint_names": names, "points": points}


WHOLE = message(STATES, [0.0, 1.5, 2.0])
NO_BASE = {"joint_names": [], "points": []}
ROBOT = {"joint_trajectory": WHOLE, "multi_dof_joint_trajectory": NO_BASE}
PARTS = [
    {"joint_trajectory": message(STATES[:2], [0.0, 1.5])},
    {"joint_trajectory": message(STATES[1:], [0.0, 0.5])},
]
OLD = json.loads(json.dumps(WHOLE).replace('"nanosec"', '"nsecs"').replace('"sec"', '"secs"'))
FLOATS = message(STATES, [0.0, 1.5, 2.0])
for point, time in zip(FLOATS["points"], (0, 1.5, 2.0), strict=True):
    point["time_from_start"] = time
MESSAGES = {
    "numbers.json": FLOATS,
    "numbers.yaml": {"trajectory": [{"joint_trajectory": FLOATS}]},
    "robot.json": ROBOT,
    "result.json": {"trajectory": ROBOT, "error_code": {"val": 1}},
    "display.json": {"model_id": "arm", "trajectory": PARTS, "trajectory_start": {}},
    "ros1.json": OLD,
    "controller.yaml": {"trajectory": WHOLE},
}


@pytest.mark.parametrize("name", [*MESSAGES, "arrays.npz", "names.csv"])
def test_every_form_of_a_motion_is_read_alike(tmp_path, name):
    file = tmp_path / name
    if name.endswith(".npz"):
        np.savez(file, t=[0.0, 1.5, 2.0], q=STATES, joint_names=NAMES)
    elif name.endswith(".csv"):
        rows = [[t, *q] for t, q in zip((0.0, 1.5, 2.0), STATES, strict=True)]
        file.write_text("time,first,second\n" + "\n".join(",".join(map(str, r)) for r in rows))
    else:
        text = json.dumps(MESSAGES[name])
        # as ros2 topic echo prints it
        as_yaml = yaml.safe_dump(json.loads(text)) + "---\n"
        file.write_text(as_yaml if name.endswith(".yaml") else text)
    motion = read_motion(file)
    assert motion.joint_names == tuple(NAMES) and motion.velocities is None
    np.testing.assert_array_equal(motion.positions, STATES)
    np.testing.assert_allclose(motion.times, [0.0, 1.5, 2.0], rtol=1e-15)
    # messages have seconds and nanoseconds; other numbers may be milliseconds
    assert motion.in_seconds == (name in MESSAGES and "numbers" not in name)


BASE = {"joint_trajectory": WHOLE, "multi_dof_joint_trajectory": {"points": [{}]}}
APART = [PARTS[1], PARTS[0]]
OTHERS = [PARTS[0], {"joint_trajectory": message(STATES[1:], [0.0, 0.5], ["first", "third"])}]
MOVING = [PARTS[0], {"joint_trajectory": message(STATES[1:], [0.0, 0.5])}]
for point in MOVING[1]["joint_trajectory"]["points"]:
    point["accelerations"] = [500.0, 0.0]
LATE = [PARTS[0], {"joint_trajectory": message(STATES[1:], [0.25, 0.5])}]
CARRIED = {"attached_collision_objects": [{"link_name": "hand", "object": {"id": "pole"}}]}
PATH = {"joint_names": NAMES, "states": STATES}
REFUSED = {
    "multi_dof_joint_trajectory moves a mobile base": BASE,
    "multi_dof_trajectory moves a mobile base": {
        "trajectory": WHOLE,
        "multi_dof_trajectory": {"points": [{}]},
    },
    "trajectory 1 does not begin where trajectory 0 ends .it has other positions": {
        "trajectory": APART
    },
    "trajectory 0 ends .it has other accelerations": {"trajectory": MOVING},
    "trajectory 0 ends .its first time is not 0": {"trajectory": LATE},
    "the robot carries pole; remove it": {"trajectory": PARTS, "trajectory_start": CARRIED},
    "'times' beside 'states' is not read": PATH | {"times": [0.0, 1.0, 2.0]},
    "'velocities' beside 'path' is not read": {"path": STATES, "velocities": STATES},
    "trajectory 1 moves joints .'first', 'third'.": {"trajectory": OTHERS},
    "its trajectory is empty": {"joint_trajectory": {"joint_names": [], "points": []}},
    "it ends with '...': print it by ros2 topic echo --full-length": {"points": [{}, "..."]},
}


@pytest.mark.parametrize("told", REFUSED)
def test_a_message_that_cannot_be_judged_is_one_line(tmp_path, told):
    (tmp_path / "m.json").write_text(json.dumps(REFUSED[told]))
    refused(told, read_motion, tmp_path / "m.json")


def test_arrays_without_states_are_one_line(tmp_path):
    np.savez(tmp_path / "m.npz", states=STATES)
    refused("it has no array 'q' of states", read_motion, tmp_path / "m.npz")
    np.savez(tmp_path / "m.npz", q=np.empty((0, 7)))
    refused("m.npz: it has no states", read_motion, tmp_path / "m.npz")
    np.savez(tmp_path / "m.npz", q=STATES, v=STATES)
    refused("no times 't'", read_motion, tmp_path / "m.npz")


@pytest.mark.parametrize("name", ["m.json", "m.npz", "m.csv"])
def test_accelerations_without_velocities_are_one_line(tmp_path, name):
    """No curve is made of positions and accelerations alone, which were ignored."""
    times = [0.0, 1.5, 2.0]
    if name == "m.json":
        pushed = message(STATES, times)
        for point in pushed["points"]:
            point["accelerations"] = [1e6, 1e6]
        (tmp_path / name).write_text(json.dumps(pushed))
    elif name == "m.npz":
        np.savez(tmp_path / name, t=times, q=STATES, a=STATES)
    else:
        kinds = ("position", "acceleration")
        head = ["time", *(f"{joint}_{kind}" for kind in kinds for joint in NAMES)]
        rows = [head, *([t, *q, *q] for t, q in zip(times, STATES, strict=True))]
        (tmp_path / name).write_text("\n".join(",".join(map(str, row)) for row in rows))
    told = refused("accelerations, but no velocities: give both", read_motion, tmp_path / name)
    assert name in told
