"""External planners that attack: none is certified falsely, and no other planner's result changes.

`hostile_planners` has their attacks. All are called from this process.
"""

import time

import numpy as np
import pytest
from properties.hostile_planners import HOSTILE

from cvqmpt_lab.benchmarks.place_task import single_goal_problem
from cvqmpt_lab.external import door
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.search.result import Budget

SECONDS = 1.0  # given to each


def ours():
    """Return the results of a built-in planner that do not depend on the clock."""
    found = solve(single_goal_problem(5), "birrt", Budget(iterations=300), 0)
    assert found.solved
    counts = found.plan.counters, found.plan.vertices, found.certificate
    return *counts, found.path.states.tobytes()


@pytest.mark.promise(
    "no planner of others is certified falsely or changes another's row",
    "hostile planners",
    ci=4,
    long=len(HOSTILE),
)
def test_hostile_planners_change_nothing(trials):
    before, limits = ours(), single_goal_problem(5).robot.upper.copy()
    for name in HOSTILE[:trials]:
        planner = f"properties.hostile_planners:{name}"
        began = time.perf_counter()
        found = solve(single_goal_problem(5), planner, Budget(seconds=SECONDS), 0)
        seconds = time.perf_counter() - began
        assert not found.solved, name
        assert found.certificate is not None or found.plan.detail, name
        assert 0.0 <= found.plan.seconds <= found.wall_seconds <= seconds, name
        assert ours() == before and np.array_equal(single_goal_problem(5).robot.upper, limits)
        door.external_planner.cache_clear()
