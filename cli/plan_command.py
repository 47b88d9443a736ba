"""`cvqmpt plan`: one problem, one planner, a short human report."""

import argparse
import logging
import sys
from functools import partial
from pathlib import Path

from cli.motion_options import MOTION, arm_of, motion_given, motion_problem, scanned
from cli.options import FLAG, REPEATED, WEIGHTS, Options, as_json, log, option, writable_file
from cli.problem_options import (
    BUDGET,
    PROBLEM,
    ROBOT,
    budget,
    optimize_budget,
    optimize_option,
    problem_asked,
    refuse_robot,
    with_clearance,
)
from cli.scan_options import SCAN
from cli.show_options import SHOW, check_show, show_solution
from cvqmpt_lab.benchmarks.suite import SUITES, suite_named
from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.files import write_text
from cvqmpt_lab.pipeline import Solution, solve
from cvqmpt_lab.planners import PLANNERS, default_planner, planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import SLOW
from cvqmpt_lab.solution_report import solution_data, solution_lines
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.warm_up import warm_up

OPTIMIZE = 0.05  # [s] after a first path, unless --optimize says otherwise


def run(args: argparse.Namespace) -> int:
    """Plan, print, show; exit code 1 when no certified path was found."""
    if args.save_path:
        writable_file(args.save_path)
    check_show(args)
    whole_number("--seed", args.seed)
    problem = _asked(args)
    if isinstance(problem, Task):
        args.planner = args.planner or "birrt"  # what tasks were measured with
        # timing needs scipy.interpolate, half a second to import
        from cli.plan_task import run_task

        return run_task(args, problem)
    if args.trajectory:
        writable_file(args.trajectory)
    planner, why = (args.planner, "") if args.planner else default_planner(problem)
    method = planner_named(planner, args.model)
    if args.cloud and not motion_given(args):  # of a suite or file, whose own obstacles count
        method = method.with_cloud(scanned(args, arm_of(args, problem.robot, problem.start)).points)
    _check_timing(args, problem)
    warm_up(problem, method, args.backend, log)
    if args.verbose:
        logging.basicConfig(format="%(name)s: %(message)s", level=logging.INFO)
    more = optimize_budget(args, OPTIMIZE)
    solution = solve(
        problem,
        method,
        budget(args),
        args.seed,
        backend=args.backend,
        optimize=more,
        near_goals_first=args.suite is None,
    )
    if args.json:
        print(as_json(solution_data(solution, planner, why, problem)))
    else:
        print("\n".join(solution_lines(solution, planner, why)))
    say = partial(print, file=sys.stderr if args.json else sys.stdout)
    if args.save_path and solution.simplified:
        states = solution.simplified.path.states
        lines = (",".join(repr(float(x)) for x in q) for q in states)
        write_text(args.save_path, "\n".join([",".join(problem.robot.joint_names), *lines, ""]))
        say(f"path written to {args.save_path}")
    if args.trajectory:
        say(_write_trajectory(args, solution))
    carried = suite_named(args.suite).carried if args.suite else ()
    for line in show_solution(args, solution, carried):
        say(line)
    return 0 if solution.solved else 1


def _asked(args: argparse.Namespace) -> PlanningProblem | Task:
    """The problem or task of the command line."""
    if not args.cloud and (args.intrinsics or args.extrinsics or args.level or args.crop):
        raise InvalidInputError(
            "--intrinsics, --extrinsics, --level and --crop are of a scan: give --cloud"
        )
    given = [
        name for name in ("suite", "problem_file", "task_file") if getattr(args, name) is not None
    ]
    if motion_given(args) and not given:
        return with_clearance(args, motion_problem(args))
    if len(given) != 1 or motion_given(args) or args.scene:
        raise InvalidInputError(
            f"name a suite ({', '.join(SUITES)}), or give --problem-file or --task-file, or "
            "--start and --goal with --cloud or --scene: one of the four"
        )
    if args.task_file is None:
        return problem_asked(args)
    refuse_robot(args)
    return with_clearance(args, Task.load(args.task_file))


def _check_timing(args: argparse.Namespace, problem: PlanningProblem) -> None:
    """Refuse before planning what would fail afterwards."""
    if args.trajectory is None:
        if args.speed is not None:
            raise InvalidInputError(
                f"--speed {args.speed} is that of --trajectory OUT.csv; give it"
            )
        return
    from cvqmpt_lab.trajectory.trajectory import file_type

    file_type(args.trajectory)
    args.speed = SLOW if args.speed is None else args.speed
    problem.robot.joint_limits.scaled(args.speed)


def _write_trajectory(args: argparse.Namespace, solution: Solution) -> str:
    """Time the certified path, certify the motion, write it; return the line to print."""
    from cvqmpt_lab.motion_check import certified_motion
    from cvqmpt_lab.trajectory.timing import TimingSettings
    from cvqmpt_lab.trajectory.trajectory import save_trajectory

    if not solution.solved or solution.simplified is None:
        return "trajectory  none: only certified paths are timed"
    motion = certified_motion(
        solution.problem, solution.simplified.path, TimingSettings(speed=args.speed)
    )
    save_trajectory(motion, args.trajectory)
    return (
        f"trajectory  {motion.duration:.2f} s at {args.speed:g} of the joint limits, at most "
        f"{motion.deviation:.1e} rad off the path, certified; written to {args.trajectory}"
    )


OPTIONS: Options = {
    **PROBLEM,
    "another robot for --problem-file, or for --start and --goal": ROBOT,
    "--task-file": option(
        "a task of several phases instead, planned phase by phase", type=Path, metavar="T.json"
    ),
    "--planner": option(
        f"one of {', '.join(PLANNERS)}, or package.module:planner (roadmap, for a task or a held "
        "mechanism birrt)"
    ),
    **WEIGHTS,
    "--cloud": option(
        "obstacles of --start and --goal; beside a suite or file what a network is shown; "
        "repeatable",
        type=Path,
        metavar="SCAN.pcd|ply|npy|xyz|png",
        **REPEATED,
    ),
    "--scene": option("obstacles of --start and --goal, not --cloud", type=Path, metavar="S.json"),
    "--seed": option("seed of all randomness (0)", type=int, default=0),
    "--json": option("print one json object instead of the report", **FLAG),
    "-v --verbose": option("say on standard error what happens inside", **FLAG),
    **MOTION,
    **SCAN,
    **BUDGET,
    **optimize_option(f"; {OPTIMIZE:g}, 0 for none"),
    **SHOW,
    "--save-path": option("write the path's states as csv", type=Path, metavar="PATH.csv"),
    "--trajectory": option(
        "write the path as the fastest motion in time, json for ROS; of a task a folder: a file "
        "a phase",
        type=Path,
        metavar="OUT.csv|OUT.json|DIR",
    ),
    "--speed": option(
        "share of the joints' limits that --trajectory uses (0.1)", type=float, metavar="FACTOR"
    ),
}
COMMANDS = {"plan": (run, OPTIONS)}
