"""Obstacles put where the robot passes: whatever their size, and wherever their frame lies, all who check see them."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.certificate import FaultKind, certify
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.result import Budget, JointPath
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, OccupancyMap, PointCloud, Shape, Sphere

ENOUGH = Budget(iterations=20_000)
CAN = Attachment("can", Cylinder(0.02, 0.1), pose((0.0, 0.0, 0.17)))
CORNERS = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, 8).T
DEEP = 0.03
"""Share by which a point lies further inside a link than a mean of some of its corners does."""


def _solid(rng: np.random.Generator) -> tuple[Shape, np.ndarray]:
    """A shape of 0.3 mm to 30 km, and a point (3,) inside it, often near its surface."""
    size = 10.0 ** rng.uniform(-3.5, 3.5) * 10.0 ** rng.uniform(0.0, 1.0, 3)
    x, y, z = inside = rng.uniform(-0.5, 0.5, 3)
    a, b, c = size
    made: tuple[tuple[Shape, np.ndarray], ...] = (
        (Box((a, b, c)), inside * size),
        (Cylinder(a, c), np.array([x * a, y * a, z * c])),
        (Sphere(a), inside * a),
        (ConvexMesh(CORNERS * np.clip(size, 0.003, 1e4)), inside * np.clip(size, 0.003, 1e4)),
    )
    return made[rng.integers(len(made))]


def _cloud(rng: np.random.Generator) -> tuple[Shape, np.ndarray]:
    """A cloud of up to 3000 points within 10 km of each other, up to 1000 km from its origin, and one of the points."""
    shift = rng.standard_normal(3) * 10.0 ** rng.uniform(-1.0, 6.0)
    wide = 10.0 ** rng.uniform(-1.0, 4.0)
    points = rng.uniform(-wide, wide, (rng.choice([1, 10, 1000, 1001, 3000]), 3)) + shift
    return PointCloud(points, 10.0 ** rng.uniform(-9.0, -1.5)), points[0]


def _map(rng: np.random.Generator) -> tuple[Shape, np.ndarray]:
    """An occupancy map of up to 500 cells, up to 100 km from its origin, and a point inside one of them."""
    cells = rng.integers(-900_000, 900_000, 3) + rng.integers(0, 40, (rng.choice([1, 500]), 3))
    edge = 10.0 ** rng.uniform(-3.0, -1.0)
    return OccupancyMap(cells.astype(float), edge), (cells[0] + rng.uniform(0.01, 0.99, 3)) * edge


def _inside(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A point (3,) [m] inside a moving link at q, or inside the can in the hand."""
    if rng.random() < 0.2:
        return (robot.pose(q) @ CAN.T_hand_object)[:3, 3]
    pieces = [piece for piece in robot.links if piece.link > 0]
    piece = pieces[rng.integers(len(pieces))]
    frame = next(name for name in robot.frame_names if robot.link_of(name)[0] == piece.link)
    T = robot.pose(q, frame) @ np.linalg.inv(robot.link_of(frame)[1]) @ piece.T_link_geometry
    some = rng.dirichlet(np.full(len(piece.vertices), 0.2)) @ piece.vertices
    return T[:3, :3] @ (DEEP * piece.vertices.mean(axis=0) + (1.0 - DEEP) * some) + T[:3, 3]


def unseen(problem: PlanningProblem, trials: int, seed: int) -> list[str]:
    """Obstacles in which a link stands somewhere on a solved path, and who does not see them."""
    solution, rng = solve(problem, "birrt", ENOUGH, seed=0, clearance=False), np.random.default_rng(seed)
    if solution.simplified is None:
        return ["not solved"]
    states, faults = solution.simplified.path.states, []
    alone = replace(problem, scene=Scene("alone", ()), attachments=(CAN,))
    for trial in range(trials):
        k = int(rng.integers(len(states) - 1))
        q = states[k] + rng.random() * (states[k + 1] - states[k])
        shape, point = (_solid, _cloud, _map)[trial % 3](rng)
        T = np.eye(4)
        T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        T[:3, 3] = _inside(problem.robot, q, rng) - T[:3, :3] @ point
        hit = replace(alone, scene=Scene("hit", (SceneObject("hit", shape, T),)))
        found = certify(hit, JointPath(states[k : k + 2]), clearance=False).faults
        sees = {
            "kernels": not ConstrainedSpace(hit).valid(q),
            "coal": hit.collision_checker().in_collision(q),
            "the certificate": any(fault.kind is FaultKind.COLLISION for fault in found),
        }
        faults += [
            f"trial {trial}: no {type(shape).__name__} at {T[:3, 3]} for {who}"
            for who, saw in sees.items()
            if not saw
        ]
    return faults
