"""roboplan (pinocchio, coal; C++): RRT-Connect, states projected on a box of roll, pitch and yaw.

Set up as in its own example of constrained planning, but for the first path found; its shortcutting
knows no constraints and is left out.
"""

import tempfile
from pathlib import Path

import numpy as np
import roboplan.core
import roboplan.rrt

from cvqmpt_lab.external.upright import once_a_world, rpy_box, upright_region
from cvqmpt_lab.external.world_files import TOOL, urdf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget

GROUP = "arm"
CONNECTION = 0.5  # [rad] longest extension of a tree
COLLISION_STEP = 0.05  # [rad] between states that are checked
NODES = 10_000_000  # more than any time is enough for


@once_a_world
def _scene(problem: PlanningProblem) -> roboplan.core.Scene:
    with tempfile.TemporaryDirectory() as folder:
        urdf, srdf = urdf_of(problem, Path(folder), np.linalg.inv(upright_region(problem).Tw_e))
        scene = roboplan.core.Scene(
            "world", roboplan.core.loadUrdfSceneDescriptionFromXml(urdf, [])
        )
    scene.importSrdf(srdf)
    scene.addGroup(GROUP, list(problem.robot.joint_names))
    return scene


def plan(problem: PlanningProblem, budget: Budget, seed: int) -> np.ndarray | None:
    """A path (m, n) [rad] by `roboplan.rrt.RRT`; None where it finds none in the budget's seconds."""
    region, scene = upright_region(problem), _scene(problem)
    lower, upper = rpy_box(region).T
    frame = np.asfortranarray(region.T0_w)
    constraint = roboplan.rrt.PoseConstraint(scene, GROUP, TOOL, lower, upper, frame)
    options = roboplan.rrt.RRTOptions(
        GROUP,
        max_nodes=NODES,
        max_connection_distance=CONNECTION,
        collision_check_step_size=COLLISION_STEP,
        max_planning_time=budget.seconds or 0.0,
        rrt_connect=True,
    )
    search = roboplan.rrt.RRT(scene, options)
    search.setRngSeed(seed)
    names = list(problem.robot.joint_names)
    ends = [roboplan.core.JointConfiguration(names, q) for q in (problem.start, problem.goals[0])]
    try:
        return np.array(search.plan(*ends, [constraint]).positions)
    except RuntimeError:  # what it raises when time or nodes are over
        return None
