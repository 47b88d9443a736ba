"""A problem to start from: robot, box, constraint, start and goal, with comments that say what else there is."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.codec.json_schema import FOLDER
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN
from cvqmpt_lab.constraints.named import upper_axis
from cvqmpt_lab.constraints.task_space_region import ROWS_TEXT, RegionConstraint, upright
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import Budget

TILT = 0.3  # [rad]
DRAWS = 2000  # configurations tried for a start and a goal
APART = 0.3  # share of the robot's reach that start and goal are apart at least
EFFORT = Budget(iterations=1000)  # of birrt, that a pair of them may take
COMMENT = [
    "A problem for `cvqmpt plan --problem-file`. Lengths in m, angles in rad; a field _comment may stand anywhere.",
    "More configurations: `cvqmpt ik`. A pose is {xyz, rpy}, {xyz, quaternion [x, y, z, w]} or a 4x4 matrix.",
    "Other fields: attachments (what the hand carries), goals (configurations, used as they are), start_region.",
]
SHAPES = [
    "type: box with size, cylinder with radius and height, sphere with radius, convex_mesh with vertices,",
    "point_cloud with points and radius; obstacle: false is seen by cameras and ignored by planners.",
]
REGIONS = [
    "A region by name, upright, fixed-orientation, plane, line or pose, or in full: T0_w, the frame w in the world,",
    f"Tw_e, the end effector in w, and Bw, {ROWS_TEXT}. Several in a list are kept all.",
]


def template(source: Mapping[str, Any]) -> dict[str, Any]:
    """Json of a problem that can be planned, for a robot as in a problem file; InvalidInputError if there is none."""
    robot = robot_from_source(source)
    size, away = round(0.1 * robot.reach, 3), round(0.6 * robot.reach, 3)
    axis = upper_axis(robot.pose(0.5 * (robot.lower + robot.upper)))
    scene = Scene("room", (SceneObject("box", Box((size, size, size)), pose((away, 0.0, size))),))
    box = {"_comment": SHAPES, "name": "box", "shape": {"type": "box", "size": [size] * 3}}
    plain = {
        "$schema": (FOLDER / "problem.schema.json").as_uri(),
        "schema": PlanningProblem.SCHEMA,
        "_comment": COMMENT,
        "name": "mine",
        "robot": dict(source),
        "scene": {"name": "room", "objects": [{**box, "T_world_object": {"xyz": [away, 0.0, size]}}]},
        "constraint": {"_comment": REGIONS, "upright": {"tilt": TILT, "axis": axis}},
    }
    for start, goal in _ends(robot, scene, RegionConstraint(robot, (upright(TILT / 2, axis),))):
        problem = {**plain, "start": start.tolist(), **_goal(robot, goal)}
        if solve(PlanningProblem.from_dict(problem), "birrt", EFFORT, seed=0, clearance=False).solved:
            return problem
    raise InvalidInputError(
        f"no start and goal were found for robot {robot.name} that keep {TILT} rad of tilt and can be planned; "
        "write a problem by hand, `cvqmpt problems new` for the panda shows how"
    )


def _goal(robot: Robot, goal: np.ndarray) -> dict[str, Any]:
    """The field that says where to: poses around one, or a configuration where joints are too few for that."""
    if robot.dof <= 5:
        return {"goals": [goal.tolist()]}
    T_world_goal = robot.pose(goal)
    rpy = Rotation.from_matrix(T_world_goal[:3, :3]).as_euler("xyz")
    at = {"xyz": T_world_goal[:3, 3].round(3).tolist(), "rpy": rpy.round(4).tolist()}
    return {"goal_region": {"pose": {"at": at, "position": 0.01, "tilt": 0.02, "yaw": 3.15}}}


def _ends(robot: Robot, scene: Scene, manifold: RegionConstraint) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of configurations (n,) free of collision on the manifold, the end effector well apart."""
    checker, rng = CollisionChecker(robot, scene, margin=SAMPLE_MARGIN), np.random.default_rng(0)
    first = None
    for q in robot.random_configurations(rng, DRAWS):
        landed = manifold.project(q)
        if landed is None:
            continue
        landed = landed.round(4).clip(robot.lower, robot.upper)
        if checker.in_collision(landed):
            continue
        if first is None:
            first = landed
        elif np.linalg.norm((robot.pose(landed) - robot.pose(first))[:3, 3]) > APART * robot.reach:
            yield first, landed
            first = None
