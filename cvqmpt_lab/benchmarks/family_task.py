"""Problems in held-out scenes of the training families, of the Panda and of other arms.

Upright: between random upright hand poses. Kinds of constraints: problem k has kind k modulo 8;
start and goal pose of the hand lie on one manifold. A short search without obstacles solves the
problem; a straight motion on the manifold does not, if a few draws contain such a problem.
Unconstrained: the place task and held-out families without a constraint.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.families import FAMILIES, family_scene
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.benchmarks.place_task import (
    HANDLE_GRIP_M,
    carried_can,
    handle_region,
    place_problem,
)
from cvqmpt_lab.benchmarks.results.row import phase_problem
from cvqmpt_lab.collision.exact import checker_of, shared_checker
from cvqmpt_lab.constraints.by_name.line import line
from cvqmpt_lab.constraints.by_name.plane import plane
from cvqmpt_lab.constraints.goals import (
    SAMPLE_MARGIN_M,
    goals_in_any_posture,
    on_manifold,
    sample_region,
)
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, upright_box
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda, robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.planner_interface import Observation, Query, search, uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace, direct_motion

ARM_SOURCES: Mapping[str, Mapping[str, Any]] = {
    "panda": {"name": "panda"},
    "ur5": {"name": "ur5"},
    "ur10": {"name": "ur10"},
    "kinova": {"name": "kinova"},
    "z1": {"name": "z1"},
    "xarm7": {"name": "xarm7"},
    "baxter": {"name": "baxter-left"},
    "talos": {"name": "talos-left-arm"},
    "tiago": {"name": "tiago-no-hand", "base": {"xyz": [0.0, 0.0, -0.6]}},
}
"""Nine arms of seven makers: 6 joints (ur5, ur10, kinova, z1), 7, and 7 on a lifting torso (tiago).

Each moves between two random upright hand poses, upright all the way, in scenes of four families.
"""


def held_out_problem(index: int, family: str) -> PlanningProblem | UnsolvableProblem:
    """Return problem `index`, in the first of 20 scenes that allows one.

    The scenes are index, 8000 + index, 8050 + index, ..., 8900 + index.
    """
    # numbers that no other suite and no tuning has used
    spare = range(8000 + index, 8950, 50)
    return _first_problem(str(index), family, (index, *spare), ARM_SOURCES["panda"])


def _first_problem(
    name: str, family: str, numbers: Sequence[int], robot_source: Mapping[str, Any]
) -> PlanningProblem | UnsolvableProblem:
    """Return the problem of the first of these scenes that allows one."""
    for number in numbers:
        found = family_problem(family, number, robot_source)
        if isinstance(found, PlanningProblem):
            return replace(found, name=name)
        reason = found.reason
    return UnsolvableProblem(name, f"{reason}, the last of {len(numbers)} scenes")


def family_problem(
    family: str,
    number: int,
    robot_source: Mapping[str, Any] = ARM_SOURCES["panda"],
    clear: float = 0.001,
) -> PlanningProblem | UnsolvableProblem:
    """Return the problem of a scene between two upright states with a blocked straight motion.

    Args:
        family: one of `FAMILIES`.
        number: number of the scene in its family.
        robot_source: json of the robot.
        clear: distance of start and goal from obstacles [m].
    """
    scene, robot = family_scene(family, number), robot_from_source(robot_source)
    return upright_problem(str(number), robot, scene, np.random.default_rng([number, 7]), clear)


def upright_problem(
    name: str, robot: Robot, scene: Scene, rng: np.random.Generator, clear: float
) -> PlanningProblem | UnsolvableProblem:
    """Return a problem between two upright states whose straight motion is blocked.

    Args:
        name: name of the problem.
        robot: the robot.
        scene: with all obstacles.
        rng: random generator for the states.
        clear: distance of start and goal from obstacles [m].
    """
    middle = 0.5 * (robot.lower + robot.upper)
    problem = PlanningProblem(name, robot, scene, middle, middle[None], (upright_box(),))
    pair = blocked_pair(problem, rng, clear)
    if pair is None:
        reason = (
            f"no two upright states {clear} m from everything in {scene.name} with a blocked "
            "straight motion"
        )
        return UnsolvableProblem(name, reason)
    return replace(problem, start=pair[0], goals=pair[1][None])


def blocked_pair(
    problem: PlanningProblem,
    rng: np.random.Generator,
    clear: float,
    moved: float = 0.0,
    draws: int = 4000,
    apart: float = 2.0,
    tries: int = 200,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return two states (n,) on the manifold whose straight motion is blocked; None if not found.

    Args:
        problem: with robot, scene and constraint.
        rng: random generator.
        clear: distance of both states from obstacles [m].
        moved: minimum distance between the positions of the hand [m].
        draws: number of configurations that are projected.
        apart: minimum distance between the states [rad].
        tries: number of pairs that are drawn.
    """
    space = ConstrainedSpace.of(problem)
    states = problem.robot.random_configurations(rng, draws)
    states = states[[space.project(q) for q in states]]
    states = states[space.valid_batch(states)]
    checker = checker_of(problem, clear)
    for _ in range(tries if len(states) > 1 else 0):
        start, goal = states[rng.choice(len(states), 2, replace=False)]
        if np.linalg.norm(goal - start) < apart or motion_free(space.arrays, start, goal):
            continue
        if (
            np.linalg.norm(problem.robot.pose(goal)[:3, 3] - problem.robot.pose(start)[:3, 3])
            < moved
        ):
            continue
        if not (checker.in_collision(start) or checker.in_collision(goal)):
            return start, goal
    return None


