"""Run planners over a suite, in parallel and resumable; every outcome gives rows.

A problem gives one row, a task one for each planned phase.
"""

import os
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base import arithmetic
from cvqmpt_lab.base.caches import sources_digest
from cvqmpt_lab.base.errors import CvqmptError, whole_number
from cvqmpt_lab.benchmarks.item import (
    ExecutedProblem,
    Phases,
    SensedProblem,
    SuiteItem,
    UnsolvableProblem,
)
from cvqmpt_lab.benchmarks.results.provenance import STREAMS, provenance
from cvqmpt_lab.benchmarks.results.row import (
    ROW_COLUMNS,
    FailReason,
    ResultRow,
    cell_text,
    phase_problem,
)
from cvqmpt_lab.benchmarks.results.store import RunStore, states_hash
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.certificate.certificate import Clearance, FaultKind, certify
from cvqmpt_lab.constraints.goals import Goals, goals_of
from cvqmpt_lab.experiments.executors import Executor, Lost, dask_cluster, local_processes
from cvqmpt_lab.experiments.experiment import Experiment, Run, externals_of, weights_of
from cvqmpt_lab.external.door import external_planner
from cvqmpt_lab.features.motion.motion_check import timed_motion
from cvqmpt_lab.features.tasks.solve import PhaseOutcome, TaskSolution, phase_seed, solve_task
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.warm_up import compile_kernels
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget, Counters, JointPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice


class Outcome(NamedTuple):
    """Rows and paths of a run that are stored."""

    rows: list[ResultRow]  # one, or one a planned phase
    # states (m, n) of the paths whose hashes stand in the rows [rad or m]
    paths: Sequence[np.ndarray] = ()


def outcome_of(run: Run, item: SuiteItem, goals: Goals | None = None) -> Outcome:
    """Solve an item; the seconds spent on the goals of a problem are charged to the planner.

    The path of a problem in a map is also judged in the mapped scene.
    """
    setup = run.experiment
    if isinstance(item, UnsolvableProblem):
        return Outcome(failed_rows(run, item, item.kind, item.reason))
    if isinstance(item, ExecutedProblem):
        from cvqmpt_lab.experiments.executed import execution_rows  # other suites need no physics

        return Outcome(execution_rows(run, item))
    if isinstance(item, Task):
        task = solve_task(item, run.method, setup.budget, run.seed, backend=setup.backend)
        return Outcome(
            phase_rows(run, task), _states([outcome.solution for outcome in task.outcomes])
        )
    if isinstance(item, Phases):
        return _planned_apart(run, item)
    began, new = time.perf_counter(), suite_named(setup.suite).new_scenes
    solution = solve(
        item.problem if isinstance(item, SensedProblem) else item,
        run.method,
        setup.budget,
        run.seed,
        backend=setup.backend,
        optimize=setup.optimize,
        use_cache=not new,
        goals=goals,
        exact_clearance=True,
    )
    row = result_row(run, solution, 0.0 if goals is None else goals.seconds)
    if solution.plan.waypoints is not None and suite_named(setup.suite).simplified_by_ompl:
        row = replace(row, path_length_ompl_rad=_simplified_by_ompl(solution)[0].length)
    if isinstance(item, SensedProblem):
        whole = item.seconds + time.perf_counter() - began
        row = replace(row, t_sense_s=item.seconds, t_whole_s=whole)
        if solution.path is not None:
            problem = replace(item.problem, scene=item.truth)
            truth = certify(problem, solution.path, exact_clearance=True)
            doubts = {FaultKind.COLLISION, FaultKind.NOT_PROVEN} & {
                fault.kind for fault in truth.faults
            }
            row = replace(
                row, true_free=not doubts, true_clearance_m=_defined(truth.min_clearance_m)
            )
    return Outcome([replace(row, scene_new=new)], _states([solution]))


def _simplified_by_ompl(solution: Solution) -> tuple[JointPath, Counters]:
    """Return a path of OMPL after OMPL's simplification, and the work of that."""
    from cvqmpt_lab.search.ompl_planners import simplified_by_ompl  # ompl takes 0.3 s to import

    assert solution.plan.waypoints is not None
    space = ConstrainedSpace.of(solution.problem, ends=solution.problem.start[None])
    return simplified_by_ompl(space, solution.plan.waypoints), space.counters


