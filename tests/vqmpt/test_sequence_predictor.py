"""Sequence predictors with small random weights; the scene transformer in numpy and in torch."""

import dataclasses

import numpy as np
import pytest
import torch
from refusals import refused
from small_models import compact_config, random_checkpoint
from torch.nn import functional as F

from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.training.generation import serial_chain
from cvqmpt_lab.training.roadmap_labels import body_points
from cvqmpt_lab.training.sequence_stage import roadmap_successors
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.codebook import dictionary_nodes
from cvqmpt_lab.vqmpt.config import SceneTransformerConfig, SceneTransformerSizes
from cvqmpt_lab.vqmpt.numpy_decoder import SequenceDecoder
from cvqmpt_lab.vqmpt.numpy_encoder import compiled_groups
from cvqmpt_lab.vqmpt.scene_transformer import SceneTransformer
from cvqmpt_lab.vqmpt.sequence_predictor import PublishedPredictor, SceneTransformerPredictor
from cvqmpt_lab.vqmpt.transformer_inputs import Ends, group_points

SMALL = {"width": 32, "layers": 3, "heads": 2, "groups": 24, "group_size": 8, "values": 4}
SMALL = SceneTransformerSizes(**SMALL, edge_width=16, links=6, stride=3)
ROBOTS = {
    "panda": {"name": "panda"},
    "tiago-no-hand": {"name": "tiago-no-hand", "base": {"xyz": [0.0, 0.0, -0.6]}},
}
MAX_CODES = SceneTransformerConfig.max_codes
CLOUD = np.random.default_rng(1).uniform(-0.7, 0.7, (300, 3))


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request):
    """The Panda, and an arm of eight joints whose first joint is prismatic."""
    return robot_from_source(ROBOTS[request.param])


@pytest.fixture(scope="module")
def checkpoint(robot):
    config = dataclasses.replace(compact_config(), joint_dim=robot.dof, feature_dim=0)
    words = random_checkpoint(robot, config, metadata={})
    nodes = dictionary_nodes(stored(words), robot).astype(np.float32)
    order = np.argsort(((nodes[:, None] - nodes) ** 2).sum(-1), axis=1)[:, 1:5]
    pairs = np.stack([np.arange(64).repeat(4), order.ravel()], axis=1)
    edges = np.unique(np.sort(pairs, axis=1), axis=0)
    joints, offsets = body_points(robot)
    chain = dataclasses.replace(serial_chain(robot), points=tuple(joints.tolist()), offsets=offsets)
    limits = {"lower": tuple(robot.lower.tolist()), "upper": tuple(robot.upper.tolist())}
    counts = {"n_nodes": 64, "n_edges": len(edges)}
    sizes = SceneTransformerConfig(**limits, body=chain, **counts, sizes=SMALL)
    torch.manual_seed(0)
    module = SceneTransformer(sizes)
    module.set_roadmap(nodes, edges)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    modules = {**words.modules, "transformer": module.eval()}
    config = dataclasses.replace(config, transformer=sizes)
    return dataclasses.replace(words, config=config, modules=modules)


@pytest.fixture(scope="module")
def model(checkpoint):
    return stored(checkpoint)


@pytest.fixture(scope="module")
def predictor(model, robot):
    return SceneTransformerPredictor(model, robot)


@pytest.fixture(scope="module")
def queries(robot):
    """Return a start and five goals."""
    q = robot.random_configurations(np.random.default_rng(2), 6)
    return q[0], q[1:]


@pytest.fixture(scope="module")
def by_torch(checkpoint):
    """Encode the scene by the torch module."""
    groups = group_points(CLOUD, SMALL.groups, SMALL.group_size)
    with torch.no_grad():
        return checkpoint.modules["transformer"].encode(*map(tensor, groups))


def tensor(array):
    return torch.from_numpy(np.asarray(array, dtype=np.float32))[None]


def test_embeddings_and_costs_are_those_of_torch(checkpoint, predictor, by_torch, queries):
    scene, network = predictor.encode(CLOUD), checkpoint.modules["transformer"]
    np.testing.assert_allclose(scene.keys, by_torch.keys[0], atol=1e-4)
    np.testing.assert_allclose(scene.parts, by_torch.parts[0], atol=1e-4)
    np.testing.assert_allclose(scene.arc_cost, network.arc_costs(by_torch)[0].detach(), atol=1e-4)
    start, goals = queries
    with torch.no_grad():
        first, ends = (network.ends(by_torch, tensor(q)) for q in (start[None], goals))
        V = network.cost_to_go(by_torch, ends)
        risk = F.softplus(-network.link_odds(by_torch, tensor(goals), ends.near))
        length = (tensor(goals)[:, :, None] - network.nodes[ends.near]).norm(dim=-1)
        cost = length + network.config.collision_cost * risk
    np.testing.assert_allclose(ends.cost, cost, atol=1e-4)
    decoder = SequenceDecoder(predictor.network, scene, start, goals)
    np.testing.assert_allclose(decoder.V, V[0], atol=1e-4)
    expected = (first.cost[0] + V[0][:, first.near[0, 0]]).min(dim=1).values
    costs = predictor.goal_costs(scene, start, goals)
    np.testing.assert_allclose(costs, expected, atol=1e-4)
    np.testing.assert_array_equal(predictor.by_cost(scene, start, goals), goals[np.argsort(costs)])


