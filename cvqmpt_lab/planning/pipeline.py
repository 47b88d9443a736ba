"""One planning run from beginning to end; start to read here."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_kind, whole_number
from cvqmpt_lab.base.jit import compile_before_clocks
from cvqmpt_lab.base.processes import one_thread
from cvqmpt_lab.certificate.certificate import Certificate, certify
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.goals import Goals, goals_of
from cvqmpt_lab.planning.planners import planner_named, require_fit
from cvqmpt_lab.planning.race import MOST_CORES, first_of, require_race
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.usable import check_problem, usable_goals, why_no_goal
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.anytime import check_units, improve, restarted
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.motion import SAME_STATE_RAD
from cvqmpt_lab.search.planner_interface import (
    Observation,
    Proposal,
    Query,
    SamplingDistribution,
    Search,
    Stages,
    search,
)
from cvqmpt_lab.search.result import Budget, Counters, JointPath, PlanResult, PlanStatus, Timings
from cvqmpt_lab.search.shortcut import Simplified, simplify
from cvqmpt_lab.search.space import ConstrainedSpace

NEAR_GOAL_COUNT = 5  # number of goals that are searched first, see `near_goals_first`
PROBLEM_HINT = "PlanningProblem.load(path) reads a file; a Task is for solve_task"
_log = logging.getLogger("cvqmpt")
Certify = Callable[[JointPath], Certificate]


@one_thread()
def solve(
    problem: PlanningProblem,
    method: Method | str,
    budget: Budget,
    seed: int,
    *,
    backend: str = "compiled",
    exact_clearance: bool = False,
    optimize: Budget | None = None,
    use_cache: bool = True,
    near_goals_first: bool = False,
    goals: Goals | None = None,
    cores: int = 1,
) -> Solution:
    """Draw goals, observe, predict, update, search, shorten and certify a path.

    It keeps no margin for tracking error; `features.plan` keeps that of `cvqmpt plan`.
    If the certificate refuses the path, the search continues. All random numbers depend on seed and
    start. Calls from several threads run one after the other, because OMPL's random numbers, caches
    and the number of BLAS threads belong to the process. Several processes can plan in parallel.

    Args:
        problem: the planning problem.
        method: a planner or its name.
        budget: budget of prediction and search.
        seed: seed of random numbers.
        backend: backend of state checks, "compiled" or "exact".
        exact_clearance: whether the certificate measures the smallest distances, see `certify`.
        optimize: budget for shorter paths after the first one; the result is never longer.
        use_cache: False: the planner's time contains all computations from the cloud, also those
            whose results are cached.
        near_goals_first: given goals near the start are searched first, as drawn ones always are.
            If there are none, and a joint can turn more than once, the same pose is a goal several
            times, whole turns apart: the nearest goals are then searched first.
        goals: result of `goals_of` for the problem; None: it is called here.
        cores: above 1: as many searches run in threads, with the seeds seed, seed + 1, ...; the
            first certified path is returned, with its seed, see `race`.

    Raises:
        InvalidProblemError: the start, or every goal, collides or violates the constraint.
        InvalidInputError: the method cannot solve the problem (weights of another robot, no
            constraint).
    """
    require_kind("problem", problem, PlanningProblem, PROBLEM_HINT)
    _check_budgets(budget, optimize)
    seed, cores = whole_number("seed", seed), whole_number("cores", cores)
    if not 1 <= cores <= MOST_CORES:
        raise InvalidInputError(f"cores {cores}: give a number from 1 to {MOST_CORES}")
    method = planner_named(method) if isinstance(method, str) else method
    require_kind("method", method, Method, "or the name of a planner")
    compile_before_clocks()
    called = time.perf_counter()
    given = goals is not None
    world = World.of(problem)
    goals = goals_of(problem, world) if goals is None else goals
    goal_seconds = 0.0 if given else goals.seconds
    if len(goals.configurations) == 0:
        check_problem(problem, world)  # refuse a start that cannot be used
        reason = f"no goal: {goals.outcome}; {why_no_goal(problem, world)}"
        return Solution(problem, no_plan(PlanStatus.NO_GOAL, reason), goal_seconds=goal_seconds)
    usable, left_out = usable_goals(problem, goals.configurations, world)
    goals = replace(goals, configurations=usable)
    require_fit(method, problem)
    certified = partial(_certified, problem, world, exact_clearance)
    if np.abs(usable - problem.start).max(axis=1).min() <= SAME_STATE_RAD:
        return _start_is_goal(problem, usable, left_out, goal_seconds, certified)
    # an external planner reads its goals from the problem
    stages = method.stages(problem.changed(goals=usable) if method.external else problem)
    began = time.perf_counter()
    cloud = None if stages.observe is None else stages.observe(problem.scene)
    observe_seconds = time.perf_counter() - began
    _log.info("%d goals in %.1f ms", len(usable), 1e3 * goals.seconds)
    _log.info("cloud of %s points", "no" if cloud is None else len(cloud))
    near = goals.near(problem.start)
    if near_goals_first:
        # one search of near and far goals together may end at a far one
        near = goals.within(problem.start) or max(
            near, NEAR_GOAL_COUNT if problem.robot.turning.any() else 0
        )
    observed = Observation(cloud, use_cache)
    ends = np.vstack([problem.start, usable])
    searches = []
    for number in range(cores):
        space = ConstrainedSpace.of(problem, backend, world, ends=ends)
        stream = problem.random_stream(seed + number)
        query = Query.of(space, problem.start, usable, budget, stream, seed + number)
        searches.append(_SearchRun(query, stages, observed, near, certified))
    if cores == 1:
        run = searches[0].ended()
    else:
        require_race(method.name, stages)
        run = first_of(searches)
    attempts, space, seed = run.attempts, run.query.space, run.query.seed
    wall = time.perf_counter() - called - goal_seconds - observe_seconds
    certifying = sum(attempt.certifying for attempt in attempts)
    plan, best = _outcome(attempts, space)
    found = Solution(
        problem,
        plan,
        simplified=best.path,
        certificate=best.certificate,
        goal_seconds=goal_seconds,
        observe_seconds=observe_seconds,
        wall_seconds=wall - certifying,
        certificate_seconds=certifying,
        distribution=_sampled(stages, attempts[-1].proposal),
        left_out=left_out,
        goals=usable,
        seed=seed,
        seeds=cores,
    )
    # `as_is`: the path of an external planner is not changed
    if optimize is None or found.path is None or plan.as_is:
        return found
    query = Query.of(space, problem.start, usable, optimize, problem.random_stream(seed, 1))
    return _improved(found, query, stages, attempts[-1].proposal, certified)


def _sampled(stages: Stages, proposal: Proposal) -> SamplingDistribution | None:
    """Return the distribution that a tree search sampled; None if it used none."""
    sampled = isinstance(_search_of(stages), BiRRT)
    sampled = sampled and proposal.path is None and not proposal.as_is
    return proposal.distribution if sampled else None


def _check_budgets(budget: Budget, optimize: Budget | None) -> None:
    """Refuse what is no budget, and a budget for shorter paths in other units."""
    Budget.require(budget)
    if optimize is not None:
        Budget.require(optimize, "optimize")
        check_units(budget, optimize)


def _search_of(stages: Stages) -> Search:
    """Return the search of a planner."""
    return stages.search or BiRRT()


def _outcome(
    attempts: Sequence["_Attempt"], space: ConstrainedSpace
) -> tuple[PlanResult, "_Attempt"]:
    """Return the result of all attempts, and the attempt whose path counts."""
    # the last attempt with a path: the search after it may have ended without one
    best = next((attempt for attempt in reversed(attempts) if attempt.path), attempts[-1])
    plan = replace(attempts[-1].plan, status=best.plan.status, path=best.plan.path)
    if space.doubtful:
        several = len(space.doubtful) > 3
        ends = f"{len(space.doubtful)} ends" if several else ", ".join(space.doubtful)
        exact = f"exact checks near {ends}"
        plan = replace(plan, detail="; ".join(filter(None, (plan.detail, exact))))
    return plan, best


def _improved(
    found: Solution, query: Query, stages: Stages, proposal: Proposal, certified: Certify
) -> Solution:
    """Return a solution with a shorter path, if one is found and certified.

    Args:
        found: the solution; it has a path.
        query: start, goals, and the budget for shorter paths.
        stages: stages of the planner.
        proposal: what it predicted for the first path.
        certified: makes the certificate of a path.
    """
    assert found.simplified is not None
    paths = stages.path_source or partial(restarted, _search_of(stages), proposal.distribution)
    shortest, improvement = improve(query, paths, found.simplified.path)
    better = certified(shortest)
    if not better.valid:
        return replace(found, improvement=replace(improvement, lengths=improvement.lengths[:1]))
    shorter = replace(found.simplified, path=shortest)
    return replace(found, simplified=shorter, certificate=better, improvement=improvement)


def _start_is_goal(
    problem: PlanningProblem,
    goals: np.ndarray,
    left_out: tuple[str, ...],
    goal_seconds: float,
    certified: Certify,
) -> Solution:
    """Return the solution of a problem whose start is a goal: an empty path, without a search.

    Args:
        problem: the problem.
        goals: (k, n) [rad or m].
        left_out: goals that cannot be used, with the reasons.
        goal_seconds: time of drawing goals [s].
        certified: makes the certificate of a path.
    """
    path = JointPath(np.array([problem.start, problem.start]))
    detail = "the start is a goal: the path is empty"
    plan = PlanResult(PlanStatus.SOLVED, path, 0.0, Counters(), 0, "none", detail=detail)
    certificate = certified(path)
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
    """One search, and the certificate of its path."""

    plan: PlanResult  # its counts are those of the whole run so far
    proposal: Proposal
    path: Simplified | None = None
    certificate: Certificate | None = None
    certifying: float = 0.0  # time of the certificate [s]

    @property
    def certified(self) -> bool:
        return self.certificate is not None and self.certificate.valid


@dataclass
class _SearchRun:
    """Attempts with one stream of random numbers until a path is certified; see `_attempts`."""

    query: Query
    stages: Stages
    observed: Observation
    near: int
    certified: Certify
    attempts: list[_Attempt] = field(default_factory=list)

    def ended(self) -> "_SearchRun":
        """Make attempts until a path is certified or the budget is spent; return this run."""
        found = _attempts(self.query, self.stages, self.observed, self.near, self.certified)
        for attempt in found:
            self.attempts.append(attempt)
            if self.query.deadline.spent() is not None or attempt.certified:
                break
        return self

    @property
    def won(self) -> bool:
        """Whether its last path is certified."""
        return self.attempts[-1].certified

    def stop(self) -> None:
        """Ask it to end soon, from another thread."""
        self.query.space.stop()


def _certified(
    problem: PlanningProblem, world: World, exact_clearance: bool, path: JointPath
) -> Certificate:
    """Return the certificate of a path, by the exact checker of this thread."""
    return certify(problem, path, checker=world.checker(), exact_clearance=exact_clearance)


def _attempts(
    query: Query,
    stages: Stages,
    observed: Observation,
    near: int,
    certified: Certify,
) -> Iterator[_Attempt]:
    """Yield attempts: one for each goal if goals are searched apart, and more after refusals.

    Args:
        query: start, goals and budget.
        stages: stages of the planner.
        observed: sensor data.
        near: number of nearest goals that are searched first.
        certified: makes the certificate of a path.
    """
    space, plan, ranking = query.space, None, Timings()
    tree_search = _search_of(stages)
    if stages.goals_apart and stages.rank_goals is not None:
        goals, ranking = stages.rank_goals(query, observed)
        query = replace(query, goals=goals)
        # later predictions use what the ranking computed from the cloud
        observed = replace(observed, use_cache=True)
    proposals: dict[bytes, Proposal] = {}  # by goals
    for tried, part in enumerate(_parts(query, stages), start=1):
        proposal = proposals.get(part.goals.tobytes())
        if proposal is None:
            # results computed from the cloud for the first goal are used for the others
            use_cache = observed.use_cache or plan is not None
            proposal = stages.predict(part, replace(observed, use_cache=use_cache))
            if stages.update is not None:
                proposal = stages.update(part, proposal)
            proposals[part.goals.tobytes()] = replace(
                proposal, timings=Timings(), vertices=0, counters=Counters()
            )
            proposal = replace(proposal, timings=proposal.timings + ranking)
            ranking = Timings()
        proposed = 1e3 * query.deadline.seconds
        _log.info("%s proposed after %.1f ms", proposal.distribution.name, proposed)
        searching = True
        while searching:
            plan = search(tree_search, part, proposal, near).after(plan)
            plan = replace(plan, goals_tried=tried)
            _log.info("search ended after %.1f ms: %s", 1e3 * plan.seconds, plan.status)
            if plan.path is None:
                yield _Attempt(plan, proposal)
                break
            shorter = Simplified(plan.path, 0.0, Counters())
            if not (plan.as_is or plan.direct):
                shorter = simplify(space, plan.path, query.rng)
            began = time.perf_counter()
            certificate = certified(shorter.path)
            certifying = time.perf_counter() - began
            if not certificate.valid:
                _log.info("refused by the certificate: %s", "; ".join(certificate.reasons))
            yield _Attempt(plan, proposal, shorter, certificate, certifying)
            # a search may find another path; a proposed path would be the same again
            searching = not plan.as_is and proposal.path is None
            # a search without iterations must use up the budget, too
            query.deadline.count()


def _parts(query: Query, stages: Stages) -> Iterator[Query]:
    """Yield a query for each search: of all goals, or of one goal after the other."""
    if not stages.goals_apart:
        yield query
        return
    # the published code limits the searches for goals only where there is a constraint
    limits = stages.goal_limits if query.space.dim else ()
    if len(limits) == len(query.goals) == 1:
        limits = ()  # the published limit shares a budget among twenty goals
    for limit in limits or (None,):
        yield from query.one_by_one(limit)


def solve_many(
    problems: Sequence[PlanningProblem],
    method: Method | str,
    budget: Budget,
    seed: int = 0,
    **options: Any,
) -> list[Solution]:
    """Solve several problems; problems of one scene and robot share their arrays.

    Args:
        problems: the planning problems.
        method: a planner or its name.
        budget: budget of each problem.
        seed: seed of each problem.
        **options: more arguments of `solve`.

    Returns:
        Solutions in the order of the problems.
    """
    method = planner_named(method) if isinstance(method, str) else method
    scenes: dict[Any, list[int]] = {}
    require_kind("problems", problems, Sequence, "a list of problems")
    for index, problem in enumerate(problems):
        require_kind(f"problems[{index}]", problem, PlanningProblem, PROBLEM_HINT)
        scenes.setdefault((problem.scene, problem.robot), []).append(index)
    found = {
        index: solve(problems[index], method, budget, seed, **options)
        for together in scenes.values()
        for index in together
    }
    return [found[index] for index in range(len(problems))]


def no_plan(status: PlanStatus, detail: str = "") -> PlanResult:
    """Return the result of a run without a search."""
    return PlanResult(status, None, 0.0, Counters(), 0, "none", detail=detail)


def with_drawn_goals(problem: PlanningProblem) -> PlanningProblem:
    """Return the problem with the goals that `solve` would draw from its goal region."""
    return problem.changed(goals=goals_of(problem).configurations)
