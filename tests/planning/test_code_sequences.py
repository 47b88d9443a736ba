"""Code sequences on the shipped dictionary's graph, and the ways walked along them, in the place task's scene."""

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search.code_graph import FEATURES, cost_to_go, ways_on
from cvqmpt_lab.kernels.search.tree_growth import REMOVED
from cvqmpt_lab.methods.loaded import SEQUENCES, eyes_of, seen_dictionary, small_network, wide_observer
from cvqmpt_lab.methods.method import Weights
from cvqmpt_lab.methods.sequences import CHEAPEST
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.code_proposals import Walker
from cvqmpt_lab.planning.code_sequences import ROOM, SequenceSearch, SequenceSettings
from cvqmpt_lab.planning.proposal import Observation
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.planning.space import ConstrainedSpace
from experiments.suites.place_task import carried_can, place_problem

WEIGHTS = Weights("vq_mpt")


@pytest.fixture(scope="module")
def problem():
    return with_sampled_goals(place_problem(1003))[0]


@pytest.fixture(scope="module")
def cloud(problem):
    return wide_observer()(problem)


@pytest.fixture(scope="module")
def seen(problem):
    return seen_dictionary(WEIGHTS, problem.robot)


def asked(seen, problem, cloud, network=None, **settings):
    network = network or small_network(WEIGHTS, SEQUENCES)
    return SequenceSearch(seen, network, cloud, problem.start, problem.goals, SequenceSettings(**settings))


def query_of(problem, seed=0):
    return Query.of(ConstrainedSpace(problem), Budget(iterations=20_000), np.random.default_rng(seed))


@pytest.mark.parametrize("carried", [(), (carried_can(),)], ids=["empty hand", "a can"])
def test_all_edges_at_once_look_as_each_on_its_own(cloud, problem, carried):
    seen = seen_dictionary(WEIGHTS, problem.robot, carried)
    rows = np.random.default_rng(0).choice(len(seen.links.edges), 300, replace=False)
    motions = seen.roadmap.nodes[seen.links.edges[rows]]
    features, odds = eyes_of(WEIGHTS, problem.robot, carried).judge(cloud, motions)
    np.testing.assert_allclose(seen.features(cloud)[rows], features, atol=1e-12)
    np.testing.assert_allclose(seen.prices(cloud)[rows], np.logaddexp(0.0, -odds), atol=1e-12)


def test_arcs_lead_along_every_edge_both_ways(seen):
    links = seen.links
    tail = np.repeat(np.arange(len(seen.roadmap.nodes)), np.diff(links.first))
    assert len(tail) == 2 * len(links.edges)
    np.testing.assert_array_equal(
        links.edges[links.edge], np.sort(np.stack([tail, links.neighbour], 1), axis=1)
    )


def test_cost_to_go_is_dijkstras(seen, problem, cloud):
    search = asked(seen, problem, cloud)
    graph, question = search.graph, search.question
    cost_to_go(graph, question)
    count, caution = len(graph.nodes), question.caution
    edges, price = seen.links.edges, graph.length + caution * graph.price
    exits = np.repeat(np.arange(count), np.diff(question.exit_first))
    way_out = np.linalg.norm(graph.nodes[exits] - problem.goals[question.exit_goal], axis=1)
    way_out += caution * question.exit_price
    best = np.full(count, np.inf)
    np.minimum.at(best, exits, way_out)
    last = np.flatnonzero(np.isfinite(best))
    rows = np.concatenate([edges[:, 0], edges[:, 1], last])
    columns = np.concatenate([edges[:, 1], edges[:, 0], np.full(len(last), count)])
    matrix = csr_array(
        (np.concatenate([price, price, best[last]]), (rows, columns)), shape=(count + 1, count + 1)
    )
    expected = dijkstra(matrix.T.tocsr(), indices=count)[:count]
    np.testing.assert_allclose(question.to_go, expected)


