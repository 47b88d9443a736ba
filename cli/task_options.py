"""Tasks on the command line: `reproduce multi-sequence`, `plan multi-sequence` and `plan --task-file`."""

import argparse
import sys
from pathlib import Path

from cli.options import ProgressBar, budget
from cli.show_options import show_task
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.table import PLANNERS, planner_named
from cvqmpt_lab.tasks.solve_task import TaskSolution, solve_task
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.trajectory.timing import SLOW, TimingSettings
from experiments.run import default_jobs
from experiments.suites.multi_sequence import TASKS, multi_sequence_task
from experiments.task_run import SUITE, TaskExperiment, run_tasks
from experiments.warmup import compile_kernels
from paper_tables.render import render_directory


def run_multi_sequence(args: argparse.Namespace) -> int:
    """Run what is missing in --out, then render its tables."""
    count = args.tasks or len(TASKS)
    if count > len(TASKS):
        raise InvalidInputError(f"--tasks {count}: the multi-sequence task has {len(TASKS)}")
    experiment = TaskExperiment(
        tasks=tuple(TASKS[:count]),
        planners=tuple(PLANNERS) if args.planners is None else args.planners,
        seeds=tuple(range(args.seeds or 1)),
        budget=budget(args),
        backend=args.backend,
    )
    out = args.out or Path("runs") / SUITE
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    jobs = args.jobs or default_jobs()
    files = _write_task_files(out, experiment.tasks)
    rows = run_tasks(experiment, out, jobs, ["cvqmpt", *sys.argv[1:]], ProgressBar(SUITE))
    written = render_directory(out)
    print(next(path for path in written if path.suffix == ".md").read_text())
    print(f"{len(rows)} rows in {out / 'runs.csv'}")
    for path in written:
        print(f"table in {path}")
    print(
        f"tasks in {files}; plan and show one with: cvqmpt plan --task-file {files / '0.json'} --picture task.png"
    )
    return 0


def _write_task_files(out: Path, tasks: tuple[int, ...]) -> Path:
    """The folder with a file for each task."""
    folder = out / "tasks"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"cannot make {folder}: {error.strerror}; use another --out") from error
    for number in tasks:
        multi_sequence_task(number).save(folder / f"{number}.json")
    return folder


def run_one_task(args: argparse.Namespace) -> int:
    """Plan the task of --task-file, or one of the ten; exit code 1 when a phase has no certified path."""
    task = Task.load(args.task_file) if args.task_file else multi_sequence_task(args.problem)
    planner = planner_named(args.planner, args.model)
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    timing = TimingSettings(speed=SLOW if args.speed is None else args.speed)
    solution = solve_task(task, planner, budget(args), args.seed, timing, backend=args.backend)
    print("\n".join(task_report(solution, args.planner)))
    for line in show_task(args, solution):
        print(line)
    return 0 if solution.solved else 1


def task_report(solution: TaskSolution, planner: str) -> list[str]:
    """The lines a person reads."""
    lines = [f"task        {solution.task.name}, planner {planner}"]
    planning = execution = 0.0
    for outcome in solution.outcomes:
        goals = sum(attempt.goal_seconds for attempt in outcome.attempts)
        search = sum(attempt.plan.seconds for attempt in outcome.attempts)
        simplify = sum(attempt.simplified.seconds for attempt in outcome.attempts if attempt.simplified)
        planning += goals + search + simplify
        line = f"{outcome.phase.name:15} "
        line += f"goals {1e3 * goals:.0f} ms, plan {1e3 * search:.0f} ms, simplify {1e3 * simplify:.0f} ms"
        if len(outcome.attempts) > 1:
            line += f" in {len(outcome.attempts)} attempts"
        if outcome.trajectory is not None:
            execution += outcome.trajectory.duration
            line += f", certified, {outcome.trajectory.duration:.1f} s of motion"
        lines.append(line + (f" ({outcome.fallback})" if outcome.fallback else ""))
    if solution.solved:
        return [*lines, f"solved      planning {planning:.2f} s, execution {execution:.1f} s"]
    return [*lines, f"FAILED      {solution.failure}"]