def _planned_apart(run: Run, item: Phases) -> Outcome:
    """Plan the phases of a task, each as a problem with a seed of its own."""
    rows, solutions, setup = [], [], run.experiment
    for number, (phase, problem) in enumerate(item.problems.items(), start=1):
        solution = solve(
            problem,
            run.method,
            setup.budget,
            phase_seed(run.seed, item.name, phase),
            backend=setup.backend,
            use_cache=False,  # each phase observes another scene
            exact_clearance=True,
        )
        row = replace(
            result_row(run, solution, solution.goal_seconds),
            problem=phase_problem(item.name, number, phase),
        )
        if solution.solved:
            row = _as_executed(row, solution)
        rows.append(row)
        solutions.append(solution)
    return Outcome(rows, _states(solutions))


def _as_executed(row: ResultRow, solution: Solution) -> ResultRow:
    """Return the row of a phase with OMPL's simplification, as published, in place of ours.

    The published code counts it as planning, and executes its path unchecked: so the execution time
    is that of a path without a certificate. `solved` is about ours. A path that OMPL did not find
    is executed as it is.
    """
    if solution.plan.waypoints is None:
        assert solution.path is not None
        motion = timed_motion(solution.problem, solution.path)
        return replace(row, execution_time_s=motion.duration)
    began = time.perf_counter()
    path, work = _simplified_by_ompl(solution)
    seconds = time.perf_counter() - began
    assert row.t_total_s is not None and solution.plan.counted is not None
    total = solution.plan.counted + work
    return replace(
        row,
        t_simplify_s=seconds,
        t_total_s=row.t_total_s - (row.t_simplify_s or 0.0) + seconds,
        n_projections=total.projections,
        n_newton_iterations=total.newton_iterations,
        n_state_checks=total.state_checks,
        path_length_ompl_rad=path.length,
        execution_time_s=timed_motion(solution.problem, path).duration,
    )


def _states(solutions: Sequence[Solution]) -> list[np.ndarray]:
    return [solution.path.states for solution in solutions if solution.path]


def failed_rows(run: Run, item: SuiteItem, reason: FailReason, detail: str) -> list[ResultRow]:
    """Return rows of an item that was not run; later phases of a task count as not reached.

    Args:
        run: planner and seed.
        item: problem or task.
        reason: reason of the failure.
        detail: one line of explanation.
    """
    if isinstance(item, ExecutedProblem):
        return [run.row(name, reason, detail) for name in item.controllers]
    names = _phase_problems(item) if isinstance(item, Task | Phases) else [item.name]
    return [
        run.row(name, FailReason.NOT_REACHED if later else reason, detail)
        for later, name in enumerate(names)
    ]


def result_row(run: Run, solution: Solution, goal_seconds: float) -> ResultRow:
    """Return the row of a solution; undefined values are None."""
    plan, shorter, certificate = solution.plan, solution.simplified, solution.certificate
    work = plan.counted
    sampler: SamplerChoice | None = run.method.sampler
    timings, search, more = plan.timings, plan.search_seconds, solution.improvement
    simplified = (shorter.seconds if shorter else 0.0) + (more.seconds if more else 0.0)
    reasons = certificate.reasons if certificate else ()
    return run.row(
        solution.problem.name,
        _fail_reason(solution),
        "; ".join(filter(None, (*reasons, plan.detail, *solution.left_out))),
        sampler_used=cell_text(plan.sampler),
        fallback=cell_text(plan.fallback),
        certified=certificate.valid if certificate else None,
        t_total_s=goal_seconds + timings.total + search + simplified,
        t_goals_s=goal_seconds,
        t_encode_s=timings.encode,
        t_predict_s=timings.predict,
        t_optimize_s=timings.optimize,
        t_plan_s=search,
        t_simplify_s=shorter.seconds if shorter and not plan.as_is else None,
        n_projections=work and work.projections,
        n_newton_iterations=work and work.newton_iterations,
        n_state_checks=work and work.state_checks,
        n_iterations=None if plan.as_is else plan.counters.iterations,
        n_clearances=None if plan.as_is else plan.counters.clearances,
        n_extensions=(work and work.extensions) or None,
        n_draw_projections=(work and work.draw_projections) or None,
        n_draw_newton_iterations=(
            work.draw_newton_iterations if work and work.draw_projections else None
        ),
        n_roots=plan.roots or None,
        n_goals_tried=None if plan.as_is else plan.goals_tried,
        vertices=None if plan.as_is else plan.vertices,
        path_length_raw_rad=plan.path.length if plan.path and not plan.as_is else None,
        path_length_rad=shorter.path.length if shorter else None,
        max_violation_rad=_defined(certificate.max_violation_rad) if certificate else None,
        max_violation_m=_defined(certificate.max_violation_m) if certificate else None,
        min_clearance_m=_defined(certificate.min_clearance_m) if certificate else None,
        obstacle_clearance_m=_distance(certificate.obstacle_clearance if certificate else None),
        self_clearance_m=_distance(certificate.self_clearance if certificate else None),
        path_sha256=states_hash(shorter.path.states) if shorter else None,
        t_improve_s=more.seconds if more else None,
        n_restarts=more.searches if more else None,
        path_length_first_rad=more.lengths[0][1] if more else None,
        g_sampled=_sampled_g(solution),
        t_wall_s=solution.wall_seconds,
        t_certify_s=solution.certificate_seconds,
        **({} if sampler is None else asdict(sampler) | {"reach": _defined(sampler.reach)}),
    )


