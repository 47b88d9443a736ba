"""Inverse kinematics and collision in one: the first free configuration that reaches each of many poses."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.kernels.collision.checker import FREE, first_contact
from cvqmpt_lab.kernels.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.entry import entry
from cvqmpt_lab.kernels.manifold.kinematics import Kinematics
from cvqmpt_lab.kernels.manifold.projection import ProjectionScratch, project
from cvqmpt_lab.kernels.manifold.regions import Regions

UNREACHABLE, COLLIDING = -1, -2


@entry
@kernel
def reach_free(
    kinematics: Kinematics,
    regions: Regions,
    robot: RobotGeometry,
    scene: SceneGeometry,
    margin,
    rotations: Annotated[np.ndarray, "count 3 3"],
    translations: Annotated[np.ndarray, "count 3"],
    configurations: Annotated[np.ndarray, "count attempts n"],
    tolerance,
    max_iterations,
    scratch: ProjectionScratch,
    wanted,
    chosen: Annotated[np.ndarray, "int64 count"],
):
    """Project configurations in place onto one pose each, in order, until one is free; go on to the next pose.

    rotations, translations: poses of the reference frame of the first region [m].
    margin: to be kept [m]. wanted: stop when so many poses have a free configuration.
    chosen: which attempt serves each pose, UNREACHABLE, or COLLIDING when what reached it was not free.

    Returns
    -------
    Number of poses tried.
    """
    found = 0
    for i in range(rotations.shape[0]):
        if found == wanted:
            return i
        for row in range(3):
            regions.reference_translation[0, row] = translations[i, row]
            for column in range(3):
                regions.reference_rotation[0, row, column] = rotations[i, row, column]
        chosen[i] = UNREACHABLE
        for attempt in range(configurations.shape[1]):
            if (
                project(kinematics, regions, configurations[i, attempt], tolerance, max_iterations, scratch)
                < 0
            ):
                continue
            geometry, _ = first_contact(scratch.link_rotation, scratch.link_translation, robot, scene, margin)
            if geometry == FREE:
                chosen[i] = attempt
                found += 1
                break
            chosen[i] = COLLIDING
    return rotations.shape[0]
