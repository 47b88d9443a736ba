"""Obstacles of any size and frame inside the robot: every checker finds the collision."""

from dataclasses import replace

import numpy as np
import pytest
from properties.test_differential import simplified, tuning_problems
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.certificate.certificate import FaultKind, certify
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, OccupancyMap, PointCloud, Sphere
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

CAN = Attachment("can", Cylinder(0.02, 0.1), pose((0.0, 0.0, 0.17)))
CORNERS = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, 8).T
# fraction of the way by which a point of a hull is moved towards the mean of its corners
DEEP = 0.03


def solid(rng):
    """A shape of 0.3 mm to 30 km, and a point (3,) inside it, often near its surface."""
    size = 10.0 ** rng.uniform(-3.5, 3.5) * 10.0 ** rng.uniform(0.0, 1.0, 3)
    inside = rng.uniform(-0.5, 0.5, 3)
    a, b, c = size
    mesh = np.clip(size, 0.003, 1e4)
    made = ((Box((a, b, c)), inside * size), (Cylinder(a, c), inside * (a, a, c)))
    made += ((Sphere(a), inside * a), (ConvexMesh(CORNERS * mesh), inside * mesh))
    return made[rng.integers(len(made))]


def cloud(rng):
    """At most 3000 points within 10 km, up to 860 km from the origin, and one of these points."""
    shift = np.clip(rng.standard_normal(3) * 10.0 ** rng.uniform(-1.0, 6.0), -5e5, 5e5)
    wide = 10.0 ** rng.uniform(-1.0, 4.0)
    points = rng.uniform(-wide, wide, (rng.choice([1, 10, 1000, 1001, 3000]), 3)) + shift
    return PointCloud(points, 10.0 ** rng.uniform(-9.0, -1.5)), points[0]


def occupancy_map(rng):
    """A map of up to 500 cells, up to 100 km from its origin, and a point inside one of them."""
    cells = rng.integers(-900_000, 900_000, 3) + rng.integers(0, 40, (rng.choice([1, 500]), 3))
    edge = 10.0 ** rng.uniform(-3.0, -1.0)
    return OccupancyMap(cells.astype(float), edge), (cells[0] + rng.uniform(0.01, 0.99, 3)) * edge


def point_inside(robot, q, rng):
    """A point (3,) [m] inside a moving link at q, or inside the can in the hand."""
    if rng.random() < 0.2:
        return (robot.pose(q) @ CAN.T_hand_object)[:3, 3]
    pieces = [piece for piece in robot.links if piece.link > 0]
    piece = pieces[rng.integers(len(pieces))]
    frame = next(name for name in robot.frame_names if robot.link_of(name)[0] == piece.link)
    T = robot.pose(q, frame) @ np.linalg.inv(robot.link_of(frame)[1]) @ piece.T_link_geometry
    some = rng.dirichlet(np.full(len(piece.vertices), 0.2)) @ piece.vertices
    return T[:3, :3] @ (DEEP * piece.vertices.mean(axis=0) + (1.0 - DEEP) * some) + T[:3, 3]


@pytest.mark.promise(
    "a collision is found if an obstacle of any size, with its frame anywhere, overlaps a link or "
    "the carried can",
    "obstacles",
    ci=20,
    long=5000,
)
def test_obstacles_on_a_path(trials):
    for problem, count, seed in tuning_problems(trials, 500):
        states, rng = simplified(problem), np.random.default_rng(seed)
        for trial in range(count):
            k = int(rng.integers(len(states) - 1))
            q = states[k] + rng.random() * (states[k + 1] - states[k])
            shape, point = (solid, cloud, occupancy_map)[trial % 3](rng)
            T = np.eye(4)
            T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
            T[:3, 3] = point_inside(problem.robot, q, rng) - T[:3, :3] @ point
            scene = Scene("hit", (SceneObject("hit", shape, T),))
            hit = replace(problem, scene=scene, attachments=(CAN,))
            faults = certify(hit, JointPath(states[k : k + 2])).faults
            seen = {
                "kernels": not ConstrainedSpace.of(hit).valid(q),
                "coal": hit.collision_checker().in_collision(q),
                "certificate": any(fault.kind is FaultKind.COLLISION for fault in faults),
            }
            assert all(seen.values()), (seen, problem.name, trial, shape, T)
