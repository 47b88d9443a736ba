"""Sequences of codes on the dictionary's roadmap:
edge costs, Dijkstra's algorithm, and what comes of them.
"""

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cvqmpt_lab.benchmarks.place_task import carried_can, place_problem
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.search.planner_interface import Query
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.sampler import COLLISION_WEIGHT, ENTRIES, EXITS, SEQUENCES, CodeSequences
from cvqmpt_lab.vqmpt.stages import POINTS, code_roadmap, edge_model, observer

WEIGHTS = "vq_mpt"


@pytest.fixture(scope="module")
def problem():
    return with_sampled_goals(place_problem(1003))[0]


@pytest.fixture(scope="module")
def cloud(problem):
    return observer(POINTS)(problem.scene)


@pytest.fixture(scope="module")
def seen(problem):
    return code_roadmap(WEIGHTS, problem.robot)


@pytest.fixture
def query(problem):
    return Query.of(ConstrainedSpace(problem), Budget(iterations=20_000), np.random.default_rng(0))


@pytest.mark.parametrize("carried", [(), (carried_can(),)], ids=["empty hand", "a can"])
def test_all_edges_at_once_look_as_each_on_its_own(cloud, problem, carried):
    seen = code_roadmap(WEIGHTS, problem.robot, carried)
    rows = np.random.default_rng(0).choice(len(seen.links.edges), 300, replace=False)
    motions = seen.roadmap.nodes[seen.links.edges[rows]]
    clearance, odds = edge_model(problem.robot, carried).log_odds(cloud, motions)
    np.testing.assert_allclose(seen.clearances(cloud)[rows], clearance.min(axis=1), atol=1e-12)
    np.testing.assert_allclose(seen.edge_costs(cloud)[rows], np.logaddexp(0.0, -odds), atol=1e-12)


def test_sequences_are_the_cheapest_through_some_code_that_none_before_has(seen, query, cloud):
    """Judged by scipy: the start is node N, any goal node N + 1."""
    found = CodeSequences(seen, cloud, query.start, query.goals).cheapest()
    nodes, edges = seen.roadmap.nodes, seen.links.edges
    count = len(nodes)
    costs = {}
    for end, near in ((count, query.start[None]), (count + 1, query.goals)):
        for q in near:
            gaps = np.linalg.norm(nodes - q, axis=1)
            closest = np.argsort(gaps)[: ENTRIES if end == count else EXITS]
            motions = np.stack([np.broadcast_to(q, nodes[closest].shape), nodes[closest]], axis=1)
            doubt = np.logaddexp(0.0, -seen.model.log_odds(cloud, motions)[1])
            for code, cost in zip(closest, gaps[closest] + COLLISION_WEIGHT * doubt, strict=True):
                costs[code, end] = min(cost, costs.get((code, end), np.inf))
    lengths = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    price = [*(lengths + COLLISION_WEIGHT * seen.edge_costs(cloud)), *costs.values()]
    rows, columns = np.concatenate([edges, np.array(list(costs))]).T
    matrix = csr_array((price, (rows, columns)), shape=(count + 2, count + 2))
    cost = dijkstra(matrix, directed=False, indices=[count, count + 1])
    through = cost.sum(axis=0)[:count]

    def total(codes):
        both = matrix + matrix.T
        return sum(both[a, b] for a, b in zip([count, *codes], [*codes, count + 1], strict=True))

    assert len(found) == SEQUENCES
    assert total(found[0]) == pytest.approx(through.min())
    for k, codes in enumerate(found):
        new = set(codes) - set().union(*found[:k])
        assert len(set(codes)) == len(codes) and new
        assert np.isclose(through[list(new)], total(codes)).any()
    assert np.all(np.diff([total(codes) for codes in found]) >= 0.0)
