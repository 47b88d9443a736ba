"""Adapter of Drake's KinematicTrajectoryOptimization (C++, SNOPT), which optimises a B-spline.

Optimisation starts from several initial guesses. Constraint and clearance are required at 30 states
of the spline. A solution is checked at 400 states; states that violate them are added, and the
spline is optimised again. The first spline without a violation is the path.
"""

import time
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.polyline import states_at
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.peers import rpy_box, upright_region, versions
from cvqmpt_lab.features.physics.mjcf import Body, bodies_of, unchecked_pairs
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Sphere
from cvqmpt_lab.search.result import Budget

MADE_BY = versions("drake", "drake")

import pydrake.all as drake


class World(NamedTuple):
    """Constraints of a problem in Drake, each on one configuration."""

    kept: tuple  # objects that must exist as long as the constraints
    upright: drake.Constraint
    clear: drake.Constraint  # distance from obstacles


def plan(problem: PlanningProblem, budget: Budget, seed: int) -> np.ndarray | None:
    """Return a path (m, n) [rad], or None if the solver found none in time.

    Args:
        problem: problem with one upright constraint and one goal, see `upright_region`.
        budget: its `seconds` [s] are the time limit.
        seed: seed of the random states through which initial guesses lead; the first guess is the
            straight line.
    """
    deadline = time.perf_counter() + (budget.seconds or np.inf)
    robot, rng = problem.robot, np.random.default_rng(seed)
    world = _world(robot, problem.scene, upright_region(problem))
    middle = 0.5 * (problem.start + problem.goals[0])
    path, through = None, middle
    while path is None and time.perf_counter() < deadline:
        path = _optimized(world, problem, through, deadline)
        # standard deviation [rad] that is large enough for guesses around obstacles
        through = np.clip(rng.normal(middle, 0.6), robot.lower, robot.upper)
    return path


def _optimized(
    world: World, problem: PlanningProblem, through: np.ndarray, deadline: float, count: int = 14
) -> np.ndarray | None:
    """Return a path (m, n) along an optimised spline, or None if there is no solution.

    The initial guess is first optimised with the upright constraint alone, without obstacles. Then
    both constraints are used; checked states that violate them are added, up to six times.

    Args:
        world: constraints.
        problem: the problem.
        through: state (n,) [rad] through which the guess leads from start to goal.
        deadline: end of the time limit, by `time.perf_counter` [s].
        count: number of control points.
    """
    corners = np.array([problem.start, through, problem.goals[0]])
    times = np.linspace(0.0, 2.0, count)
    guess = states_at(corners, np.arange(3.0), times)
    basis = drake.KinematicTrajectoryOptimization(problem.robot.dof, count).basis()
    spline = drake.BsplineTrajectory(basis, guess[:, :, None])
    both, fine = [world.upright, world.clear], np.linspace(0.0, 1.0, 400)[1:-1]
    asked = list(np.linspace(0.0, 1.0, 32)[1:-1])
    for constraints in ([world.upright], *[both] * 6):
        spline, solved = _solved(problem, spline, constraints, asked, deadline)
        if constraints is not both:
            continue
        if not solved:
            return None
        inner = {s: spline.value(s).ravel() for s in fine}
        missed = [s for s, q in inner.items() if not all(c.CheckSatisfied(q, 1e-3) for c in both)]
        if not missed:
            return np.array([corners[0], *inner.values(), corners[2]])
        asked = sorted([*asked, *missed[::4]])
    return None


