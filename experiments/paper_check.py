"""Cost of a state check in the paper's simulator, PyBullet: all distances between bodies."""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.errors import require_installed
from cvqmpt_lab.experiments.stage_times import CpuClock, Measured
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder

STATES = 100  # random configurations that are checked
Placement = tuple[list[float], list[float]]  # position [m] and quaternion (x, y, z, w)
MOST_DISTANCE = 10.0  # [m] no pair is farther apart, so getClosestPoints measures every pair


def paper_check(problem: PlanningProblem) -> list[Measured]:
    """Processor times [ms] of the paper's state check, and of its distances between links alone.

    The state check measures all distances between links, and from links to obstacles. A link is
    the convex hull of its meshes, an obstacle a box or cylinder. The time includes placing the
    links, but no forward kinematics.

    InvalidInputError: the extra `pybullet` is not installed.
    """
    require_installed("pybullet", "bench paper-check", "pybullet")
    import pybullet as bullet

    client, clock = bullet.connect(bullet.DIRECT), CpuClock()
    try:
        links = _links(problem.robot)
        hulls = [
            bullet.createCollisionShape(bullet.GEOM_MESH, vertices=vertices.tolist())
            for _, vertices in links.values()
        ]
        bodies = [bullet.createMultiBody(0.0, hull) for hull in hulls]
        kitchen, count = _obstacles(bullet, problem.scene.obstacles), len(problem.scene.obstacles)
        # with the pair of each body and itself
        pairs = list(combinations_with_replacement(bodies, 2))

        def measure_links() -> None:
            for first, second in pairs:
                bullet.getClosestPoints(first, second, MOST_DISTANCE)

        def check(placed: Sequence[Placement]) -> None:
            for body, placement in zip(bodies, placed, strict=True):
                bullet.resetBasePositionAndOrientation(body, *placement)
            clock(f"PyBullet: {len(pairs)} distances between {len(bodies)} links", measure_links)
            for body in bodies:
                bullet.getClosestPoints(body, kitchen, MOST_DISTANCE)

        for q in problem.robot.random_configurations(np.random.default_rng(0), STATES):
            rotation, translation = link_poses(problem.robot.kinematics, q[None])
            placed = [
                _placement(rotation[0, row], translation[0, row]) for row, _ in links.values()
            ]
            clock(
                f"PyBullet: a state check, these and {len(bodies) * count} to the kitchen",
                check,
                placed,
            )
        return clock.measured()
    finally:
        bullet.disconnect(client)


def _links(robot: Robot) -> dict[str, tuple[int, np.ndarray]]:
    """Pose row and corners (n, 3) [m, link frame] of each link with collision geometry, by name."""
    found: dict[str, tuple[int, list[np.ndarray]]] = {}
    # pieces are named after their link: LINK_0, LINK_1, ...
    for piece in robot.links:
        found.setdefault(piece.name.rpartition("_")[0], (piece.link, []))[1].append(
            piece.vertices_in_link
        )
    return {name: (row, np.concatenate(corners)) for name, (row, corners) in found.items()}


def _placement(rotation: np.ndarray, translation: np.ndarray) -> Placement:
    return translation.tolist(), Rotation.from_matrix(rotation).as_quat().tolist()


def _obstacles(bullet: Any, obstacles: tuple[SceneObject, ...]) -> int:
    """PyBullet's number of one body that holds all obstacles as fixed links, as from a URDF."""
    shapes, poses = [], []
    for item in obstacles:
        if isinstance(item.shape, Box):
            half = item.shape.half.tolist()
            shapes.append(bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half))
        else:
            assert isinstance(item.shape, Cylinder)
            size = {"radius": item.shape.radius, "height": item.shape.height}
            shapes.append(bullet.createCollisionShape(bullet.GEOM_CYLINDER, **size))
        T = item.T_world_object
        poses.append(_placement(T[:3, :3], T[:3, 3]))
    count, origin = len(shapes), [0.0, 0.0, 0.0]
    return bullet.createMultiBody(
        0.0,
        linkMasses=[0.0] * count,
        linkCollisionShapeIndices=shapes,
        linkVisualShapeIndices=[-1] * count,
        linkPositions=[position for position, _ in poses],
        linkOrientations=[quaternion for _, quaternion in poses],
        linkInertialFramePositions=[origin] * count,
        linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * count,
        linkParentIndices=[0] * count,
        linkJointTypes=[bullet.JOINT_FIXED] * count,
        linkJointAxis=[[0.0, 0.0, 1.0]] * count,
    )
