"""What pictures draw and what is proven, by the URDF's text alone: links, tools, loads, bases."""

import xml.etree.ElementTree as ElementTree
from functools import cache

import numpy as np
import pytest
from random_arms import ARMS as RANDOM_ARMS
from random_arms import random_urdf
from scipy.spatial.transform import Rotation
from second_judge import Arm, pose_of

from cvqmpt_lab.features.pictures.bodies import robot_bodies
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.source import ARMS, read_source
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box, Sphere

LIMITS = ("acceleration_limits", "jerk_limits", "effort_limits", "torque_rate_limits")
QUICK = ("panda", "random", "ur5", "random", "baxter", "so-arm101", "random", "tiago", "xarm7")
NOTHING = Scene("nothing", ())
OFF = 1e-9  # [m], of entries of poses


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("drawn")


def random_pose(rng, far):
    """Return a pose (4, 4) within `far` of the origin along each axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-far, far, 3)
    return T


@cache
def plain_robot(name, folder):
    """Return the source of an arm by name, or of a random arm by number, and its robot."""
    if name in ARMS:
        source = {"name": name} | dict.fromkeys(LIMITS, 100.0)
    else:
        path = folder / f"arm_{name}.urdf"
        path.write_bytes(random_urdf(name))
        source = {"urdf": str(path), "end_effector": "tool", "srdf": ""}
    return source, robot_from_source(source)


def drawn_source(rng, name, folder):
    """Return a source: another base, a tool in a hand, and a joint that is held, or without."""
    source, robot = plain_robot(name, folder)
    source = dict(source)
    if rng.random() < 0.7:
        source["base"] = random_pose(rng, 1.0).tolist()
    if len(robot.end_effectors) == 1 and rng.random() < 0.6:
        source["tool"] = random_pose(rng, 0.3).tolist()
    if robot.dof > 2 and rng.random() < 0.6:
        j = int(rng.integers(robot.dof))
        lower, upper = np.maximum(robot.lower[j], -3.0), np.minimum(robot.upper[j], 3.0)
        held = dict(read_source(source).locked) | {
            robot.joint_names[j]: float(rng.uniform(lower, upper))
        }
        source["locked"] = held
    return source


class Own:
    """Poses of links, hands and bodies of a robot's source, from its URDF alone."""

    def __init__(self, robot, folder):
        given = read_source(robot.source)  # the files and values that a name stands for
        hands = list(given.end_effectors) or [given.end_effector]
        fields = {"urdf": given.urdf, "srdf": None, "end_effectors": hands}
        held = {**given.locked, **{joint.name: joint.value for joint in robot.held_joints}}
        self.arm = Arm({**fields, "locked": held}, folder, robot.joint_names, bodies=False)
        self.links = {
            link.get("name"): link
            for link in ElementTree.parse(given.urdf).getroot().findall("link")
        }
        self.base = np.eye(4) if given.base is None else np.array(given.base)
        self.tool = {} if given.tool is None else {f"{hands[0]}/tool": (hands[0], given.tool)}

    def pose(self, frame, states):
        """Return the poses (m, 4, 4) in the world of a link, or of a tool HAND/tool."""
        link, T_tool = self.tool.get(frame, (frame, np.eye(4)))
        group, T = self.arm.frames[link]
        return self.base @ self.arm.poses(states)[group] @ T @ T_tool

    def body(self, name, kind, states):
        """Return the poses (m, 4, 4) in the world of the body LINK_NUMBER of a kind."""
        link, _, number = name.rpartition("_")
        return self.pose(link, states) @ pose_of(self.links[link].findall(kind)[int(number)])

    def drawn(self, name, states):
        """Return the poses of a drawn body: the visual one, or the collision one if none is."""
        link = name.rpartition("_")[0]
        kind = "collision" if self.links[link].find("visual") is None else "visual"
        return self.body(name, kind, states)


def loads_of(rng, robot):
    """Return objects in random hands, on tools and on their links."""
    frames = [None, *robot.end_effectors, *robot.tool_links]
    chosen = [frames[rng.integers(len(frames))] for _ in range(rng.integers(3))]
    shapes = Box((0.02, 0.03, 0.04)), Sphere(0.02)
    return tuple(
        Attachment(f"load{k}", shapes[k % 2], random_pose(rng, 0.2), end_effector=frame)
        for k, frame in enumerate(chosen)
    )


@pytest.mark.promise(
    "drawn links, tools and loads are where the URDF has them, and where they are proven",
    "robots",
    ci=9,
    long=1000,
)
def test_drawn_against_proven(trials, folder, request):
    """Robots by name and random ones; base, tool, held joint and loads vary."""
    every = request.config.getoption("--long") or request.config.getoption("--trials")
    names = [name for one in ARMS for name in (one, "random")] if every else QUICK
    off = {}
    for number in range(trials):
        rng, name = np.random.default_rng(number), names[number % len(names)]
        name = number % RANDOM_ARMS if name == "random" else name
        robot = robot_from_source(drawn_source(rng, name, folder))
        loads, own = loads_of(rng, robot), Own(robot, folder)
        states = robot.random_configurations(rng, 2)
        problem = PlanningProblem("drawn", robot, NOTHING, states[0], states[1:])
        problem = problem.changed(attachments=loads)
        seen = robot_bodies(problem, states)
        links, carried = seen[: len(seen) - len(loads)], seen[len(seen) - len(loads) :]
        found = [(body.name, body.poses - own.drawn(body.name, states)) for body in links]
        rotations, translations = link_poses(robot.kinematics, states)
        for piece in robot.links:
            T = np.tile(np.eye(4), (2, 1, 1))
            T[:, :3, :3], T[:, :3, 3] = rotations[:, piece.link], translations[:, piece.link]
            there = own.body(piece.name, "collision", states)
            found.append((f"proven {piece.name}", T @ piece.T_link_geometry - there))
        for load, body in zip(loads, carried, strict=True):
            hand = load.end_effector or robot.end_effector
            found.append((load.name, body.poses - own.pose(hand, states) @ load.T_hand_object))
        for hand in (*robot.end_effectors, *robot.tool_links):
            found.append((f"hand {hand}", robot.poses(states, hand) - own.pose(hand, states)))
        assert len(links) and (len(links) >= robot.dof or isinstance(name, int))
        off |= {(number, what): np.abs(x).max() for what, x in found if np.abs(x).max() > OFF}
    assert off == {}
