"""KOMO (C++, robotic): a path of 60 states optimised at once, then from other guesses.

Its bounds hold at these states; between them nothing is asked of the path, and so it may fail the
certificate. It ends at the first path that it calls feasible.
"""

import time
from functools import lru_cache
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull

from cvqmpt_lab.execution.mjcf import Body, bodies_of, unchecked_pairs
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Sphere, shape_vertices
from cvqmpt_lab.search.result import Budget
from experiments.peers import rpy_box, upright_region, versions

MADE_BY = versions("komo", "robotic")

import robotic


def plan(
    problem: PlanningProblem, budget: Budget, seed: int, slices: int = 60
) -> np.ndarray | None:
    """A path (slices + 1, n) [rad], or None if none that KOMO calls feasible was found in time.

    Args:
        problem: with one upright constraint and one goal, see `upright_region`.
        budget: its seconds [s]; an optimisation that has begun is not interrupted.
        seed: of the states that guesses after the first, a straight line, go through.
        slices: states after the start.
    """
    deadline = time.perf_counter() + (budget.seconds or np.inf)
    robot, rng = problem.robot, np.random.default_rng(seed)
    world, path = _world(problem), None
    world.setJointState(problem.start)
    through = [problem.goals[0]]
    while path is None and time.perf_counter() < deadline:
        path = _optimized(world, problem, through, slices)
        through = [robot.random_configurations(rng, 1)[0], problem.goals[0]]
    return path if time.perf_counter() < deadline else None


def _optimized(
    world: robotic.Config, problem: PlanningProblem, through: list[np.ndarray], slices: int
) -> np.ndarray | None:
    """A path (slices + 1, n), or None; the first guess goes straight through states."""
    komo = robotic.KOMO(world, phases=1.0, slicesPerPhase=slices, kOrder=2, enableCollisions=True)
    square, equal, below = robotic.OT.sos, robotic.OT.eq, robotic.OT.ineq
    komo.addControlObjective([], order=1, scale=1.0)
    komo.addControlObjective([], order=2, scale=0.1)
    komo.addObjective([], robotic.FS.jointLimits, [], below)
    komo.addObjective([], robotic.FS.accumulatedCollisions, [], equal, [10.0])
    komo.addObjective([1.0], robotic.FS.qItself, [], equal, [10.0], problem.goals[0])
    bound = np.sin(rpy_box(upright_region(problem))[4, 1])
    both = robotic.FS.scalarProductXY, robotic.FS.scalarProductXZ
    for feature, sign in product(both, (10.0, -10.0)):
        komo.addObjective([], feature, ["tool", "w"], below, [sign], [np.copysign(bound, sign)])
    corners = np.array([problem.start, *through])
    times = np.linspace(0.0, len(through), slices + 1)[1:]
    guess = [np.interp(times, range(len(corners)), column) for column in corners.T]
    komo.initWithPath(np.stack(guess, axis=1))
    found = robotic.NLP_Solver(komo.nlp(), verbose=0).solve()
    return np.vstack([problem.start, komo.getPath()]) if found.feasible else None


def _world(problem: PlanningProblem) -> robotic.Config:
    """Robot and obstacles, with a frame `tool` at T_hand_tool = Tw_e^-1, and the region's `w`."""
    region, arm = upright_region(problem), problem.robot.kinematics
    world = robotic.Config()
    world.addFrame("link_0")
    for j in range(problem.robot.dof):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = arm.rotation[j], arm.translation[j]
        _placed(world, f"before_{j}", f"link_{arm.parent[j]}", T)
        kind = robotic.JT.transZ if arm.prismatic[j] else robotic.JT.hingeZ
        link = world.addFrame(f"link_{j + 1}", f"before_{j}")
        link.setJoint(kind, limits=[arm.lower[j], arm.upper[j]])
    # a root of its own: what is asked of parents below is not meant of obstacles
    world.addFrame("scene")
    pieces = len(problem.robot.links)
    for k, body in enumerate(bodies_of(problem.robot, problem.scene)):
        parent = f"link_{body.link}" if k < pieces else "scene"
        _shaped(_placed(world, body.name, parent, body.T_link_body), body)
    # it leaves out pairs by a count of parents alone: so many that none is checked that must not be
    unchecked = {frozenset(pair) for pair in unchecked_pairs(problem.robot)}
    for parents in range(2 * problem.robot.dof + 2):
        for k in range(pieces):
            world.getFrame(f"piece_{k}").setContact(-parents or 1)
        names = world.getCollidablePairs()
        if not unchecked & set(map(frozenset, zip(names[::2], names[1::2], strict=True))):
            break
    row, T_link_hand = problem.robot.end_effector_link
    _placed(world, "tool", f"link_{row}", T_link_hand @ np.linalg.inv(region.Tw_e))
    _placed(world, "w", "link_0", region.T0_w)
    return world


def _placed(world: robotic.Config, name: str, parent: str, T: np.ndarray) -> robotic.Frame:
    """A new frame at the pose T (4, 4) in its parent."""
    frame = world.addFrame(name, parent)
    return frame.setRelativePosition(T[:3, 3]).setRelativeRotationMatrix(T[:3, :3])


def _shaped(frame: robotic.Frame, body: Body) -> None:
    """Give a frame the body's shape; all but spheres as a convex mesh of its corners."""
    match body.shape:
        case Sphere(radius):
            frame.setShape(robotic.ST.sphere, [radius])
        case Cylinder(radius, height):
            frame.setShape(robotic.ST.cylinder, [height, radius])
        case Box() | ConvexMesh():
            frame.setConvexMesh(shape_vertices(body.shape))
    frame.setContact(1)