def test_successors_are_as_likely_as_by_torch(checkpoint, predictor, by_torch, queries):
    network, (start, goals) = checkpoint.modules["transformer"], queries
    rng = np.random.default_rng(0)
    decoder = SequenceDecoder(predictor.network, predictor.encode(CLOUD), start, goals)
    successors, log_p = decoder.start()
    steps, codes = [(successors, log_p)], []
    for _ in range(MAX_CODES):
        each = zip(successors, log_p, strict=True)
        possible = [row[np.isfinite(p) & (row < 64)] for row, p in each]
        codes.append(np.array([rng.choice(row) for row in possible]))
        successors, log_p = decoder.advance(np.arange(len(goals)), codes[-1])
        steps.append((successors, log_p))
    codes = torch.from_numpy(np.stack(codes, axis=1))[None]
    with torch.no_grad():
        first, ends = (network.ends(by_torch, tensor(q)) for q in (start[None], goals))
        V = network.cost_to_go(by_torch, ends)
        first = Ends(*(p.expand(-1, len(goals), -1) for p in first))
        logits = network.logits(by_torch, first, ends, V, codes)[0]
        roadmap = network.nodes, network.edges, network.config.sizes.links
        starts = tensor(start).expand(1, len(goals), -1)
        allowed = roadmap_successors(*roadmap, starts, tensor(goals), codes)[0]
    expected = logits.masked_fill(~allowed, -torch.inf).log_softmax(-1).numpy()
    for step, (successors, log_p) in enumerate(steps):
        found = np.full((len(goals), 65), -np.inf)
        for row in range(len(goals)):
            known = np.isfinite(log_p[row])
            found[row, successors[row][known]] = log_p[row][known]
        np.testing.assert_allclose(found, expected[:, step], atol=1e-4)


GOAL = 64  # the class behind the codes


def likeliest_by_hand(decoder, beams):
    """Find codes and score of the best hypothesis for a decoder of one goal.

    The beam keeps the best continuations, finished ones included, until a finished one is the best
    or the maximum length is reached.
    """
    (first,), (log_p,) = decoder.start()
    grown = [(0, (code,), p) for code, p in zip(first.tolist(), log_p.tolist(), strict=True)]
    best = sorted(grown, key=lambda one: -one[2])[:beams]
    for _ in range(MAX_CODES):
        rows, latest = np.array([(row, codes[-1] % GOAL) for row, codes, _ in best]).T
        grown, advanced = [], decoder.advance(rows, latest)
        for row, (following, log_p, (_, codes, score)) in enumerate(
            zip(*advanced, best, strict=True)
        ):
            if codes[-1] == GOAL:
                grown.append((row, codes, score))
                continue
            for code, p in zip(following.tolist(), log_p.tolist(), strict=True):
                grown.append((row, (*codes, code), score + p))
        best = sorted(grown, key=lambda one: -one[2])[:beams]
        if best[0][1][-1] == GOAL:
            break
    return next((one for one in best if one[1][-1] == GOAL), best[0])[1:]


@pytest.mark.parametrize("beams", [1, 3, 6])
def test_sequences_are_those_of_a_beam_search_by_hand(predictor, queries, beams):
    scene, (start, goals) = predictor.encode(CLOUD), queries
    found = [one[0] for one in predictor.hypotheses(scene, start, goals, beams=beams)]
    decoders = [SequenceDecoder(predictor.network, scene, start, goal[None]) for goal in goals]
    codes, scores = zip(*(likeliest_by_hand(decoder, beams) for decoder in decoders), strict=True)
    assert [one.codes + (GOAL,) * one.finished for one in found] == list(codes)
    np.testing.assert_allclose([one.score for one in found], scores, atol=1e-4)
    alone = [predictor.hypotheses(scene, start, goal[None], beams=beams)[0][0] for goal in goals]
    assert [one.codes for one in alone] == [one.codes for one in found]
    every = predictor.hypotheses(scene, start, goals, beams=beams, every=True)
    assert [one[0] for one in every] == found and {len(set(one)) for one in every} == {beams}
    for hypotheses in every:
        scores = [one.score for one in hypotheses]
        assert scores == sorted(scores, reverse=True) and all(one.finished for one in hypotheses)


