"""Plan the phases of a task in order, by depth-first search over the goals of each planned phase.

If a phase fails, go back to the phase before, remove the goal reached and plan to another one.
Slides and turns, impossible from some grasps, get a small share of the budget first, and all of it
if all grasps fail.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    InvalidProblemError,
    require_kind,
    whole_number,
)
from cvqmpt_lab.certificate.motion_check import certified_motion
from cvqmpt_lab.planning.margins import NO_MARGIN, Margin, solve_with_margin
from cvqmpt_lab.planning.pipeline import Solution, no_plan
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.planning.solution_report import solution_data
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.tasks.task import Move, Phase, PlannedPhase, Task
from cvqmpt_lab.tasks.world import World, phase_goals, prepare
from cvqmpt_lab.trajectory.timing import TimingSettings
from cvqmpt_lab.trajectory.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class PhaseOutcome:
    """The result of a planned phase."""

    phase: PlannedPhase
    world: World  # before the phase
    attempts: tuple[Solution, ...]  # in order; the last one counts
    trajectory: Trajectory | None = None  # of the last attempt, if it is certified
    margin: str = ""  # that it was planned with, and why not more
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
        return replace(
            whole,
            joint_names=whole.joint_names[:n],
            positions=whole.positions[:, :n],
            velocities=whole.velocities[:, :n],
            accelerations=whole.accelerations[:, :n],
        )

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
        planned = len(self.task.planned)
        return len(self.outcomes) == planned and all(outcome.solved for outcome in self.outcomes)

    @property
    def failure(self) -> str:
        """The phase that failed and why, or ""."""
        last = self.outcomes[-1]
        return "" if last.solved else f"phase {last.phase.name!r}: {last.reason}"

    @property
    def steps(self) -> Iterator[tuple[Phase, PhaseOutcome | None]]:
        """The phases in order, planned ones with their outcome, up to the one that failed."""
        outcomes = {outcome.phase.name: outcome for outcome in self.outcomes}
        for phase in self.task.phases:
            if isinstance(phase, PlannedPhase) and phase.name not in outcomes:
                return
            yield phase, outcomes.get(phase.name)


def solve_task(
    task: Task,
    method: Method | str,
    budget: Budget,
    seed: int,
    timing: TimingSettings | None = None,
    backend: str = "compiled",
    margin: Margin = NO_MARGIN,
) -> TaskSolution:
    """Plan, certify and time every phase.

    Args:
        task: a move that goes through regions is planned in legs, and stops between them; the
            solution's task has them as phases.
        method: planner; birrt plans phases that it cannot serve.
        budget: of one planning run.
        seed: of all randomness.
        timing: speed of the motions.
        backend: of collision checks, see `pipeline.solve`.
        margin: of every phase, as far as its start and goals allow it.
    """
    require_kind("task", task, Task, "Task.load(path) reads a file; a PlanningProblem is for solve")
    Budget.require(budget)
    seed = whole_number("seed", seed)
    method = planner_named(method) if isinstance(method, str) else method
    require_kind("method", method, Method, "or the name of a planner")
    timing = timing or TimingSettings()
    legs = (phase.legs if isinstance(phase, Move) else (phase,) for phase in task.phases)
    task = task.changed(phases=tuple(leg for several in legs for leg in several))
    return _Run(task, method, budget, seed, timing, backend, margin.check()).solve()


@dataclass(eq=False)
class _Step:
    """A planned phase and the goals that it has left."""

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
        assert self.outcome is not None and self.outcome.solution.path is not None
        return self.outcome.solution.path.states[-1]


@dataclass(eq=False)
class _Run:
    """One call of `solve_task`."""

    task: Task
    method: Method
    budget: Budget
    seed: int
    timing: TimingSettings
    backend: str
    margin: Margin
    retries: int = 0  # times that it may still go back to another goal
    runs: int = 0
    cut_short: bool = False  # whether a run failed with a share of the budget
    attempts: dict[str, tuple[Solution, ...]] = field(default_factory=dict)  # by name of phase

    def solve(self) -> TaskSolution:
        """With little for slides and turns, then with the whole budget if one of them failed."""
        # of 10 s: slides of tasks 100 to 124 take birrt, roadmap or ompl-projected up to 0.24 s
        found = self._search(0.02)
        return found if found.solved or not self.cut_short else self._search(1.0)

    def _search(self, share: float) -> TaskSolution:
        """Plan the next phase, or go back after a failure; share: of budget, slides and turns."""
        self.retries = 10
        steps = [self._step(0, World.before(self.task))]
        deepest: tuple[PhaseOutcome, ...] = ()
        while True:
            step = steps[-1]
            first_or_move = len(steps) == 1 or isinstance(step.phase, Move)
            step.outcome = self._planned(step, 1.0 if first_or_move else share)
            outcomes = tuple(planned.outcome for planned in steps if planned.outcome)
            if len(outcomes) > len(deepest):
                deepest = outcomes
            if step.outcome.solved:
                world = step.world.moved(step.end)
                if len(steps) == len(self.task.planned):
                    last = self.task.phases.index(step.phase)
                    # the hand's, after the last planned one
                    rest = (
                        p for p in self.task.phases[last + 1 :] if not isinstance(p, PlannedPhase)
                    )
                    return TaskSolution(self.task, outcomes, world.through(rest))
                steps.append(self._step(len(steps), world))
                continue
            if len(steps) == 1 or self.retries == 0:
                return TaskSolution(self.task, deepest, deepest[-1].world)
            self.retries -= 1
            steps.pop()
            step = steps[-1]
            step.ends += 1
            step.goals = step.goals[np.abs(step.goals - step.end).max(axis=1) > 1e-6]
            step.reason = f"a later phase failed from each of the {step.ends} ends reached"

    def _step(self, k: int, world: World) -> _Step:
        """Planned phase k with its goals, from the world after the planned phase before it."""
        hand, phase = self.task.planned[k]
        world = world.through(hand)
        prepare(self.task, k, world)
        began = time.perf_counter()
        goals, reason = phase_goals(self.task, k, world)
        if len(goals) == 0 and isinstance(phase, Move):
            # another start of the move would not change that
            self.retries = 0
        return _Step(phase, world, goals, time.perf_counter() - began, reason)

    def _planned(self, step: _Step, share: float) -> PhaseOutcome:
        """One planning run to the goals left, its certificate and its timing."""
        problem = step.world.problem(self.task, step.phase)
        incompatible = self.method.incompatibility(problem)
        fallback = f"birrt: {incompatible}" if incompatible else ""
        reason, margin = step.reason, ""
        if len(step.goals) == 0:
            solution = Solution(problem, no_plan(PlanStatus.NO_GOAL))
            reason = "; ".join(filter(None, (reason, problem.why_no_goal())))
        else:
            self.runs += 1
            try:
                # each phase must observe its own world, so not from the cache
                solution, margin = solve_with_margin(
                    problem.changed(goals=step.goals),
                    "birrt" if incompatible else self.method,
                    self.budget.share(share),
                    int(np.random.default_rng([self.seed, self.runs]).integers(2**32)),
                    self.margin,
                    backend=self.backend,
                    use_cache=False,
                )
                reason = "" if solution.solved else _why(solution)
                self.cut_short |= not solution.solved and share < 1.0
            except InvalidProblemError as error:
                solution, reason = Solution(problem, no_plan(PlanStatus.INVALID_START)), str(error)
        solution = replace(solution, goal_seconds=step.goal_seconds)
        step.goal_seconds = 0.0
        name = step.phase.name
        attempts = self.attempts[name] = (*self.attempts.get(name, ()), solution)
        outcome = PhaseOutcome(
            step.phase, step.world, attempts, margin=margin, fallback=fallback, reason=reason
        )
        if not solution.solved or solution.path is None:
            return outcome
        try:
            motion = certified_motion(solution.problem, solution.path, self.timing)
        except InvalidInputError as error:
            return replace(outcome, reason=f"not timed: {error}")
        return replace(outcome, trajectory=motion)


def _why(solution: Solution) -> str:
    """Why a planning run has no certified path."""
    if solution.certificate is not None:
        return "; ".join(solution.certificate.reasons)
    return solution.plan.detail or str(solution.plan.status)


def event_of(phase: Phase) -> dict[str, Any]:
    """Name and kind of a phase, and what the gripper does in it."""
    plain = to_plain(phase, Phase)
    told = ("kind", "articulation", "object", "gripper")
    return {"phase": phase.name, **{key: plain[key] for key in told if key in plain}}


def task_data(solution: TaskSolution, planner: str) -> dict[str, Any]:
    """Plain data for json: the phases in order, planned ones as `solution_data` has them."""
    phases = []
    for phase, outcome in solution.steps:
        said = event_of(phase)
        if outcome is not None:
            seconds = outcome.trajectory and outcome.trajectory.duration
            more = {
                "attempts": len(outcome.attempts),
                "duration_s": seconds,
                "margin": outcome.margin,
                "reason": outcome.reason,
            }
            said |= more | solution_data(outcome.solution, planner)
            said |= {"solved": outcome.solved, "fallback": outcome.fallback or said["fallback"]}
        phases.append(said)
    whole = {"task": solution.task.name, "planner": planner, "solved": solution.solved}
    return {**whole, "failure": solution.failure, "phases": phases}


def task_lines(solution: TaskSolution, planner: str) -> list[str]:
    """The lines a person reads."""
    lines = [f"task        {solution.task.name}, planner {planner}"]
    planning = execution = 0.0
    for outcome in solution.outcomes:
        goals = sum(attempt.goal_seconds for attempt in outcome.attempts)
        search = sum(attempt.plan.seconds for attempt in outcome.attempts)
        simplify = sum(
            attempt.simplified.seconds for attempt in outcome.attempts if attempt.simplified
        )
        planning += goals + search + simplify
        line = (
            f"{outcome.phase.name:15} goals {1e3 * goals:.0f} ms, plan {1e3 * search:.0f} ms, "
            f"simplify {1e3 * simplify:.0f} ms"
        )
        if len(outcome.attempts) > 1:
            line += f" in {len(outcome.attempts)} attempts"
        if outcome.trajectory is not None:
            execution += outcome.trajectory.duration
            line += f", certified, {outcome.trajectory.duration:.1f} s of motion"
        lines.append(line + (f" ({outcome.fallback})" if outcome.fallback else ""))
    if solution.solved:
        return [*lines, f"solved      planning {planning:.2f} s, execution {execution:.1f} s"]
    return [*lines, f"FAILED      {solution.failure}"]
