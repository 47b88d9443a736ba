"""One call from a problem to a certified motion: `plan(problem, Request(...))`.

It puts together the run of a problem (`planning.pipeline.solve`), the margin for tracking error
(`planning.margins`), velocities at start and end (`motion.moving_ends`) and timing
(`motion.motion_check`).
"""

from __future__ import annotations  # so `help` shows types by their names

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from cvqmpt_lab.base.errors import require_choice, require_kind, whole_number
from cvqmpt_lab.base.reports import Report
from cvqmpt_lab.constraints.goals import Goals
from cvqmpt_lab.planning.margins import Kept, Margin, keep_margin, kept_by
from cvqmpt_lab.planning.pipeline import PROBLEM_HINT, solve
from cvqmpt_lab.planning.planners import default_planner
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.space import BACKENDS

if TYPE_CHECKING:
    from cvqmpt_lab.features.motion.timing import TimingSettings
    from cvqmpt_lab.features.motion.trajectory import Trajectory


@dataclass(frozen=True)
class Request:
    """What `plan` is asked for; `cvqmpt plan` has the same budget and margin."""

    planner: Method | str | None = None  # a planner or its name; None: `default_planner`
    # of prediction and search
    budget: Budget = field(default_factory=lambda: Budget(seconds=10.0))
    seed: int = 0  # of random numbers
    # for tracking error, kept where start and goals allow it
    margin: Margin = field(default_factory=Margin)
    optimize: Budget | None = None  # for shorter paths after the first one
    # speed, duration and velocities at the ends of the motion; None: a path without times
    timing: TimingSettings | None = None
    backend: str = "compiled"  # of state checks, or "exact"
    exact_clearance: bool = False  # whether the certificate measures the smallest distances
    near_goals_first: bool = False  # see `solve`
    use_cache: bool = True  # False: the planner's time contains what is cached of the cloud

    def __post_init__(self) -> None:
        if self.planner is not None and not isinstance(self.planner, str):
            require_kind("planner", self.planner, Method, "or the name of a planner")
        Budget.require(self.budget)
        if self.optimize is not None:
            Budget.require(self.optimize, "optimize")
        object.__setattr__(self, "seed", whole_number("seed", self.seed))
        require_choice("backend", self.backend, BACKENDS)
        if self.timing is not None:
            from cvqmpt_lab.features.motion.timing import TimingSettings  # imports scipy

            require_kind("timing", self.timing, TimingSettings, "give TimingSettings(speed=0.2)")
        require_kind("margin", self.margin, Margin, "give Margin(metres, radians)")
        self.margin.check()


@dataclass(frozen=True, eq=False)
class Plan:
    """Result of `plan`."""

    request: Request
    solution: Solution  # path and certificate
    margin: Kept  # that the path keeps; str() has the reason if it is smaller

    def __repr__(self) -> str:
        return f"{self.solution!r}\nmargin      {self.margin}"

    def report(
        self,
        planner: str = "",
        why: str = "",
        record: Callable[[], Mapping[str, Any] | None] = lambda: None,
    ) -> Report:
        """Return the report of the solution, with a line for the margin.

        Args:
            planner: name of the planner.
            why: the reason if the planner was chosen by default.
            record: makes the record of the certificate for the data, see `record.record_of`.
        """
        of_solution = self.solution.report(planner, why, record)
        return of_solution.with_entry("margin", str(self.margin), margin=str(self.margin))

    @property
    def solved(self) -> bool:
        """Whether there is a certified path."""
        return self.solution.solved

    @property
    def path(self) -> JointPath | None:
        """The path, from the start to a goal; None without one."""
        return self.solution.path

    @cached_property
    def motion(self) -> Trajectory | None:
        """The certified motion along the path, computed when it is first read.

        None: no timing was asked for, or no path is certified. Raises InvalidInputError if the path
        cannot be timed, or no motion along it is certified.
        """
        from cvqmpt_lab.features.motion.motion_check import certified_motion  # half a second

        if self.request.timing is None or not self.solved or self.path is None:
            return None
        return certified_motion(self.solution.problem, self.path, self.request.timing)


def plan(problem: PlanningProblem, request: Request | None = None) -> Plan:
    """Plan a certified path, or a certified motion, with a margin for tracking error.

    Args:
        problem: the planning problem.
        request: planner, budget, margin, timing and more; None: the defaults.

    Raises:
        InvalidProblemError: the start, or every goal, collides or violates the constraint.
        InvalidInputError: the planner cannot solve the problem, or velocities at the ends do not
            fit it.
    """
    require_kind("problem", problem, PlanningProblem, PROBLEM_HINT)
    request = Request() if request is None else request
    require_kind("request", request, Request, "give Request(planner=..., budget=...)")
    run, timing = partial(_run, request), request.timing
    velocities = () if timing is None else (timing.start_velocity, timing.end_velocity)
    if timing is None or all(velocity is None for velocity in velocities):
        return Plan(request, *keep_margin(problem, request.margin, run))
    from cvqmpt_lab.features.motion.moving_ends import MovingEnds  # few motions have them

    ends = MovingEnds.of(problem, velocities, timing.speed)
    solution, margin = keep_margin(ends.between, request.margin, run)
    solution = ends.joined(solution, request.exact_clearance)
    if solution.path is not None:
        margin = kept_by(problem, solution.path, margin)
    return Plan(request, solution, margin)


def _run(request: Request, problem: PlanningProblem, goals: Goals | None, share: float) -> Solution:
    """Solve a problem with a share of the budget.

    Args:
        request: planner and settings.
        problem: the problem, or a tighter one.
        goals: its goals; None: they are drawn.
        share: of the budget.
    """
    return solve(
        problem,
        request.planner or default_planner(problem)[0],
        request.budget.share(share),
        request.seed,
        backend=request.backend,
        exact_clearance=request.exact_clearance,
        optimize=request.optimize,
        use_cache=request.use_cache,
        near_goals_first=request.near_goals_first,
        goals=goals,
    )
