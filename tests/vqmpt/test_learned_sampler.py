"""Learned samplers and ablations with the shipped weights; rollouts of MPNet networks."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
import torch

from cvqmpt_lab.benchmarks.place_task import TUNING_ENVIRONMENTS, place_problem
from cvqmpt_lab.benchmarks.results.store import states_hash
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.planning.by_name import declared
from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Observation, Query, Uniform
from cvqmpt_lab.search.result import Budget, JointPath, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.mpnet_stage import MPNet
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint, stored
from cvqmpt_lab.vqmpt.code_predictors import CodeProposal
from cvqmpt_lab.vqmpt.codebook import codes_of
from cvqmpt_lab.vqmpt.config import BY_ROLLOUTS, ROLLOUTS_ALONE, MPNetConfig
from cvqmpt_lab.vqmpt.learned_sampler import (
    LearnedSampler,
    codebook_of,
    dictionary_roadmap,
    model_of,
)
from cvqmpt_lab.vqmpt.mpnet_rollouts import MPNetNetwork, MPNetRollouts, line_free
from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice
from cvqmpt_lab.vqmpt.weights import robot_signature

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def problem():
    return with_drawn_goals(place_problem(1003))


@pytest.fixture
def query(problem):
    space, rng = ConstrainedSpace.of(problem), np.random.default_rng(0)
    return Query.of(space, problem.start, problem.goals, ENOUGH, rng)


@pytest.fixture
def proposed(problem, query):
    """Return a function from a planner's name to its proposal, after the update if it has one."""

    def propose(name):
        stages = planner_named(name).stages(problem)
        cloud = stages.observe(problem.scene) if stages.observe else None
        proposal = stages.predict(query, Observation(cloud))
        return proposal if stages.update is None else stages.update(query, proposal)

    return propose


def test_names_are_read_as_choices():
    along = {"gaussians": "along", "draws": "free-draws", "reach": 1.0, "goals": "goals-apart"}
    wide = {"predictor": "random", "gaussians": "wide", "uniform_share": 0.15}
    other = {"update": "projected", "cloud": "other-cloud", "uniform_share": 0.5}
    for words, product in {
        "random": {"predictor": "random"},
        "transformer+along+free-draws+reach=1+goals-apart": along | {"uniform_share": 0.15},
        "transformer+algorithm-2": {"update": "algorithm-2"},
        "nearest-lines+along+std=0.5": {
            "predictor": "nearest-lines",
            "gaussians": "along",
            "std": 0.5,
            "uniform_share": 0.15,
        },
        "random+wide": wide,
        "random+uniform=0.5+projected+wide+other-cloud": wide | other,
    }.items():
        choice = SamplerChoice(**{"predictor": "transformer"} | product)
        assert SamplerChoice.of(words) == planner_named(f"cvq:{words}").sampler == choice


def test_the_cloud_of_another_scene_has_as_many_points(problem):
    """It had four times as many, so that a comparison of clouds compared their sizes, too."""
    own, other = (
        planner_named(f"cvq:transformer+{cloud}").stages(problem).observe(problem.scene)
        for cloud in ("own-cloud", "other-cloud")
    )
    assert own.shape == other.shape and not np.array_equal(own, other)


@pytest.mark.parametrize("predictor", ["transformer", "random", "oracle"])
def test_the_distribution_is_the_mixture_of_codes_and_goals(problem, proposed, predictor):
    """Weights are equal; Gaussians are those of the decoder, and 0.1 joint ranges around goals."""
    proposal = proposed(f"cvq:{predictor}")
    mixture, c = proposal.distribution, len(proposal.codes)
    codebook = codebook_of("vq_mpt", problem.robot)
    means, covariances = codebook.gaussians(codebook.vectors[proposal.codes])
    assert c > 0 and mixture.uniform_share == 0.0
    np.testing.assert_array_equal(mixture.means[:c], means)
    np.testing.assert_allclose(mixture.covariances[:c], covariances, atol=1e-8)
    np.testing.assert_array_equal(mixture.means[c:], proposal.goals)
    span = problem.robot.upper - problem.robot.lower
    around = np.diag((LearnedSampler.goal_std * span) ** 2)
    np.testing.assert_allclose(mixture.covariances[c:], [around] * len(proposal.goals))
    assert all((np.abs(problem.goals - goal).max(axis=1) < 1e-9).any() for goal in proposal.goals)


