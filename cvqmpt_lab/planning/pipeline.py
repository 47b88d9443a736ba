"""One planning run from beginning to end; newcomers start here."""

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import require_kind, whole_number
from cvqmpt_lab.base.processes import one_thread
from cvqmpt_lab.certificate.certificate import Certificate, certify
from cvqmpt_lab.constraints.goals import Goals, goals_of
from cvqmpt_lab.planning.planners import planner_named, require_fit
from cvqmpt_lab.problem import PlanningProblem, check_problem, usable_goals
from cvqmpt_lab.search.anytime import Improvement, check_units, improve, restarted
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import (
    Observation,
    Proposal,
    Query,
    SamplingDistribution,
    Search,
    Stages,
    search,
)
from cvqmpt_lab.search.result import Budget, Counters, JointPath, PlanResult, PlanStatus
from cvqmpt_lab.search.shortcut import Simplified, simplify
from cvqmpt_lab.search.space import ConstrainedSpace

SAME_STATE_RAD = 1e-9  # a goal this close to the start is the start
NEAR_GOALS = 5  # searched first where joints turn more than once, see `near_goals_first`
LOAD = "PlanningProblem.load(path) reads a file; a Task is for solve_task"
_log = logging.getLogger("cvqmpt")


@dataclass(frozen=True)
class Solution:
    """The result of a problem."""

    problem: PlanningProblem
    plan: PlanResult
    simplified: Simplified | None = None  # none without a path
    certificate: Certificate | None = None  # of the shortened path; None without one
    goal_seconds: float = 0.0  # what drawing goals took [s]
    observe_seconds: float = 0.0  # of rendering or reading the cloud [s]; charged to nobody
    # of the whole call up to the path, without goals and cloud [s]
    wall_seconds: float | None = None
    improvement: Improvement | None = None  # by `optimize`; `simplified` then has the best path
    # that the search drew from; None where it drew from none
    distribution: SamplingDistribution | None = None
    left_out: tuple[str, ...] = ()  # goals that the problem had and that cannot be used, and why
    # (k, n) that were searched: the given ones that can be used, or those drawn [rad or m]
    goals: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    def __repr__(self) -> str:
        plan, path, sure = self.plan, self.path, self.certificate
        lines = [
            f"Solution of {self.problem.name!r}: "
            f"{'solved and certified' if self.solved else 'not solved'}",
            f"plan        {plan.status} after {1e3 * plan.seconds:.1f} ms, samples: {plan.sampler}"
            + (f" ({plan.detail})" if plan.detail else ""),
        ]
        lines += [f"left out    {text}" for text in self.left_out]
        lines += [f"path        {path!r}"] if path else []
        if sure is not None:
            clear = (
                f", clearance {1e3 * sure.min_clearance_m:.1f} mm"
                if sure.min_clearance_m >= 0.0
                else ""
            )
            lines.append(f"certificate {'; '.join((str(sure.verdict), *sure.reasons[:1]))}{clear}")
        return "\n".join(lines)

    @property
    def path(self) -> JointPath | None:
        """The shortened path, the one that `certificate` judges; None without one."""
        return self.simplified.path if self.simplified else None

    @property
    def solved(self) -> bool:
        """Certified success."""
        return self.certificate is not None and self.certificate.valid