def test_the_authors_network_predicts_goals_in_one_batch_as_alone(panda):
    predictor = PublishedPredictor(stored(random_checkpoint(panda)), panda)
    rng = np.random.default_rng(3)
    start, *goals = panda.random_configurations(rng, 7)
    scene = predictor.encode(rng.uniform(-0.8, 0.8, (200, 3)))
    found = predictor.hypotheses(scene, start, np.array(goals))
    alone = [predictor.hypotheses(scene, start, goal[None])[0] for goal in goals]
    assert [one[0].codes for one in alone] == [one[0].codes for one in found]
    assert len({code for one in found for code in one[0].codes}) > 1
    refused("0 points; give at least 2", predictor.encode, CLOUD[:0])
    never = PublishedPredictor(stored(random_checkpoint(panda, goal_bias=-1e6)), panda)
    lost = never.hypotheses(never.encode(CLOUD), start, np.array(goals))
    assert len(lost) == 6 and not any(one[0].finished for one in lost)
    alone = random_checkpoint(panda, compact_config())
    refused("train published", PublishedPredictor, stored(alone), panda)


def test_compiled_groups_are_those_of_training():
    rng = np.random.default_rng(0)
    for count in (1, 5, 9, 300, 1024):
        cloud = rng.uniform(-1.0, 1.0, (count, 3)).astype(np.float32)
        (centres, offsets), (ours, near) = group_points(cloud, 24, 8), compiled_groups(cloud, 24, 8)
        np.testing.assert_array_equal(ours, centres)
        reach = [np.sort((part**2).sum(-1), axis=1) for part in (offsets, near)]
        np.testing.assert_allclose(*reach, atol=1e-6)


def test_clouds_of_few_and_many_points_and_a_start_far_from_all_codes(predictor, robot, queries):
    nothing, one = predictor.encode(np.empty((0, 3))), predictor.encode(np.full((1, 3), 0.4))
    many = predictor.encode(np.random.default_rng(0).uniform(-0.7, 0.7, (1_000_000, 3)))
    assert all(np.isfinite(scene.arc_cost).all() for scene in (nothing, one, many))
    assert not np.allclose(one.arc_cost, nothing.arc_cost)
    scene, asked = predictor.encode(CLOUD), (robot.upper, queries[1])
    assert predictor.encode(CLOUD.copy()) is scene
    assert predictor.encode(CLOUD, use_cache=False) is not scene
    found = predictor.hypotheses(scene, *asked)
    assert all(one[0].finished and len(one[0].codes) > 0 for one in found)
    refused("7 beams; give 1 to 6", predictor.hypotheses, scene, *asked, beams=7)


def test_weights_that_do_not_fit_are_refused(model, robot):
    def changed(**arrays):
        part = model.parts["transformer"] | arrays
        return dataclasses.replace(model, parts={**model.parts, "transformer": part})

    def configured(**changes):
        sizes = dataclasses.replace(model.config.transformer, **changes) if changes else None
        config = dataclasses.replace(model.config, transformer=sizes)
        return dataclasses.replace(model, config=config)

    nodes, edges = (model.parts["transformer"][name] for name in ("nodes", "edges"))
    wider = tuple(limit + 0.1 for limit in model.config.transformer.upper)
    nan = np.full((MAX_CODES + 2, 32), np.nan, dtype=np.float32)
    without = dataclasses.replace(model, parts={"dictionary": model.parts["dictionary"]})
    for message, bad in (
        (r"no transformer, only dictionary; train one: cvqmpt train transformer", without),
        ("was trained on the codes of another", changed(nodes=nodes[::-1].copy())),
        (r"nodes is \(63, .\), expected", changed(nodes=nodes[1:])),
        (r"edges is \(.*\) of float32, exp", changed(edges=edges.astype(np.float32))),
        ("edges that do not join two of its 64 nodes", changed(edges=edges + 1)),
        ("is for 60 codes, the dictionary has 64", configured(n_nodes=60)),
        ("was made with other upper limits", configured(upper=wider)),
        (r"weight is \(16, 31\), exp", changed(**{"look.value.weight": np.zeros((16, 31))})),
        ("place has NaN", changed(place=nan)),
        ("describes none", configured()),
    ):
        refused(message, SceneTransformerPredictor, bad, robot)