def test_every_waypoint_is_read_along_the_nodes_of_sequences(problem, proposed):
    """Codes of states 0.13 rad apart from start to goal through the nodes, without repetitions."""
    proposal = proposed("cvq:transformer+every-waypoint")
    nodes = dictionary_roadmap("vq_mpt", problem.robot).nodes
    listed = []
    for line, goal in zip(proposal.polylines, proposal.goals, strict=True):
        np.testing.assert_array_equal(line[[0, -1]], [problem.start, goal])
        assert all((node == nodes).all(axis=1).any() for node in line[1:-1])
        codes = codes_of(model_of("vq_mpt"), problem.robot, JointPath(line).spaced(0.13))
        listed += [code for code, _ in groupby(codes.tolist())]
    assert proposal.codes.tolist() == listed and len(listed) > len(proposed("cvq-wide").codes) / 3
    assert len(proposal.distribution.means) == len(listed) + len(proposal.goals)


def test_the_report_counts_codes_without_wrong_plurals(proposed):
    """It said "5 codes of 1 sequences to 1 goals"."""
    wide = proposed("cvq-wide")
    counted = f"codes: {len(wide.codes)}, sequences: {len(wide.polylines)}, goals: "
    assert wide.detail.startswith(f"{counted}{len(wide.goals)}")
    every = proposed("cvq:transformer+every-waypoint")
    assert every.detail.endswith(f", codes of every waypoint: {len(every.codes)}")


def test_gaussians_along_sequences_hold_start_and_goals(problem, proposed):
    proposal = proposed("cvq-tuned")
    mixture = proposal.distribution
    for end in (problem.start, *proposal.goals):
        assert (np.abs(mixture.means - end).max(axis=1) < 1e-12).any()
    np.testing.assert_array_equal(mixture.covariances, [0.81 * np.eye(7)] * len(mixture.means))
    length = sum(JointPath(line).length for line in proposal.polylines)
    assert length / 0.4 <= len(mixture.means) <= length / 0.4 + 2 * len(proposal.polylines)


@pytest.mark.parametrize("predictor", ["nearest-lines", "transformer-lines", "solved", "oracle"])
def test_controls_give_polylines_from_the_start_to_goals(problem, proposed, predictor):
    """Controls give straight lines or paths, along which codes are read or Gaussians are placed."""
    lines = proposed(f"cvq:{predictor}+every-waypoint").polylines
    for line in lines:
        np.testing.assert_array_equal(line[0], problem.start)
        assert (np.abs(problem.goals - line[-1]).max(axis=1) < 1e-9).any()
        assert (len(line) == 2) == predictor.endswith("lines")
    along = proposed(f"cvq:{predictor}+along+std=0.5").distribution
    assert along.covariances[0, 0, 0] == 0.25
    if predictor == "transformer-lines":
        chosen = proposed("cvq:transformer").goals
        np.testing.assert_array_equal([line[-1] for line in lines], chosen)


def test_uniform_samples_as_a_product_are_those_of_birrt(problem):
    product, printed = (plan(problem, name) for name in ("cvq:uniform", "birrt-printed"))
    np.testing.assert_array_equal(product.path.states, printed.path.states)
    assert product.counters == printed.counters


def test_goals_are_tried_one_after_the_other(problem):
    """Each goal has a separate query; the first reached goal ends the run."""
    asked = []
    stages = planner_named("birrt").stages(problem)

    def predict(query, observation):
        asked.append(query.goals)
        return stages.predict(query, observation)

    apart = Method.simple("apart", predict=predict, goals_apart=True)
    few = solve(problem, apart, Budget(iterations=len(problem.goals)), seed=0)
    np.testing.assert_array_equal(np.concatenate(asked), problem.goals)
    assert few.plan.status is PlanStatus.ITERATION_LIMIT
    assert few.plan.counters.iterations == len(problem.goals)
    asked.clear()
    found = solve(problem, apart, Budget(iterations=40_000), seed=0)
    np.testing.assert_array_equal(found.plan.path.states[-1], asked[-1][0])
    assert found.solved and found.plan.vertices > few.plan.vertices


def test_wide_gaussians_lie_at_the_nodes_of_the_roadmap(problem, proposed):
    proposal = proposed("cvq:random+wide")
    c, nodes = len(proposal.codes), dictionary_roadmap("vq_mpt", problem.robot).nodes
    np.testing.assert_allclose(proposal.distribution.means[:c], nodes[proposal.codes], atol=1e-4)
    assert np.sqrt(np.linalg.eigvalsh(proposal.distribution.covariances[:c])).min() > 1.09
    assert proposal.distribution.uniform_share == 0.15


