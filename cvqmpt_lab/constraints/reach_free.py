"""Compiled inverse kinematics: free configurations of many poses, by Newton's method from seeds."""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.collision.checker import in_contact
from cvqmpt_lab.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.constraints.project import ProjectionScratch, newton
from cvqmpt_lab.constraints.regions import Regions
from cvqmpt_lab.robot.kinematics import Kinematics

REACHED_POSE, UNTRIED_POSE, UNREACHABLE_POSE, COLLIDING_POSE = range(4)
VISIT = 4  # attempts at a pose before the turn of the next one


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
    # REACHED_POSE by a free configuration, UNTRIED_POSE, UNREACHABLE_POSE so far, or COLLIDING_POSE
    # if all configurations found collide
    verdict: Annotated[np.ndarray, "int64 count"]
    reached: Annotated[np.ndarray, "int64 count"]  # numbers of the poses reached, in that order


class Attempts(NamedTuple):
    """Where Newton's method starts for each pose."""

    seeds: Seeds
    # an attempt starts from the best of `look` seeds from number firsts[attempt, pose] on; a
    # multiple of VISIT attempts a pose
    firsts: Annotated[np.ndarray, "int64 attempts count"]
    look: int


class Stopping(NamedTuple):
    """When Newton's method and the search end."""

    wanted: int  # number of configurations
    tolerance: float  # on the pose [m, rad]
    max_iterations: int
    on_stall: bool  # give up attempts that stall


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
    starts: Attempts,
    stopping: Stopping,
    scratch: ProjectionScratch,
    balls: Annotated[np.ndarray, "bodies 4"],
    poses: Poses,
):
    """Find a free configuration for each of several poses, until there are as many as wanted.

    Args:
        kinematics: kinematics of the robot.
        regions: the first is the pose to be reached; the others hold at the same time.
        robot: pieces of the robot.
        scene: obstacles.
        margin: to be kept from obstacles [m].
        starts: configurations that Newton's method starts from.
        stopping: when it ends.
        scratch: work arrays.
        balls: work array, see `checker.safe_advance`.
        poses: configurations and verdicts are written.

    Returns:
        Number of poses reached.
    """
    seeds, firsts, look = starts
    wanted, tolerance, max_iterations, stop_on_stall = stopping
    found = 0
    for i in range(poses.verdict.shape[0]):
        poses.verdict[i] = UNTRIED_POSE
    attempts, count = firsts.shape
    for turn in range(attempts * count):
        i, attempt = turn // VISIT % count, turn // (VISIT * count) * VISIT + turn % VISIT
        if found >= wanted:
            return found
        if poses.verdict[i] == REACHED_POSE:
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
            poses.verdict[i] = max(poses.verdict[i], UNREACHABLE_POSE)
            continue
        if in_contact(scratch.link_rotation, scratch.link_translation, robot, scene, margin, balls):
            poses.verdict[i] = COLLIDING_POSE
            continue
        poses.verdict[i] = REACHED_POSE
        poses.reached[found] = i
        found += 1
    return found
