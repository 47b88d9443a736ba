"""Build an occupancy map from a point cloud, and plan around it."""

from cvqmpt_lab import (
    Budget,
    OccupancyMap,
    PlanningProblem,
    Request,
    Scene,
    SceneObject,
    plan,
    pose,
    robot_from_source,
)

import numpy as np

rng = np.random.default_rng(0)
points = rng.uniform((0.45, -0.1, 0.0), (0.65, 0.1, 0.5), (4000, 3))  # a pillar [m]
cells = np.unique(np.floor(points / 0.02).astype(int), axis=0)
pillar = SceneObject("scan", OccupancyMap(cells, resolution=0.02, padding=0.01), pose((0, 0, 0)))
problem = PlanningProblem(
    name="past-the-pillar",
    robot=robot_from_source({"name": "panda"}),
    scene=Scene("scan", (pillar,)),
    start=np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8]),
    goals=np.array([[0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8]]),
)
planned = plan(problem, Request("roadmap", Budget(seconds=10.0)))
print(planned)
