"""Tasks of several phases on the command line of `cvqmpt plan`."""

import argparse

from cli.options import log
from cli.planner_options import budget
from cli.show_options import show_task
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.robot.robot import SLOW
from cvqmpt_lab.tasks.solve_task import TaskSolution, solve_task
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.trajectory.timing import TimingSettings
from cvqmpt_lab.warm_up import compile_kernels

OF_PROBLEMS = ("cloud", "json", "optimize", "save_path", "trajectory", "view")


def run_task(args: argparse.Namespace, task: Task) -> int:
    """Plan a task, report, show; exit code 1 when a phase has no certified path."""
    wrong = next((name for name in OF_PROBLEMS if getattr(args, name)), None)
    if wrong is not None:
        raise InvalidInputError(f"--{wrong.replace('_', '-')} does not go with a task; leave it out")
    planner = planner_named(args.planner, args.model)
    compile_kernels(log)
    timing = TimingSettings(speed=SLOW if args.speed is None else args.speed)
    solution = solve_task(task, planner, budget(args), args.seed, timing, backend=args.backend)
    print("\n".join([*task_report(solution, args.planner), *show_task(args, solution)]))
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
