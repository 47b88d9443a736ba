"""Times of search and certificate by the size of a problem: boxes, points of a cloud, joints.

A scene has ten boxes. Larger scenes are the same boxes in pieces, and clouds are points on their
faces, so that the free space stays nearly the same. There is no constraint.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.family_task import blocked_pair
from cvqmpt_lab.experiments.bench.stage_times import CpuClock, Measured, plan_stages
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, PointCloud

Cuboid = tuple[np.ndarray, np.ndarray]  # centre and size (3,) [m]


def size_times(problems: int) -> list[Measured]:
    """Measure planning with `birrt` in growing scenes and clouds, and for arms of more joints.

    One start and goal are planned between in all scenes of a problem. Times of each size: making
    the space, search, shortening and certificate.
    """
    clock = CpuClock()
    for number in range(problems):
        rng = np.random.default_rng(number)
        boxes, posed = _posed({"name": "panda"}, rng)
        for cuts in ((1, 1, 1), (5, 2, 1), (5, 5, 4), (10, 10, 10)):
            objects = _objects([piece for box in boxes for piece in _pieces(box, cuts)])
            plan_stages(clock, _in(posed, objects), f"{len(objects)} boxes: ")
        for power in (3, 4, 5, 6):
            cloud = PointCloud(_points(boxes, 10**power, rng), 0.005)
            objects = [SceneObject("cloud", cloud, np.eye(4))]
            plan_stages(clock, _in(posed, objects), f"10^{power} points: ")
        for source in _arms():
            _, posed = _posed(source, rng)
            plan_stages(clock, posed, f"{posed.robot.dof} joints: ")
    return clock.measured()


def _arms() -> list[Mapping[str, Any]]:
    """Return sources of robots with 2, 4, 7 and 14 planned joints."""
    two = {"wrist_2_joint": -1.5, "wrist_3_joint": 0.0}
    four = {"elbow_joint": 1.5, "wrist_1_joint": -1.5, **two}
    arms = [{"name": "ur5", "locked": locked} for locked in (four, two)]
    return [*arms, {"name": "panda"}, {"name": "baxter"}]


def _posed(
    source: Mapping[str, Any], rng: np.random.Generator
) -> tuple[list[Cuboid], PlanningProblem]:
    """Return ten random boxes, and a problem among them whose straight motion is blocked."""
    robot, pair = robot_from_source(source), None
    middle = 0.5 * (robot.lower + robot.upper)
    while pair is None:
        boxes: list[Cuboid] = []
        while len(boxes) < 10:
            angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(0.35, 0.8) * robot.reach
            at = (far * np.cos(angle), far * np.sin(angle), rng.uniform(-0.2, 0.8) * robot.reach)
            boxes.append((np.array(at), rng.uniform(0.1, 0.25, 3) * robot.reach))
        scene = Scene("boxes", tuple(_objects(boxes)))
        problem = PlanningProblem("sizes", robot, scene, middle, middle[None])
        pair = blocked_pair(problem, rng, clear=0.01)
    return boxes, replace(problem, start=pair[0], goals=pair[1][None])


def _in(problem: PlanningProblem, objects: Sequence[SceneObject]) -> PlanningProblem:
    """Return the problem in another scene."""
    return problem.changed(scene=Scene(f"{len(objects)} objects", tuple(objects)))


def _objects(boxes: Sequence[Cuboid]) -> list[SceneObject]:
    return [
        SceneObject(f"box_{k}", Box(tuple(size.tolist())), pose(centre))
        for k, (centre, size) in enumerate(boxes)
    ]


def _pieces(box: Cuboid, cuts: tuple[int, int, int]) -> list[Cuboid]:
    """Cut a box into equal pieces along its axes."""
    centre, size = box
    piece = size / cuts
    corner = centre - 0.5 * size + 0.5 * piece
    return [(corner + piece * place, piece) for place in np.ndindex(cuts)]


def _points(boxes: Sequence[Cuboid], count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw points (count, 3) on the faces of the boxes [m]."""
    centres, sizes = map(np.array, zip(*boxes, strict=True))
    chosen = rng.integers(len(boxes), size=count)
    inside = rng.uniform(-0.5, 0.5, (count, 3))
    inside[np.arange(count), rng.integers(3, size=count)] = rng.choice((-0.5, 0.5), count)
    return centres[chosen] + inside * sizes[chosen]
