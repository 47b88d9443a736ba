"""Goal configurations drawn from a region of poses: inverse kinematics and checks, compiled."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.collision.arrays import robot_arrays, scene_arrays
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.collision.checker import in_contact
from cvqmpt_lab.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.constraints.inverse_kinematics import (
    ATTEMPTS,
    INSIDE,
    MAX_ITERATIONS,
    NEAR,
    SAMPLE_MARGIN,
    TOLERANCE,
    GoalSample,
    one_pose,
)
from cvqmpt_lab.constraints.project import ProjectionScratch, newton, projection_scratch
from cvqmpt_lab.constraints.regions import Regions
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, stack_regions
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.robot import Robot

REACHED, UNTRIED, UNREACHABLE, COLLIDING = range(4)
VISIT = 4  # attempts at a pose before the next one's turn


class Seeds(NamedTuple):
    """Configurations and where each puts the hand."""

    configurations: Annotated[np.ndarray, "rows n"]  # [rad or m]
    rotations: Annotated[np.ndarray, "rows 3 3"]  # of the end effector
    translations: Annotated[np.ndarray, "rows 3"]  # of the end effector [m]
    length: float  # [m] a hand this far off counts as one turned by a radian


class Poses(NamedTuple):
    """Poses for the hand, and the configurations found."""

    rotations: Annotated[np.ndarray, "count 3 3"]  # of the end effector
    translations: Annotated[np.ndarray, "count 3"]  # of the end effector [m]
    # that reach them, where the verdict says so [rad or m]
    configurations: Annotated[np.ndarray, "count n"]
    # REACHED by a free configuration, UNTRIED, UNREACHABLE so far, or COLLIDING if only others did
    verdict: Annotated[np.ndarray, "int64 count"]
    reached: Annotated[np.ndarray, "int64 count"]  # numbers of the poses reached, in that order


@kernel(inline="source")
def _nearest_seed(seeds, first, look, rotation, translation):
    """The one of `look` seeds from the first whose hand pose (R_k, t_k) is nearest to (R, t).

    Minimises |t_k - t|^2 / length^2 + |R_k - R|^2 over the first two columns of R.
    """
    nearest, least = first, np.inf
    for k in range(first, first + look):
        shift = turn = 0.0
        for i in range(3):
            gap = seeds.translations[k, i] - translation[i]
            shift += gap * gap
            for j in range(2):  # the third axis follows
                gap = seeds.rotations[k, i, j] - rotation[i, j]
                turn += gap * gap
        square = shift / (seeds.length * seeds.length) + turn
        if square < least:
            nearest, least = k, square
    return seeds.configurations[nearest]


@entry
def reach_free(
    kinematics: Kinematics,
    regions: Regions,
    robot: RobotGeometry,
    scene: SceneGeometry,
    margin: float,
    seeds: Seeds,
    firsts: Annotated[np.ndarray, "int64 attempts count"],
    look: int,
    tolerance: float,
    max_iterations: int,
    stop_on_stall: bool,
    scratch: ProjectionScratch,
    wanted: int,
    poses: Poses,
):
    """Find a free configuration for each of several poses, until there are as many as wanted.

    Args:
        kinematics: of the robot.
        regions: the first is the pose to be reached; the others hold at the same time.
        robot: pieces of the robot.
        scene: obstacles.
        margin: to be kept from obstacles [m].
        seeds: configurations that Newton's method starts from.
        firsts: an attempt starts from the best of `look` seeds from number firsts[attempt, pose]
            on; a multiple of VISIT attempts a pose.
        look: see `firsts`.
        tolerance: on the pose [m, rad].
        max_iterations: of Newton's method.
        stop_on_stall: attempts that stall are given up.
        scratch: work arrays.
        wanted: number of configurations.
        poses: configurations and verdicts are written.

    Returns:
        Number of poses reached.
    """
    found = 0
    for i in range(poses.verdict.shape[0]):
        poses.verdict[i] = UNTRIED
    attempts, count = firsts.shape
    for turn in range(attempts * count):
        i, attempt = turn // VISIT % count, turn // (VISIT * count) * VISIT + turn % VISIT
        if found >= wanted:
            return found
        if poses.verdict[i] == REACHED:
            continue
        rotation, translation, q = (
            poses.rotations[i],
            poses.translations[i],
            poses.configurations[i],
        )
        for row in range(3):
            regions.reference_translation[0, row] = translation[row]
            for column in range(3):
                regions.reference_rotation[0, row, column] = rotation[row, column]
        seed = _nearest_seed(seeds, firsts[attempt, i], look, rotation, translation)
        for j in range(q.shape[0]):
            q[j] = seed[j]
        if newton(kinematics, regions, q, tolerance, max_iterations, stop_on_stall, scratch) < 0:
            poses.verdict[i] = max(poses.verdict[i], UNREACHABLE)
            continue
        if in_contact(scratch.link_rotation, scratch.link_translation, robot, scene, margin):
            poses.verdict[i] = COLLIDING
            continue
        poses.verdict[i] = REACHED
        poses.reached[found] = i
        found += 1
    return found


def sample_goals(
    problem: PlanningProblem,
    rng: np.random.Generator,
    count: int,
    max_poses: int = 100,
    within: Sequence[TaskSpaceRegion] = (),
    near: np.ndarray | None = None,
    project: bool = False,
    look: int = 16,
) -> GoalSample:
    """Up to count collision-free configurations in a problem's goal region, one per pose.

    Where joints turn by more than a full turn, every second configuration is turned by whole turns
    towards the start: else most goals of such arms are whole turns away.

    Args:
        problem: the problem; its goal region must not be None.
        rng: random numbers.
        count: of configurations.
        max_poses: at most so many poses are drawn.
        within: regions kept at the same time; that of a held handle puts its door at the hand.
        near: configuration (n,) around which Newton's method starts, instead of anywhere.
        project: onto the region itself, not onto poses drawn in it.
        look: seeds of Newton's method compared for an attempt.
    """
    robot, region = problem.robot, problem.goal_region
    assert region is not None
    if near is None:
        seeds = _seeds_anywhere(robot, region.end_effector)
    else:
        scattered = near + NEAR * rng.standard_normal((512, robot.dof))
        seeds = _seeds(robot, np.clip(scattered, robot.lower, robot.upper), region.end_effector)
    T = region.sample_poses(rng, max_poses)
    regions = stack_regions(robot, (one_pose(region), *within))
    if project:
        # no pose is the one to start near to
        T[:], look = region.T0_w, 1
        regions = stack_regions(robot, (region, *within), INSIDE)
    poses = Poses(
        np.ascontiguousarray(T[:, :3, :3]),
        np.ascontiguousarray(T[:, :3, 3]),
        np.empty((max_poses, robot.dof)),
        np.empty(max_poses, dtype=np.int64),
        np.empty(max_poses, dtype=np.int64),
    )
    found = reach_free(
        robot.kinematics,
        regions,
        robot_arrays(robot, problem.attachments),
        scene_arrays(problem.scene, reach_with(robot, problem.attachments), problem.clearance),
        SAMPLE_MARGIN,
        seeds,
        rng.integers(len(seeds.configurations) - look + 1, size=(ATTEMPTS, max_poses)),
        look,
        TOLERANCE,
        MAX_ITERATIONS,
        # from a given posture, or along limits and bounds, progress may be slow
        near is None and not project,
        projection_scratch(robot.dof, regions),
        count,
        poses,
    )
    configurations = poses.configurations[poses.reached[:found]]
    configurations[::2] = _turned_near(configurations[::2], problem.start, robot)
    return GoalSample(
        configurations,
        poses_tried=int((poses.verdict != UNTRIED).sum()),
        unreachable=int((poses.verdict == UNREACHABLE).sum()),
        colliding=int((poses.verdict == COLLIDING).sum()),
    )


def _turned_near(configurations: np.ndarray, start: np.ndarray, robot: Robot) -> np.ndarray:
    """The same postures (k, n), hinges turned by whole turns as near to start as limits allow."""
    whole = 2.0 * np.pi * np.round((configurations - start) / (2.0 * np.pi))
    turned = configurations - np.where(robot.kinematics.prismatic, 0.0, whole)
    return np.where((turned >= robot.lower) & (turned <= robot.upper), turned, configurations)


@lru_cache(maxsize=8)
def _seeds_anywhere(robot: Robot, end_effector: str | None) -> Seeds:
    """Uniform configurations, always the same."""
    uniform = robot.random_configurations(np.random.default_rng(0), 8192)
    return _seeds(robot, uniform, end_effector)


def _seeds(robot: Robot, configurations: np.ndarray, end_effector: str | None) -> Seeds:
    """Configurations (k, n) with the poses of an end effector."""
    link, T = robot.hand(end_effector)
    rotations, translations = link_poses(robot.kinematics, configurations)
    return Seeds(
        configurations,
        rotations[:, link] @ T[:3, :3],
        translations[:, link] + rotations[:, link] @ T[:3, 3],
        0.3 * robot.reach,
    )
