"""Plan for a UR5 around a box, with the hand upright."""

from cvqmpt_lab import (
    Box,
    Budget,
    PlanningProblem,
    Request,
    Scene,
    SceneObject,
    plan,
    pose,
    region,
    robot_from_source,
)

import numpy as np

robot = robot_from_source({"name": "ur5"})
box = SceneObject("box", Box((0.2, 0.2, 0.3)), pose((0.5, 0.0, 0.15)))
problem = PlanningProblem(
    name="around-the-box",
    robot=robot,
    scene=Scene("table", (box,)),
    start_region=region("pose", at={"xyz": [0.4, -0.35, 0.3], "rpy": [np.pi, 0.0, 0.0]}),
    goal_region=region("pose", at={"xyz": [0.4, 0.35, 0.3], "rpy": [np.pi, 0.0, 0.0]}),
    constraint=(region("upright", tilt=0.1, axis="-z"),),
)
planned = plan(problem, Request("roadmap", Budget(seconds=10.0)))
print(planned)
