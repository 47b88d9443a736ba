"""roboplan (pinocchio, coal; C++): RRT-Connect, states projected on a box of roll, pitch and yaw.

Set up as in its own example of constrained planning, but for the first path found; its shortcutting
knows no constraints and is left out.
"""

import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget
from experiments.peers import rpy_box, upright_region, versions
from experiments.peers.world_files import TOOL, urdf_of

MADE_BY = versions("roboplan", "roboplan")

import roboplan.core
import roboplan.rrt

GROUP = "arm"


@lru_cache(maxsize=4)
def _scene(robot: Robot, scene: Scene, region: TaskSpaceRegion) -> roboplan.core.Scene:
    with tempfile.TemporaryDirectory() as folder:
        urdf, srdf = urdf_of(robot, scene, Path(folder), np.linalg.inv(region.Tw_e))
        description = roboplan.core.loadUrdfSceneDescriptionFromXml(urdf, [])
        world = roboplan.core.Scene("world", description)
    world.importSrdf(srdf)
    world.addGroup(GROUP, list(robot.joint_names))
    return world


def plan(problem: PlanningProblem, budget: Budget, seed: int) -> np.ndarray | None:
    """A path (m, n) [rad] by `roboplan.rrt.RRT`; None where it finds none in the budget."""
    region = upright_region(problem)
    scene = _scene(problem.robot, problem.scene, region)
    lower, upper = rpy_box(region).T
    frame = np.asfortranarray(region.T0_w)
    constraint = roboplan.rrt.PoseConstraint(scene, GROUP, TOOL, lower, upper, frame)
    options = roboplan.rrt.RRTOptions(
        GROUP,
        # more nodes than any time is enough for
        max_nodes=10_000_000,
        # [rad] longest extension of a tree
        max_connection_distance=0.5,
        # [rad] between states that are checked
        collision_check_step_size=0.05,
        max_planning_time=budget.seconds or 0.0,
        rrt_connect=True,
    )
    search = roboplan.rrt.RRT(scene, options)
    search.setRngSeed(seed)
    names = list(problem.robot.joint_names)
    ends = [roboplan.core.JointConfiguration(names, q) for q in (problem.start, problem.goals[0])]
    try:
        return np.array(search.plan(*ends, [constraint]).positions)
    except RuntimeError:
        # raised when time or nodes are over
        return None
