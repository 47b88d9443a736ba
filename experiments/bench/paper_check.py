"""Cost of a state check in the paper's simulator, PyBullet: all distances between bodies."""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.errors import require_installed
from cvqmpt_lab.experiments.bench.stage_times import CpuClock, Measured
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder

STATES = 100  # random configurations that are checked
Placement = tuple[list[float], list[float]]  # position [m] and quaternion (x, y, z, w)
MOST_DISTANCE = 10.0  # [m] no pair is farther apart, so getClosestPoints measures every pair


class Simulator:
    """A robot among the obstacles of a problem, in PyBullet; a context that ends the simulator.

    A link is the convex hull of its meshes, an obstacle a box or cylinder.

    InvalidInputError: the extra `pybullet` is not installed.
    """

    def __init__(self, problem: PlanningProblem) -> None:
        require_installed("pybullet", "bench paper-check", "pybullet")
        import pybullet as bullet

        self.bullet: Any = bullet
        self._client = bullet.connect(bullet.DIRECT)
        links = _links(problem.robot)
        self.rows = [row for row, _ in links.values()]  # pose row of each link
        self.bodies = [
            bullet.createMultiBody(
                0.0, bullet.createCollisionShape(bullet.GEOM_MESH, vertices=vertices.tolist())
            )
            for _, vertices in links.values()
        ]
        self._kitchen = _obstacles(bullet, problem.scene.obstacles)
        # with the pair of each body and itself
        self.pairs = list(combinations_with_replacement(range(len(links)), 2))
        names, of_piece = list(links), [_link_name(piece.name) for piece in problem.robot.links]
        checked = problem.robot.self_collision_pairs
        self._counted = {
            tuple(sorted(names.index(of_piece[piece]) for piece in pair)) for pair in checked
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.bullet.disconnect(self._client)

    def place(self, placed: Sequence[Placement]) -> None:
        """Move the links to their placements."""
        for body, placement in zip(self.bodies, placed, strict=True):
            self.bullet.resetBasePositionAndOrientation(body, *placement)

    def links_apart(self) -> bool:
        """Measure all distances between links; return whether no checked pair touches."""
        apart = True
        for first, second in self.pairs:
            found = self._distances(self.bodies[first], self.bodies[second])
            apart &= (first, second) not in self._counted or min(found) > 0.0
        return apart

    def clear_of_obstacles(self) -> bool:
        """Measure all distances from links to obstacles; return whether no moving link touches."""
        found = [min(self._distances(body, self._kitchen)) for body in self.bodies]
        return all(x > 0.0 for x, row in zip(found, self.rows, strict=True) if row)

    def _distances(self, first: int, second: int) -> list[float]:
        """Return the distances [m] of the parts of two bodies; the ninth entry of each point."""
        return [point[8] for point in self.bullet.getClosestPoints(first, second, MOST_DISTANCE)]


def paper_check(problem: PlanningProblem) -> list[Measured]:
    """Processor times [ms] of the paper's state check, and of its distances between links alone.

    The state check measures all distances between links, and from links to obstacles. The time
    includes placing the links, but no forward kinematics.

    InvalidInputError: the extra `pybullet` is not installed.
    """
    clock = CpuClock()
    with Simulator(problem) as simulator:
        count, obstacles = len(simulator.bodies), len(problem.scene.obstacles)

        def check(placed: Sequence[Placement]) -> None:
            simulator.place(placed)
            between = f"PyBullet: {len(simulator.pairs)} distances between {count} links"
            clock(between, simulator.links_apart)
            simulator.clear_of_obstacles()

        for q in problem.robot.random_configurations(np.random.default_rng(0), STATES):
            rotation, translation = link_poses(problem.robot.kinematics, q[None])
            placed = [placement_of(rotation[0, row], translation[0, row]) for row in simulator.rows]
            clock(
                f"PyBullet: a state check, these and {count * obstacles} to the kitchen",
                check,
                placed,
            )
    return clock.measured()


def _links(robot: Robot) -> dict[str, tuple[int, np.ndarray]]:
    """Pose row and corners (n, 3) [m, link frame] of each link with collision geometry, by name."""
    found: dict[str, tuple[int, list[np.ndarray]]] = {}
    for piece in robot.links:
        found.setdefault(_link_name(piece.name), (piece.link, []))[1].append(piece.vertices_in_link)
    return {name: (row, np.concatenate(corners)) for name, (row, corners) in found.items()}


def _link_name(piece: str) -> str:
    """Return the link of a piece; pieces are named after their link: LINK_0, LINK_1, ..."""
    return piece.rpartition("_")[0]


def placement_of(rotation: np.ndarray, translation: np.ndarray) -> Placement:
    """Return a placement of a rotation (3, 3) and a translation (3,) [m]."""
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
        poses.append(placement_of(T[:3, :3], T[:3, 3]))
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
