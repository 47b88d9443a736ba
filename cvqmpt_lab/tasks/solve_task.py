"""Plan the phases of a task in order, by depth-first search over the goals of each planned phase.

If a phase fails, go back to the phase before, remove the goal reached and plan to another one. A
slide or a turn is easy from most grasps and impossible from some: it gets `FIRST_SHARE` of the
budget, and the whole if all grasps fail.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, InvalidProblemError, require_kind, whole_number
from cvqmpt_lab.motion_check import certified_motion
from cvqmpt_lab.pipeline import Solution, no_plan, solve
from cvqmpt_lab.planners import Method, planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.tasks.phase_goals import following, phase_goals, prepare, world_before
from cvqmpt_lab.tasks.task import Move, PlannedPhase, Task
from cvqmpt_lab.tasks.world import World
from cvqmpt_lab.trajectory.timing import TimingSettings
from cvqmpt_lab.trajectory.trajectory import Trajectory

# of 10 s: slides of tasks 100 to 124 that birrt, roadmap or ompl-projected finds take up to 0.24 s
FIRST_SHARE = 0.02
RETRIES = 10  # times that a task goes back to another goal
SUBSTITUTE = "birrt"  # plans phases that the planner asked for cannot


@dataclass(frozen=True, eq=False)
class PhaseOutcome:
    """The result of a planned phase."""

    phase: PlannedPhase
    world: World  # before the phase
    attempts: tuple[Solution, ...]  # in order; the last one counts
    trajectory: Trajectory | None = None  # of the last attempt, if it is certified
    timing_seconds: float = 0.0
    fallback: str = ""  # why another planner than the one asked for was used, or ""
    reason: str = ""  # why the phase failed, or ""

    @property
    def solution(self) -> Solution:
        """The last attempt."""
        return self.attempts[-1]

    @property
    def arm_trajectory(self) -> Trajectory | None:
        """The trajectory of the arm's own joints, without that of a door in the hand."""
        whole, n = self.trajectory, self.world.arm.dof
        if whole is None:
            return None
        arrays = (whole.positions[:, :n], whole.velocities[:, :n], whole.accelerations[:, :n])
        return Trajectory(whole.joint_names[:n], whole.times, *arrays, deviation=whole.deviation)

    @property
    def solved(self) -> bool:
        """Certified, and timed."""
        return self.solution.solved and self.trajectory is not None


@dataclass(frozen=True, eq=False)
class TaskSolution:
    """The result of a task."""

    task: Task
    # of the planned phases in order, up to the first that failed
    outcomes: tuple[PhaseOutcome, ...]
    world: World  # at the end

    def __repr__(self) -> str:
        timed = [outcome.trajectory.duration for outcome in self.outcomes if outcome.trajectory]
        ended = f"solved, {sum(timed):.1f} s of motion" if self.solved else self.failure
        return (
            f"TaskSolution of {self.task.name!r}: {ended}\nphases      {len(timed)} planned "
            f"and certified"
        )

    @property
    def solved(self) -> bool:
        """Every phase certified."""
        planned = sum(isinstance(phase, PlannedPhase) for phase in self.task.phases)
        return len(self.outcomes) == planned and all(outcome.solved for outcome in self.outcomes)

    @property
    def failure(self) -> str:
        """The phase that failed and why, or ""."""
        last = self.outcomes[-1]
        return "" if last.solved else f"phase {last.phase.name!r}: {last.reason}"


def solve_task(
    task: Task,
    method: Method | str,
    budget: Budget,
    seed: int,
    timing: TimingSettings | None = None,
    backend: str = "compiled",
) -> TaskSolution:
    """Plan, certify and time every phase; `budget` is that of one planning run.

    A move that goes through regions is planned in legs, and stops between them; the solution's task
    has them as phases.
    """
    require_kind("task", task, Task, "Task.load(path) reads a file; a PlanningProblem is for solve")
    Budget.require(budget)
    seed = whole_number("seed", seed)
    method = planner_named(method) if isinstance(method, str) else method
    require_kind("method", method, Method, "or the name of a planner")
    return _Run(task.in_legs, method, budget, seed, timing or TimingSettings(), backend).solve()


@dataclass(eq=False)
class _Step:
    """A planned phase and the goals that it has left."""

    number: int
    phase: PlannedPhase
    world: World
    goals: np.ndarray  # (k, n) [rad or m]
    goal_seconds: float  # of sampling, until an attempt has counted it
    reason: str
    ends: int = 0
    outcome: PhaseOutcome | None = None

    @property
    def end(self) -> np.ndarray:
        """The end of its last path (n,)."""
        assert self.outcome is not None and self.outcome.solution.simplified is not None
        return self.outcome.solution.simplified.path.states[-1]

    def discard_end(self) -> None:
        """Remove the goal reached."""
        self.ends += 1
        self.goals = self.goals[np.abs(self.goals - self.end).max(axis=1) > 1e-6]
        self.reason = f"a later phase failed from each of the {self.ends} ends reached"


