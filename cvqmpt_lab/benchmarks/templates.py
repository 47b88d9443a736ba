"""Template of a problem, with comments, for any arm: a table, an obstacle, a constraint, a goal.

`with_limits` adds limits that a URDF does not state. `task_template` is the template of a task.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.two_arms import two_arms_template
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.function import FunctionConstraint
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, goals_in_any_posture
from cvqmpt_lab.constraints.named import rpy_of, upper_axis
from cvqmpt_lab.constraints.no_goal import hand_reach
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import FREE, ROWS_TEXT, Axis, TaskSpaceRegion, upright
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.pairs import cure_of_overlap
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace, direct_motion

TEMPLATE_TILT_RAD = 0.3
PROBLEM_COMMENTS = {  # comments of the template: possible values of fields of a problem file
    "problem": [
        "A problem for `cvqmpt plan FILE`. Lengths in m, angles in rad; a field _comment "
        "may stand anywhere.",
        "start: numbers, {joint: value} or the name of a group_state of the SRDF; more "
        "configurations: `cvqmpt ik`.",
        "A pose is {xyz, rpy}, {xyz, quaternion [x, y, z, w]} or a 4x4 matrix.",
        "Other fields: attachments (what the hand carries), goals (configurations, used as they "
        "are), start_region.",
    ],
    "two arms": [
        "Two hands carry a tray. constraint: `base` is the first hand's frame; the second one, "
        "`end_effector`, keeps its pose in it (a closed chain);",
        "the other region keeps the tray level. attachments: the tray, carried by the first hand "
        "and also_held_by the second, which may touch it.",
        "goal_region: poses of the first hand. More configurations of both: `cvqmpt ik`.",
    ],
    "object": [
        "type: box with size, cylinder with radius and height, sphere with radius, convex_mesh "
        "with vertices,",
        "point_cloud with points and radius; obstacle: false is seen by cameras and ignored by "
        "planners.",
    ],
    "constraint": [
        "A region by name, upright, upright-box, fixed-orientation, plane, line or pose, or in "
        "full: T0_w, the frame w in the world,",
        f"Tw_e, the end effector in w, and Bw, {ROWS_TEXT}. Several in a list are kept all.",
    ],
}


class TableLayout(NamedTuple):
    """Positions from the first joint in shares of the hand's reach; heights above the table."""

    table: tuple[float, float, float, float]  # from x, to x, half width, thickness
    wall: tuple[float, float, float, float]  # its x, edges along x and y, height
    hand: tuple[float, float, float]  # x, y to both sides, height
    around: float  # distance from there within which the hand may be


TABLE_LAYOUTS = (
    TableLayout((0.3, 1.0, 0.8, 0.05), (0.5, 0.4, 0.06, 0.45), (0.5, 0.4, 0.32), 0.12),
    TableLayout((0.3, 1.0, 0.8, 0.05), (0.6, 0.3, 0.06, 0.3), (0.55, 0.35, 0.25), 0.25),
    TableLayout((0.2, 1.0, 0.8, 0.05), (0.6, 0.1, 0.06, 0.2), (0.5, 0.3, 0.3), 0.5),
    # a post; the hand may be anywhere
    TableLayout((0.6, 0.7, 0.05, 0.1), (0.65, 0.05, 0.05, 0.05), (0.0, 0.0, 0.0), 2.0),
)


