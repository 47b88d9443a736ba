"""Goal configurations drawn from a region of poses: solved and checked in compiled code."""

from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.constraints.inverse_kinematics import (
    ATTEMPTS,
    MAX_ITERATIONS,
    POSES,
    SAMPLE_MARGIN,
    TOLERANCE,
    GoalSample,
    first_guesses,
    pose_regions,
)
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.kernels.manifold.projection import projection_scratch
from cvqmpt_lab.kernels.search.reach import COLLIDING, UNREACHABLE, reach_free
from cvqmpt_lab.planning.collision_arrays import robot_arrays, scene_arrays
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.exact_shapes import reach_with


def sample_goals(
    problem: PlanningProblem,
    rng: np.random.Generator,
    count: int,
    max_poses: int = 100,
    within: Sequence[TaskSpaceRegion] = (),
    near: np.ndarray | None = None,
) -> GoalSample:
    """Up to count collision-free configurations in a problem's goal region, one per pose.

    The draws are those of `sample_region`, and so are the configurations, except where the compiled checker, which is
    a little more cautious than coal, calls one colliding.

    within, near: see `solve_poses`.
    """
    robot, region = problem.robot, problem.goal_region
    assert region is not None
    regions = pose_regions(robot, within)
    scratch = projection_scratch(robot.dof, regions)
    pieces = robot_arrays(robot, problem.attachments)
    obstacles = scene_arrays(problem.scene, reach_with(robot, problem.attachments))
    found: list[np.ndarray] = []
    tried = unreachable = colliding = 0
    while len(found) < count and tried < max_poses:
        poses = region.sample_poses(rng, min(POSES, max_poses - tried))
        guesses = first_guesses(robot, rng, len(poses), ATTEMPTS, near)
        chosen = np.empty(len(poses), dtype=np.int64)
        looked = reach_free(
            robot.kinematics,
            regions,
            pieces,
            obstacles,
            SAMPLE_MARGIN,
            np.ascontiguousarray(poses[:, :3, :3]),
            np.ascontiguousarray(poses[:, :3, 3]),
            guesses,
            TOLERANCE,
            MAX_ITERATIONS,
            scratch,
            count - len(found),
            chosen,
        )
        chosen = chosen[:looked]
        found += [guesses[k, attempt] for k, attempt in enumerate(chosen) if attempt >= 0]
        tried += looked
        unreachable += int((chosen == UNREACHABLE).sum())
        colliding += int((chosen == COLLIDING).sum())
    return GoalSample(np.array(found).reshape(-1, robot.dof), tried, unreachable, colliding)
