"""Proofs of motions: of robots by name, with loads, clouds, paths; what cannot be proven."""

import json
import math

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.cli.main import main
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, displacements
from cvqmpt_lab.features.motion.judge import judge
from cvqmpt_lab.features.motion.limit_use import Ends
from cvqmpt_lab.features.motion.motion_curves import curves_of
from cvqmpt_lab.features.motion.trajectory import Trajectory, read_motion, save_trajectory
from cvqmpt_lab.features.proof.cvqmpt_check import Proof, Refused
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
    text = "joint_names: [" + ", ".join(ur5.joint_names) + "]\nstates: " + str(STATES.tolist())
    (tmp_path / "m.yaml").write_text(text)
    told = "cannot read .*m.yaml, or the robot .* json of a JointTrajectory, .* csv or npz"
    refused(told, proof_of, problem_with(ur5, STATES), tmp_path / "m.yaml")


def kept(folder, joints, kind):
    """Write a motion of many points, at rest at its ends, as a kind of file; return it."""
    still = np.zeros((2, len(joints)))
    motion = Trajectory(joints, np.array([0.0, 4.0]), STATES, still, still).sampled(0.1)
    table = {"t": motion.times, "q": motion.positions, "v": motion.velocities}
    path = folder / f"m.{'csv' if 'csv' in kind else 'npz'}"
    if kind == "csv":
        save_trajectory(motion, path)
    elif kind == "npz":
        backwards = {key: table[key][:, ::-1] for key in "qv"}
        np.savez(path, t=motion.times, joint_names=np.array(joints[::-1]), **backwards)
    elif kind == "csv of positions":
        rows = np.column_stack([motion.times, motion.positions])
        np.savetxt(path, rows, delimiter=",", header=",".join(["time", *joints]), comments="")
    else:
        np.savez(path, t=motion.times, q=motion.positions)
    return path


@pytest.mark.parametrize("kind", ["csv", "npz", "csv of positions", "npz of positions"])
def test_tables_and_arrays_are_proven_with_the_curves_of_the_certificate(ur5, tmp_path, kind):
    path, problem = kept(tmp_path, ur5.joint_names, kind), problem_with(ur5, STATES)
    judged = judge(read_motion(path), problem)
    assert judged.certified
    told = proof_of(problem, path)
    assert "jumps of velocity" in told["not_proven"]
    proof = Proof(told, urdf_of(problem).read_bytes(), path.read_bytes())
    curves, _ = curves_of(read_motion(path).of_joints(ur5.joint_names))
    names = list(curves)[::-1]  # in this order from each point
    assert proof.b.shape[1] == len(names) * 40
    shares = np.array([0.0, 0.3, 1.0])
    powers = [math.comb(5, k) * shares**k * (1.0 - shares) ** (5 - k) for k in range(6)]
    for k, name in enumerate(names):
        own = np.einsum("sk,kpn->spn", np.transpose(powers), proof.b[:, k :: len(names)])
        starts, spans = curves[name].x[:-1], np.diff(curves[name].x)
        # a share of the piece, just inside of it
        expected = curves[name](starts + shares[:, None] * spans * (1.0 - 1e-12))
        assert np.abs(own - expected).max() < 1e-9


def test_a_part_of_a_motion_has_a_natural_spline(ur5, tmp_path):
    path, problem = kept(tmp_path, ur5.joint_names, "npz of positions"), problem_with(ur5, STATES)
    told = proof_of(problem, path, Ends(part=True, moving=True))
    assert told["ends"] == [None, None]
    proof = Proof(told, urdf_of(problem).read_bytes(), path.read_bytes())
    curve = curves_of(read_motion(path), part=True, moving=True)[0]["spline"]
    middle = proof.b[:, 1::2].T @ np.array([1, 5, 10, 10, 5, 1]) / 32.0
    assert np.abs(middle.T - curve(curve.x[:-1] + 0.5 * np.diff(curve.x))).max() < 1e-9


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_turns_on_one_side_and_bearings_are_proven(ur5, tmp_path, side):
    bounds = np.array([[-np.inf, np.inf]] * 6)
    low, high = sorted((-0.02 * side, 1.5 * side))
    turns = TaskSpaceRegion(ur5.pose(STATES[0]), np.eye(4), bounds)
    found = displacements(ur5, turns, np.linspace(*STATES, 200))[:, 3:6]
    row = int(np.abs(found).max(axis=0).argmax())
    bounds[3 + row] = (low, high) if found[-1, row] * side > 0.0 else (-high, -low)
    turns = TaskSpaceRegion(ur5.pose(STATES[0]), np.eye(4), bounds)
    ahead = ur5.pose(STATES[0]) @ at((0.0, 0.0, 0.6))
    free = np.array([[-np.inf, np.inf]] * 6)
    seen = displacements(ur5, TaskSpaceRegion(ahead, np.eye(4), free, bearing=3.0), STATES)[:, 9]
    looks = TaskSpaceRegion(ahead, np.eye(4), free, bearing=float(seen.max()) + 0.02)
    path = saved(tmp_path, ur5, STATES)
    problem = problem_with(ur5, STATES, constraint=(turns, looks))
    told = proof_of(problem, path)
    assert not [text for text in told["not_proven"] if "bearing" in text]
    files = urdf_of(problem).read_bytes(), path.read_bytes()
    Proof(told, *files).check()
    told["regions"][1]["bounds"][9][1] = float(seen.max()) - 0.02
    with pytest.raises(Refused, match=r"region of .* is left"):
        Proof(told, *files).check()
    told["regions"][1]["bounds"][9][1] = 3.0
    reversed_bounds = [-x for x in told["regions"][0]["bounds"][3 + row]]
    told["regions"][0]["bounds"][3 + row] = sorted(reversed_bounds)
    with pytest.raises(Refused, match=r"region of .* is left"):
        Proof(told, *files).check()


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