def problem_template(
    source: Mapping[str, Any], functions: Sequence[FunctionConstraint] = ()
) -> dict[str, Any]:
    """Return json of a problem that birrt solves, for the json of a robot.

    Args:
        source: the json of the robot.
        functions: constraints that start and goal keep, too; the json does not name them.

    Raises:
        InvalidInputError: no such problem is found, or nothing of the robot can collide.
    """
    robot = robot_from_source(source)
    if robot.nothing_collides:
        raise InvalidInputError(
            f"robot {robot.name}: {robot.nothing_collides}; no path among obstacles is certified"
        )
    head = {
        "$schema": "problem.schema.json",  # written into the folder of the problem
        "schema": PlanningProblem.SCHEMA,
        "_comment": PROBLEM_COMMENTS["problem"],
    }
    if len(robot.end_effectors) > 1:
        if functions:
            raise InvalidInputError(
                f"--constraint {functions[0].name}: problems new finds no start of two hands that "
                f"keeps it; give one hand of {robot.name}: cvqmpt robot --end-effector"
            )
        return {**head, **two_arms_template(source), "_comment": PROBLEM_COMMENTS["two arms"]}
    plain: dict[str, Any] = {**head, "name": "mine", "robot": dict(source)}
    for layout in TABLE_LAYOUTS:
        for axis in _axes(robot):
            top, scene = _scene(robot, layout)
            begun = {
                **plain,
                "scene": scene,
                "constraint": {
                    "_comment": PROBLEM_COMMENTS["constraint"],
                    "upright": {"tilt": TEMPLATE_TILT_RAD, "axis": axis},
                },
            }
            ends = _ends(robot, from_plain(Scene, scene), layout, top, axis, functions)
            for start, goal in ends:
                joints = dict(zip(robot.joint_names, start.tolist(), strict=True))
                # poses around a goal need not have configurations that keep functions
                goals = {"goals": [goal.tolist()]} if functions else _goal(robot, goal)
                made = {**begun, "start": joints, **goals}
                blocked = layout is not TABLE_LAYOUTS[-1]
                problem = PlanningProblem.from_dict(made)
                kept = replace(problem, constraint=(*problem.constraint, *functions))
                # a function in Python takes long
                if _solved(kept, blocked, iterations=100 if functions else 1000):
                    return made
    asked = "".join(f", keep {function.describe()}" for function in functions)
    overlap = cure_of_overlap(robot)
    raise InvalidInputError(
        f"no start and goal were found for robot {robot.name} that keep {TEMPLATE_TILT_RAD} rad of "
        f"tilt{asked} and can be planned; {overlap}{'; or ' if overlap else ''}write a problem by "
        "hand, `cvqmpt problems new` for the panda shows how"
    )


