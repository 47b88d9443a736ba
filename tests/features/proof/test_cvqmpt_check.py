"""The checker of proofs: kinematics, refusals, and a run in an environment that has numpy alone."""

import ast
import copy
import hashlib
import json
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from random_arms import random_urdf
from small_arms import box, joint

from cvqmpt_lab import PlanningProblem
from cvqmpt_lab.collision.directions import Directions
from cvqmpt_lab.features.motion.trajectory import Trajectory, save_trajectory
from cvqmpt_lab.features.proof import cvqmpt_check
from cvqmpt_lab.features.proof.claims import claims
from cvqmpt_lab.features.proof.cvqmpt_check import Proof, Refused, Robot, bodies_of
from cvqmpt_lab.features.proof.write_proof import proof_of, urdf_of
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene

CHECKER = Path(cvqmpt_check.__file__)
START, END = np.array([-0.8, 0.0]), np.array([0.8, 0.4])


def two_links():
    """An arm in the plane: links of 0.4 m along x, hinges about z, one after the other."""
    return (
        '<robot name="two">'
        + box("base", (0.1, 0.1, 0.1), (0.0, 0.0, -0.3))
        + box("upper", (0.4, 0.05, 0.05), (0.2, 0.0, 0.0))
        + box("fore", (0.3, 0.04, 0.04), (0.2, 0.0, 0.1))
        + joint("shoulder", "base", "upper", "revolute", (0, 0, 1))
        + joint("elbow", "upper", "fore", "revolute", (0, 0, 1), (0.4, 0.0, 0.0))
        + "</robot>"
    )


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A problem, a motion's file, the URDF's bytes, and the proof as it is read from a file."""
    folder = tmp_path_factory.mktemp("proof")
    (folder / "arm.urdf").write_text(two_links())
    T = np.eye(4)
    T[:3, 3] = (0.0, 0.9, 0.1)
    box_ahead = {"type": "box", "size": [0.2, 0.1, 0.2]}
    region = {"T0_w": np.eye(4).tolist(), "Tw_e": np.eye(4).tolist(), "tilt": 0.1}
    region["Bw"] = [[None, None], [None, None], [-0.1, 0.1], *[[None, None]] * 3]
    data = {
        "schema": "cvqmpt-problem/1",
        "name": "swing",
        "robot": {"urdf": "arm.urdf", "end_effector": "fore", "acceleration_limits": 20.0},
        "scene": {
            "name": "s",
            "objects": [{"name": "b", "shape": box_ahead, "T_world_object": T.tolist()}],
        },
        "start": START.tolist(),
        "goals": [END.tolist()],
        "constraint": [region],
        "clearance": 0.01,
    }
    (folder / "problem.json").write_text(json.dumps(data))
    problem = PlanningProblem.load(folder / "problem.json")
    states, still = np.array([START, END]), np.zeros((2, 2))
    motion = Trajectory(problem.robot.joint_names, np.array([0.0, 2.0]), states, still, still)
    save_trajectory(motion, folder / "motion.json")
    proof = json.loads(json.dumps(proof_of(problem, folder / "motion.json")))
    return folder, problem, proof


def checked(given, proof, motion=None):
    """Check a proof; return why it is refused, or "yes"."""
    folder = given[0]
    data = (folder / "motion.json").read_bytes() if motion is None else motion
    try:
        Proof(proof, (folder / "arm.urdf").read_bytes(), data).check()
    except Refused as refused:
        return str(refused)
    return "yes"


def test_it_is_one_short_file_that_needs_numpy_alone():
    tree = ast.parse(CHECKER.read_text())
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module.split(".")[0])
    assert names - {"numpy"} <= set(sys.stdlib_module_names)
    own = {k for k, line in enumerate(CHECKER.read_text().splitlines(), 1) if line.strip(" #")}
    own -= {k for k in own if CHECKER.read_text().splitlines()[k - 1].lstrip().startswith("#")}
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(
            node
        ):
            own -= {*range(node.body[0].lineno, node.body[0].end_lineno + 1)}
    assert len(own) <= 400  # lines of code, without comments


def test_it_runs_alone_in_another_folder(given, tmp_path):
    folder, _, proof = given
    site = tmp_path / "site"
    site.mkdir()
    installed = Path(np.__file__).parent
    for part in installed.parent.glob("numpy*"):
        (site / part.name).symlink_to(part)
    shutil.copy(CHECKER, tmp_path / "check.py")
    (tmp_path / "p.json").write_text(json.dumps(proof))
    files = ["p.json", "--urdf", folder / "arm.urdf", "--motion", folder / "motion.json"]
    start = f"import sys, runpy; sys.path.insert(0, {str(site)!r}); sys.argv = sys.argv[1:]; "
    code = start + "runpy.run_path('check.py', run_name='__main__')"
    command = [sys.executable, "-I", "-S", "-c", code, "check.py", *map(str, files)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env={**os.environ})
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("yes: motion.json of two")
    assert "not compared: base and upper (adjacent)" in done.stdout
    assert "not proven: jerk, effort" in done.stdout
    (tmp_path / "p.json").write_text("{}")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env={**os.environ})
    assert done.returncode == 1 and done.stdout.startswith("no: its schema is None")


@pytest.mark.parametrize("number", range(6))
def test_poses_are_those_of_the_toolkit(number, tmp_path):
    text, hand = random_urdf(number), "tool"
    (tmp_path / "arm.urdf").write_bytes(text)
    robot = robot_from_source({"urdf": str(tmp_path / "arm.urdf"), "end_effector": hand})
    held = {one.name: one.value for one in robot.held_joints}
    told = {"joints": list(robot.joint_names), "held": held, "base": None}
    own = Robot(ElementTree.fromstring(text), told)
    states = robot.random_configurations(np.random.default_rng(number), 5)
    R, p = own.poses(states)
    row, expected = own.rows[hand], robot.poses(states, hand)
    assert np.abs(R[:, row] - expected[:, :3, :3]).max() < 1e-9
    assert np.abs(p[:, row] - expected[:, :3, 3]).max() < 1e-9


def test_the_bound_on_ways_holds_at_random_states(given):
    proof = given[2]
    told = {"joints": proof["joints"], "held": {}, "base": None}
    own = Robot(ElementTree.fromstring(two_links()), told)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (1, 20, 3))
    row = own.rows["fore"]
    for _ in range(20):
        q, widths = rng.uniform(-2.0, 2.0, (1, 2)), rng.uniform(0.0, 1.0, (1, 2))
        others = q + rng.uniform(-1.0, 1.0, (200, 2)) * widths
        R, p = own.poses(np.vstack([q, others]))
        placed = np.einsum("mij,kj->mki", R[:, row], points[0]) + p[:, None, row]
        way = own.ways((R[:1], p[:1], widths), own.moves[row], placed[:1])
        assert np.linalg.norm(placed[1:] - placed[0], axis=2).max() <= way[0]


def test_joints_that_follow_others_move_and_their_limits_are_not_proven(tmp_path):
    follows = '<mimic joint="shoulder" multiplier="-0.5" offset="0.1"/></joint>'
    text = two_links().replace("</joint></robot>", f"{follows}</robot>")
    (tmp_path / "arm.urdf").write_text(text)
    robot = robot_from_source(
        {"urdf": str(tmp_path / "arm.urdf"), "end_effector": "fore", "acceleration_limits": 20.0}
    )
    states, still = np.array([[-0.8], [0.8]]), np.zeros((2, 1))
    motion = Trajectory(robot.joint_names, np.array([0.0, 2.0]), states, still, still)
    save_trajectory(motion, tmp_path / "m.json")
    problem = PlanningProblem("p", robot, Scene("s", ()), states[0], states[1:])
    proof = proof_of(problem, tmp_path / "m.json")
    assert "limits of joints that follow others" in proof["not_proven"]
    checker = Proof(proof, text.encode(), (tmp_path / "m.json").read_bytes())
    checker.check()
    assert checker.robot.joints[checker.robot.rows["fore"]][4:] == (0, -0.5, 0.1)


def test_meshes_without_hulls_and_links_in_a_circle_are_refused(given):
    folder, _, proof = given
    proof = copy.deepcopy(proof)
    proof["hulls"] = [{"mesh": "a.stl", "scale": "1 1 1", "sha256": "", "pieces": []}]
    assert checked(given, proof) == "a mesh has no hull"
    proof["hulls"] = []
    text = two_links().replace('<parent link="base"/>', '<parent link="fore"/>').encode()
    proof["sha256"]["robot"] = hashlib.sha256(text).hexdigest()
    with pytest.raises(RecursionError):
        Proof(proof, text, (folder / "motion.json").read_bytes())


def test_a_proof_is_accepted(given):
    assert checked(given, given[2]) == "yes"


def leaf_of(proof):
    """Return a tree of planes and the number of its first plane."""
    tree = max((tree for *_, tree in proof["planes"]), key=len)
    return tree, next(k for k, token in enumerate(tree) if isinstance(token, list))


def turned(proof):
    tree, k = leaf_of(proof)
    tree[k] = [-x for x in tree[k]]


def left_out(proof):
    tree, k = leaf_of(proof)
    del tree[k]


def moved(proof):
    proof["obstacles"][0]["points"] = [
        [x, y - 0.3, z] for x, y, z in proof["obstacles"][0]["points"]
    ]
    text = json.dumps(proof["obstacles"], separators=(",", ":"))
    proof["sha256"]["scene"] = hashlib.sha256(text.encode()).hexdigest()


def narrow(proof):
    proof["regions"][0]["bounds"][2] = [0.05, 0.1]


CHANGES = {
    "gap less way": turned,
    "has no plane": left_out,
    "fore_0 and b": moved,
    "region of fore is left": narrow,
    "shoulder exceeds its position limits": lambda p: p["limits"]["shoulder"].update(upper=0.5),
    "shoulder exceeds its velocity limit": lambda p: p["limits"]["shoulder"].update(velocity=1.0),
    "elbow exceeds its acceleration limit": lambda p: p["limits"]["elbow"].update(acceleration=0.3),
    "have neither planes nor a reason": lambda p: p["planes"].pop(),
    "of another robot: its sha256": lambda p: p["sha256"].update(robot="0"),
    "of another motion: its sha256": lambda p: p["sha256"].update(motion="0"),
    "of another scene: its sha256": lambda p: p["obstacles"].clear(),
    "its schema is 'cvqmpt-proof/9'": lambda p: p.update(schema="cvqmpt-proof/9"),
    "its clearance is negative": lambda p: p.update(clearance=-1.0),
    "['elbow'] are planned twice, or planned and held": lambda p: p["held"].update(elbow=0.0),
    "the motion moves joints ['shoulder', 'elbow'], the proof ['shoulder']": lambda p: (
        p["joints"].remove("elbow"),
        p["held"].update(elbow=0.0),
    ),
    "joint elbow is neither planned nor held": lambda p: p["joints"].remove("elbow"),
    "no joints ['wrist']": lambda p: p["joints"].append("wrist"),
    "base_0 and fore_0 are not adjacent": lambda p: (
        p["planes"].__setitem__(slice(None), [x for x in p["planes"] if x[0] != "base_0"]),
        p["not_compared"].append(["base", "fore", "adjacent"]),
    ),
}


@pytest.mark.parametrize("why", CHANGES)
def test_changed_proofs_are_refused(given, why):
    proof = copy.deepcopy(given[2])
    CHANGES[why](proof)
    assert why in checked(given, proof)


def test_limits_wider_than_the_urdf_are_named(given):
    folder, _, proof = given
    proof = copy.deepcopy(proof)
    proof["limits"]["elbow"]["velocity"] *= 2.0
    files = [(folder / name).read_bytes() for name in ("arm.urdf", "motion.json")]
    checker = Proof(proof, *files)
    checker.check()
    # the URDF states no limit of acceleration
    assert checker.wider == ["velocity of elbow"]


def test_a_motion_changed_by_a_micron_is_another_motion(given):
    folder, _, proof = given
    motion = json.loads((folder / "motion.json").read_text())
    motion["points"][0]["positions"][0] += 1e-6
    assert "of another motion" in checked(given, proof, json.dumps(motion).encode())


def test_a_motion_that_goes_farther_is_refused_with_its_own_digest(given):
    folder, _, proof = given
    motion = json.loads((folder / "motion.json").read_text())
    motion["points"][1]["positions"][0] += 1.0  # in the same time
    data, proof = json.dumps(motion).encode(), copy.deepcopy(proof)
    proof["sha256"]["motion"] = hashlib.sha256(data).hexdigest()
    assert "shoulder exceeds its velocity limit" in checked(given, proof, data)


@pytest.mark.parametrize("name", ["panda", "so-arm101", "baxter-left"])
def test_bodies_contain_those_of_the_toolkit(name):
    robot = robot_from_source({"name": name})
    q = robot.random_configurations(np.random.default_rng(0), 2)
    problem = PlanningProblem("p", robot, Scene("s", ()), q[0], q[1:])
    urdf = urdf_of(problem).read_bytes()
    told = claims(problem, Directions(robot, problem.scene, ()), urdf)
    root = ElementTree.fromstring(urdf)
    own = Robot(root, told)
    bodies = {body.name: body for body, _ in bodies_of(own, root, told)}
    assert set(bodies) == {piece.name for piece in robot.links}
    R, p = own.poses(q)
    rotations, translations = link_poses(robot.kinematics, q)
    n = np.random.default_rng(1).normal(size=(20, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    for piece in robot.links:
        body, row = bodies[piece.name], bodies[piece.name].row
        corners = piece.vertices_in_link @ rotations[1, piece.link].T + translations[1, piece.link]
        larger = body.reach(n @ R[1, row]) + n @ p[1, row] - (corners @ n.T).max(axis=0)
        round_body = (
            body.disc > 0.0 or len(body.points) == 1
        )  # the toolkit has a polytope around it
        assert round_body or (larger.min() > -1e-9 and larger.max() < 1e-4)
