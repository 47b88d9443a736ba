"""Problems at the edge of what makes sense:
closed in, without a free goal, with goals by the thousand.
"""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.goals import sample_goals
from cvqmpt_lab.search.result import Budget, PlanStatus

HALF = 0.85  # [m] from the base to the walls


@pytest.fixture(scope="module")
def closed_in(problem):
    """The place task's start and goals in a closed box instead of the kitchen."""
    centre, plates = np.array([0.0, 0.0, HALF - 0.1]), []
    for axis in range(3):
        for side in (-1.0, 1.0):
            size, offset = np.full(3, 2.0 * HALF), np.zeros(3)
            size[axis], offset[axis] = 0.02, side * HALF
            plates.append(
                SceneObject(f"plate {axis} {side:g}", Box(tuple(size)), pose(centre + offset))
            )
    return replace(problem, scene=Scene("closed box", tuple(plates)))


def test_a_robot_in_a_closed_box_plans_inside_it(closed_in):
    assert solve(closed_in, "birrt", Budget(iterations=20_000), seed=0).solved


def test_goals_behind_the_wall_are_counted_and_no_search_begins(closed_in):
    outside = replace(closed_in.goal_region, T0_w=pose((HALF + 0.05, 0.0, 0.5)))
    problem = replace(closed_in, goals=np.empty((0, 7)), goal_region=outside)
    plan = solve(problem, "birrt", Budget(seconds=60.0), seed=0).plan
    sample = sample_goals(problem, np.random.default_rng(0), 20)
    assert plan.status is PlanStatus.NO_GOAL and plan.counters.iterations == 0
    assert plan.detail.startswith("no goal: of 100 poses, ")
    assert sample.colliding > 0 and sample.unreachable + sample.colliding == 100


@pytest.mark.parametrize("method", ["birrt", "roadmap-cvq"])
def test_ten_thousand_goals_are_planned_for(problem, method):
    many = replace(problem, goals=np.tile(problem.goals, (10_000 // len(problem.goals), 1)))
    solution = solve(many, method, Budget(seconds=10.0), seed=0, clearance=False)
    assert solution.solved and len(solution.problem.goals) == 10_000