def with_limits(source: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the json of a robot with all its limits, and notes that name the guessed ones.

    Known limits are written as they are. Unknown ones are guessed: a joint reaches its velocity
    limit in 0.5 s, and this acceleration in 0.1 s. Efforts are not guessed.
    """
    robot = robot_from_source(source)
    limits: dict[str, Any] = {}
    notes: list[str] = []
    below = robot.velocity_limits
    for kind, seconds in (("acceleration", 0.5), ("jerk", 0.1)):
        known = robot.limits.get(kind)
        if known is None and not (np.isfinite(below) & (below > 0.0)).all():
            joint = robot.joint_names[int(np.argmin(np.isfinite(below) & (below > 0.0)))]
            notes.append(
                f"{kind}_limits are not written: the URDF states no velocity limit of {joint}; "
                "write them by cvqmpt robot --velocity"
            )
            continue
        values = (below / seconds).round(3) if known is None else known
        limits[f"{kind}_limits"] = values.tolist()
        if known is None:
            less = "velocity" if kind == "acceleration" else "acceleration"
            notes.append(
                f"{kind}_limits are a guess, the limit of {less} in {seconds:g} s; replace them by "
                "those of the arm's maker"
            )
        below = values
    effort = robot.limits["effort"]
    if np.isfinite(effort).all():
        limits["effort_limits"] = effort.tolist()
    else:
        missing = np.array(robot.joint_names)[np.isinf(effort)]
        notes.append(
            f"effort_limits are not written: the URDF states none of {', '.join(missing)}; its "
            "others are kept"
        )
    return {**source, **limits}, notes


def _solved(problem: PlanningProblem, blocked: bool, iterations: int) -> bool:
    """Return whether a path is found, and, if `blocked`, no straight motion leads to a goal.

    Every second goal is left out: those are turned by whole turns towards the start.
    """
    solution = solve(problem, "birrt", Budget(iterations=iterations), seed=0)
    if not solution.solved or solution.path is None:
        return False
    if not blocked:
        return True
    space, last = ConstrainedSpace.of(problem), solution.path.states[-1]
    goals = problem.goals
    if len(goals) == 0:
        goals = goals_in_any_posture(problem).configurations
    ends = (last, *goals[1::2])
    return all(direct_motion(space, problem.start, end) is None for end in ends)


def _axes(robot: Robot) -> list[Axis]:
    """Return axes of the end effector that may point up, first that of a tool pointing down."""
    _, T_link_hand = robot.hand()
    outward = T_link_hand[2, :3] * (-1.0 if T_link_hand[2, 3] < 0.0 else 1.0)
    down = np.eye(4)
    down[2, :3] = -outward
    middle = robot.pose(0.5 * (robot.lower + robot.upper))
    return list(dict.fromkeys((upper_axis(down), upper_axis(middle))))


def _scene(robot: Robot, layout: TableLayout) -> tuple[float, dict[str, Any]]:
    """Return the height of a table [m], and json of the scene: the table with a wall on it.

    A comment in the first object lists the shapes.
    """
    reach, (x, y, z) = hand_reach(robot), robot.kinematics.translation[0]
    top = 0.0 if 0.0 <= z <= 0.6 * reach else z - 0.35 * reach
    begin, end, half, thick = (reach * share for share in layout.table)
    at, *size = (reach * share for share in layout.wall)
    places = {
        "table": ((end - begin, 2.0 * half, thick), (0.5 * (begin + end), -0.5 * thick)),
        "wall": (size, (at, 0.5 * size[2])),
    }
    objects = [
        box_object(name, edges, pose(np.round((x + ahead, y, top + up), 3)))
        for name, (edges, (ahead, up)) in places.items()
    ]
    return top, {
        "name": "room",
        "objects": [{"_comment": PROBLEM_COMMENTS["object"], **objects[0]}, objects[1]],
    }


def box_object(name: str, edges: Sequence[float], T_world_box: np.ndarray) -> dict[str, Any]:
    """Return json of a box in a scene: its name, edges (3,) [m] and pose (4, 4)."""
    return {
        "name": name,
        "shape": {"type": "box", "size": np.round(edges, 3).tolist()},
        "T_world_object": pose_field(T_world_box),
    }


def pose_field(T: np.ndarray) -> dict[str, Any]:
    """Return json of a pose (4, 4), without a rotation that is 0."""
    xyz = (np.round(T[:3, 3], 6) + 0.0).tolist()
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    if abs(quaternion[3]) > 1.0 - 1e-12:
        return {"xyz": xyz}
    return {"xyz": xyz, "quaternion": (np.round(quaternion, 7) + 0.0).tolist()}


def _goal(robot: Robot, goal: np.ndarray) -> dict[str, Any]:
    """Return the goal field: poses around one pose, or a configuration for up to five joints."""
    if robot.dof <= 5:
        return {"goals": [goal.tolist()]}
    T_world_goal = robot.pose(goal)
    rpy = rpy_of(T_world_goal[:3, :3])
    at = {"xyz": T_world_goal[:3, 3].round(3).tolist(), "rpy": rpy.round(4).tolist()}
    return {"goal_region": {"pose": {"at": at, "position": 0.01, "tilt": 0.02, "yaw": 3.15}}}


def _ends(
    robot: Robot,
    scene: Scene,
    layout: TableLayout,
    top: float,
    axis: Axis,
    functions: Sequence[FunctionConstraint],
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of free configurations (n,) on the manifold at both sides of the wall.

    Args:
        robot: the robot.
        scene: table and wall.
        layout: layout of the scene and the hand.
        top: height of the table [m].
        axis: axis of the end effector that points up.
        functions: further constraints.
    """
    checker = CollisionChecker(robot, scene, margin=SAMPLE_MARGIN_M)
    reach, origin = hand_reach(robot), robot.kinematics.translation[0]
    x, y, z = (reach * share for share in layout.hand)
    sides = []
    for side in (-1.0, 1.0):
        place = pose((origin[0] + x, origin[1] + side * y, top + z))
        around = layout.around * reach
        bounds = np.array([[-around, around]] * 3 + [[-FREE, FREE]] * 3)
        region = TaskSpaceRegion(place, np.eye(4), bounds)
        manifold = RegionConstraint(
            robot, (upright(TEMPLATE_TILT_RAD / 2, axis), region, *functions)
        )
        sides.append(_central(robot, manifold, checker))
    tried = 0
    for start in sides[0][:12]:
        for goal in sides[1]:
            apart = np.linalg.norm((robot.pose(start) - robot.pose(goal))[:3, 3])
            if apart > 0.3 * reach:
                tried += 1
                yield start, goal
            if tried == 30:
                return


def _central(
    robot: Robot, manifold: RegionConstraint, checker: CollisionChecker, draws: int = 400
) -> list[np.ndarray]:
    """Return free configurations (n,) on a manifold, those near the middle of the ranges first."""
    middle = 0.5 * (robot.lower + robot.upper)
    if robot.turning.any():
        middle = np.clip(0.0, robot.lower, robot.upper)
    found = []
    for q in robot.random_configurations(np.random.default_rng(0), draws):
        landed = manifold.project(middle + 0.5 * (q - middle))
        if landed is None:
            continue
        if not manifold.functions:  # rounded, it could leave a function
            landed = landed.round(4).clip(robot.lower, robot.upper)
        if not checker.in_collision(landed):
            found.append(landed)
    return sorted(found, key=lambda q: float(np.linalg.norm(q - middle)))