@one_thread()
def solve(
    problem: PlanningProblem,
    method: Method | str,
    budget: Budget,
    seed: int,
    *,
    backend: str = "compiled",
    clearance: bool = True,
    optimize: Budget | None = None,
    use_cache: bool = True,
    near_goals_first: bool = False,
    goals: Goals | None = None,
) -> Solution:
    """Draw goals, observe, predict, update, search, shorten, certify; search on if it is refused.

    All randomness comes from seed and start. Calls from several threads run one after the other:
    OMPL's random numbers, caches and the number of BLAS threads belong to the process. Several
    processes plan at the same time.

    Args:
        problem: what is planned.
        method: a planner or its name.
        budget: of prediction and search.
        seed: of random numbers.
        backend: of state checks, "compiled" or "exact".
        clearance: whether the certificate measures the smallest distance.
        optimize: budget for shorter paths after the first one; the result is never longer.
        use_cache: False charges the planner for all that it computes from the cloud, cached or not.
        near_goals_first: where hinges turn more than once, the nearest goals are searched alone
            first: others are whole turns away. Drawn goals near the start always are.
        goals: as `goals_of` returns them for the problem; None: they are found here.

    Raises:
        InvalidProblemError: the start, or every goal, collides or violates the constraint.
        InvalidInputError: the method cannot serve the problem (weights of another robot, no
            constraint).
    """
    require_kind("problem", problem, PlanningProblem, LOAD)
    Budget.require(budget)
    if optimize is not None:
        Budget.require(optimize, "optimize")
        check_units(budget, optimize)
    seed = whole_number("seed", seed)
    method = planner_named(method) if isinstance(method, str) else method
    require_kind("method", method, Method, "or the name of a planner")
    called = time.perf_counter()
    given = goals is not None
    goals = goals_of(problem) if goals is None else goals
    goal_seconds = 0.0 if given else goals.seconds
    if len(goals.configurations) == 0:
        check_problem(problem)  # a start that cannot be used is named first
        reason = f"no goal: {goals.outcome}; {problem.why_no_goal()}"
        return Solution(problem, no_plan(PlanStatus.NO_GOAL, reason), goal_seconds=goal_seconds)
    usable, left_out = usable_goals(problem, goals.configurations)
    goals = replace(goals, configurations=usable)
    require_fit(method, problem)
    if np.abs(usable - problem.start).max(axis=1).min() <= SAME_STATE_RAD:
        return _standing(problem, usable, left_out, goal_seconds, clearance)
    # an external planner finds its goals in the problem
    stages = method.stages(problem.changed(goals=usable) if method.external else problem)
    began = time.perf_counter()
    cloud = None if stages.observe is None else stages.observe(problem.scene)
    observe_seconds = time.perf_counter() - began
    _log.info("%d goals in %.1f ms", len(usable), 1e3 * goal_seconds)
    _log.info("cloud of %s points", "no" if cloud is None else len(cloud))
    space = ConstrainedSpace.of(problem, backend, ends=np.vstack([problem.start, usable]))
    rng = problem.random_stream(seed)

    query = Query.of(space, problem.start, usable, budget, rng, seed)
    tree_search = stages.search or BiRRT()
    near = goals.near(problem.start)
    if near_goals_first and problem.robot.turning.any():
        near = max(near, NEAR_GOALS)
    attempts: list[_Attempt] = []
    observed = Observation(cloud, use_cache)
    for attempt in _attempts(problem, query, stages, observed, tree_search, near, clearance):
        attempts.append(attempt)
        if query.deadline.spent() is not None or attempt.certified:
            break
    plan, proposal = attempts[-1].plan, attempts[-1].proposal
    # a later search may have ended without a path
    best = next((attempt for attempt in reversed(attempts) if attempt.path), attempts[-1])
    shorter, certificate, improvement = best.path, best.certificate, None
    plan = replace(plan, status=best.plan.status, path=best.plan.path)

    if space.doubtful:
        several = len(space.doubtful) > 3
        ends = f"{len(space.doubtful)} ends" if several else ", ".join(space.doubtful)
        exact = f"exact checks near {ends}"
        plan = replace(plan, detail="; ".join(filter(None, (plan.detail, exact))))
    sampled = isinstance(tree_search, BiRRT) and proposal.path is None and not proposal.as_is
    wall = time.perf_counter() - called - goal_seconds - observe_seconds
    wall -= sum(attempt.certifying for attempt in attempts)
    if shorter is not None and optimize is not None and not plan.as_is:
        rng = problem.random_stream(seed, 1)
        paths = stages.path_source or partial(restarted, tree_search, proposal.distribution)
        better_query = Query.of(space, problem.start, usable, optimize, rng)
        shortest, improvement = improve(better_query, paths, shorter.path)
        better = certify(problem, shortest, clearance=clearance)
        if better.valid:
            shorter, certificate = replace(shorter, path=shortest), better
        else:
            improvement = replace(improvement, lengths=improvement.lengths[:1])
    return Solution(
        problem,
        plan,
        shorter,
        certificate,
        goal_seconds,
        observe_seconds,
        wall,
        improvement,
        proposal.distribution if sampled else None,
        left_out,
        usable,
    )