def robots_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return problem index % 20 of robot index // 20; its rows are named by index and robot."""
    number, k = divmod(index, 20)
    robot = tuple(ARM_SOURCES)[number]
    return replace(other_robot_problem(robot, k), name=phase_problem(str(index), number + 1, robot))


def other_robot_problem(robot: str, index: int) -> PlanningProblem | UnsolvableProblem:
    """Return problem `index` of a robot of `ARM_SOURCES`; `pipeline.solve` samples its goals.

    Its scene is the first of 2000 + index, 2020 + index, ... of its family that allows a problem.
    """
    # 2000 to 2399 are numbers that no other suite uses
    numbers = range(2000 + index, 2400 + index, 20)
    families = ("cubes-spheres", "table", "shelves", "kitchen-like")
    found = _first_problem(str(index), families[index % len(families)], numbers, ARM_SOURCES[robot])
    if isinstance(found, UnsolvableProblem):
        return found
    there = TaskSpaceRegion(found.robot.pose(found.goals[0]), np.eye(4), np.zeros((6, 2)))
    return replace(found, goals=np.empty((0, found.robot.dof)), goal_region=there)


def unconstrained_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return problem `index`: below 60 of the place task, from 60 on of the families in turn.

    Its rows are named by index and group: kitchen or families.
    """
    if index < 60:
        group, found = (1, "kitchen"), place_problem(index)
    else:
        turn, family = divmod(index - 60, len(FAMILIES))
        group, found = (2, "families"), held_out_problem(turn, tuple(FAMILIES)[family])
    if isinstance(found, PlanningProblem):
        found = found.changed(constraint=())
    return replace(found, name=phase_problem(str(index), *group))


TRAY_TILT_RAD = 0.02  # largest tilt of a tray, and of the axis of an arc
OFF_CURVE_M = 0.002  # largest distance from a plane, line or arc


class HandConstraint(NamedTuple):
    """Constraint, start and goal of the hand, and what it carries."""

    region: TaskSpaceRegion  # poses that the hand may have
    attachments: tuple[Attachment, ...] = ()  # objects that it carries
    start: TaskSpaceRegion | None = None  # poses at the start; None: any in the region
    goal: TaskSpaceRegion | None = None  # poses at the goal; None: any in the region


def _turned_like(
    T: np.ndarray, about_z: float | None = None, tolerance: float = 0.1
) -> TaskSpaceRegion:
    """Return the region of the orientation of T (4, 4) at any position.

    Args:
        T: pose of the hand.
        about_z: largest turn about the z axis of T [rad]; None: tolerance.
        tolerance: largest turn about the other axes [rad].
    """
    there = T.copy()
    there[:3, 3] = 0.0
    about_z = tolerance if about_z is None else about_z
    bound = np.array([FREE] * 3 + [tolerance] * 2 + [about_z])
    return TaskSpaceRegion(there, np.eye(4), np.stack([-bound, bound], axis=1))


def _arc(T: np.ndarray, rng: np.random.Generator) -> HandConstraint:
    """Return a rotation about a random axis; the hand turns with it as with a crank."""
    axis = line(_direction(rng), (0.0, 0.0, 0.0)).T0_w.copy()
    axis[:3, 3] = T[:3, 3] + rng.uniform(0.15, 0.4) * axis[:3, 0]
    return HandConstraint(_about(axis, T, 2.5))


def _about(axis: np.ndarray, T: np.ndarray, turn: float) -> TaskSpaceRegion:
    """Return the hand poses T (4, 4) turned about the z axis of a frame (4, 4) by +-turn [rad]."""
    bound = np.array([OFF_CURVE_M] * 3 + [TRAY_TILT_RAD] * 2 + [turn])
    return TaskSpaceRegion(axis, np.linalg.inv(axis) @ T, np.stack([-bound, bound], axis=1))


def _direction(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a vector whose direction is uniform on the sphere."""
    x, y, z = rng.standard_normal(3)
    return float(x), float(y), float(z)


