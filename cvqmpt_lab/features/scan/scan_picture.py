"""Picture of a scan: kept and removed raw points, cameras, and the obstacles made of the scan."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cvqmpt_lab.base.processes import one_thread
from cvqmpt_lab.features.pictures.bodies import Body, mesh_of, robot_bodies, scene_bodies
from cvqmpt_lab.features.pictures.meshes import axes_marks, hull_mesh, shape_mesh
from cvqmpt_lab.features.pictures.picture import legend_of, strip, write_picture
from cvqmpt_lab.features.pictures.raster import Renderer, framed
from cvqmpt_lab.features.scan.scan import Arm, Scan
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import PointCloud


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
        scene: the obstacles made of the scan.
        voxel: edge of the voxels in which its points were averaged [m].
        path: the file to write.
        arm: the robot to draw; None: none is drawn.
        size: width and height, legend included [pixels].
    """
    solid = scan_bodies(made, voxel)
    if arm is not None:
        alone = PlanningProblem("scan", arm.robot, scene, start=arm.q, goals=arm.q[None])
        solid += robot_bodies(alone, arm.q[None])
    obstacles = scene_bodies(scene, ())
    named = [Body("obstacles", "scene", "scene", body.mesh, body.colour) for body in obstacles[:1]]
    legend = strip(legend_of([*solid, *named]), size[0])
    size = (size[0], size[1] - len(legend))
    viewpoint = framed(mesh_of([*solid, *obstacles]).corners.reshape(-1, 3), size)
    renderer = Renderer(mesh_of(()), None, viewpoint, size)
    layers = [renderer.layer(mesh_of(obstacles), 0.35)] if obstacles else []
    write_picture(Path(path), np.concatenate([renderer.image(mesh_of(solid), layers), legend]))


def scan_bodies(made: Scan, voxel: float, radius: float = 0.003) -> list[Body]:
    """Bodies of the kept and removed raw points, the cameras, and the axes of the base frame.

    Args:
        made: the scan.
        voxel: edge of the voxels in which its points were averaged [m].
        radius: radius of the drawn points [m].
    """
    raw = np.concatenate([capture.in_world for capture in made.captures])
    removed = np.ones(len(raw), dtype=bool)
    if len(made.points):
        # the distance of a kept point from the mean of its voxel is at most the voxel's diagonal
        removed = cKDTree(made.points).query(raw)[0] > np.sqrt(3.0) * voxel
    found = []
    for name, points, colour in (
        ("raw points, kept", raw[~removed], (0.20, 0.42, 0.80)),
        ("raw points, removed", raw[removed], (0.90, 0.20, 0.15)),
    ):
        if len(points):
            found.append(Body(name, "scan", name, shape_mesh(PointCloud(points, radius)), colour))
    corners = 0.12 * np.array([(x, y, 1.0) for x in (-0.6, 0.6) for y in (-0.45, 0.45)])
    pyramid = hull_mesh(np.vstack([np.zeros(3), corners]))
    found += [
        Body("camera", "scan", "camera", pyramid, (0.55, 0.25, 0.70), capture.T_world_camera[None])
        for capture in made.captures
        # the identity stands for an unknown pose: the points are in the base frame
        if not np.array_equal(capture.T_world_camera, np.eye(4))
    ]
    axes = (
        Body(f"{name} of the base frame", "scan", name, mesh, colour)
        for name, colour, mesh in axes_marks(3.0)
    )
    return [*found, *axes]
