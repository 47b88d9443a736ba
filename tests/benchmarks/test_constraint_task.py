"""Problems under every kind of constraint: what the hand keeps, start, goal and payload."""

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.constraint_task import MOVED, NAMES, constraint_problem, trivial
from cvqmpt_lab.problem import check_problem
from cvqmpt_lab.results.row import split_problem

ATTACHED = {"tray": ["tray"], "pouring": ["carried_can"]}
ATTACHED["door"] = ["panel", "handle_bar", "handle_post_lower", "handle_post_upper"]


@pytest.mark.parametrize("kind", NAMES)
def test_problems_of_a_kind_start_and_end_free_on_the_manifold_and_not_straight_ahead(kind):
    index = 8 * 60 + NAMES.index(kind)
    problem, again = constraint_problem(index), constraint_problem(index)
    assert split_problem(problem.name).phase == kind and index >= 160
    np.testing.assert_array_equal(problem.start, again.start)
    np.testing.assert_array_equal(problem.goals, again.goals)
    check_problem(problem)
    assert len(problem.goals) > 0 and not trivial(problem)
    assert [item.name for item in problem.attachments] == ATTACHED.get(kind, [])
    hands = [problem.robot.pose(q)[:3, 3] for q in (problem.start, problem.goals[0])]
    assert np.linalg.norm(hands[1] - hands[0]) > 0.8 * MOVED


def test_a_door_stays_on_its_hinge():
    problem = constraint_problem(8 * 60 + NAMES.index("door"))
    panel = next(item for item in problem.attachments if item.name == "panel")
    hinge = problem.constraint[0].T0_w
    edges = []
    for q in (problem.start, *problem.goals):
        T = np.linalg.inv(hinge) @ problem.robot.pose(q) @ panel.T_hand_object
        edges.append((np.hypot(*T[:2, 3]), T[2, 3]))
    np.testing.assert_allclose(edges, [edges[0]] * len(edges), atol=5e-3)