def test_the_cheapest_sequence_costs_what_dijkstra_says(seen, problem, cloud):
    search = asked(seen, problem, cloud, CHEAPEST)
    best = search.likeliest()[0]
    graph, question = search.graph, search.question
    target, feature = np.empty(ROOM, dtype=np.int32), np.empty((ROOM, FEATURES))
    for here in [len(graph.nodes), *best.codes]:  # every step is the one of least cost
        count = ways_on(graph, question, int(here), target, feature)
        chosen = dict(
            zip([len(graph.nodes), *best.codes], [*best.codes, len(graph.nodes) + best.goal], strict=True)
        )
        assert feature[:count, 2][target[:count] == chosen[here]].min() == 0.0


def test_sequences_come_likeliest_first_and_add_up(seen, problem, cloud):
    network = small_network(WEIGHTS, SEQUENCES)
    search = asked(seen, problem, cloud, network)
    found = search.likeliest()
    assert len(found) == SequenceSettings().beams
    scores = [one.log_probability for one in found]
    assert scores == sorted(scores, reverse=True) and scores[0] < 0.0
    target, feature = np.empty(ROOM, dtype=np.int32), np.empty((ROOM, FEATURES))
    for one in found:
        assert len(set(one.codes.tolist())) == len(one.codes)
        total = 0.0
        for here, there in zip(
            [len(search.graph.nodes), *one.codes],
            [*one.codes, len(search.graph.nodes) + one.goal],
            strict=True,
        ):
            count = ways_on(search.graph, search.question, int(here), target, feature)
            said = network(feature[:count])
            total += (said - np.logaddexp.reduce(said))[target[:count] == there].max()
        assert one.log_probability == pytest.approx(total)


def test_a_blocked_way_is_not_predicted_again_and_is_forgotten_with_its_question(seen, problem, cloud):
    before = seen.prices(cloud).copy()
    query, search = query_of(problem), asked(seen, problem, cloud)
    walker = Walker(query, search, drift=1.5)
    tried = set()
    for _ in range(30):
        way = search.likeliest()[0]
        assert (way.codes.tobytes(), way.goal) not in tried
        tried.add((way.codes.tobytes(), way.goal))
        path = walker.walk(way)
        if path is not None:
            break
    assert len(tried) > 1, "choose a harder problem: the first way is free"
    np.testing.assert_array_equal(seen.prices(cloud), before)


def test_what_was_walked_is_in_the_tree_of_the_start(seen, problem, cloud):
    query, search = query_of(problem), asked(seen, problem, cloud)
    walker = Walker(query, search, drift=1.5)
    for _ in range(3):
        walker.walk(search.likeliest()[0])
    size = int(walker.trees.size[0])
    nodes, parent = walker.trees.nodes[0, :size], walker.trees.parent[0, :size]
    assert size > 1 and (parent[1:] < np.arange(1, size)).all() and parent[0] == -1
    kept = nodes[:, 0] != REMOVED  # by a fine check
    nodes, parent = nodes[kept], np.searchsorted(np.flatnonzero(kept), parent[kept])
    assert query.space.valid_batch(nodes).all()
    assert np.abs(problem.manifold.residual(nodes)).max() < 2e-3
    assert np.linalg.norm(nodes[1:] - nodes[parent[1:]], axis=1).max() < 0.45


def test_early_sequences_lie_on_the_manifold(problem):
    stages = planner_named("opt-cvq-route").stages(problem)
    query = query_of(problem)
    walker, predicted = stages.predict.predicted(query, Observation(stages.observe(problem)))
    for one in predicted:
        assert np.abs(problem.manifold.residual(walker.search.graph.nodes[one.codes])).max() < 2e-3


def test_a_network_with_other_inputs_is_refused(seen, problem, cloud):
    with pytest.raises(InvalidInputError, match="reads 6 numbers; this one 3"):
        asked(seen, problem, cloud, SmallNetwork.untrained(3))
