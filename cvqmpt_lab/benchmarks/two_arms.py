"""Two arms carry one tray or box: over a table, through a window, into a shelf.

Both hands hold it, a closed chain: the second hand has a `relative-pose` in the frame of the first.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.benchmarks.hold_handle import outward, pieces_of
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import with_first_goal
from cvqmpt_lab.benchmarks.results.row import phase_problem
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.by_name.relative_pose import relative_pose
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, find_in_region, first_guesses, solve_poses
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, symmetric_region
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.pairs import cure_of_overlap
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import Budget


def _box(name: str, low: Sequence[float], high: Sequence[float]) -> SceneObject:
    """Return a box between two corners [m]."""
    size = np.subtract(high, low).round(4).tolist()
    return SceneObject(name, Box(tuple(size)), pose(0.5 * np.add(low, high).round(4)))


def _over_table(
    rng: np.random.Generator, ends: np.ndarray, reach: float, size: np.ndarray, wide: float
) -> Iterator[SceneObject]:
    """Yield a table below both ends, and a block between them, higher than the carried object."""
    x, _, z = ends.mean(axis=0)
    top = ends[:, 2].min() - reach * rng.uniform(0.1, 0.15)
    half = 0.7 * reach
    yield _box("table", (x - 0.3 * reach, -half, top - 0.05), (x + 0.4 * reach, half, top))
    deep, thick = reach * rng.uniform((0.05, 0.02), (0.15, 0.04))
    high = z + reach * rng.uniform(0.0, 0.08)
    yield _box("block", (x - deep, -thick, top), (x + deep, thick, high))


def _through_window(
    rng: np.random.Generator, ends: np.ndarray, reach: float, size: np.ndarray, wide: float
) -> Iterator[SceneObject]:
    """Yield a wall between both ends with an opening in it."""
    x, y, z = ends.mean(axis=0) + reach * rng.uniform(-0.03, 0.03, 3)
    across, up = wide + reach * rng.uniform(0.05, 0.12), reach * rng.uniform(0.15, 0.25)
    side, thick = max(0.8 * reach, across + 0.2 * reach), 0.02
    yield _box("wall below", (x, -side, z - reach), (x + thick, side, z - up))
    yield _box("wall above", (x, -side, z + up), (x + thick, side, z + reach))
    yield _box("wall right", (x, -side, z - up), (x + thick, y - across, z + up))
    yield _box("wall left", (x, y + across, z - up), (x + thick, side, z + up))


def _into_shelf(
    rng: np.random.Generator, ends: np.ndarray, reach: float, size: np.ndarray, wide: float
) -> Iterator[SceneObject]:
    """Yield two boards with sides around the goal, in front of the start."""
    x, y, z = ends[1]
    front, back = x - 0.5 * size[0] - 0.03 * reach, x + 0.5 * size[0] + 0.1 * reach
    across = wide + reach * rng.uniform(0.03, 0.1)
    low = z - 0.5 * size[2] - reach * rng.uniform(0.05, 0.1)
    high = z + 0.5 * size[2] + reach * rng.uniform(0.1, 0.2)
    yield _box("lower board", (front, y - across, low - 0.02), (back, y + across, low))
    yield _box("upper board", (front, y - across, high), (back, y + across, high + 0.02))
    for name, edge in (("right", -1.0), ("left", 1.0)):
        first, last = sorted((y + edge * across, y + edge * (across + 0.02)))
        yield _box(f"{name} side", (front, first, low - 0.02), (back, last, high + 0.02))


class CarryingLayout(NamedTuple):
    """A kind of problem; lengths are fractions of the reach of an arm (dimensionless)."""

    size: tuple[float, float, float]  # size of the carried object
    start: tuple[float, float, float]  # its centre, from the middle between the shoulders
    goal: tuple[float, float, float]
    grasps: tuple[str, ...]  # direction of the hands: forward, inward (to each other) or down
    # obstacles for a random generator, both ends (2, 3), the reach, the size (3,) and half the
    # width of the carried object with its hands [m]
    scene: Callable[
        [np.random.Generator, np.ndarray, float, np.ndarray, float], Iterator[SceneObject]
    ]


CARRYING_LAYOUTS: Mapping[str, CarryingLayout] = {
    "tray-over-table": CarryingLayout(
        size=(0.2, 0.22, 0.03),
        start=(0.55, 0.2, -0.1),
        goal=(0.55, -0.2, -0.1),
        grasps=("forward", "inward", "down"),
        scene=_over_table,
    ),
    "tray-through-window": CarryingLayout(
        size=(0.2, 0.3, 0.03),
        start=(0.45, 0.0, -0.1),
        goal=(0.7, 0.0, -0.1),
        grasps=("forward", "inward"),
        scene=_through_window,
    ),
    "box-into-shelf": CarryingLayout(
        size=(0.2, 0.25, 0.15),
        start=(0.42, 0.0, 0.0),
        goal=(0.68, 0.0, -0.05),
        grasps=("forward", "inward"),
        scene=_into_shelf,
    ),
}


@lru_cache(maxsize=8)
def shoulders(robot: Robot) -> tuple[np.ndarray, float]:
    """Return the middle (3,) between both shoulders and the reach of a hand from its shoulder [m].

    A shoulder is the origin of the first joint that moves only one hand.
    """
    hands = list(robot.end_effectors.values())
    moves = robot.kinematics.moves[:, [row for row, _ in hands]]
    firsts = (moves & (moves.sum(axis=1, keepdims=True) == 1)).argmax(axis=0) + 1
    states = robot.random_configurations(np.random.default_rng(0), 4000)
    states[0] = np.clip(0.0, robot.lower, robot.upper)
    turns, origins = link_poses(robot.kinematics, states)
    ends = [origins[:, row] + turns[:, row] @ T[:3, 3] for row, T in hands]
    far = [
        np.linalg.norm(end - origins[:, first], axis=1)
        for end, first in zip(ends, firsts, strict=True)
    ]
    return origins[0, firsts].mean(axis=0), float(np.max(far))


@lru_cache(maxsize=8)
def hold(
    robot: Robot, kind: str, poses: int = 12
) -> tuple[Attachment, np.ndarray, tuple[TaskSpaceRegion, ...]]:
    """Return the pair of grasps, one at each side of an object, that is reached most often.

    Hands point forward, to each other, or down, and are rotated about this direction in steps of 90
    deg. Of both hands the smaller number of collision-free inverse kinematics solutions counts.

    Args:
        robot: with two end effectors.
        kind: one of `CARRYING_LAYOUTS`.
        poses: number of poses of the object that are tried for each grasp.

    Returns:
        The object in the first hand, its size (3,) [m], and two regions: the pose of the second
        hand in the first one, and the object level.
    """
    if len(robot.end_effectors) != 2:
        raise InvalidInputError(
            f"robot {robot.name} has {len(robot.end_effectors)} end effectors: name two, "
            "--end-effectors LEFT RIGHT"
        )
    layout = CARRYING_LAYOUTS[kind]
    middle, reach = shoulders(robot)
    size = np.round(reach * np.array(layout.size), 2)
    rng = np.random.default_rng(0)
    around = [
        symmetric_region(pose(middle + reach * np.array(end)), np.eye(4), [0.05 * reach] * 6)
        for end in (layout.start, layout.goal)
    ]
    checker = CollisionChecker(robot, Scene("none", ()), margin=SAMPLE_MARGIN_M)
    scores: dict[str, list[tuple[int, np.ndarray]]] = {}
    T_world_item = np.concatenate([region.sample_poses(rng, poses // 2) for region in around])
    for style in layout.grasps:
        for side, hand in zip((1.0, -1.0), robot.end_effectors, strict=True):
            found = []
            for roll in range(4):
                T = _grasp(robot, hand, style, side, roll, size)
                there = around[0].changed(end_effector=hand)
                guesses = first_guesses(robot, np.random.default_rng(0), poses)
                states = solve_poses(robot, there, T_world_item @ T, guesses)
                free = sum(any(not checker.in_collision(q) for q in rows) for rows in states)
                found.append((free, T))
            scores.setdefault(style, []).append(max(found, key=lambda it: it[0]))
    style = max(scores, key=lambda style: min(free for free, _ in scores[style]))
    (_, first), (_, second) = scores[style]
    left, right = robot.end_effectors
    item = Attachment(
        kind.split("-")[0], Box(tuple(size.tolist())), np.linalg.inv(first), also_held_by=(right,)
    )
    closed = relative_pose(left, np.linalg.inv(first) @ second).changed(end_effector=right)
    return item, size, (closed, symmetric_region(np.eye(4), first, [FREE] * 6, 0.1))


def _grasp(
    robot: Robot, hand: str, style: str, side: float, roll: int, size: np.ndarray
) -> np.ndarray:
    """Return T_item_hand (4, 4) of a hand at the left (side 1) or right (-1) edge of a box."""
    axis = outward(robot, hand)
    k, sign = "xyz".index(axis[-1]), -1.0 if axis[0] == "-" else 1.0
    tip = float((np.concatenate(list(pieces_of(robot, hand).values()))[:, k] * sign).max())
    ahead = {"forward": (1.0, 0.0, 0.0), "inward": (0.0, -side, 0.0), "down": (0.0, 0.0, -1.0)}
    x = np.array(ahead[style])
    y = np.roll(np.abs(x), 1)
    for _ in range(roll):
        y = np.cross(x, y)
    # columns of R_item_hand: the outward axis along x, the next ones along y and across both
    R = np.empty((3, 3))
    R[:, k], R[:, (k + 1) % 3], R[:, (k + 2) % 3] = sign * x, y, np.cross(sign * x, y)
    edge = np.array([0.0, side * 0.5 * size[1], 0.0])
    return rigid(R, edge - (tip - 0.01) * x)


def two_arms_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Return problem index % 30 of pair index // 30 of robot (baxter, tiago-pro) and layout."""
    number, k = divmod(index, 30)
    robot, kind = tuple(product(("baxter", "tiago-pro"), CARRYING_LAYOUTS))[number]
    made = carrying_problem(robot_from_source({"name": robot}), kind, k)
    return replace(made, name=phase_problem(str(index), number + 1, f"{robot} {kind}"))


