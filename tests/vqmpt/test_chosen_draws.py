"""Draws that a tree gets of its own, and draws that are compared with the cloud."""

from dataclasses import dataclass

import numpy as np
import pytest

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.search import ompl_planners
from cvqmpt_lab.search.ompl_planners import published_search
from cvqmpt_lab.search.planner_interface import GaussianMixture, Observation, Query, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.search.work import PRICES
from cvqmpt_lab.sensing.observation import Observer
from cvqmpt_lab.vqmpt.chosen_draws import TRIES, BodyBalls, ClearestDraws, Clearness, HalvedMixture

IN_OMPL = "cvq:transformer+decoded+goals-apart+in-ompl"


@dataclass
class Constant:
    """A distribution of one configuration, or of one for each tree."""

    trees: tuple
    name: str = "constant"

    def of_tree(self, tree):
        """The draws of a tree."""
        return Constant((self.trees[tree],))

    def sample(self, rng, count):
        """Return copies of the configuration."""
        return np.array([self.trees[0]] * count)


def query_of(problem, iterations=400):
    space = ConstrainedSpace.of(problem)
    rng, budget = np.random.default_rng(0), Budget(iterations=iterations)
    return Query.of(space, problem.start, problem.goals[:1], budget, rng)


def test_the_tree_from_the_start_draws_first_and_both_draw_in_turn(problem, monkeypatch):
    draws, motions = [], []
    plain = ompl_planners._Draws.next

    def next_draw(self):
        draws.append(plain(self))
        motions.append([])
        return draws[-1]

    def project(self, x):
        motions[-1].append(np.array(x))
        return plain_projection(self, x)

    plain_projection = ompl_planners._Manifold._project
    monkeypatch.setattr(ompl_planners._Draws, "next", next_draw)
    monkeypatch.setattr(ompl_planners._Manifold, "_project", project)
    of_start, of_goal = problem.goals[3], problem.goals[5]
    published_search(reach=0.3).search(query_of(problem, 10), Constant((of_start, of_goal)))
    np.testing.assert_array_equal(draws, [of_start, of_goal] * 5)
    # the first motion of the first iteration begins at the start
    assert np.linalg.norm(motions[0][1] - problem.start) < 0.1


@pytest.mark.parametrize(("codes", "first", "second"), [(4, 2, 2), (5, 3, 3), (1, 1, 1)])
def test_halves_of_a_sequence_share_the_middle_and_the_goal_is_in_the_second(codes, first, second):
    means = np.arange(codes + 1.0)[:, None]
    uniform = Uniform(np.zeros(1), np.ones(1))
    whole = GaussianMixture.equal(means, 1e-12 * np.eye(1), uniform, 0.0, "halved")
    halves = HalvedMixture.of(whole, codes).halves
    np.testing.assert_array_equal(halves[0].means, means[:first])
    np.testing.assert_array_equal(halves[1].means, means[codes - second :])
    drawn = HalvedMixture.of(whole, codes).sample(np.random.default_rng(0), 20)
    assert drawn.shape == (20, 1)
    assert (drawn[::2] < first - 0.5).all() and (drawn[1::2] > codes - second - 0.5).all()


def test_without_codes_both_halves_draw_around_the_goal():
    whole = GaussianMixture.equal(np.ones((1, 1)), np.eye(1), Uniform(None, None), 0.0, "goal")
    assert [len(half.means) for half in HalvedMixture.of(whole, 0).halves] == [1, 1]


def test_depth_in_a_cloud_is_summed_over_the_balls_of_the_body(problem):
    space, cloud = ConstrainedSpace.of(problem), Observer()(problem.scene)
    states = problem.robot.random_configurations(np.random.default_rng(1), 5)
    balls = BodyBalls.of(space)
    rotation, translation = link_poses(problem.robot.kinematics, states)
    for q, found in enumerate(Clearness(space, cloud).depths(states)):
        depth = 0.0
        for link, centre, radius in zip(*balls, strict=True):
            point = rotation[q, link] @ centre + translation[q, link]
            distance = np.linalg.norm(cloud - point, axis=1).min()
            depth += max(0.0, radius + 0.02 - distance)
        assert found == pytest.approx(depth, abs=1e-9)
    assert not Clearness(space, np.empty((0, 3))).depths(states).any()


def test_the_clearest_of_eight_draws_collide_less_often(problem):
    space, cloud = ConstrainedSpace.of(problem), Observer()(problem.scene)
    uniform = Uniform(problem.robot.lower, problem.robot.upper)
    clearness = Clearness(space, cloud)
    every = uniform.sample(np.random.default_rng(2), 60 * TRIES)
    chosen = ClearestDraws(uniform, clearness).sample(np.random.default_rng(2), 60)
    np.testing.assert_allclose(
        clearness.depths(chosen), clearness.depths(every).reshape(60, TRIES).min(axis=1)
    )
    free = [np.mean([space.valid(np.array(q)) for q in states]) for states in (every, chosen)]
    assert free[1] > free[0] + 0.1


@pytest.mark.parametrize(
    "name",
    [
        f"{IN_OMPL}+own-half+clearest-draw+free-draws",
        f"{IN_OMPL.replace('apart', 'ranked')}+own-half+algorithm-2",
        f"{IN_OMPL.replace('apart', 'again')}+clearest-draw",
        "cvq:uniform+goals-again+clearest-draw+in-ompl",
        "cvq:nearest-lines+every-waypoint+goals-apart+own-half+clearest-draw+in-ompl",
    ],
)
def test_chosen_draws_plan_certified_paths_that_repeat(problem, name):
    found, again = (solve(problem, name, Budget(cost=100.0), seed=2) for _ in range(2))
    assert found.plan.counters == again.plan.counters
    if "uniform" in name:  # uniform draws seldom reach a goal in 2.5 s
        return
    assert found.solved
    np.testing.assert_array_equal(found.path.states, again.path.states)


def test_one_goal_may_use_the_whole_budget(problem):
    """The tries of one goal summed up to 37.5 s of 100 s."""
    name = IN_OMPL.replace("apart", "ranked")
    one = problem.changed(goals=problem.goals[:1])
    found = solve(one, name, Budget(cost=60.0), seed=0)
    assert found.solved or found.plan.counters.cost(PRICES["published"]) >= 60.0
    limits = [limit.cost for limit in planner_named(name).stages(problem).goal_limits]
    assert sum(limits) >= 100.0 and 20 * sum(limits[:2]) >= 100.0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cvq:transformer+own-half+goals-apart", "add in-ompl"),
        ("cvq:transformer+clearest-draw", "add in-ompl"),
        ("cvq:transformer+own-half+in-ompl", "one goal: add goals-apart"),
        ("cvq:uniform+own-half+goals-apart+in-ompl", "uniform has none"),
    ],
)
def test_choices_that_do_not_go_together_are_refused(name, message):
    with pytest.raises(InvalidInputError, match=message):
        planner_named(name)


def test_the_cloud_of_clearest_draws_is_that_of_the_network(problem):
    """With no-cloud, every draw is equally clear."""
    stages = planner_named(f"{IN_OMPL}+no-cloud+clearest-draw").stages(problem)
    assert len(stages.observe(problem.scene)) == 0
    proposal = stages.predict(query_of(problem), Observation(np.empty((0, 3))))
    assert isinstance(proposal.distribution, ClearestDraws)