def _standing(
    problem: PlanningProblem,
    goals: np.ndarray,
    left_out: tuple[str, ...],
    goal_seconds: float,
    clearance: bool,
) -> Solution:
    """The solution of a problem whose start is a goal: an empty path, without any search.

    Args:
        problem: the problem.
        goals: (k, n) [rad or m].
        left_out: goals that cannot be used, and why.
        goal_seconds: spent on drawing goals [s].
        clearance: whether the certificate measures the smallest distance.
    """
    path = JointPath(np.array([problem.start, problem.start]))
    detail = "the start is a goal: the path is empty"
    plan = PlanResult(PlanStatus.SOLVED, path, 0.0, Counters(), 0, "none", detail=detail)
    certificate = certify(problem, path, clearance=clearance)
    return Solution(
        problem,
        plan,
        Simplified(path, 0.0, Counters()),
        certificate,
        goal_seconds,
        wall_seconds=0.0,
        left_out=left_out,
        goals=goals,
    )


class _Attempt(NamedTuple):
    """One search, and what became of its path."""

    plan: PlanResult  # its counts are of the whole run
    proposal: Proposal
    path: Simplified | None = None
    certificate: Certificate | None = None
    certifying: float = 0.0  # [s]

    @property
    def certified(self) -> bool:
        return self.certificate is not None and self.certificate.valid


def _attempts(
    problem: PlanningProblem,
    query: Query,
    stages: Stages,
    observed: Observation,
    tree_search: Search,
    near: int,
    clearance: bool,
) -> Iterator[_Attempt]:
    """Search goal after goal if they are apart, and again where a path is refused."""
    space, plan = query.space, None
    for part in query.one_by_one() if stages.goals_apart else (query,):
        # what was computed from the cloud for the first goal serves the others
        use_cache = observed.use_cache or plan is not None
        proposal = stages.predict(part, replace(observed, use_cache=use_cache))
        if stages.update is not None:
            proposal = stages.update(part, proposal)
        proposed = 1e3 * query.deadline.seconds
        _log.info("%s proposed after %.1f ms", proposal.distribution.name, proposed)
        searching = True
        while searching:
            plan = search(tree_search, part, proposal, near).after(plan)
            _log.info("search ended after %.1f ms: %s", 1e3 * plan.seconds, plan.status)
            if plan.path is None:
                yield _Attempt(plan, proposal)
                break
            # the path of an external planner is not post-processed
            shorter = Simplified(plan.path, 0.0, Counters())
            if not plan.as_is:
                shorter = simplify(space, plan.path, query.rng)
            began = time.perf_counter()
            certificate = certify(problem, shorter.path, clearance=clearance)
            certifying = time.perf_counter() - began
            yield _Attempt(plan, proposal, shorter, certificate, certifying)
            _log.info("refused by the certificate: %s", "; ".join(certificate.reasons))
            # a search may find another path; one that was proposed would be the same again
            searching = not plan.as_is and proposal.path is None
            # a search that needs no iteration must not go on for ever
            query.deadline.count()


def solve_many(
    problems: Sequence[PlanningProblem],
    method: Method | str,
    budget: Budget,
    seed: int = 0,
    **options: Any,
) -> list[Solution]:
    """Solve problems one after the other, those of one scene together, whose arrays are made once.

    Options, errors and solutions are those of `solve`, in the order of the problems.
    """
    method = planner_named(method) if isinstance(method, str) else method
    scenes: dict[Any, list[int]] = {}
    require_kind("problems", problems, Sequence, "a list of problems")
    for index, problem in enumerate(problems):
        require_kind(f"problems[{index}]", problem, PlanningProblem, LOAD)
        scenes.setdefault((problem.scene, problem.robot), []).append(index)
    found = {
        index: solve(problems[index], method, budget, seed, **options)
        for together in scenes.values()
        for index in together
    }
    return [found[index] for index in range(len(problems))]


def no_plan(status: PlanStatus, detail: str = "") -> PlanResult:
    """The result of a search that was never begun."""
    return PlanResult(status, None, 0.0, Counters(), 0, "none", detail=detail)


def with_drawn_goals(problem: PlanningProblem) -> PlanningProblem:
    """The problem with the goals given that planning would draw from its region."""
    return problem.changed(goals=goals_of(problem).configurations)