def _distance(clearance: Clearance | None) -> float | None:
    return _defined(clearance.distance_m) if clearance else None


def _sampled_g(solution: Solution, draws: int = 256) -> float | None:
    """Return the mean of `G(q) = F(q)^T F(q)` (Algorithm 2); None without samples or constraint."""
    problem = solution.problem
    if solution.distribution is None or not problem.constraint:
        return None
    drawn = solution.distribution.sample(np.random.default_rng(0), draws)
    residual = problem.manifold.residual(np.clip(drawn, problem.robot.lower, problem.robot.upper))
    return float(np.square(residual).sum(axis=1).mean())


def _fail_reason(solution: Solution) -> FailReason | None:
    """Return the first fault of the path, or the reason why the planner found none."""
    if solution.solved:
        return None
    if solution.certificate is not None:
        return FailReason(f"uncertified_{solution.certificate.faults[0].kind}")
    return FailReason(solution.plan.status)


def _defined(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _phase_problems(task: Task | Phases) -> list[str]:
    """Return the names of a task's planned phases in rows."""
    planned = [phase.name for _, phase in task.planned] if isinstance(task, Task) else task.problems
    return [phase_problem(task.name, number, name) for number, name in enumerate(planned, start=1)]


def phase_rows(run: Run, solution: TaskSolution) -> list[ResultRow]:
    """Return rows of all planned phases; phases after a failed one are failures, too."""
    names = _phase_problems(solution.task)
    rows = [_phase_row(run, *pair) for pair in zip(names, solution.outcomes, strict=False)]
    return rows + [
        run.row(name, FailReason.NOT_REACHED, solution.failure) for name in names[len(rows) :]
    ]


def _phase_row(run: Run, problem: str, outcome: PhaseOutcome) -> ResultRow:
    """Return the row of the last attempt with the time and work of all attempts."""
    attempts = [result_row(run, attempt, attempt.goal_seconds) for attempt in outcome.attempts]
    last = attempts[-1]
    untimed = last.solved and not outcome.solved
    sums: dict[str, Any] = {}
    # columns of a phase that count all of its attempts
    for column in (*(name for name in ROW_COLUMNS if name.startswith(("t_", "n_"))), "vertices"):
        values = [value for row in attempts if (value := getattr(row, column)) is not None]
        sums[column] = sum(values) if values else None
    return replace(
        last,
        problem=problem,
        solved=outcome.solved,
        fail_reason=FailReason.NOT_TIMED if untimed else last.fail_reason,
        detail=cell_text(outcome.reason) or last.detail,
        fallback=last.fallback or cell_text(outcome.fallback),
        execution_time_s=outcome.trajectory.duration if outcome.trajectory else None,
        **sums,
    )


WARM_UP_S = 5.0  # given to a planner to warm up [s]


def executor_for(
    experiment: Experiment, jobs: int, dask: str | None = None
) -> AbstractContextManager[Executor]:
    """Return processes on this machine, or the Dask cluster at an address."""
    whole_number("jobs", jobs, 1)
    if dask is not None:
        return dask_cluster(dask, experiment.limit, partial(_installed, experiment))
    return local_processes(jobs, experiment.limit)


def run_experiment(
    experiment: Experiment,
    out: Path,
    executor: Executor,
    command: Sequence[str],
    on_progress: Callable[[int, int, str], None],
    profile: str | None = None,
) -> list[ResultRow]:
    """Run the missing runs of an experiment and return all rows, sorted.

    Finished runs are kept after an interrupt.

    Args:
        experiment: problems, planners and seeds.
        out: folder of the rows.
        executor: executor of the runs.
        command: words of the command line, for the provenance.
        on_progress: called with runs done, all runs, and a note on the last run.
        profile: of `cvqmpt reproduce all`, for the provenance.
    """
    session = provenance(
        command,
        experiment.seeds,
        weights_of(experiment.planners, experiment.model),
        executor.size,
        experiment.digests,
        externals_of(experiment.planners),
    )
    session["streams"] = STREAMS
    if profile is not None:
        session["profile"] = profile
    with RunStore.open(out, experiment.settings(), session) as store:
        runs, done = experiment.runs, store.done()
        left = [run for run in runs if run.key not in done]
        finished = len(runs) - len(left)
        on_progress(finished, len(runs), "")
        one_run_a_planner = tuple({run.planner: run for run in left}.values())
        for run, result in executor.results(partial(_run_in_worker, one_run_a_planner), left):
            outcome = result
            if isinstance(result, Lost):
                item = suite_named(experiment.suite).item(run.item)
                outcome = Outcome(failed_rows(run, item, result.reason, result.detail))
            store.append(outcome.rows, outcome.paths)
            failed = next((row for row in outcome.rows if not row.solved), None)
            reason = failed.fail_reason if failed else None
            note = f"{failed.problem} {reason.shown}" if failed and reason else f"{run.item} solved"
            finished += 1
            on_progress(finished, len(runs), f"{run.planner} {note}")
        return store.rows()


def default_jobs() -> int:
    """Return the number of cores: one process for each."""
    return os.cpu_count() or 1


def _installed(experiment: Experiment) -> dict[str, object]:
    """Return digests of sources, weights and problems on this machine, which decide rows."""
    library = Path(__file__).parents[1]  # cvqmpt_lab holds experiments
    return {
        "sources": sources_digest(library, library / "experiments"),
        "arithmetic": arithmetic.facts(),
        "weights": weights_of(experiment.planners, experiment.model),
        "problem files": experiment.digests,
        "planners": externals_of(experiment.planners),
    }


def _run_in_worker(one_run_a_planner: tuple[Run, ...], run: Run) -> Outcome:
    """Return the outcome of a run; an unexpected error fails only this run."""
    _warm_up(tuple(one for one in one_run_a_planner if not one.method.external))
    item, goals = _item(run.experiment.suite, run.item)
    try:
        # in its own run: it may hang
        if run.method.external and not external_planner(run.planner).process.has_planned:
            _run_shortly(run)
        return outcome_of(run, item, goals)
    except (CvqmptError, MemoryError):
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        return Outcome(failed_rows(run, item, FailReason.PLANNER_ERROR, what))


@lru_cache(maxsize=1)
def _warm_up(runs: tuple[Run, ...]) -> None:
    """Load compiled code and planner libraries by short runs, so that no row includes this time."""
    compile_kernels(lambda *_: None)
    for run in runs:
        _run_shortly(run)
    _item.cache_clear()


def _run_shortly(run: Run) -> None:
    """Plan for a few seconds at most (our planners: one iteration); discard the result."""
    item, goals = _item(run.experiment.suite, run.item)
    item = item.problem if isinstance(item, ExecutedProblem) else item
    budget = run.experiment.budget
    if run.method.external:
        budget = replace(budget, seconds=min(WARM_UP_S, budget.seconds or WARM_UP_S))
    else:
        budget = Budget(seconds=WARM_UP_S, iterations=None if isinstance(item, Task) else 1)
    # this run alone: an experiment checks all that it names when it is made
    problems, planners, seeds = (run.item,), (run.planner,), (run.seed,)
    alone = replace(
        run.experiment, problems=problems, planners=planners, seeds=seeds, budget=budget
    )
    outcome_of(run._replace(experiment=alone), item, goals)


@lru_cache(maxsize=4)
def _item(suite: str, index: int | str) -> tuple[SuiteItem, Goals | None]:
    """Return an item, and the goals of a problem, which are drawn once for all planners."""
    item = suite_named(suite).item(index)
    return item, goals_of(item) if isinstance(item, PlanningProblem) else None