def test_updates_move_codes_towards_the_constraint(problem, proposed):
    """F^T F at the means is smaller after Algorithm 2 and almost 0 after projection."""
    off = {}
    for update in ("none", "algorithm-2", "projected"):
        proposal = proposed(f"cvq:random+{update}")
        means = proposal.distribution.means[: -len(proposal.goals)]
        off[update] = np.square(problem.manifold.residual(means)).sum(axis=1).mean()
    assert off["projected"] < 1e-5 < off["algorithm-2"] < off["none"]


def test_without_codes_samples_are_uniform_and_the_proposal_says_so(problem, query):
    stages = planner_named("cvq:random+algorithm-2").stages(problem)
    none = CodeProposal(query.uniform)
    sampler = replace(stages.predict.__self__, predict=lambda query, observation: none)
    proposal = sampler.propose(query, Observation())
    assert isinstance(proposal, CodeProposal) and isinstance(proposal.distribution, Uniform)
    assert proposal.fallback == "no code sequence reached a goal"
    assert stages.update(query, proposal) is proposal


def plan(problem, name, budget=ENOUGH):
    return solve(problem, name, budget, seed=0).plan


@pytest.mark.parametrize("name", declared("control"))
def test_controls_solve_repeat_and_give_up(problem, name):
    first, second = plan(problem, name), plan(problem, name)
    assert first.status is PlanStatus.SOLVED and certify(problem, first.path).valid
    np.testing.assert_array_equal(first.path.states, second.path.states)
    assert first.counters == second.counters
    assert plan(problem, name, Budget(seconds=1e-9)).status is PlanStatus.TIMEOUT


def test_a_roadmap_needs_its_own_scene():
    """With edge costs of another scene, the work summed over a few problems is larger."""
    ratios = []
    for environment in (1003, 1007, 1017, 1020, 1030):
        problem = with_drawn_goals(place_problem(environment))
        counted = [plan(problem, f"roadmap-{name}").counters for name in ("cvq", "wrong-scene")]
        own, wrong = (counters.projections + counters.state_checks for counters in counted)
        ratios.append(np.log(wrong / own))
    assert np.exp(np.mean(ratios)) > 1.3


WIDTHS = {"encoder_widths": (8, 6), "planner_widths": (140, 12, 8)}
CONFIG = MPNetConfig(n_points=16, code_dim=4, dropout=0.2, **WIDTHS)
COPIES = 10


@pytest.fixture(scope="module")
def tuning():
    return with_drawn_goals(place_problem(TUNING_ENVIRONMENTS[0]))


def random_network(config=CONFIG):
    torch.manual_seed(0)
    return MPNet(config).eval()


def in_numpy(network, robot):
    checkpoint = Checkpoint(network.config, robot_signature(robot), {"mpnet": network})
    return MPNetNetwork(stored(checkpoint))


def heading_network(share=0.5):
    """Network that proposes current + share * (goal - current), with noise from dropout."""
    network = random_network(replace(CONFIG, planner_widths=(14 * COPIES, 8)))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        (first, slope), (second, other_slope) = network.hidden
        slope.weight.fill_(1.0)
        other_slope.weight.fill_(1.0)
        first.weight[:, CONFIG.code_dim :] = torch.eye(14).repeat(COPIES, 1)
        both = torch.cat(((1.0 - share) * torch.eye(7), share * torch.eye(7)), 1)
        second.weight[:7] = both.repeat(1, COPIES) / COPIES
        network.out.weight[:, :7] = torch.eye(7)
    return network


def on_manifold(problem, draw, valid):
    """Draw and project configurations (n,) until one is valid, or invalid, as wanted."""
    space, rng = ConstrainedSpace.of(problem), np.random.default_rng(0)
    while True:
        q = draw(rng)
        if space.project(q) and space.valid(q) == valid:
            return q


def colliding(problem):
    """Return a configuration (n,) on the manifold that collides."""
    robot = problem.robot
    return on_manifold(problem, lambda rng: rng.uniform(robot.lower, robot.upper), False)


def stuck_network(problem):
    """Network that always proposes the same colliding configuration."""
    robot, network = problem.robot, heading_network()
    with torch.no_grad():
        network.out.weight.zero_()
        unit = 2.0 * (colliding(problem) - robot.lower) / (robot.upper - robot.lower) - 1.0
        network.out.bias[:] = torch.from_numpy(unit)
    return network


