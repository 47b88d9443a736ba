"""Learned samplers: their names, mixtures and updates; controls on the shipped weights."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planners import CONTROLS, planner_named
from cvqmpt_lab.search.planner_interface import Observation, Query, Uniform
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.learned_sampler import (
    CodeProposal,
    LearnedSampler,
    codebook_of,
)
from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def problem():
    return with_sampled_goals(place_problem(1003))[0]


@pytest.fixture
def query(problem):
    return Query.of(ConstrainedSpace(problem), ENOUGH, np.random.default_rng(0))


@pytest.fixture
def proposed(problem, query):
    """Proposal of a planner, updated or not, and its codes' vectors."""

    def propose(name):
        stages = planner_named(name).stages(problem)
        cloud = stages.observe(problem.scene) if stages.observe else None
        proposal = stages.predict(query, Observation(cloud))
        return proposal if stages.update is None else stages.update(query, proposal)

    return propose


WIDE = {"predictor": "random", "gaussians": "wide"}


@pytest.mark.parametrize(
    ("words", "choice"),
    [
        ("random", SamplerChoice(predictor="random")),
        ("transformer+algorithm-2", SamplerChoice(predictor="transformer", update="algorithm-2")),
        ("random+wide", SamplerChoice(**WIDE, uniform_share=0.15)),
        (
            "random+uniform=0.5+projected+wide+other-cloud",
            SamplerChoice(**WIDE, update="projected", cloud="other-cloud", uniform_share=0.5),
        ),
    ],
)
def test_words_say_the_product(words, choice):
    assert SamplerChoice.of(words) == planner_named(f"cvq:{words}").sampler == choice


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "predictor of a learned sampler ''; valid choices: transformer"),
        ("wide", "'wide'; valid choices: transformer"),
        ("random+broad", "part of planner cvq:random+broad 'broad'; valid choices: decoded, wide"),
        ("random+wide+decoded", "two parts of one kind, 'decoded'"),
        ("random+uniform=2", "uniform share 2.0 of a learned sampler: give 0 to 1"),
        ("random+all-beams", "all-beams goes with predictor transformer, not random"),
        ("random+uniform=x", "give a number from 0 to 1 behind 'uniform='"),
    ],
)
def test_other_words_are_refused(words, message):
    refused(message.replace("+", r"\+"), planner_named, f"cvq:{words}", error=CvqmptError)


@pytest.mark.parametrize("predictor", ["transformer", "random", "oracle"])
def test_sampled_is_the_mixture_of_codes_and_goals(problem, proposed, predictor):
    """Equal weights; the decoder's Gaussians; around goals sigma is a tenth of a joint's range."""
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


def test_updates_move_codes_towards_the_constraint(problem, proposed):
    """F^T F at the means: less after Algorithm 2, almost nothing after projection."""
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
    return solve(problem, name, budget, seed=0, clearance=False).plan


@pytest.mark.parametrize("name", CONTROLS)
def test_controls_solve_repeat_and_give_up(problem, name):
    first, second = plan(problem, name), plan(problem, name)
    assert first.status is PlanStatus.SOLVED and certify(problem, first.path).valid
    np.testing.assert_array_equal(first.path.states, second.path.states)
    assert first.counters == second.counters
    assert plan(problem, name, Budget(seconds=1e-9)).status is PlanStatus.TIMEOUT


def test_a_roadmap_needs_its_own_scene():
    """With another scene's roadmap a planner needs more work, summed over a few problems."""
    ratios = []
    for environment in (1003, 1007, 1017, 1020, 1030):
        problem = with_sampled_goals(place_problem(environment))[0]
        counted = [plan(problem, f"roadmap-{name}").counters for name in ("cvq", "wrong-scene")]
        own, wrong = (counters.projections + counters.state_checks for counters in counted)
        ratios.append(np.log(wrong / own))
    assert np.exp(np.mean(ratios)) > 1.3
