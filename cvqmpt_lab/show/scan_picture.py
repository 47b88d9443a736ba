"""A picture of a scan: raw points, those that filters removed, cameras, obstacles made of it."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cvqmpt_lab.base.processes import one_thread
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import PointCloud
from cvqmpt_lab.sensing.scan import Arm, Scan
from cvqmpt_lab.show.bodies import Body, robot_bodies, scene_bodies, whole
from cvqmpt_lab.show.meshes import axes_marks, hull_mesh, shape_mesh
from cvqmpt_lab.show.picture import legend_of, strip, write_png
from cvqmpt_lab.show.raster import Stage, framed


@one_thread()
def draw_scan(
    made: Scan,
    scene: Scene,
    voxel: float,
    path: Path,
    arm: Arm | None = None,
    size: tuple[int, int] = (1200, 800),
) -> None:
    """Write a PNG of a scan with a legend; obstacles are translucent.

    Args:
        made: the scan.
        scene: the obstacles made of it.
        voxel: edge of the voxels in which its points were averaged [m].
        path: of the file.
        arm: the robot to draw, if any.
        size: width and height, legend included [pixels].
    """
    solid = scan_bodies(made, voxel)
    if arm is not None:
        alone = PlanningProblem("scan", arm.robot, scene, start=arm.q, goals=arm.q[None])
        solid += robot_bodies(alone, arm.q[None])
    obstacles = scene_bodies(scene, ())
    named = [Body("obstacles", *("scene",) * 2, body.mesh, body.colour) for body in obstacles[:1]]
    legend = strip(legend_of([*solid, *named]), size[0])
    size = (size[0], size[1] - len(legend))
    viewpoint = framed(whole([*solid, *obstacles]).corners.reshape(-1, 3), size)
    stage = Stage(whole(()), None, viewpoint, size)
    layers = [stage.layer(whole(obstacles), 0.35)] if obstacles else []
    write_png(Path(path), np.concatenate([stage.image(whole(solid), layers), legend]))


def scan_bodies(made: Scan, voxel: float, radius: float = 0.003) -> list[Body]:
    """The raw points that were kept and removed, cameras, and the axes of the base frame.

    Args:
        made: the scan.
        voxel: edge of the voxels in which its points were averaged [m].
        radius: of points [m].
    """
    raw = np.concatenate([capture.in_world for capture in made.captures])
    gone = np.ones(len(raw), dtype=bool)
    if len(made.points):
        # a point lies at most a voxel's diagonal from the mean that stands for it
        gone = cKDTree(made.points).query(raw)[0] > np.sqrt(3.0) * voxel
    found = []
    for name, points, colour in (
        ("raw points, kept", raw[~gone], (0.20, 0.42, 0.80)),
        ("raw points, removed", raw[gone], (0.90, 0.20, 0.15)),
    ):
        if len(points):
            found.append(Body(name, "scan", name, shape_mesh(PointCloud(points, radius)), colour))
    corners = 0.12 * np.array([(x, y, 1.0) for x in (-0.6, 0.6) for y in (-0.45, 0.45)])
    pyramid = hull_mesh(np.vstack([np.zeros(3), corners]))
    found += [
        Body("camera", "scan", "camera", pyramid, (0.55, 0.25, 0.70), capture.T_world_camera[None])
        for capture in made.captures
        # else no pose is known, points are in the base frame
        if not np.array_equal(capture.T_world_camera, np.eye(4))
    ]
    axes = (
        Body(f"{name} of the base frame", "scan", name, mesh, colour)
        for name, colour, mesh in axes_marks(3.0)
    )
    return [*found, *axes]
