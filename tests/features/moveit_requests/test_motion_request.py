"""Motions judged by MoveIt's requests: kept, dropped and missed conditions; requests refused."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from command_line import refused
from refusals import refused as called
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.cli.main import main
from cvqmpt_lab.cli.robot_command import with_tool_speed
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.features.moveit_requests.motion_request import (
    MotionRequest,
    judge_request,
    read_request,
)
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import FrameLimit
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget

FREE = 3.1416
AT_ORIGIN = {
    "position": {"x": 0.4, "y": 0.0, "z": 0.5},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}
ANYTHING = {"path_constraints": {}}


def quaternion(R):
    return dict(zip("xyzw", Rotation.from_matrix(R).as_quat().tolist(), strict=True))


@pytest.fixture(scope="module")
def request_of(problem, solution):
    """Return the request of the place task: upright within 0.1 rad, to the solution's last state.

    The rotation vector from the upright orientation is bounded about y and z.
    """
    robot, upright = problem.robot, problem.constraint[0]
    end = solution.path.states[-1]
    joints = [
        {"joint_name": name, "position": q, "tolerance_above": 1e-3, "tolerance_below": 1e-3}
        for name, q in zip(robot.joint_names, end.tolist(), strict=True)
    ]
    R = upright.T0_w[:3, :3] @ upright.Tw_e[:3, :3]
    tilt = {
        "header": {"frame_id": "panda_link0"},
        "link_name": "panda_hand",
        "orientation": quaternion(R),
        "absolute_x_axis_tolerance": FREE,
        "absolute_y_axis_tolerance": 0.101,
        "absolute_z_axis_tolerance": 0.101,
        "parameterization": 1,
    }

    def made(**changed):
        """The request with changed fields; those of `tilt` by their names."""
        told = {key: changed.pop(key) for key in list(changed) if key in tilt}
        return {
            "group_name": "panda_arm",
            "goal_constraints": [{"joint_constraints": joints}],
            "path_constraints": {"orientation_constraints": [tilt | told]},
            "max_velocity_scaling_factor": 0.1,
            **changed,
        }

    return made


@pytest.fixture
def judged(tmp_path, problem):
    def judge(request, states):
        (tmp_path / "r.json").write_text(json.dumps(request))
        made = read_request(tmp_path / "r.json", problem.robot)
        motion = Motion(problem.robot.joint_names, states)
        return judge_request(motion, made, problem.robot, problem.scene)[1]

    return judge


@pytest.fixture(scope="module")
def dropped(problem, solution):
    """A path to the same goal without the constraint, as MoveIt returns when it drops one."""
    free = replace(problem, constraint=(), goals=solution.path.states[-1:])
    return solve(free, "birrt", Budget(iterations=20_000), seed=0).path.states


@pytest.mark.parametrize("kind", [0, 1])
def test_a_dropped_orientation_constraint_is_found(judged, request_of, solution, dropped, kind):
    # where the hand is turned about the vertical, Euler angles exceed entries of the vector
    most = 0.17 if kind == 0 else 0.101
    wide = {f"absolute_{axis}_axis_tolerance": most for axis in "yz"}
    request = request_of(parameterization=kind, **wide)
    kept = judged(request, solution.path.states)
    assert kept.certified, kept.check.certificate.reasons
    lost = judged(request, dropped)
    assert "manifold" in {fault.kind for fault in lost.check.certificate.faults}


def test_euler_angles_beyond_their_tolerance_by_a_milliradian_are_found(
    judged, request_of, problem, solution
):
    states = solution.path.states
    R = np.linalg.inv(problem.robot.poses(states)[:, :3, :3])[0]
    request = request_of(parameterization=0, orientation=quaternion(R.T))
    turned = R @ problem.robot.poses(states)[:, :3, :3]
    most = np.abs(Rotation.from_matrix(turned).as_euler("XYZ")).max(axis=0)
    axes = ("absolute_x_axis_tolerance", "absolute_y_axis_tolerance", "absolute_z_axis_tolerance")
    names = {axis: float(value) for axis, value in zip(axes, most + 0.05, strict=True)}
    tilt = request["path_constraints"]["orientation_constraints"][0]
    tilt.update(names)
    assert judged(request, states).certified
    for axis, value in zip(axes, most, strict=True):
        tilt.update(names | {axis: float(value) - 1e-3})
        faults = judged(request, states).check.certificate.faults
        assert [fault.kind for fault in faults] == ["manifold"], axis


def test_goals_and_starts_that_are_missed_are_found(judged, request_of, problem, solution):
    states = solution.path.states
    kinds = {fault.kind for fault in judged(request_of(), states[:-3]).check.certificate.faults}
    assert kinds == {"goal"}
    start = {"joint_state": {"name": ["panda_joint1"], "position": [states[0, 0] + 0.1]}}
    start["is_diff"] = True
    faults = judged(request_of(start_state=start), states).check.certificate.faults
    assert [fault.kind for fault in faults] == ["current"]
    bounds = {"joint_name": "panda_joint1", "position": float(states[:, 0].min())}
    request = request_of()
    request["path_constraints"]["joint_constraints"] = [bounds]
    assert "panda_joint1 is at" in judged(request, states).first_fault.text


@pytest.mark.parametrize(
    ("shape", "kept"),
    [
        ({"type": 1, "dimensions": [0.1, 0.1, 0.1]}, False),
        ({"type": 1, "dimensions": [3.0, 3.0, 3.0]}, True),
        ({"type": 2, "dimensions": [0.3]}, False),
        ({"type": 2, "dimensions": [1.5]}, True),
        ({"type": 3, "dimensions": [2.0, 0.3]}, False),
        ({"type": 3, "dimensions": [2.0, 1.2]}, True),
    ],
)
def test_positions_stay_in_their_region(judged, request_of, solution, shape, kept):
    request = request_of()
    place = {"primitives": [shape], "primitive_poses": [{"position": {"x": 0.0, "y": 0, "z": 0.5}}]}
    bounds = {"link_name": "panda_hand", "constraint_region": place, "target_point_offset": {}}
    request["path_constraints"]["position_constraints"] = [bounds]
    assert judged(request, solution.path.states).certified == kept


def test_the_command_judges_by_a_request(tmp_path, capsys, request_of, solution, problem):
    np.savetxt(tmp_path / "m.csv", solution.path.states, delimiter=",", fmt="%.17g")
    (tmp_path / "r.yaml").write_text(json.dumps({"request": request_of()}))
    words = ["certify", str(tmp_path / "m.csv"), "--request", str(tmp_path / "r.yaml")]
    assert main(words) == 0
    told = capsys.readouterr()
    assert told.out.startswith("certificate certified") and "no --scene is given" in told.err
    said = refused(capsys, *words, "--current", "0 0 0 0 0 0 0")
    assert "--current does not go with --request" in said


WRONG = {
    "link_name 'panda_hnad'": {"link_name": "panda_hnad"},
    "parameterization is 3": {"parameterization": 3},
    "frame_id 'panda_link5' is moved by the planned joints": {
        "header": {"frame_id": "panda_link5"}
    },
    "absolute_x_axis_tolerance is 'wide'": {"absolute_x_axis_tolerance": "wide"},
    "trajectory_constraints are not judged": {"trajectory_constraints": {"constraints": [{}]}},
    "unknown key of the request 'path_constraint'": {"path_constraint": {}},
    "unknown key of goal_constraints[0] 'joints'": {"goal_constraints": [{"joints": []}]},
    "unknown key of orientation 'axis'": {
        "path_constraints": {"orientation_constraints": [{"axis": "z"}]}
    },
    "the robot carries can; remove it": {
        "start_state": {"attached_collision_objects": [{"object": {"id": "can"}}]}
    },
    "goal_constraints is 3": {"goal_constraints": 3},
    "group_name 'hand' moves none of the robot's joints": {"group_name": "hand"},
    "start_state has joints 'elbow'; the robot has": {
        "start_state": {"joint_state": {"name": ["elbow"], "position": [0.0]}}
    },
    "start_state has no value of panda_joint2, panda_joint3": {
        "start_state": {"joint_state": {"name": ["panda_joint1"], "position": [0.0]}}
    },
    "start_state is 'garbage'": {"start_state": "garbage"},
    "unknown key of start_state 'joint_stat'": {"start_state": {"joint_stat": {}}},
    "unknown key of start_state.joint_state 'names'": {
        "start_state": {"joint_state": {"names": ["panda_joint1"], "positions": [2.0]}}
    },
    "'panda_joint1' occurs twice": {
        "start_state": {"joint_state": {"name": ["panda_joint1"] * 2, "position": [0.0, 0.0]}}
    },
    "start_state.joint_state.velocity is [0.0, 0.5], but motions are judged from rest": {
        "start_state": {"joint_state": {"velocity": [0.0, 0.5]}}
    },
    "start_state.multi_dof_joint_state places ['base'], which is not judged": {
        "start_state": {"multi_dof_joint_state": {"joint_names": ["base"], "transforms": [{}]}}
    },
    "position 40 of panda_joint1 is outside its limits": {
        "path_constraints": {"joint_constraints": [{"joint_name": "panda_joint1", "position": 40}]}
    },
}


def test_an_object_that_is_no_request_is_refused(tmp_path, problem):
    for empty in ({}, {"motion_plan_request": {}}):
        (tmp_path / "r.json").write_text(json.dumps(empty))
        with pytest.raises(InvalidInputError, match="the request is empty: any motion"):
            read_request(tmp_path / "r.json", problem.robot)
    (tmp_path / "r.json").write_text(json.dumps({"robot": {"name": "panda"}, "scene": {}}))
    with pytest.raises(InvalidInputError, match="unknown key of the request 'robot'; valid"):
        read_request(tmp_path / "r.json", problem.robot)


def test_constraints_that_ask_nothing_are_refused(tmp_path, problem):
    """Any motion met them, and was certified."""
    none = {"joint_constraints": [], "position_constraints": [], "orientation_constraints": []}
    for told, what in (
        ({"name": "upright", **none}, "the request has no constraint"),
        ({"goal_constraints": [none]}, r"goal_constraints\[0\] has no constraint"),
    ):
        (tmp_path / "r.json").write_text(json.dumps(told))
        called(f"{what}.*any motion", read_request, tmp_path / "r.json", problem.robot)
    # a request without path constraints is usual
    (tmp_path / "r.json").write_text(json.dumps({"path_constraints": none}))
    read_request(tmp_path / "r.json", problem.robot)


def test_the_frame_of_a_speed_limit_has_two_names(tmp_path, request_of, problem):
    for name in ("cartesian_speed_limited_link", "cartesian_speed_end_effector_link"):
        request = request_of(max_cartesian_speed=0.5, **{name: "panda_link4"})
        (tmp_path / "r.json").write_text(json.dumps(request))
        assert list(read_request(tmp_path / "r.json", problem.robot).frame_limits) == [
            "panda_link4"
        ]


def test_the_links_of_a_request_are_links_also_where_the_robot_has_a_tool(tmp_path, request_of):
    """MoveIt knows of no tool: also the limited link that a request does not name is a link."""
    robot = robot_from_source({"name": "panda", "tool": {"xyz": [0.0, 0.0, 0.2]}})
    sphere = {"primitives": [{"type": 2, "dimensions": [0.01]}], "primitive_poses": [AT_ORIGIN]}
    position = {"link_name": "panda_hand", "constraint_region": sphere}
    request = request_of(
        max_cartesian_speed=0.5, goal_constraints=[{"position_constraints": [position]}]
    )
    (tmp_path / "r.json").write_text(json.dumps(request))
    made = read_request(tmp_path / "r.json", robot)
    assert list(made.frame_limits) == ["panda_hand"]
    (tilt,), (goal,) = made.path.regions, made.goals[0].regions
    for region in (tilt, goal):
        assert region.links(robot)[1][1] is robot.tool_links["panda_hand"][1]


BESIDE = {
    "unknown key of the message 'nonsense'": {"nonsense": 1},
    "the robot carries pole; remove it": {
        "robot_state": {"attached_collision_objects": [{"object": {"id": "pole"}}]}
    },
    "planning_scene_diff adds 'wall'; write it into a PlanningScene": {
        "world": {"collision_objects": [{"id": "wall"}]}
    },
    "planning_scene_diff adds an octomap": {"world": {"octomap": {"octomap": {"data": [1]}}}},
    "planning_scene_diff has a joint_state": {
        "robot_state": {"joint_state": {"name": ["panda_joint1"], "position": [1.0]}}
    },
}


@pytest.mark.parametrize("told", BESIDE)
def test_what_stands_beside_a_request_is_not_dropped(tmp_path, problem, told):
    diff = {"world": {"collision_objects": []}, "robot_state": {"is_diff": True}}
    whole = {"request": ANYTHING, "planning_options": {"planning_scene_diff": diff}}
    file = tmp_path / "r.json"
    file.write_text(json.dumps(whole))
    assert read_request(file, problem.robot) == MotionRequest()
    if "nonsense" in BESIDE[told]:
        whole |= BESIDE[told]
    diff |= BESIDE[told]
    file.write_text(json.dumps(whole))
    called(re.escape(told), read_request, file, problem.robot)


def test_joints_that_the_robot_holds_are_where_the_start_state_says(tmp_path, problem):
    file, names = tmp_path / "r.json", ["panda_joint1", "panda_finger_joint1"]
    kinds = ("velocity", "acceleration", "jerk", "effort", "torque_rate")
    limits = {f"{kind}_limits": 100.0 for kind in kinds}
    locked = robot_from_source({"name": "panda", "locked": {"panda_joint1": 0.0}, **limits})

    def read(robot, *values):
        joints = {"name": [*names, "panda_joint2"], "position": [*values, 0.5]}
        state = {"joint_state": joints, "is_diff": True}
        file.write_text(json.dumps({"start_state": state, **ANYTHING}))
        return read_request(file, robot)

    told = "panda_joint1 at 1.5, the robot holds it at 0: give --lock panda_joint1=1.5"
    called(told, read, locked, 1.5, 0.04)
    # the hand is judged as it is opened, but not against a --lock
    request = read(locked, 0.0, 0.01)
    fingers = {"panda_finger_joint1": 0.01, "panda_finger_joint2": 0.01}  # the second one mimics
    assert request.fingers == fingers
    states = np.zeros((2, 6)) + 0.5
    judged = judge_request(Motion(None, states), request, locked, Scene("none", ()))[0].robot
    assert {joint.name: joint.value for joint in judged.held_joints} == {
        "panda_joint1": 0.0,
        **fingers,
    }
    opened = robot_from_source({"name": "panda", "locked": {"panda_finger_joint1": 0.0}})
    called("holds it at 0: give --lock panda_finger_joint1=0.01", read, opened, 0.0, 0.01)


@pytest.mark.parametrize("told", WRONG)
def test_wrong_requests_are_one_line(tmp_path, capsys, request_of, solution, told):
    np.savetxt(tmp_path / "m.csv", solution.path.states, delimiter=",", fmt="%.17g")
    (tmp_path / "r.json").write_text(json.dumps(request_of(**WRONG[told])))
    words = ("certify", tmp_path / "m.csv", "--request", tmp_path / "r.json")
    assert told in refused(capsys, *words)


@pytest.fixture
def certified(tmp_path, capsys, solution):
    """Return the exit code and what `certify` says of the solution with a request and options."""

    def run(request, *options):
        np.savetxt(tmp_path / "m.csv", solution.path.states, delimiter=",", fmt="%.17g")
        (tmp_path / "r.json").write_text(json.dumps(request))
        words = [tmp_path / "m.csv", "--request", tmp_path / "r.json", *options]
        code = main(["certify", *map(str, words)])
        told = capsys.readouterr()
        return code, told.out + told.err

    return run


def test_obstacles_are_where_the_frame_of_their_poses_is(tmp_path, certified, problem, solution):
    hand = problem.robot.pose(solution.path.states[0])[:3, 3]
    ball = {
        "id": "ball",
        "header": {"frame_id": "panda_link0"},
        "primitives": [{"type": 2, "dimensions": [0.05]}],
        "primitive_poses": [{"position": dict(zip("xyz", hand.tolist(), strict=True))}],
    }
    file = tmp_path / "s.yaml"
    robot = tmp_path / "robot.json"
    assert main(["robot", "panda", "--base", "0,0,1", "--out", str(robot)]) == 0
    words = ("--scene", str(file), "--robot", str(robot))
    for frame, code, said in (
        ("panda_link0", 1, "in collision: panda_"),
        ("world", 0, "certificate certified"),
        ("panda_hand", 2, "frame_id 'panda_hand' is moved by the planned joints"),
        ("no_such_frame", 2, "frame of robot panda 'no_such_frame'"),
    ):
        ball["header"]["frame_id"] = frame
        file.write_text(json.dumps({"world": {"collision_objects": [ball]}}))
        found = certified(ANYTHING, *words)
        assert found[0] == code and said in found[1], (frame, found)


@pytest.mark.parametrize("elsewhere", [0.0, 5e-4, 0.01])
def test_held_joints_are_where_the_scene_says(tmp_path, certified, request_of, problem, elsewhere):
    """The motion was judged with the hand open, in a scene whose robot had it closed."""
    held = {joint.name: joint.value for joint in problem.robot.held_joints}
    value = held["panda_finger_joint1"] - elsewhere
    joints = {"name": ["panda_joint1", "panda_finger_joint1"], "position": [1.0, value]}
    scene = {"world": {"collision_objects": []}, "robot_state": {"joint_state": joints}}
    (tmp_path / "s.yaml").write_text(json.dumps(scene))
    code, told = certified(request_of(), "--scene", tmp_path / "s.yaml")
    if elsewhere < 1e-3:
        assert code == 0, told
        return
    assert code == 2 and "s.yaml" in told and "robot_state has panda_finger_joint1 at" in told
    lock = f"panda_finger_joint1={value:.9g}"
    assert f": give --lock {lock}" in told
    robot = tmp_path / "robot.json"
    assert main(["robot", "panda", "--lock", lock, "--out", str(robot)]) == 0
    code, told = certified(request_of(), "--scene", tmp_path / "s.yaml", "--robot", robot)
    assert code == 0, told


def test_the_stricter_of_two_limits_of_the_hand_counts():
    limited = robot_from_source(
        {"name": "panda", "frame_limits": {"panda_hand": {"speed": 0.1, "turning_speed": 0.2}}}
    )
    for given, speed in ((0.5, 0.1), (0.05, 0.05)):
        made = MotionRequest(frame_limits={"panda_hand": FrameLimit(given)})
        states = np.stack([limited.lower, limited.lower + 0.01])
        problem, _ = judge_request(
            Motion(limited.joint_names, states), made, limited, Scene("none", ())
        )
        assert problem.robot.frame_limits == {"panda_hand": FrameLimit(speed, 0.2)}
    for option, turning in (([1.0], 0.2), ([1.0, 2.0], 2.0)):
        changed = with_tool_speed(limited, option)
        assert changed.frame_limits == {"panda_hand": FrameLimit(1.0, turning)}


def test_motions_of_few_or_far_states_have_no_euler_angles_to_cut(judged, request_of, solution):
    first = solution.path.states[:1]
    found = judged(request_of(parameterization=0), first).check.certificate
    assert any("states have shape (1, 7)" in reason for reason in found.reasons)
    called(r"states of shape \(0, 7\)", judged, request_of(), first[:0])
    # cut finely, this motion would fill the memory
    far = np.concatenate([first, first + 1e12])
    assert not judged(ANYTHING, far).certified


def test_joints_of_the_start_that_the_robot_lacks_are_left_out(problem, solution, judged, caplog):
    """MoveIt warns and goes on; the wheels of a base moved no arm."""
    states = solution.path.states
    names = [*problem.robot.joint_names, "left_wheel", "right_wheel"]
    state = {"name": names, "position": [*states[0].tolist(), 0.3, -2.1]}
    asked = ANYTHING | {"start_state": {"joint_state": state}}
    assert judged(asked, states).certified
    assert caplog.text.count("left_wheel, right_wheel are left out: panda lacks them") == 1
    state["position"][0] += 0.1
    assert not judged(asked, states).certified
