"""From a task to motions: phase by phase, back to another grasp where a later phase has no solution."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.errors import InvalidInputError, InvalidProblemError
from cvqmpt_lab.pipeline import MAX_GOALS, Solution, solve
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.planner import Planner
from cvqmpt_lab.planning.result import Budget, Counters, Path, PlanResult, PlanStatus
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.exact_checker import CollisionChecker
from cvqmpt_lab.tasks.task import Move, PlannedPhase, Slide, Task, Turn
from cvqmpt_lab.tasks.world import World
from cvqmpt_lab.trajectory.timing import TimingSettings, time_path
from cvqmpt_lab.trajectory.trajectory import Trajectory

RETRIES = 10  # how often in all a task goes back to another grasp
DOOR_MARGIN = 5e-4  # [m] in place of SAMPLE_MARGIN with a door in the hand
GOALS = {Move: MAX_GOALS, Slide: 3, Turn: 10}  # sought; those of slides and turns differ only in posture
POSES = {Move: 100, Slide: 3, Turn: 25}  # of the end effector that are tried for them
GOALS_AHEAD = {Slide: 1, Turn: 5}  # a grasp that lets fewer be reached stands at a limit and may get stuck
POSES_AHEAD = {Slide: 1, Turn: 8}
FIRST_GOALS = {Slide: 8, Turn: 20}  # sought by the phase before, of which it needs ...
GRASPS = {Slide: 5, Turn: 2}  # ... so many from which the slide or turn has goals
REPEATED = 1e-8  # [rad] states that OMPL repeats cannot be timed
ANY_ROBOT = frozenset({"birrt", "guided-birrt", "ompl-projected", "atlas-rrt", "tb-rrt", "straight-line"})
NEEDS_CONSTRAINT = frozenset({"ompl-projected", "atlas-rrt", "tb-rrt"})


@dataclass(frozen=True, eq=False)
class PhaseOutcome:
    """What came of a planned phase.

    Attributes
    ----------
    world: before it. attempts: solutions one after another, the last one counts; after earlier ones the task
        went back to another grasp. trajectory: of the last one, when it is certified.
    instead: why another planner than the one asked for was used, or "".
    reason: why the phase failed, or "".
    """

    phase: PlannedPhase
    world: World
    attempts: tuple[Solution, ...]
    trajectory: Trajectory | None = None
    timing_seconds: float = 0.0
    instead: str = ""
    reason: str = ""

    @property
    def solution(self) -> Solution:
        """The last attempt."""
        return self.attempts[-1]

    @property
    def solved(self) -> bool:
        """Certified, and timed."""
        return self.solution.solved and self.trajectory is not None


@dataclass(frozen=True, eq=False)
class TaskSolution:
    """Outcomes of the planned phases in order, up to the first that failed; the world at the end."""

    task: Task
    outcomes: tuple[PhaseOutcome, ...]
    world: World

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
    planner: Planner,
    budget: Budget,
    seed: int,
    timing: TimingSettings | None = None,
    backend: str = "compiled",
    clearance: bool = True,
) -> TaskSolution:
    """Plan, certify and time every phase; `budget` is that of one planning run."""
    return _Run(task, planner, budget, seed, timing or TimingSettings(), backend, clearance).solve()


def suited(planner: Planner, problem: PlanningProblem) -> tuple[Planner, str]:
    """The planner, or tree growth with uniform samples where it cannot be used, and why.

    Models are trained on the arm alone, not on an arm with a door; OMPL's constrained spaces need a
    constraint (the paper's baselines also reach freely without one).
    """
    if planner.name not in ANY_ROBOT and "articulated" in problem.robot.source:
        return BiRRT(), f"birrt instead: {planner.name} is trained on the arm without a door"
    if planner.name in NEEDS_CONSTRAINT and not problem.constraint:
        return BiRRT(), f"birrt instead: {planner.name} needs a constraint"
    return planner, ""


@dataclass(eq=False)
class _Run:
    """One call of `solve_task`."""

    task: Task
    planner: Planner
    budget: Budget
    seed: int
    timing: TimingSettings
    backend: str
    clearance: bool
    retries: int = RETRIES
    runs: int = 0
    deepest: tuple[PhaseOutcome, ...] = field(default=())
    attempts: dict[int, tuple[Solution, ...]] = field(default_factory=dict)  # by phase, whatever came of them

    def solve(self) -> TaskSolution:
        found = self._from(0, World.before(self.task), ())
        if found is not None:
            return found
        return TaskSolution(self.task, self.deepest, self.deepest[-1].world)

    def _from(self, k: int, world: World, before: tuple[PhaseOutcome, ...]) -> TaskSolution | None:
        """Solve phases k, k + 1, ...; None when they have no solution from this world."""
        k, world = self._to_planned(k, world)
        if k == len(self.task.phases):
            return TaskSolution(self.task, before, world)
        phase = self._phase(k)
        goals, seconds, reason = self._goals(k, world)
        if len(goals) == 0 and isinstance(phase, Move):
            self.retries = 0  # where the arm comes from makes no difference to that
        ends = 0
        while True:
            outcome = self._planned(phase, world, goals, seconds, self.attempts.get(k, ()), reason)
            self.attempts[k], seconds = outcome.attempts, 0.0
            if not outcome.solved:
                if len(before) >= len(self.deepest):
                    self.deepest = (*before, outcome)
                return None
            end = outcome.solution.simplified.path.states[-1]  # type: ignore[union-attr]
            found = self._from(k + 1, world.moved(end), (*before, outcome))
            if found is not None or self.retries == 0:
                return found
            self.retries, ends = self.retries - 1, ends + 1
            goals = goals[np.abs(goals - end).max(axis=1) > 1e-6]
            reason = f"a later phase failed from each of the {ends} ends reached"

    def _to_planned(self, k: int, world: World) -> tuple[int, World]:
        """The next planned phase from k on, and the world before it."""
        phases = self.task.phases
        while k < len(phases) and not isinstance(phases[k], PlannedPhase):
            world = world.after(phases[k])
            k += 1
        return k, world

    def _phase(self, k: int) -> PlannedPhase:
        phase = self.task.phases[k]
        assert isinstance(phase, PlannedPhase)
        return phase

    def _goals(self, k: int, world: World) -> tuple[np.ndarray, float, str]:
        """Goals (m, n) of phase k from which the phase after it can begin, the seconds spent, why there are none."""
        phase = self._phase(k)
        problem = world.problem(self.task, phase)
        following = self._following(k)
        self._set_up(k, world, problem, following)
        began = time.perf_counter()
        count = FIRST_GOALS.get(type(following), GOALS[type(phase)])
        goals, reason = sampled_goals(problem, phase, count, POSES[type(phase)])
        if len(goals) and isinstance(following, Slide | Turn):
            wanted = GRASPS[type(following)]
            good: list[np.ndarray] = []
            for goal in goals:
                if len(good) < wanted and self._goes_on(k, world.moved(goal)):
                    good.append(goal)
            if not good:
                reason = f"none of {len(goals)} goals lets {following.name!r} reach its own"
            goals = np.array(good).reshape(-1, problem.robot.dof)
        return goals, time.perf_counter() - began, reason

    def _set_up(self, k: int, world: World, problem: PlanningProblem, following: PlannedPhase | None) -> None:
        """Build the checkers that sampling asks, which no time is charged for, as for planners' spaces."""
        _checker(problem)
        if isinstance(following, Turn) and isinstance(self.task.phases[k], Move):
            later, world = self._to_planned(k + 1, world)
            _checker(world.problem(self.task, self._phase(later)))

    def _following(self, k: int) -> PlannedPhase | None:
        """The planned phase after phase k."""
        return next((phase for phase in self.task.phases[k + 1 :] if isinstance(phase, PlannedPhase)), None)

    def _goes_on(self, k: int, world: World) -> bool:
        """Whether the slide or turn after phase k has goals from a world."""
        later, world = self._to_planned(k + 1, world)
        phase = self._phase(later)
        problem = world.problem(self.task, phase)
        if _checker(problem).in_collision(problem.start):
            return False
        needed, poses = GOALS_AHEAD[type(phase)], POSES_AHEAD[type(phase)]
        return len(sampled_goals(problem, phase, needed, poses)[0]) >= needed

    def _planned(
        self,
        phase: PlannedPhase,
        world: World,
        goals: np.ndarray,
        goal_seconds: float,
        earlier: tuple[Solution, ...],
        reason: str,
    ) -> PhaseOutcome:
        """One planning run, its certificate and its timing."""
        problem = world.problem(self.task, phase)
        if len(goals) == 0:
            return PhaseOutcome(
                phase, world, (*earlier, _nothing(problem, PlanStatus.NO_GOAL, goal_seconds)), reason=reason
            )
        planner, instead = suited(self.planner, problem)
        self.runs += 1
        seed = int(np.random.default_rng([self.seed, self.runs]).integers(2**32))
        try:
            solution = solve(
                problem.with_goals(goals),
                planner,
                self.budget,
                seed,
                backend=self.backend,
                clearance=self.clearance,
            )
        except InvalidProblemError as error:
            solution = _nothing(problem, PlanStatus.INVALID_START, goal_seconds)
            return PhaseOutcome(phase, world, (*earlier, solution), instead=instead, reason=str(error))
        attempts = (*earlier, replace(solution, goal_seconds=goal_seconds))
        if not solution.solved:
            return PhaseOutcome(phase, world, attempts, instead=instead, reason=_why(solution))
        began = time.perf_counter()
        try:
            trajectory = _timed(solution, self.timing)
        except InvalidInputError as error:
            return PhaseOutcome(phase, world, attempts, instead=instead, reason=f"not timed: {error}")
        seconds = time.perf_counter() - began
        return PhaseOutcome(phase, world, attempts, trajectory, seconds, instead)


def sampled_goals(
    problem: PlanningProblem, phase: PlannedPhase, count: int, poses: int
) -> tuple[np.ndarray, str]:
    """Up to count goal configurations (m, n) of a phase's problem, and why there are none, or "".

    The draw depends on the start alone. Slides and turns get goals in a posture like the start's: others
    could only be reached by letting go.
    """
    assert problem.goal_region is not None
    rng = np.random.default_rng(np.abs(problem.start * 1e6).astype(np.uint64))
    near = None if isinstance(phase, Move) else problem.start
    found = sample_region(
        problem.robot,
        problem.goal_region,
        _checker(problem),
        rng,
        count,
        max_poses=poses,
        within=problem.constraint if isinstance(phase, Turn) else (),
        near=near,
    )
    if len(found.configurations):
        return found.configurations, ""
    return found.configurations, (
        f"no goal: of {found.poses_tried} poses, {found.unreachable} without inverse kinematics, "
        f"{found.colliding} in collision"
    )


def _checker(problem: PlanningProblem) -> CollisionChecker:
    """The one that starts and goals are drawn with; a closed door is only 1 mm from its neighbour."""
    return problem.collision_checker(DOOR_MARGIN if "articulated" in problem.robot.source else SAMPLE_MARGIN)


def _timed(solution: Solution, settings: TimingSettings) -> Trajectory:
    """The certified path in time; its rounded corners are certified too."""
    assert solution.simplified is not None
    problem, states = solution.problem, solution.simplified.path.states
    steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
    return time_path(
        states[np.append(True, steps > REPEATED)],
        problem.robot.joint_limits,
        settings,
        _certifier(problem),
    )


def _certifier(problem: PlanningProblem) -> Callable[[np.ndarray], Sequence[str]]:
    return lambda states: certify(problem, Path(states), clearance=False).reasons


def _nothing(problem: PlanningProblem, status: PlanStatus, goal_seconds: float) -> Solution:
    plan = PlanResult(status, None, 0.0, Counters(), 0, "none")
    return Solution(problem, plan, None, None, goal_seconds)


def _why(solution: Solution) -> str:
    """Why a planning run brought no certified path."""
    if solution.certificate is not None:
        return "; ".join(solution.certificate.reasons)
    return solution.plan.detail or str(solution.plan.status)
