"""Inverse kinematics and collision in one: free configurations that reach many poses, with as little work as it takes.

Newton's method starts from a seed that already puts the hand near the pose, and is given up as soon as it stalls:
of the poses of a region most have no free solution, and what fails must fail cheaply. A visit to a pose is VISIT
attempts at most; all poses are visited before any is visited again.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.collision.checker import FREE, first_contact
from cvqmpt_lab.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.constraints.project import ProjectionScratch, newton
from cvqmpt_lab.constraints.regions import Regions
from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.robot.kinematics import Kinematics

REACHED, UNTRIED, UNREACHABLE, COLLIDING = range(4)
VISIT = 4  # attempts at a pose before the next one's turn


class Seeds(NamedTuple):
    """Configurations and where each puts the hand."""

    configurations: Annotated[np.ndarray, "rows n"]
    """[rad or m]."""
    rotations: Annotated[np.ndarray, "rows 3 3"]
    """Of the end effector."""
    translations: Annotated[np.ndarray, "rows 3"]
    """Of the end effector [m]."""
    length: float
    """A hand this far off is as far as one turned by a radian [m]."""


class Poses(NamedTuple):
    """Where the hand shall be, and what came of it."""

    rotations: Annotated[np.ndarray, "count 3 3"]
    """Of the end effector."""
    translations: Annotated[np.ndarray, "count 3"]
    """Of the end effector [m]."""
    configurations: Annotated[np.ndarray, "count n"]
    """That reach them, where the verdict says so [rad or m]."""
    verdict: Annotated[np.ndarray, "int64 count"]
    """REACHED by a free configuration, UNTRIED, UNREACHABLE so far, or COLLIDING where only others reached it."""
    reached: Annotated[np.ndarray, "int64 count"]
    """Numbers of the poses reached, in that order."""


@kernel(inline="source")
def _nearest_seed(seeds, first, look, rotation, translation):
    """The one of `look` seeds from the first that puts the hand nearest to a pose."""
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
    hurry: bool,
    scratch: ProjectionScratch,
    wanted: int,
    poses: Poses,
):
    """Find a free configuration for each of several poses, until there are as many as wanted.

    Parameters
    ----------
    regions: the first is the pose to be reached, the others are kept at the same time.
    margin: to be kept from obstacles [m].
    firsts, look: an attempt starts from the best of `look` seeds from number firsts[attempt, pose] on; a multiple
        of VISIT attempts a pose.
    hurry: attempts that stall are given up.
    poses: configurations and verdicts are written.

    Returns
    -------
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
        rotation, translation, q = poses.rotations[i], poses.translations[i], poses.configurations[i]
        for row in range(3):
            regions.reference_translation[0, row] = translation[row]
            for column in range(3):
                regions.reference_rotation[0, row, column] = rotation[row, column]
        seed = _nearest_seed(seeds, firsts[attempt, i], look, rotation, translation)
        for j in range(q.shape[0]):
            q[j] = seed[j]
        if newton(kinematics, regions, q, tolerance, max_iterations, hurry, scratch) < 0:
            poses.verdict[i] = max(poses.verdict[i], UNREACHABLE)
            continue
        geometry, _ = first_contact(scratch.link_rotation, scratch.link_translation, robot, scene, margin)
        if geometry != FREE:
            poses.verdict[i] = COLLIDING
            continue
        poses.verdict[i] = REACHED
        poses.reached[found] = i
        found += 1
    return found
