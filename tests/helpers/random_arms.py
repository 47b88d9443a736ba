"""Random arms of hinges and sliders about any axes, as URDF and loaded, and problems for them."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.benchmarks.families import random_scene
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import load_robot, robot_from_source

ARMS = 12  # to draw from: loading one takes longer than a trial with it
WIDTHS = (0.0, 2e-4, 0.1, 1.0, np.inf)  # half widths of regions [m, rad]


def random_urdf(seed):
    """An arm of two to nine joints, of which about a third slide, that ends in link "tool"."""
    rng = np.random.default_rng(seed)
    joints = int(rng.integers(2, 10))
    parts = ['<robot name="random">', link("base", rng)]
    for k in range(joints):
        parent = "base" if k == 0 else f"link{k}"
        child = f"link{k + 1}"
        parts += [link(child, rng), moving_joint(f"joint{k + 1}", parent, child, rng)]
        if rng.random() < 0.15:  # a branch, which planning holds still
            parts += [link(f"side{k}", rng), moving_joint(f"turn{k}", parent, f"side{k}", rng)]
    mount = joint("mount", "fixed", f"link{joints}", "tool", origin(rng, 0.1))
    return "\n".join([*parts, '<link name="tool"/>', mount, "</robot>"]).encode()


def link(name, rng):
    if rng.random() < 0.3:
        return f'<link name="{name}"/>'
    a, b, c = rng.uniform(0.02, 0.08, 3)
    solids = (
        f'<box size="{a} {b} {c}"/>',
        f'<sphere radius="{a}"/>',
        f'<cylinder radius="{a}" length="{b}"/>',
    )
    geometry = f"<geometry>{rng.choice(solids)}</geometry>"
    return f'<link name="{name}"><collision>{origin(rng, 0.05)}{geometry}</collision></link>'


def moving_joint(name, parent, child, rng):
    slides = rng.random() < 0.3
    kind = "prismatic" if slides else rng.choice(["revolute", "revolute", "continuous"])
    low, high = np.sort(rng.uniform(-1.0, 1.0, 2) * (0.6 if slides else 3.1)) + [-0.05, 0.05]
    axis = f'<axis xyz="{" ".join(map(str, direction(rng)))}"/>'
    limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
    return joint(name, kind, parent, child, origin(rng, 0.35) + axis + limit)


def joint(name, kind, parent, child, rest):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{rest}</joint>'


def direction(rng):
    axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
    return axis / np.linalg.norm(axis)


def origin(rng, away):
    xyz = " ".join(map(str, away * direction(rng) * rng.uniform(0.2, 1.0)))
    rpy = " ".join(map(str, Rotation.random(random_state=rng).as_euler("xyz")))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


@cache
def arm(number):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_bytes(random_urdf(number))
        return load_robot(path, "tool")


@cache
def two_armed(number):
    """A random arm with another one on its base or on its first link; their ends are planned."""
    names = ("base", "link", "joint", "side", "turn", "tool", "mount")
    first, second = (random_urdf(seed).decode() for seed in (number, number + ARMS))
    for name in names:
        second = second.replace(f'"{name}', f'"other_{name}')
    inside = second.partition(">")[2].rpartition("</robot>")[0]
    shoulder = origin(np.random.default_rng(number), 0.3)
    shoulder = joint("neck", "fixed", ("base", "link1")[number % 2], "other_base", shoulder)
    text = first.replace("</robot>", f"{inside}{shoulder}</robot>")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arms.urdf"
        path.write_text(text)
        return robot_from_source({"urdf": str(path), "end_effectors": ["tool", "other_tool"]})


def problem_around(seed):
    """A random arm in a random scene, start and goal in one region; None if blocked."""
    rng = np.random.default_rng(seed)
    robot, cubes = arm(seed % ARMS), int(rng.integers(4))
    scene = random_scene(seed % 1000, n_cubes=cubes, n_spheres=2)
    start = robot.random_configurations(rng, 1)[0]
    halves = rng.choice(WIDTHS[2:], 6)
    region = TaskSpaceRegion(robot.pose(start), np.eye(4), np.stack([-halves, halves], axis=1))
    problem = PlanningProblem("random", robot, scene, start, start[None], constraint=(region,))
    checker = problem.collision_checker()
    for q in robot.random_configurations(rng, 20):
        goal = problem.manifold.project(q)
        if goal is not None and not checker.in_collision(goal) and not checker.in_collision(start):
            return problem.changed(goals=goal[None])
    return None