def _solved(
    problem: PlanningProblem,
    spline: drake.BsplineTrajectory,
    constraints: list[drake.Constraint],
    asked: list[float],
    deadline: float,
) -> tuple[drake.BsplineTrajectory, bool]:
    """Return an optimised spline, and whether constraints hold at the parameters `asked`."""
    optimizer = drake.KinematicTrajectoryOptimization(spline)
    optimizer.AddPositionBounds(problem.robot.lower, problem.robot.upper)
    optimizer.AddDurationConstraint(1.0, 1.0)
    optimizer.AddPathLengthCost()
    for state, s in ((problem.start, 0.0), (problem.goals[0], 1.0)):
        optimizer.AddPathPositionConstraint(state, state, s)
    for s in asked:
        for constraint in constraints:
            optimizer.AddPathPositionConstraint(constraint, s)
    options = drake.SolverOptions()
    for name, value in {
        "Major iterations limit": 100,
        "Major feasibility tolerance": 1e-4,
        "Major optimality tolerance": 1e-2,
        "Time limit": max(0.01, deadline - time.perf_counter()),
    }.items():
        options.SetOption(drake.SnoptSolver.id(), name, value)
    found = drake.SnoptSolver().Solve(optimizer.prog(), None, options)
    return optimizer.ReconstructTrajectory(found), found.is_success()


@lru_cache(maxsize=4)
def _world(robot: Robot, scene: Scene, region: TaskSpaceRegion) -> World:
    """Return the constraints of a robot in a scene; frame `tool` is at T_hand_tool = Tw_e^-1."""
    arm = robot.kinematics
    builder = drake.DiagramBuilder()
    plant, shapes_of = drake.AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    links = [plant.world_body()]
    for j in range(robot.dof):
        links.append(
            plant.AddRigidBody(f"link_{j + 1}", drake.SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        )
        T = rigid(arm.rotation[j], arm.translation[j])
        kind = drake.PrismaticJoint if arm.prismatic[j] else drake.RevoluteJoint
        parent = links[arm.parent[j]].body_frame()
        before = plant.AddFrame(drake.FixedOffsetFrame(f"before_{j}", parent, _pose(T)))
        frames = before, links[j + 1].body_frame()
        plant.AddJoint(kind(f"joint_{j}", *frames, [0.0, 0.0, 1.0], arm.lower[j], arm.upper[j]))
    bodies = bodies_of(robot, scene)
    shapes = {
        body.name: plant.RegisterCollisionGeometry(
            links[body.link],
            _pose(body.T_link_body),
            _shape(body),
            body.name,
            drake.CoulombFriction(),
        )
        for body in bodies
    }
    row, T_link_hand = robot.hand()
    T_link_tool = T_link_hand @ np.linalg.inv(region.Tw_e)
    hand = links[row].body_frame()
    tool = plant.AddFrame(drake.FixedOffsetFrame("tool", hand, _pose(T_link_tool)))
    plant.Finalize()
    rules = drake.CollisionFilterDeclaration()
    for pair in unchecked_pairs(robot):
        rules.ExcludeBetween(*(drake.GeometrySet(shapes[name]) for name in pair))
    shapes_of.collision_filter_manager().Apply(rules)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    x, tilt = np.eye(3)[0], rpy_box(region)[4, 1]
    upright = drake.AngleBetweenVectorsConstraint(
        plant, plant.world_frame(), region.T0_w[:3, 0], tool, x, 0.0, tilt, own
    )
    # distances must be at least 1 mm; pairs farther apart than 0.1 m are ignored
    clear = drake.MinimumDistanceLowerBoundConstraint(plant, 1e-3, own, None, 0.1)
    return World((diagram, context, plant), upright, clear)


def _pose(T: np.ndarray) -> drake.RigidTransform:
    return drake.RigidTransform(drake.RotationMatrix.ProjectToRotationMatrix(T[:3, :3]), T[:3, 3])


def _shape(body: Body) -> drake.Shape:
    match body.shape:
        case Box(size):
            return drake.Box(size)
        case Cylinder(radius, height):
            return drake.Cylinder(radius, height)
        case Sphere(radius):
            return drake.Sphere(radius)
        case ConvexMesh(vertices):
            return drake.Convex(vertices.T, body.name)
    raise AssertionError(body)  # bodies_of returns no other shapes
