"""Trees of cells: narrow passages, slices of work, grids that grow, no free rows."""

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.passages import cage_problem, maze_problem, slot_problem
from cvqmpt_lab.benchmarks.results.store import states_hash
from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
from cvqmpt_lab.robot.hulls import coal_distance
from cvqmpt_lab.scene.coal_shapes import coal_shape, transform
from cvqmpt_lab.search.cell_grids import empty_grids, free_rows
from cvqmpt_lab.search.cell_trees import CellTrees
from cvqmpt_lab.search.planner_interface import Query
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace

MOST = Budget(iterations=30_000)


@pytest.fixture(scope="module")
def maze():
    return with_drawn_goals(maze_problem(0.06, 3))


def test_a_maze_is_solved_and_repeats_bit_for_bit(maze):
    first, again = (solve(maze, "cells", MOST, seed=1) for _ in range(2))
    assert first.plan.status is PlanStatus.SOLVED and first.certificate.valid
    assert first.plan.counters == again.plan.counters
    assert states_hash(first.plan.path.states) == states_hash(again.plan.path.states)
    assert 0 < first.plan.counters.projections < 500_000


def grown(problem, slices, seed=2):
    """Return path and work of trees that grow in slices of a given work."""
    space = ConstrainedSpace.of(problem)
    rng = problem.random_stream(seed)
    query = Query.of(space, problem.start, problem.goals, Budget(iterations=10**9), rng)
    growth = CellTrees(query)
    for _ in range(1_000_000):
        before = space.work
        path = growth.grow(query.deadline, slices)
        if path is not None:
            return path, growth, space
        assert space.work >= before + slices
    raise AssertionError("no path")


def test_slices_of_work_change_nothing(maze):
    whole, growth, one = grown(maze, np.inf)
    parts, _, other = grown(maze, 1500)
    np.testing.assert_array_equal(whole.states, parts.states)
    assert one.counters == other.counters
    assert growth.trees.size.sum() > 1000


def test_motions_of_the_trees_are_free_and_on_the_manifold(maze):
    """Every motion of both trees passes the fine check of paths."""
    _, growth, space = grown(maze, np.inf)
    for nodes, parents, size in zip(*(growth.trees[k] for k in (0, 1, 3)), strict=True):
        for node in range(0, size, 101):
            if parents[node] >= 0:
                pair = nodes[[parents[node], node]]
                assert space.checked_path(pair)[0] is not None


def test_free_rows(maze):
    space = ConstrainedSpace.of(maze)
    assert free_rows(space).tolist() == [[0, 0], [0, 1], [0, 5]]
    assert len(empty_grids(space, np.random.default_rng(0)).projection) == 5
    bare = ConstrainedSpace.of(maze.changed(constraint=()))
    assert free_rows(bare).shape == (0, 2)


def test_without_a_constraint_cells_divide_the_joints(maze):
    plan = solve(maze.changed(constraint=()), "cells", MOST, seed=0).plan
    assert plan.status is PlanStatus.SOLVED


def between(scene, one, other):
    """Return the distance [m] between two objects of a scene."""
    found = (item for item in scene.objects if item.name in (one, other))
    placed = [(coal_shape(item.shape), transform(item.T_world_object)) for item in found]
    return coal_distance(*placed[0], *placed[1])


def test_the_width_of_a_passage_is_the_gap():
    for make, width, *sides in (
        (maze_problem, 0.05, "wall_0", "wall_1"),
        (maze_problem, 0.05, "wall_1", "wall_2"),
        (cage_problem, 0.21, "bar_0", "bar_31"),
        (slot_problem, 0.19, "board_-1", "board_1"),
    ):
        one, again, other = make(width, 4), make(width, 4), make(width, 5)
        assert between(one.scene, *sides) == pytest.approx(width, abs=0.005)
        np.testing.assert_array_equal(one.start, again.start)
        assert not np.array_equal(one.start, other.start)
        assert len(with_drawn_goals(one).goals) > 0
