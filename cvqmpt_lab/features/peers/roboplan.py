"""Adapter of roboplan (C++, pinocchio, coal): RRT-Connect with states projected onto constraints.

Constraints bound roll, pitch and yaw. The settings are from roboplan's example of constrained
planning, but the search ends at the first path. Its shortcutting ignores constraints and is not
used.
"""

import tempfile
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.peers import rpy_box, upright_region, versions
from cvqmpt_lab.features.peers.world_files import TOOL, urdf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget

MADE_BY = versions("roboplan", "roboplan")

import roboplan.core
import roboplan.rrt

GROUP = "arm"


@lru_cache(maxsize=4)
def _world(robot: Robot, scene: Scene, region: TaskSpaceRegion) -> roboplan.core.Scene:
    """Return robot and obstacles as roboplan's scene; frame `tool` is T_hand_tool = Tw_e^-1."""
    with tempfile.TemporaryDirectory() as folder:
        urdf, srdf = urdf_of(robot, scene, Path(folder), np.linalg.inv(region.Tw_e))
        description = roboplan.core.loadUrdfSceneDescriptionFromXml(urdf, [])
        world = roboplan.core.Scene("world", description)
    world.importSrdf(srdf)
    world.addGroup(GROUP, list(robot.joint_names))
    return world


def plan(
    problem: PlanningProblem, budget: Budget, seed: int, rewired: bool = False
) -> np.ndarray | None:
    """Plan with `roboplan.rrt.RRT`.

    Args:
        problem: problem with one upright constraint and one goal, see `upright_region`.
        budget: its `seconds` [s] are the planner's time limit.
        seed: seed of the planner's random numbers.
        rewired: whether the tree is rewired to shorter paths from the root (RRT*).

    Returns:
        A path (m, n) [rad], or None if none was found in the budget.
    """
    region = upright_region(problem)
    world = _world(problem.robot, problem.scene, region)
    lower, upper = rpy_box(region).T
    T0_w = np.asfortranarray(region.T0_w)
    constraint = roboplan.rrt.PoseConstraint(world, GROUP, TOOL, lower, upper, T0_w)
    options = roboplan.rrt.RRTOptions(
        GROUP,
        # more nodes than any budget allows
        max_nodes=10_000_000,
        # largest length of an extension of a tree [rad]
        max_connection_distance=0.5,
        # distance of checked states on an edge [rad]
        collision_check_step_size=0.05,
        max_planning_time=budget.seconds or 0.0,
        rrt_connect=True,
        rrt_star=rewired,
        # radius of rewiring [rad], equal to the length of an extension
        rewire_distance=0.5,
    )
    search = roboplan.rrt.RRT(world, options)
    search.setRngSeed(seed)
    names = list(problem.robot.joint_names)
    ends = [roboplan.core.JointConfiguration(names, q) for q in (problem.start, problem.goals[0])]
    try:
        return np.array(search.plan(*ends, [constraint]).positions)
    except RuntimeError:
        # raised if no path was found within the limits of time and nodes
        return None


# with `rrt_star`, which roboplan's authors recommend for constraints
plan_star = partial(plan, rewired=True)
