"""Constraints that are no bounds on a hand's pose, on three arms, in held-out scenes.

Problem k has kind k // 20 of `MORE_KINDS`, modulo their number. A random free state meets the
constraint; start and goal are projected states, see `family_task`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cvqmpt_lab.benchmarks.families import FAMILIES, family_scene
from cvqmpt_lab.benchmarks.family_task import blocked_pair, trivial, within_reach
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.results.row import phase_problem
from cvqmpt_lab.collision.exact import shared_checker
from cvqmpt_lab.constraints.goals import MAX_GOALS, sample_goals
from cvqmpt_lab.constraints.named import region
from cvqmpt_lab.constraints.region_constraint import Member
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.body_masses import BodyMasses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot

Draw = Callable[[Robot, np.ndarray, np.random.Generator], Member]


def _ahead(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Member:
    """The hand looks along its z axis at a point, from 0.6 to 1.4 times the distance at q."""
    T, far = robot.pose(q), robot.reach * rng.uniform(0.3, 0.6)
    point = (T[:3, 3] + far * T[:3, 2]).tolist()
    return region("look-at", point=point, angle=0.15, distance=[0.6 * far, 1.4 * far])


def _from_shoulder(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Member:
    """The hand keeps its distance from the frame of the second joint within 1 cm."""
    second = np.flatnonzero(robot.kinematics.moves[:, robot.hand()[0]])[1]
    base = next(name for name in robot.frame_names if robot.link_of(name)[0] == second + 1)
    far = np.linalg.norm(robot.pose(q)[:3, 3] - robot.pose(q, base)[:3, 3])
    return region("distance", bounds=[max(far - 0.01, 0.0), far + 0.01], base=base)


def _sphere(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Member:
    """The hand stays within 2 mm of a sphere of 15 to 40 cm."""
    at, way, radius = robot.pose(q)[:3, 3], rng.standard_normal(3), rng.uniform(0.15, 0.4)
    centre = (at + radius * way / np.linalg.norm(way)).tolist()
    return region("on-sphere", centre=centre, radius=radius, tolerance=0.002)


def _cylinder(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Member:
    """The hand stays within 2 mm of a cylinder of 15 to 40 cm around any axis."""
    at, (z, way), radius = robot.pose(q)[:3, 3], rng.standard_normal((2, 3)), rng.uniform(0.15, 0.4)
    across = np.cross(z, way)
    point = (at + radius * across / np.linalg.norm(across)).tolist()
    return region("on-cylinder", direction=z.tolist(), point=point, radius=radius, tolerance=0.002)


def _coupled(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Member:
    """Sum or difference of two joints stays within 0.01 rad."""
    first, second = rng.choice(robot.dof, 2, replace=False)
    sign = rng.choice([-1.0, 1.0])
    factors = {robot.joint_names[first]: 1.0, robot.joint_names[second]: float(sign)}
    middle = float(q[first] + sign * q[second])
    return region("joint-coupling", factors=factors, lower=middle - 0.01, upper=middle + 0.01)


def _balanced(robot: Robot, q: np.ndarray, rng: np.random.Generator, spread: float = 0.6) -> Member:
    """The centre of mass stays above a square around that at q, 0.6 deviations of it wide."""
    centres = BodyMasses(robot).centre(robot.random_configurations(rng, 200))[:, :2]
    (x, y), half = BodyMasses(robot).centre(q[None])[0, :2], spread * centres.std(axis=0).max()
    corners = [[x + a * half, y + b * half] for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return region("centre-of-mass", corners=corners)


def _with_goals_around(problem: PlanningProblem, far: float) -> PlanningProblem:
    """Return a problem with up to 20 goals on its manifold, see `more_constraints_problem`."""
    free = [(-far, far)] * 3 + [(-np.pi, np.pi)] * 3
    region = TaskSpaceRegion(problem.robot.pose(problem.goals[0]), np.eye(4), np.array(free))
    wanted = replace(problem, goals=problem.goals[:0], goal_region=region)
    rng, within = wanted.random_stream(), wanted.constraint
    found = sample_goals(wanted, rng, MAX_GOALS, within=within, project=True).configurations
    return problem.changed(goals=found if len(found) else problem.goals)


MORE_KINDS: Mapping[str, Draw] = {
    "look-at": _ahead,
    "distance": _from_shoulder,
    "on-sphere": _sphere,
    "on-cylinder": _cylinder,
    "joint-coupling": _coupled,
    "centre-of-mass": _balanced,
}


def more_constraints_problem(
    index: int, arms: Sequence[str] = ("panda",), each: int = 20, around: float = 0.0
) -> PlanningProblem | UnsolvableProblem:
    """Return problem `index` with one of several arms in turn; rows have its index and kind.

    Args:
        index: number of the problem.
        arms: names of arms.
        each: number of problems of a kind, one after the other.
        around: largest distance of other goals' hands from that of the first goal, along each axis
            of that hand [m]; 0: one goal.
    """
    place, number = divmod(index, each)
    place %= len(MORE_KINDS)
    kind = tuple(MORE_KINDS)[place]
    name = phase_problem(str(index), place + 1, kind)
    robot, rng = (
        robot_from_source({"name": arms[number % len(arms)]}),
        np.random.default_rng([index, 13]),
    )
    # numbers that no other suite uses begin at 2700
    scene = family_scene(tuple(FAMILIES)[number % len(FAMILIES)], 2700 + index)
    checker, easy = shared_checker(robot, scene, (), 1e-3), None
    # until the goal can be reached, and not by a straight motion
    for _ in range(12):
        drawn = robot.random_configurations(rng, 100)
        q = next((q for q in drawn if not checker.in_collision(q)), None)
        if q is None:
            continue
        member = MORE_KINDS[kind](robot, q, rng)
        problem = PlanningProblem(name, robot, scene, q, q[None], (member,))
        pair = blocked_pair(problem, rng, 1e-3, moved=0.15 * robot.reach, draws=600, apart=1.0)
        if pair is None:
            continue
        problem = replace(problem, start=pair[0], goals=pair[1][None])
        if around:
            problem = _with_goals_around(problem, around)
        if not within_reach(problem):
            continue
        if not trivial(problem):
            return problem
        easy = easy or problem
    return easy or UnsolvableProblem(name, "no two free states far enough apart that keep it")
