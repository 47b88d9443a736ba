"""Small roadmaps of what a shorter path can pass through:
which draws are kept, and what paths are given.
"""

import numpy as np
import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.search.anytime import improve
from cvqmpt_lab.search.informed_roadmap import InformedRoadmaps
from cvqmpt_lab.search.lazy_roadmap import keep_short_ways
from cvqmpt_lab.search.query import Deadline
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.roadmap import Roadmap, RoadmapQuery, RoadmapSearchSettings, scene_costs
from cvqmpt_lab.search.space import ConstrainedSpace

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def first(problem):
    """A path of `birrt`, shortened."""
    return solve(problem, "birrt", ENOUGH, 0, clearance=False).simplified.path


def test_draws_kept_are_free_on_the_manifold_and_on_short_ways(problem, first):
    space, length = ConstrainedSpace(problem), 1.2 * first.length
    draws = first.spaced(0.02) + np.random.default_rng(0).normal(
        scale=0.3, size=first.spaced(0.02).shape
    )
    draws = np.clip(draws, problem.robot.lower, problem.robot.upper)
    expected = []
    for q in draws.copy():
        on = space.project(q)
        to_goal = np.linalg.norm(problem.goals - q, axis=1).min()
        if on and np.linalg.norm(q - problem.start) + to_goal < length and space.valid(q):
            expected.append(q)
    kept = keep_short_ways(space.arrays, draws, problem.start, problem.goals, length)
    assert 0 < kept < len(draws)
    np.testing.assert_array_equal(draws[:kept], expected)
    with pytest.raises(InvalidInputError, match="start"):
        keep_short_ways(space.arrays, draws, problem.start[:3], problem.goals, length)


def test_paths_that_cost_more_than_asked_are_not_looked_for(problem):
    nodes = problem.robot.random_configurations(np.random.default_rng(5), 1500)
    settings = RoadmapSearchSettings(greed=1.0, searches=2000)

    def length_within(longest):
        space = ConstrainedSpace(problem)
        ends, costs = (problem.start, problem.goals), scene_costs(space)
        query = RoadmapQuery(space, Roadmap.of(nodes), *ends, settings, costs, longest)
        found = query.next_path(Deadline(ENOUGH, space))
        return None if found is None else found.length

    straight = np.linalg.norm(problem.goals - problem.start, axis=1).min()
    assert length_within(0.99 * straight) is None
    assert length_within(100.0) == length_within(np.inf) is not None


def test_informed_roadmaps_find_shorter_paths_that_repeat_and_a_straight_path_ends_the_search(
    problem, first
):
    def better():
        return improve(
            ConstrainedSpace(problem),
            InformedRoadmaps(),
            first,
            Budget(iterations=400),
            np.random.default_rng(0),
        )

    (path, made), (again, _) = better(), better()
    np.testing.assert_array_equal(path.states, again.states)
    assert path.length < first.length and made.searches > 3 and made.iterations >= 400
    space = ConstrainedSpace(problem)
    assert space.checked_path(path.states)[0] is not None
    assert max(np.abs(space.residual_and_jacobian(q)[0]).max() for q in path.states) < 1e-3
    nearest = problem.goals[np.linalg.norm(problem.goals - problem.start, axis=1).argmin()]
    straight = JointPath(np.stack([problem.start, nearest]))
    _, made = improve(
        ConstrainedSpace(problem),
        InformedRoadmaps(),
        straight,
        Budget(iterations=400),
        np.random.default_rng(0),
    )
    assert made.searches == 0
