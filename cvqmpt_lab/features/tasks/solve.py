"""Plan the phases of a task in order, by depth-first search over the goals of each planned phase.

If a phase fails, the search returns to the phase before it, removes the goal that was reached, and
plans to another one. Slides and turns are impossible from some grasps. They get a small share of
the budget first, and the whole budget if they fail from all grasps.
"""

import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    InvalidProblemError,
    require_kind,
    whole_number,
)
from cvqmpt_lab.base.reports import Report
from cvqmpt_lab.features.motion.record import record_of
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.motion.trajectory import Trajectory
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.features.tasks.task import Move, Phase, PlannedPhase, Task
from cvqmpt_lab.features.tasks.world import World, phase_goals, prepare
from cvqmpt_lab.planning.margins import NO_MARGIN, Margin
from cvqmpt_lab.planning.pipeline import no_plan
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.usable import why_no_goal
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.result import Budget, PlanStatus


@dataclass(frozen=True, eq=False)
class PhaseOutcome:
    """Result of a planned phase."""

    phase: PlannedPhase
    world: World  # before the phase
    attempts: tuple[Solution, ...]  # in order; the last one counts
    # timed path of the last attempt; None: the attempt is not certified or not timed
    trajectory: Trajectory | None = None
    margin: str = ""  # margin of the plan, and why it is not larger
    fallback: str = ""  # planner used instead of the chosen one and the reason, or ""
    reason: str = ""  # reason of the failure, or ""

    @property
    def solution(self) -> Solution:
        """The last attempt."""
        return self.attempts[-1]

    @property
    def arm_trajectory(self) -> Trajectory | None:
        """The trajectory of the arm's own joints, without the joint of a door in the hand."""
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
        """Whether the phase has a certified path and a trajectory."""
        return self.solution.solved and self.trajectory is not None


@dataclass(frozen=True, eq=False)
class TaskSolution:
    """Result of a task."""

    task: Task
    # results of the planned phases in order, up to one that failed
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
        """Whether every planned phase is solved."""
        planned = len(self.task.planned)
        return len(self.outcomes) == planned and all(outcome.solved for outcome in self.outcomes)

    @property
    def failure(self) -> str:
        """The phase that failed and the reason, or "" if the task is solved."""
        last = self.outcomes[-1]
        return "" if last.solved else f"phase {last.phase.name!r}: {last.reason}"

    @property
    def steps(self) -> Iterator[tuple[Phase, PhaseOutcome | None]]:
        """Phases in order, planned ones with their outcomes, up to the one that failed."""
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
    """Plan, certify and time every phase of a task.

    Args:
        task: the task. A move through regions becomes several moves, with stops between them; the
            solution's task has these as phases.
        method: planner or its name; birrt plans the phases with which it is incompatible.
        budget: budget of one planning run.
        seed: seed of all random numbers, with the names of task and phases, see `phase_seed`.
        timing: speed and corner deviation of the motions; None: the defaults.
        backend: collision checks of the search, see `pipeline.solve`.
        margin: margin of every phase, reduced if its start or goals do not allow it.
    """
    require_kind("task", task, Task, "Task.load(path) reads a file; a PlanningProblem is for solve")
    Budget.require(budget)
    seed = whole_number("seed", seed)
    method = planner_named(method) if isinstance(method, str) else method
    require_kind("method", method, Method, "or the name of a planner")
    timing = timing or TimingSettings()
    return _Run(task.in_legs, method, budget, seed, timing, backend, margin.check()).solve()


def phase_seed(seed: int, task: str, phase: str, tried: int = 0) -> int:
    """Return the seed of one planning run, which no other task, phase or attempt has.

    Args:
        seed: seed of the task's run.
        task: name of the task.
        phase: name of the phase.
        tried: number of earlier attempts to plan the phase.
    """
    key = hashlib.sha256(f"{task}/{phase}".encode()).digest()
    stream = np.random.default_rng([seed, tried, *np.frombuffer(key, "<u4")])
    return int(stream.integers(2**53))