@dataclass(eq=False)
class _Run:
    """One call of `solve_task`."""

    task: Task
    method: Method
    budget: Budget
    seed: int
    timing: TimingSettings
    backend: str
    retries: int = RETRIES
    runs: int = 0
    cut_short: bool = False  # whether a run failed with a share of the budget
    attempts: dict[int, tuple[Solution, ...]] = field(default_factory=dict)  # by number of phase

    def solve(self) -> TaskSolution:
        """With little for slides and turns, then with the whole budget if one of them failed."""
        found = self._search(FIRST_SHARE)
        if found.solved or not self.cut_short:
            return found
        self.retries = RETRIES
        return self._search(1.0)

    def _search(self, share: float) -> TaskSolution:
        """Go to the next phase when one is solved, back when it is not; share:
        of the budget, for slides and turns.
        """
        step = self._step(0, World.before(self.task))
        assert step is not None  # a task has a planned phase
        done: list[_Step] = []
        deepest: tuple[PhaseOutcome, ...] = ()
        while True:
            outcome = step.outcome = self._planned(
                step, share if done and not isinstance(step.phase, Move) else 1.0
            )
            outcomes = (*(earlier.outcome for earlier in done if earlier.outcome), outcome)
            if outcome.solved:
                done.append(step)
                world = step.world.moved(step.end)
                ahead = self._step(step.number + 1, world)
                if ahead is None:
                    rest = world_before(self.task, world, step.number + 1, len(self.task.phases))
                    return TaskSolution(self.task, outcomes, rest)
                step = ahead
                continue
            if len(outcomes) > len(deepest):
                deepest = outcomes
            if not done or self.retries == 0:
                return TaskSolution(self.task, deepest, deepest[-1].world)
            self.retries -= 1
            step = done.pop()
            step.discard_end()

    def _step(self, k: int, world: World) -> _Step | None:
        """The first planned phase from k on with its goals; None if there is none."""
        found = following(self.task, k)
        if found is None:
            return None
        number, phase = found
        world = world_before(self.task, world, k, number)
        prepare(self.task, number, world)
        began = time.perf_counter()
        goals = phase_goals(self.task, number, world)
        if len(goals.configurations) == 0 and isinstance(phase, Move):
            self.retries = 0  # another start of the move would not change that
        seconds = time.perf_counter() - began
        return _Step(number, phase, world, goals.configurations, seconds, goals.reason)

    def _planned(self, step: _Step, share: float) -> PhaseOutcome:
        """One planning run to the goals left, its certificate and its timing."""
        problem = step.world.problem(self.task, step.phase)
        earlier, seconds = self.attempts.get(step.number, ()), step.goal_seconds
        step.goal_seconds = 0.0
        incompatible = self.method.incompatibility(problem)
        fallback = f"{SUBSTITUTE}: {incompatible}" if incompatible else ""
        reason = step.reason
        if len(step.goals) == 0:
            solution = Solution(problem, no_plan(PlanStatus.NO_GOAL))
            reason = "; ".join(filter(None, (reason, problem.why_no_goal())))
        else:
            try:
                solution = self._solve(problem.with_goals(step.goals), fallback, share)
                reason = "" if solution.solved else _why(solution)
                self.cut_short |= not solution.solved and share < 1.0
            except InvalidProblemError as error:
                solution, reason = Solution(problem, no_plan(PlanStatus.INVALID_START)), str(error)
        attempts = self.attempts[step.number] = (*earlier, replace(solution, goal_seconds=seconds))
        outcome = PhaseOutcome(step.phase, step.world, attempts, fallback=fallback, reason=reason)
        return self._timed(outcome) if solution.solved else outcome

    def _solve(self, problem: PlanningProblem, fallback: str, share: float) -> Solution:
        self.runs += 1
        seed = int(np.random.default_rng([self.seed, self.runs]).integers(2**32))
        method = SUBSTITUTE if fallback else self.method
        # Without the cache: each phase must observe its own world, also if an equal one was
        # observed before.
        return solve(
            problem, method, self.budget.share(share), seed, backend=self.backend, use_cache=False
        )

    def _timed(self, outcome: PhaseOutcome) -> PhaseOutcome:
        """The outcome with its trajectory, whose rounded corners are certified too, or why there is
        none.
        """
        assert outcome.solution.simplified is not None
        began = time.perf_counter()
        try:
            trajectory = certified_motion(
                outcome.solution.problem, outcome.solution.simplified.path, self.timing
            )
        except InvalidInputError as error:
            return replace(outcome, reason=f"not timed: {error}")
        return replace(outcome, trajectory=trajectory, timing_seconds=time.perf_counter() - began)


def _why(solution: Solution) -> str:
    """Why a planning run has no certified path."""
    if solution.certificate is not None:
        return "; ".join(solution.certificate.reasons)
    return solution.plan.detail or str(solution.plan.status)