def peers_problem(index: int, each: int = 10) -> PlanningProblem | UnsolvableProblem:
    """Return a problem of baxter with one goal, for external planners: a tray, table or window.

    Args:
        index: 0 to 19.
        each: number of problems of a kind.
    """
    kind, k = divmod(index, each)
    made = two_arms_problem(30 * kind + k)
    return with_first_goal(replace(made, name=f"{index}/{made.name.partition('/')[2]}"))


def carrying_problem(
    robot: Robot, kind: str, number: int, draws: int = 20
) -> PlanningProblem | UnsolvableProblem:
    """Return a problem of a kind in the first of some scenes that has a free start and goal.

    Start and goal are drawn around those of the layout; the carried object is level and may yaw.

    Args:
        robot: with two hands.
        kind: one of `CARRYING_LAYOUTS`.
        number: number of the problem.
        draws: number of scenes that are tried.
    """
    item, size, constraint = hold(robot, kind)
    middle, reach = shoulders(robot)
    layout = CARRYING_LAYOUTS[kind]
    T_item_hand = np.linalg.inv(item.T_hand_object)
    beyond = (T_item_hand, T_item_hand @ constraint[0].T0_w)
    wide = max(abs(T[1, 3]) for T in beyond) + 0.08
    rng = np.random.default_rng([number, *kind.encode()])
    for _ in range(draws):
        shift = reach * rng.uniform(-0.05, 0.05, (2, 3))
        ends = middle + reach * np.array([layout.start, layout.goal]) + shift
        scene = Scene(kind, tuple(layout.scene(rng, ends, reach, size, wide)))
        regions = [
            symmetric_region(pose(end), T_item_hand, [width] * 3 + [0.0, 0.0, 0.3])
            for end, width in zip(ends, (0.02, 0.01), strict=True)
        ]
        checker = CollisionChecker(robot, scene, (item,), margin=SAMPLE_MARGIN_M)
        ends_found, near = [], None
        for region in regions:
            # draw the goal near the start's posture: a closed chain cannot change its posture
            found = find_in_region(
                robot, region, checker, rng, count=1, within=constraint, near=near
            )
            near = next(iter(found.configurations), None)
            if near is None:
                break
            ends_found.append(near)
        else:
            return PlanningProblem(
                f"{kind} {number}",
                robot,
                scene,
                ends_found[0],
                constraint=constraint,
                attachments=(item,),
                goal_region=regions[1],
            )
    return UnsolvableProblem(f"{kind} {number}", f"none of {draws} scenes has a start and a goal")


def two_arms_template(source: Mapping[str, Any], numbers: int = 10) -> dict[str, Any]:
    """Return json of a problem of two hands that birrt solves.

    Args:
        source: json of the robot.
        numbers: problems of each kind that are tried.

    Raises:
        InvalidInputError: none of them is solved.
    """
    robot = robot_from_source(source)
    for kind, number in product(CARRYING_LAYOUTS, range(numbers)):
        made = carrying_problem(robot, kind, number, draws=1)
        if isinstance(made, PlanningProblem):
            solution = solve(made, "birrt", Budget(iterations=2000), seed=0)
            if solution.solved:
                joints = dict(zip(robot.joint_names, made.start.tolist(), strict=True))
                return {**made.to_dict(), "robot": dict(source), "start": joints}
    overlap = cure_of_overlap(robot)
    raise InvalidInputError(
        f"no tray or box was found that both hands of robot {robot.name} can move; "
        f"{overlap}{'; or ' if overlap else ''}name other "
        "--end-effectors, or write a problem by hand: `cvqmpt problems new --robot baxter` shows "
        "how"
    )