CONSTRAINT_KINDS = (
    *("upright", "fixed-orientation", "plane", "line", "arc", "tray", "pouring", "door"),
)


def hand_constraint(kind: str, T: np.ndarray, rng: np.random.Generator) -> HandConstraint:
    """Return a constraint that a hand at the pose T (4, 4) meets.

    Args:
        kind: one of `CONSTRAINT_KINDS`, except the door, which is `held_door`.
        T: pose of the hand.
        rng: random generator for directions.
    """
    if kind == "upright":
        return HandConstraint(upright_box())
    if kind == "fixed-orientation":
        return HandConstraint(_turned_like(T))
    if kind == "plane":
        return HandConstraint(plane(_direction(rng), tuple(T[:3, 3]), OFF_CURVE_M))
    if kind == "line":
        return HandConstraint(line(_direction(rng), tuple(T[:3, 3]), OFF_CURVE_M))
    if kind == "arc":
        return _arc(T, rng)
    if kind == "tray":
        tray = Attachment("tray", Box((0.02, 0.24, 0.18)), pose((0.0, 0.0, 0.19)))
        return HandConstraint(upright_box(TRAY_TILT_RAD), (tray,))
    # pouring: a can is tipped about the axis along which the fingers reach
    return HandConstraint(_turned_like(T, about_z=FREE), (carried_can(),))


def held_door(rng: np.random.Generator) -> tuple[Scene, HandConstraint]:
    """Return the kitchen without a door of the shelf, which the hand holds and moves on an arc.

    Unlike in `door_problem` the door is carried by seven joints and is not a joint itself.
    """
    # smallest and largest angle of the door, and the smallest difference of start and goal [rad]
    ajar, wide, swung = 0.15, 1.5, 0.6
    scene = kitchen()
    door = str(rng.choice(("dagger_door_left", "dagger_door_right")))
    hinge = scene.articulation(door)
    sign = 1.0 if hinge.upper > 0.0 else -1.0
    first = rng.uniform(ajar, wide - swung)
    angles = sign * rng.permutation((first, rng.uniform(first + swung, wide)))
    # the hand may be turned about the handle, either way
    in_bar = pose((0.0, 0.0, 0.0), rng.uniform(-0.6, 0.6)) @ handle_region().Tw_e
    hands = [
        scene.with_joint(door, a)[f"{door}/handle_bar"].T_world_object @ in_bar for a in angles
    ]
    begun = scene.with_joint(door, angles[0])
    parts = tuple(_carried(begun, name, hands[0]) for name in hinge.moves)
    start, goal = (TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2))) for T in hands)
    hand = _about(hinge.T_world_joint, hands[0], wide)
    return scene.without(*hinge.moves), HandConstraint(hand, parts, start, goal)


