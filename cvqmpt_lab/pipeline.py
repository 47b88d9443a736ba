"""The whole story of one planning run; newcomers start here."""

import time
from dataclasses import dataclass, replace

import numpy as np

from cvqmpt_lab.certificate import Certificate, certify
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region_chain import TaskSpaceRegionChain
from cvqmpt_lab.distributions import SamplingDistribution, Uniform
from cvqmpt_lab.planning.planner import Planner
from cvqmpt_lab.planning.result import Budget, Counters, PlanResult, PlanStatus
from cvqmpt_lab.planning.simplify import Simplified, SimplifySettings, simplify
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem, check_problem

MAX_GOALS = 20


@dataclass(frozen=True)
class Solution:
    """What came of a problem: the plan, its simplification, its certificate, the time each stage took [s]."""

    problem: PlanningProblem
    plan: PlanResult
    simplified: Simplified | None
    certificate: Certificate | None
    goal_seconds: float

    @property
    def solved(self) -> bool:
        """Certified success."""
        return self.certificate is not None and self.certificate.valid


def solve(
    problem: PlanningProblem,
    planner: Planner,
    budget: Budget,
    seed: int,
    sampler: SamplingDistribution | None = None,
    backend: str = "compiled",
    simplification: SimplifySettings | None = None,
    clearance: bool = True,
) -> Solution:
    """Sample goals, plan, simplify, certify; the same for every planner, all randomness from seed."""
    problem, goal_seconds = with_sampled_goals(problem)
    if len(problem.goals) == 0:
        nothing = PlanResult(PlanStatus.NO_GOAL, None, 0.0, Counters(), 0, "none")
        return Solution(problem, nothing, None, None, goal_seconds)
    check_problem(problem)
    space = ConstrainedSpace(problem, backend)
    sampler = sampler or Uniform(problem.robot.lower, problem.robot.upper)
    rng = np.random.default_rng(seed)
    plan = planner.plan(space, problem.start, problem.goals, sampler, budget, rng)
    if space.doubtful:
        plan = replace(
            plan, detail=f"{plan.detail}; exact checks near {', '.join(space.doubtful)}".lstrip("; ")
        )
    if plan.path is None:
        return Solution(problem, plan, None, None, goal_seconds)
    shorter = simplify(space, plan.path, rng, simplification)
    certificate = certify(problem, shorter.path, clearance=clearance)
    return Solution(problem, plan, shorter, certificate, goal_seconds)


def with_sampled_goals(problem: PlanningProblem) -> tuple[PlanningProblem, float]:
    """The problem with goal configurations drawn from its goal region when it has none, and the seconds spent.

    The draw depends on the problem's start alone, so that every planner and seed gets the same goals.
    Where the hand holds a door, goals have the door where the hand takes it, and an arm posture like the
    start's: most other postures can only be reached by letting go.
    """
    if len(problem.goals) > 0 or problem.goal_region is None:
        return problem, 0.0
    began = time.perf_counter()
    rng = np.random.default_rng(np.abs(problem.start * 1e6).astype(np.uint64))
    checker = problem.collision_checker(SAMPLE_MARGIN)
    held = [region for region in problem.constraint if isinstance(region, TaskSpaceRegionChain)]
    near = problem.start if held else None
    goals = sample_region(problem.robot, problem.goal_region, checker, rng, MAX_GOALS, within=held, near=near)
    return problem.with_goals(goals.configurations), time.perf_counter() - began
