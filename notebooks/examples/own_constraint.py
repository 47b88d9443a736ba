"""Keep a constraint function of your own: the hand follows the inside of a bowl."""

from cvqmpt_lab import (
    Budget,
    FunctionConstraint,
    PlanningProblem,
    Scene,
    region,
    robot_from_source,
    solve,
)

import numpy as np

robot = robot_from_source({"name": "panda"})


def above_the_bowl(q):
    x, y, z = robot.poses(np.atleast_2d(q))[:, :3, 3].T
    return (z - 0.2 - 2.0 * ((x - 0.5) ** 2 + y**2))[:, None]


problem = PlanningProblem(
    name="bowl",
    robot=robot,
    scene=Scene("empty", ()),
    start_region=region("distance", bounds=[0.0, 0.02], point=[0.5, -0.3, 0.38]),
    goal_region=region("distance", bounds=[0.0, 0.02], point=[0.5, 0.3, 0.38]),
    constraint=(FunctionConstraint(1, above_the_bowl, name="bowl", units="m"),),
)
solution = solve(problem, "birrt", Budget(seconds=10.0), seed=0)
print(solution)
