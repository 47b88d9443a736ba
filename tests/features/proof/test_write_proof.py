"""Proofs of motions: of robots by name, with loads, clouds, paths; what cannot be proven."""

import json

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.cli.main import main
from cvqmpt_lab.features.motion.trajectory import Trajectory, as_csv, save_trajectory
from cvqmpt_lab.features.proof.cvqmpt_check import Proof
from cvqmpt_lab.features.proof.write_proof import proof_of, urdf_of, write_proof
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, PointCloud, Sphere


def at(xyz):
    T = np.eye(4)
    T[:3, 3] = xyz
    return T


def saved(folder, robot, states, span=3.0):
    """Write a motion at rest at its ends; return its file."""
    still = np.zeros_like(states)
    motion = Trajectory(robot.joint_names, np.array([0.0, span]), states, still, still)
    save_trajectory(motion, folder / "motion.json")
    return folder / "motion.json"


def problem_with(robot, states, objects=(), **more):
    scene = Scene("s", tuple(objects))
    return PlanningProblem("p", robot, scene, states[0], states[-1:], **more)


@pytest.fixture(scope="module")
def ur5():
    return robot_from_source({"name": "ur5", "acceleration_limits": 10.0})


STATES = np.array([[0.0, -1.2, 1.0, 0.0, 0.5, 0.0], [0.5, -1.0, 0.8, 0.2, 0.7, 0.5]])


def test_cylinders_balls_clouds_and_loads_are_proven(ur5, tmp_path):
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    objects = (
        SceneObject("can", Cylinder(0.05, 0.3), at((0.0, 0.7, 0.2))),
        SceneObject("ball", Sphere(0.1), at((-0.5, 0.0, 0.3))),
        SceneObject("cloud", PointCloud(points, 0.01), at((-0.6, -0.6, 0.5))),
    )
    load = Attachment("tray", Box((0.1, 0.1, 0.02)), at((0.0, 0.0, 0.05)))
    problem = problem_with(ur5, STATES, objects, attachments=(load,), clearance=0.02)
    motion = saved(tmp_path, ur5, STATES)
    command = write_proof(tmp_path / "p.json", problem, motion)
    assert f"--urdf {urdf_of(problem)} --motion {motion}" in command
    proof = json.loads((tmp_path / "p.json").read_text())
    Proof(proof, urdf_of(problem).read_bytes(), motion.read_bytes()).check()
    assert len(proof["obstacles"]) == 202 and [x["name"] for x in proof["carried"]] == ["tray"]
    assert {"tray", "obstacles"} <= {name for pair in proof["planes"] for name in pair[:2]}


def test_a_path_without_times_has_no_speed(ur5, tmp_path):
    (tmp_path / "path.json").write_text(
        json.dumps({"joint_names": ur5.joint_names, "states": STATES.tolist()})
    )
    proof = proof_of(problem_with(ur5, STATES), tmp_path / "path.json")
    assert proof["planes"] and "jerk" in proof["not_proven"]


def test_motions_that_touch_have_no_proof(ur5, tmp_path):
    objects = [SceneObject("wall", Box((0.1, 2.0, 2.0)), at((0.5, 0.0, 0.5)))]
    problem = problem_with(ur5, STATES, objects)
    refused("come too close, .* more clearance", proof_of, problem, saved(tmp_path, ur5, STATES))


def test_other_files_of_motions_are_refused(ur5, tmp_path):
    motion = Trajectory(
        ur5.joint_names, np.array([0.0, 3.0]), STATES, np.zeros_like(STATES), np.zeros_like(STATES)
    )
    (tmp_path / "m.csv").write_text(as_csv(motion))
    problem, csv = problem_with(ur5, STATES), tmp_path / "m.csv"
    refused("cannot read .* as json of a JointTrajectory", proof_of, problem, csv)


def test_a_load_on_a_tool_is_where_the_tool_is(tmp_path):
    source = {
        "name": "ur5",
        "acceleration_limits": 10.0,
        "tool": {"xyz": [0, 0, 0.2], "rpy": [0, 0, 0]},
    }
    robot = robot_from_source(source)
    load = Attachment("ball", Sphere(0.02), at((0.0, 0.0, 0.1)))
    problem = problem_with(robot, STATES, attachments=(load,))
    proof = proof_of(problem, saved(tmp_path, robot, STATES))
    assert proof["carried"][0]["link"] == "tool0"
    assert np.allclose(proof["carried"][0]["points"], [[0.0, 0.0, 0.3]])


def test_certify_writes_a_proof_of_a_certified_motion_alone(ur5, tmp_path, capsys):
    problem, motion = problem_with(ur5, STATES), saved(tmp_path, ur5, STATES)
    problem.save(tmp_path / "problem.json")
    command = ["certify", str(motion), str(tmp_path / "problem.json")]
    command += ["--proof", str(tmp_path / "p.json")]
    assert main(command) == 0
    assert "check it by: python" in capsys.readouterr().err
    (tmp_path / "p.json").unlink()
    saved(tmp_path, ur5, STATES, span=0.1)  # too fast
    assert main(command) == 1
    assert "no proof is written" in capsys.readouterr().err
    assert not (tmp_path / "p.json").exists()