def cloud_of(scene):
    """Positions of the obstacles as a cloud, which needs no cameras."""
    return np.array([item.T_world_object[:3, 3] for item in scene.obstacles])


def mpnet_of(robot, network=None, observe=cloud_of, bridged=False, **settings):
    """Return MPNet with this network."""
    rollouts = MPNetRollouts(in_numpy(network or heading_network(), robot), bridged, **settings)
    return Method.simple("mpnet", predict=rollouts, observe=observe)


def test_mpnet_in_numpy_computes_the_same_as_in_torch(panda):
    network = random_network()
    inference = in_numpy(network, panda)
    rng = np.random.default_rng(0)
    points, current, goal = rng.normal(size=(16, 3)), rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 7)
    code = inference.encode(points)
    with torch.no_grad():
        expected = network.encode(torch.tensor(points[None], dtype=torch.float32))
        np.testing.assert_allclose(code, expected[0], atol=1e-6)
        ends = (torch.tensor(q[None], dtype=torch.float32) for q in (current, goal))
        answer = network(*ends, expected, stochastic=False)
    np.testing.assert_allclose(inference.propose(current, goal, code), answer[0], atol=1e-6)


@pytest.mark.parametrize("make", [heading_network, random_network])
def test_bridged_rollouts_solve_a_place_problem(tuning, make):
    method = mpnet_of(tuning.robot, make(), bridged=True)
    solution = solve(tuning, method, ENOUGH, seed=0)
    assert solution.plan.status is PlanStatus.SOLVED and solution.certificate.reasons == ()
    assert solution.plan.detail.startswith(BY_ROLLOUTS)
    assert states_hash(plan(tuning, method).path.states) == states_hash(solution.plan.path.states)


def test_published_rollouts_end_at_the_nearest_goal(tuning):
    states = plan(tuning, mpnet_of(tuning.robot)).path.states
    nearest = min(tuning.goals, key=lambda goal: np.linalg.norm(goal - tuning.start))
    np.testing.assert_array_equal(states[-1], nearest)
    tried = [
        planner_named(name).stages(tuning).predict.rollouts for name in ("mpnet", "mpnet-bridged")
    ]
    assert tried == [50, 10], "as published; ours"


def test_attempts_are_bounded_where_nothing_is_free(tuning):
    stuck, few = stuck_network(tuning), {"rollouts": 3, "attempts": 6}
    cut = "2 of 50 rollouts failed: 1 cut short by the budget, 1"
    for limits, budget, iterations, detail in (
        (few, ENOUGH, 3 * 6, "all 3 of 3 rollouts failed: 3"),
        ({}, Budget(iterations=40), 40, cut),
    ):
        result = plan(tuning, mpnet_of(tuning.robot, stuck, **limits), budget)
        assert result.path is None and result.status is PlanStatus.ITERATION_LIMIT
        assert result.detail == f"{detail} without a free state"
        assert result.counters.iterations == iterations


def test_sides_that_do_not_meet_are_bridged_or_given_up(tuning):
    short, settings = heading_network(share=0.1), {"predictions": 1, "rollouts": 1, "share": 1.0}
    published = plan(tuning, mpnet_of(tuning.robot, short, **settings))
    assert published.detail == "all 1 of 1 rollouts failed: 1 whose sides did not meet"
    assert published.path is None
    bridged = plan(tuning, mpnet_of(tuning.robot, short, bridged=True, **settings))
    assert bridged.path is not None and "a bridge" in bridged.detail


def test_rollouts_alone_reach_a_goal_that_a_direct_motion_does(tuning):
    near = on_manifold(tuning, lambda rng: tuning.start + rng.normal(scale=0.05, size=7), True)
    easy = replace(tuning, goals=near[None], goal_region=None)
    result = plan(easy, mpnet_of(easy.robot))
    assert result.detail == ROLLOUTS_ALONE
    assert result.counters.state_checks >= 100 and result.counters.projections > 0


def test_a_straight_line_is_checked_only_for_collision(tuning):
    space = ConstrainedSpace.of(tuning)
    off = tuning.start.copy()
    off[6] += 0.3  # turns the hand: off the manifold
    assert space.valid(off) and np.linalg.norm(tuning.manifold.residual(off)) > 0.01
    assert line_free(space, tuning.start, off)
    assert space.counters.projections == 0 and space.counters.state_checks == 1 + 100
    assert not line_free(space, tuning.start, colliding(tuning))
