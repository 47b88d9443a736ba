"""Opening the shelf's door: the hand holds the handle's bar and moves the door.

As published, the hand frame stands 0.10 m in front of the bar, its x axis down, and the door goes
from closed to -0.45 pi. Here the motion is planned: the door is the robot's eighth joint, the
constraint a region about the bar.
"""

from functools import lru_cache

import numpy as np

from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import DOOR
from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.inverse_kinematics import sample_region
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegionChain
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda, robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.articulation import take_out
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Scene

OPEN = -0.45 * np.pi  # [rad]
BAR = f"{DOOR}/handle_bar"
GRIP = 0.0075  # [m] opening of each finger: the bar's radius
PADS = ("panda_leftfinger_3", "panda_rightfinger_3")  # pieces of the fingers that close on the bar
TURN = 0.4  # [rad] about the bar: goals lie within +- this, so that the fingers can open there


def handle_region(turn: float = FREE) -> TaskSpaceRegionChain:
    """Hand poses that hold the bar, turned about it by at most +-turn [rad]."""
    Tw_e = pose((-0.10, 0.0, 0.0))
    # hand z along x, hand x down
    Tw_e[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    Bw = np.zeros((6, 2))
    Bw[5] = -turn, turn
    return TaskSpaceRegionChain(np.eye(4), Tw_e, Bw, BAR)


@lru_cache(maxsize=2)
def door_world(finger_opening: float = GRIP) -> tuple[Scene, Robot]:
    """The kitchen without the door, and the Panda with it; only finger pads may touch the bar."""
    scene, door = take_out(kitchen(), DOOR, may_touch=[(pad, BAR) for pad in PADS])
    return scene, robot_from_source({**panda(finger_opening).source, "articulated": to_plain(door)})


def bar_pose(angle: float) -> np.ndarray:
    """T_world_bar (4, 4) with the door at an angle [rad]; InvalidInputError outside its range."""
    return kitchen().with_joint(DOOR, angle)[BAR].T_world_object


def door_problem(seed: int, goals_needed: int = 10) -> PlanningProblem | UnsolvableProblem:
    """Open the door, from a grasp of the closed one; goals are sampled by `pipeline.solve`.

    Args:
        seed: of the start grasp.
        goals_needed: in whose posture so many of `pipeline.MAX_GOALS` are found; one that reaches
            fewer stands at a limit and may get stuck.
    """
    scene, robot = door_world()
    # a closed door is only 1 mm from its neighbour
    checker = CollisionChecker(robot, scene, margin=5e-4)
    grasp = handle_region(turn=0.0)
    goal = handle_region(TURN).at(bar_pose(OPEN))
    rng = np.random.default_rng([seed, 1])
    starts = sample_region(robot, grasp.at(bar_pose(0.0)), checker, rng, count=20, within=(grasp,))
    for start in starts.configurations:
        problem = PlanningProblem(
            name=str(seed),
            robot=robot,
            scene=scene,
            start=start,
            goals=np.empty((0, robot.dof)),
            constraint=(handle_region(),),
            goal_region=goal,
        )
        if len(with_sampled_goals(problem)[0].goals) >= goals_needed:
            return problem
    return UnsolvableProblem(
        str(seed), f"no start grasp whose posture reaches the goal: {starts.outcome}"
    )
