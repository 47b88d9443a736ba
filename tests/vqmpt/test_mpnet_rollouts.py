"""The MPNet planner on tuning environments: real networks, and one that heads for the goal."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cvqmpt_lab.benchmarks.place_task import TUNING_ENVIRONMENTS, place_problem
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planners import Method
from cvqmpt_lab.results.row import BY_ROLLOUTS, ROLLOUTS_ALONE
from cvqmpt_lab.results.store import states_hash
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.mpnet_stage import MPNet
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint, stored
from cvqmpt_lab.vqmpt.config import MPNetConfig
from cvqmpt_lab.vqmpt.mpnet_rollouts import MPNetNetwork, MPNetRollouts, line_free
from cvqmpt_lab.vqmpt.weights import robot_signature

CONFIG = MPNetConfig(
    n_points=16, encoder_widths=(8, 6), code_dim=4, planner_widths=(140, 12, 8), dropout=0.2
)
ENOUGH = Budget(iterations=20_000)
COPIES = 10


@pytest.fixture(scope="module")
def tuning():
    return with_sampled_goals(place_problem(TUNING_ENVIRONMENTS[0]))[0]


def random_network(config=CONFIG):
    torch.manual_seed(0)
    return MPNet(config).eval()


def in_numpy(network, robot):
    checkpoint = Checkpoint(network.config, robot_signature(robot), {"mpnet": network})
    return MPNetNetwork(stored(checkpoint))


def heading_network(share=0.5):
    """Proposes current + share * (goal - current), noisy by dropout of copies of its inputs."""
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
    """A projected draw (n,), of a generator, that is valid or not."""
    space, rng = ConstrainedSpace(problem), np.random.default_rng(0)
    while True:
        q = draw(rng)
        if space.project(q) and space.valid(q) == valid:
            return q


def colliding(problem):
    """A configuration (n,) on the manifold that collides."""
    robot = problem.robot
    return on_manifold(problem, lambda rng: rng.uniform(robot.lower, robot.upper), False)


def stuck_network(problem):
    """Always proposes the same colliding configuration."""
    robot, network = problem.robot, heading_network()
    with torch.no_grad():
        network.out.weight.zero_()
        unit = 2.0 * (colliding(problem) - robot.lower) / (robot.upper - robot.lower) - 1.0
        network.out.bias[:] = torch.from_numpy(unit)
    return network


def cloud_of(scene):
    """Corners of the obstacles: faster than cameras."""
    return np.array([item.T_world_object[:3, 3] for item in scene.obstacles])


def mpnet_of(robot, network=None, observe=cloud_of, bridged=False, **settings):
    """A method whose rollouts are those of a network."""
    rollouts = MPNetRollouts(in_numpy(network or heading_network(), robot), bridged, **settings)
    return Method.simple("mpnet", predict=rollouts, observe=observe)


def plan(problem, method, budget=ENOUGH, seed=0):
    """Result of the method."""
    return solve(problem, method, budget, seed, clearance=False).plan


def test_it_computes_what_the_torch_network_does(panda):
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


def test_attempts_are_bounded_where_nothing_is_free(tuning):
    stuck, few = stuck_network(tuning), {"rollouts": 3, "attempts": 6}
    cut = "2 of 10 rollouts failed: 1 cut short by the budget, 1"
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


def test_a_straight_line_is_checked_for_collision_alone(tuning):
    space = ConstrainedSpace(tuning)
    off = tuning.start.copy()
    off[6] += 0.3  # turns the hand: off the manifold
    assert space.valid(off) and np.linalg.norm(tuning.manifold.residual(off)) > 0.01
    assert line_free(space, tuning.start, off)
    assert space.counters.projections == 0 and space.counters.state_checks == 1 + 100
    assert not line_free(space, tuning.start, colliding(tuning))