def _carried(scene: Scene, name: str, T: np.ndarray, trim: float = 0.02) -> Attachment:
    """Return a part of the door in the frame of the hand at a pose (4, 4).

    Args:
        scene: with the door.
        name: name of the part.
        T: pose of the hand.
        trim: width that is cut off at all edges of the panel [m]: its gap is half a millimetre.
    """
    item = scene[name]
    shape = item.shape
    if isinstance(shape, Box):
        thin, wide, high = shape.size
        shape = Box((thin, wide - 2 * trim, high - 2 * trim))
    T_hand_object = np.linalg.inv(T) @ item.T_world_object
    return Attachment(name.rpartition("/")[2], shape, T_hand_object, item.mass)


def constraint_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return problem `index` with its goals; indices from 160 on are for tuning."""
    number, place = divmod(index, len(CONSTRAINT_KINDS))
    kind = CONSTRAINT_KINDS[place]
    name = phase_problem(str(index), place + 1, kind)
    rng = np.random.default_rng([index, 11])
    easy = None
    # until the goals can be reached, and none of them by a straight motion
    for _ in range(12):
        posed = _posed(kind, number, name, rng)
        if posed is None or not len(posed.goals) or not within_reach(posed):
            continue
        if not trivial(posed):
            return posed
        easy = easy or posed
    return easy or UnsolvableProblem(
        name, "no two free states far enough apart that keep the constraint"
    )


def trivial(problem: PlanningProblem) -> bool:
    """Return whether a straight motion on the manifold leads from the start to a goal."""
    space = ConstrainedSpace.of(problem)
    return any(direct_motion(space, problem.start, goal) is not None for goal in problem.goals)


def within_reach(problem: PlanningProblem) -> bool:
    """Return whether a short search without obstacles finds a path within the joint limits."""
    alone = ConstrainedSpace.of(replace(problem, scene=Scene("empty", ())))
    budget, rng = Budget(iterations=300), np.random.default_rng(0)
    query = Query.of(alone, problem.start, problem.goals, budget, rng)
    return search(BiRRT(), query, uniform(query, Observation())).path is not None


def _posed(kind: str, number: int, name: str, rng: np.random.Generator) -> PlanningProblem | None:
    """Return a problem with a constraint of a kind, a free start and goals; None if not found."""
    scene, robot, hand = _drawn(kind, number, rng)
    middle = 0.5 * (robot.lower + robot.upper)
    problem = PlanningProblem(
        name, robot, scene, middle, middle[None], (hand.region,), attachments=hand.attachments
    )
    if hand.start is not None:
        checker = checker_of(problem, SAMPLE_MARGIN_M)
        start = next(
            iter(sample_region(robot, hand.start, checker, rng, count=1).configurations), None
        )
        goal = hand.goal
    else:
        pair = blocked_pair(problem, rng, SAMPLE_MARGIN_M, moved=0.25, draws=600)
        if pair is None:
            return None
        start, end = pair
        goal = TaskSpaceRegion(robot.pose(end), np.eye(4), np.zeros((6, 2)))
    if start is None:
        return None
    problem = replace(problem, start=start, goals=np.empty((0, robot.dof)), goal_region=goal)
    goals = on_manifold(problem, goals_in_any_posture(problem).configurations)
    return problem.changed(goals=goals)


def _drawn(kind: str, number: int, rng: np.random.Generator) -> tuple[Scene, Robot, HandConstraint]:
    """Return a scene, the arm, and a constraint that a free configuration of the arm meets."""
    if kind == "door":
        scene, hand = held_door(rng)
        return scene, panda(HANDLE_GRIP_M), hand
    families, robot = tuple(FAMILIES), panda()
    # numbers that no other suite uses begin at 2500
    scene = family_scene(families[number % len(families)], 2500 + number)
    checker = shared_checker(robot, scene, (), SAMPLE_MARGIN_M)
    drawn = robot.random_configurations(rng, 100)
    free = next((q for q in drawn if not checker.in_collision(q)), drawn[0])
    return scene, robot, hand_constraint(kind, robot.pose(free), rng)