@dataclass(eq=False)
class _Step:
    """A planned phase and its remaining goals."""

    phase: PlannedPhase
    world: World  # before the phase
    goals: np.ndarray  # (k, n) remaining goals [rad or m]
    goal_seconds: float  # time of goal sampling [s]; 0 once it is part of an attempt
    reason: str  # why there are no goals, or ""
    ends: int = 0  # number of goals that were removed because a later phase failed
    outcome: PhaseOutcome | None = None

    @property
    def end(self) -> np.ndarray:
        """End (n,) of its last path [rad or m]."""
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
    retries: int = 0  # remaining number of returns to an earlier phase
    cut_short: bool = False  # whether a run with a share of the budget failed
    attempts: dict[str, tuple[Solution, ...]] = field(default_factory=dict)  # by name of phase

    def solve(self) -> TaskSolution:
        """Search with a small budget for slides and turns; if one failed, search with all of it."""
        # birrt, roadmap and ompl-projected need at most 0.24 s for slides of tasks 100 to 124
        found = self._search(0.02)
        return found if found.solved or not self.cut_short else self._search(1.0)

    def _search(self, share: float) -> TaskSolution:
        """Plan phase after phase; after a failure return to the phase before.

        share: share of the budget for slides and turns.
        """
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
                    hand_phases = (
                        phase
                        for phase in self.task.phases[last + 1 :]
                        if not isinstance(phase, PlannedPhase)
                    )
                    return TaskSolution(self.task, outcomes, world.through(hand_phases))
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
        """Sample goals of planned phase k, which begins in `world` after its hand phases."""
        hand, phase = self.task.planned[k]
        world = world.through(hand)
        prepare(self.task, k, world)
        began = time.perf_counter()
        goals, reason = phase_goals(self.task, k, world)
        if len(goals) == 0 and isinstance(phase, Move):
            # from another start, or with more time, the move would have no goals either
            self.retries, self.cut_short = 0, False
        return _Step(phase, world, goals, time.perf_counter() - began, reason)

    def _planned(self, step: _Step, share: float) -> PhaseOutcome:
        """Plan to the remaining goals with a share of the budget, certify and time the path."""
        problem = step.world.problem(self.task, step.phase)
        incompatible = self.method.incompatibility(problem)
        fallback = f"birrt: {incompatible}" if incompatible else ""
        reason, planned = step.reason, None
        if len(step.goals) == 0:
            solution = Solution(problem, no_plan(PlanStatus.NO_GOAL))
            reason = "; ".join(filter(None, (reason, why_no_goal(problem))))
        else:
            tried = len(self.attempts.get(step.phase.name, ()))
            try:
                request = Request(
                    "birrt" if incompatible else self.method,
                    self.budget.share(share),
                    phase_seed(self.seed, self.task.name, step.phase.name, tried),
                    self.margin,
                    timing=self.timing,
                    backend=self.backend,
                    exact_clearance=True,
                    use_cache=False,  # each phase observes another scene
                )
                planned = plan(problem.changed(goals=step.goals), request)
                solution = planned.solution
                reason = "" if solution.solved else _why(solution)
                self.cut_short |= not solution.solved and share < 1.0
            except InvalidProblemError as error:
                solution, reason = Solution(problem, no_plan(PlanStatus.INVALID_START)), str(error)
        solution = replace(solution, goal_seconds=step.goal_seconds)
        step.goal_seconds = 0.0
        name = step.phase.name
        attempts = self.attempts[name] = (*self.attempts.get(name, ()), solution)
        margin = "" if planned is None else str(planned.margin)
        outcome = PhaseOutcome(
            step.phase, step.world, attempts, margin=margin, fallback=fallback, reason=reason
        )
        try:
            return replace(outcome, trajectory=None if planned is None else planned.motion)
        except InvalidInputError as error:
            return replace(outcome, reason=f"not timed: {error}")


def _why(solution: Solution) -> str:
    """Reason why a planning run has no certified path."""
    if solution.certificate is not None:
        return "; ".join(solution.certificate.reasons)
    return solution.plan.detail or str(solution.plan.status)


def event_of(phase: Phase) -> dict[str, Any]:
    """Name and kind of a phase, and the fields about its gripper, as plain data for json."""
    plain = to_plain(phase, Phase)
    keys = ("kind", "articulation", "object", "gripper")
    return {"phase": phase.name, **{key: plain[key] for key in keys if key in plain}}


def _data(solution: TaskSolution, planner: str) -> dict[str, Any]:
    """Plain data for json: the phases in order, planned ones with their data."""
    phases = []
    for phase, outcome in solution.steps:
        data = event_of(phase)
        if outcome is not None:
            data |= {
                "attempts": len(outcome.attempts),
                "duration_s": outcome.trajectory and outcome.trajectory.duration,
                "margin": outcome.margin,
                "reason": outcome.reason,
            }
            own = outcome.solution.report(planner, record=partial(record_of, outcome.solution))
            data |= own.data
            data |= {"solved": outcome.solved, "fallback": outcome.fallback or data["fallback"]}
        phases.append(data)
    return {
        "task": solution.task.name,
        "planner": planner,
        "solved": solution.solved,
        "failure": solution.failure,
        "phases": phases,
    }


def task_report(solution: TaskSolution, planner: str, speed: float = 1.0) -> Report:
    """Return the report of a task; speed: fraction of the joint limits, for the lines."""
    at_speed = f"at {speed:g} of the limits"
    lines = [("task", f"{solution.task.name}, planner {planner}")]
    planning = execution = 0.0
    for outcome in solution.outcomes:
        goals = sum(attempt.goal_seconds for attempt in outcome.attempts)
        search = sum(attempt.plan.seconds for attempt in outcome.attempts)
        simplify = sum(
            attempt.simplified.seconds for attempt in outcome.attempts if attempt.simplified
        )
        planning += goals + search + simplify
        line = (
            f"goals {1e3 * goals:.0f} ms, plan {1e3 * search:.0f} ms, "
            f"simplify {1e3 * simplify:.0f} ms"
        )
        if len(outcome.attempts) > 1:
            line += f" in {len(outcome.attempts)} attempts"
        if outcome.trajectory is not None:
            execution += outcome.trajectory.duration
            line += f", certified, {outcome.trajectory.duration:.1f} s of motion {at_speed}"
            line += f", margin {outcome.margin}"
        line += f" ({outcome.fallback})" if outcome.fallback else ""
        lines.append((f"{outcome.phase.name:15} ", line))
    if solution.solved:
        lines += [
            ("solved", f"planning {planning:.2f} s, execution {execution:.1f} s {at_speed}"),
        ]
    else:
        lines.append(("FAILED", solution.failure))
    return Report.of(lines, partial(_data, solution, planner))
