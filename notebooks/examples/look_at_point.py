"""Look at a point on the way from one side of it to the other."""

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

block = SceneObject("block", Box((0.1, 0.1, 0.1)), pose((0.5, 0.0, 0.05)))
problem = PlanningProblem(
    name="look-at-the-block",
    robot=robot_from_source({"name": "panda"}),
    scene=Scene("table", (block,)),
    start_region=region("pose", at={"xyz": [0.5, -0.3, 0.4], "rpy": [-2.44, 0.0, 0.0]}, yaw=3.15),
    goal_region=region("pose", at={"xyz": [0.5, 0.3, 0.4], "rpy": [2.44, 0.0, 0.0]}, yaw=3.15),
    constraint=(region("look-at", point=[0.5, 0.0, 0.05], angle=0.2, distance=[0.3, 0.6]),),
)
planned = plan(problem, Request("birrt", Budget(seconds=10.0)))
print(planned)
