"""`cvqmpt plan`: solve one problem or task with one planner; print a report, write files.

`cvqmpt studio`: serve a page on which a problem is changed and planned again.
"""

import argparse
import json
import logging
import re
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, few
from cvqmpt_lab.base.files import csv_table, make_folder, write_text
from cvqmpt_lab.base.jit import compile_in_processes
from cvqmpt_lab.base.reports import Report
from cvqmpt_lab.base.values import bound_text
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.cli.options import (
    ProgressBar,
    as_json,
    compiling,
    refuse_given,
    writable_file,
)
from cvqmpt_lab.cli.plan_command import FILM_SUFFIX, OPTIMIZE_S, PAGE_SUFFIX, STATES_SUFFIX
from cvqmpt_lab.cli.problem_arguments import (
    budget,
    chosen_problem,
    end_velocities,
    margin_of_task,
    motion_given,
    name_file,
    optimize_budget,
    robot_source,
    with_clearance,
)
from cvqmpt_lab.features.plan import Plan, Request, plan
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.planning.planners import default_planner, planner_named
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.usable import with_projected_start
from cvqmpt_lab.planning.warm_up import compile_kernels, warm_up
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import SLOW_SPEED, Robot

if TYPE_CHECKING:
    from cvqmpt_lab.features.motion.timing import TimingSettings
    from cvqmpt_lab.features.motion.trajectory import Trajectory
    from cvqmpt_lab.features.tasks.solve import TaskSolution


def run(args: argparse.Namespace) -> int:
    """Plan, print the report and write files; return 1 if no certified path was found."""
    item = _problem_or_task(args)
    if args.speed is not None and args.trajectory is None and not isinstance(item, Task):
        raise InvalidInputError(f"--speed {args.speed} goes with --trajectory OUT.csv; give it")
    for name in ("rate", "duration"):
        if (value := getattr(args, name)) is not None and args.trajectory is None:
            raise InvalidInputError(f"--{name} {value:g} goes with --trajectory OUT.csv; give it")
    moving = ("start_velocity", "end_velocity")
    if args.trajectory is None:
        refuse_given(args, moving, "goes with --trajectory OUT.csv; give it")
    if isinstance(item, Task):
        refuse_given(args, ("duration",), "goes with one motion; give a task its --speed")
        refuse_given(args, moving, "goes with one motion; those of a task begin and end at rest")
    args.speed = SLOW_SPEED if args.speed is None else args.speed
    solution: Solution | TaskSolution
    write: Callable[[], str]
    if isinstance(item, Task):
        done, report = _solved_task(args, item)
        solution, write = done, partial(_write_trajectories, args, done)
    else:
        planned, report = _solved_problem(args, item)
        solution, write = planned.solution, partial(_write_trajectory, args, planned)
    print(as_json(report.data) if args.json else report)
    # with --json, standard output holds the json object alone
    say = partial(print, file=sys.stderr if args.json else sys.stdout)
    untimed: CvqmptError | OSError | None = None
    motion: Trajectory | None = None  # that pages show over its seconds
    if args.trajectory:
        try:
            say(write())
            motion = None if isinstance(item, Task) else planned.motion
        except (CvqmptError, OSError) as error:
            untimed = error  # pictures, pages and states of the certified path are written first
    for line in _show(args, solution, motion):
        say(line)
    if untimed is not None:
        raise untimed
    return 0 if solution.solved else 1


def _solved_problem(args: argparse.Namespace, problem: PlanningProblem) -> tuple[Plan, Report]:
    """Plan for a problem; return the plan and its report."""
    if args.project_start:
        problem = with_projected_start(problem)
    planner, why = (args.planner, "") if args.planner else default_planner(problem)
    method = planner_named(planner, args.model, args.reach)
    if args.cloud and not motion_given(args):
        from cvqmpt_lab.cli.motion_arguments import scanned
        from cvqmpt_lab.features.scan.scan import Arm

        # obstacles are those of the suite or file; the cloud is the input of a network
        made = scanned(args.cloud, Arm(problem.robot, problem.start))
        method = method.with_cloud(made.points)
    if args.trajectory:
        from cvqmpt_lab.base.readers import kind_of
        from cvqmpt_lab.features.motion.trajectory import TRAJECTORY_WRITERS

        # a wrong file name or speed is refused before anything is planned
        kind_of(writable_file(args.trajectory), TRAJECTORY_WRITERS, "trajectory")
        problem.robot.joint_limits.scaled(args.speed)
    timing = _timing(args, problem.robot)
    margin = Margin(*args.margin).check()
    warm_up(problem, method, args.backend)
    if args.verbose:
        logging.basicConfig(format="%(name)s: %(message)s", level=logging.INFO)
    request = Request(
        method,
        budget(args),
        args.seed,
        margin,
        optimize_budget(args, OPTIMIZE_S),
        timing,
        args.backend,
        args.exact_clearance,
        near_goals_first=args.suite is None,
        cores=args.cores or 1,
    )
    planned = plan(problem, request)
    return planned, planned.report(planner, why, partial(_record, planned.solution, problem))


def _record(solution: Solution, problem: PlanningProblem) -> dict[str, Any] | None:
    """Return the record of a solution's certificate for the problem of the user."""
    # it needs scipy.interpolate, which takes half a second to import
    from cvqmpt_lab.features.motion.record import record_of

    return record_of(solution, problem)


def _timing(args: argparse.Namespace, robot: Robot) -> "TimingSettings | None":
    """Return the settings of the motion that --trajectory asks for; None without it."""
    end_velocities(args, robot)  # refuses a wrong number of them
    if args.trajectory is None:
        return None
    from cvqmpt_lab.features.motion.timing import TimingSettings

    return TimingSettings(
        speed=args.speed,
        duration=args.duration,
        start_velocity=args.start_velocity,
        end_velocity=args.end_velocity,
    )


def _solved_task(args: argparse.Namespace, task: Task) -> tuple["TaskSolution", Report]:
    """Solve a task; return its solution and report."""
    # timing needs scipy.interpolate, which takes half a second to import
    from cvqmpt_lab.features.motion.timing import TimingSettings
    from cvqmpt_lab.features.tasks.solve import solve_task, task_report

    of_problems = ("cloud", "optimize", "project_start", "cores")
    refuse_given(args, of_problems, "does not go with a task; leave it out")
    if any(path.suffix == STATES_SUFFIX for path in args.save):
        raise InvalidInputError(
            "--save PATH.csv does not go with a task; --trajectory DIR writes its motions"
        )
    folder = args.trajectory
    if folder is not None:
        if folder.suffix or folder.is_file():
            raise InvalidInputError(
                f"--trajectory {folder}: a task writes a file for each phase; name a folder"
            )
        make_folder(folder)
    planner = args.planner or "birrt"  # the planner with which tasks were measured
    method = planner_named(planner, args.model, args.reach)
    compile_kernels(compiling())
    margin = margin_of_task(args)
    timing = TimingSettings(speed=args.speed)
    # a wrong speed is refused before anything is planned
    robot_from_source(task.robot).joint_limits.scaled(args.speed)
    solution = solve_task(task, method, budget(args), args.seed, timing, args.backend, margin)
    return solution, task_report(solution, planner, args.speed)


def _problem_or_task(args: argparse.Namespace) -> PlanningProblem | Task:
    """Return the problem or task that the command line names."""
    name_file(args)
    named = any((args.suite, args.problem_file, args.task_file))
    if motion_given(args) and not named:
        from cvqmpt_lab.cli.motion_arguments import motion_problem

        compile_in_processes(compiling())
        return with_clearance(args, motion_problem(args))
    if not named or motion_given(args) or args.scene:
        raise InvalidInputError(
            f"name a suite ({few(SUITES, 3)}), a problem file or a task file, or give --start and "
            "--goal, alone or with --cloud or --scene: one of the four; cvqmpt problems new "
            "mine.json --robot ur5 writes a first problem"
        )
    if args.suite is not None:
        suite_named(args.suite)  # an unknown name is refused before anything is compiled
    compile_in_processes(compiling())
    return chosen_problem(args)


def _write_trajectory(args: argparse.Namespace, planned: Plan) -> str:
    """Time the certified path, certify and write the motion; return the line to print."""
    from cvqmpt_lab.features.motion.trajectory import save_trajectory

    motion, timing, solution = planned.motion, planned.request.timing, planned.solution
    if motion is None or timing is None:
        return "trajectory  none: only certified paths are timed"
    motion = _at_rate(args.rate, solution.problem, motion, timing)
    save_trajectory(motion, args.trajectory, solution.problem.robot.joint_limits)
    return (
        f"trajectory  {motion.duration:.2f} s at {args.speed:g} of the joint limits"
        f"{' at most' * (args.duration is not None)}, at most "
        f"{bound_text(motion.deviation, up=True)} rad off the path, certified; written to "
        f"{args.trajectory}"
        f"{_not_limited(solution.problem.robot)}"
    )


def _write_trajectories(args: argparse.Namespace, solution: "TaskSolution") -> str:
    """Write a file for each planned phase, and an index; return the line to print.

    The index lists these files and the gripper's events in the order in which they are executed.
    """
    from cvqmpt_lab.features.motion.timing import TimingSettings
    from cvqmpt_lab.features.motion.trajectory import save_trajectory
    from cvqmpt_lab.features.tasks.solve import event_of

    if not solution.solved:
        return "trajectory  none: only tasks whose phases are all certified are written"
    steps = []
    for k, (phase, outcome) in enumerate(solution.steps, start=1):
        step = event_of(phase)
        if outcome is not None and outcome.arm_trajectory is not None:
            name = f"{k:02d}-{re.sub('[^A-Za-z0-9_.-]', '-', phase.name)}.json"
            assert outcome.trajectory is not None
            of_phase = outcome.solution.problem, outcome.trajectory
            sampled = _at_rate(args.rate, *of_phase, TimingSettings())
            motion = replace(outcome, trajectory=sampled).arm_trajectory
            assert motion is not None
            limits = outcome.solution.problem.robot.joint_limits
            save_trajectory(motion, args.trajectory / name, limits)
            step |= {"file": name, "duration_s": outcome.arm_trajectory.duration}
            if len(sampled.joint_names) > len(motion.joint_names):
                kinds = ("positions", "velocities", "accelerations")
                columns = {kind: getattr(sampled, kind)[:, -1].tolist() for kind in kinds}
                step["held"] = {"joint": sampled.joint_names[-1], **columns}
        steps.append(step)
    index = args.trajectory / "task.json"
    text = json.dumps({"task": solution.task.name, "speed": args.speed, "steps": steps}, indent=1)
    write_text(index, text + "\n")
    files = sum("file" in step for step in steps)
    events = f"{len(steps) - files} gripper events"
    unlimited = _not_limited(robot_from_source(solution.task.robot))
    return f"trajectory  {files} files and {events}, in order in {index}{unlimited}"


def _at_rate(
    rate: float | None, problem: PlanningProblem, motion: "Trajectory", timing: "TimingSettings"
) -> "Trajectory":
    """Return a motion with more states, certified.

    Args:
        rate: least number of states a second [Hz]; None: the motion as it is.
        problem: its problem.
        motion: the motion.
        timing: the settings with which it was timed.
    """
    if rate is None:
        return motion
    from cvqmpt_lab.features.motion.motion_check import trajectory_faults

    sampled = motion.sampled(1.0 / rate)
    reasons = trajectory_faults(problem, sampled, timing)
    if reasons:
        raise InvalidInputError(
            f"--rate {rate:g}: the motion between these states is not certified: "
            f"{'; '.join(reasons)}; give a higher rate, or leave it out"
        )
    return sampled


def _not_limited(robot: Robot) -> str:
    """Return a line that lists limits unknown to the timing, or ""."""
    from cvqmpt_lab.robot.dynamics import without_effort_limit

    missing = [without_effort_limit(robot)]
    if "jerk" not in robot.limits:
        missing.append("jerk not limited: cvqmpt robot --jerk limits it")
    said = "; ".join(filter(None, missing))
    return f"\n            {said}" if said else ""


def _show(
    args: argparse.Namespace, solution: "Solution | TaskSolution", motion: "Trajectory | None"
) -> list[str]:
    """Write the picture, film, page or recording of the options; return a line for each."""
    # some suites show an object in the hand that their problems leave out
    of_suite = args.suite and isinstance(solution, Solution)
    carried = suite_named(args.suite).carried if of_suite else ()
    lines = []
    if args.picture:
        from cvqmpt_lab.features.pictures.picture import draw_solution, task_image, write_picture

        what = "picture"
        if isinstance(solution, Solution):
            draw_solution(solution, args.picture, carried=carried)
        else:
            image, names = task_image(solution, (600, 450))
            write_picture(args.picture, image)
            what = f"picture of {', '.join(names)}"
        lines.append(f"{what} written to {args.picture}")
    saved = partial(_saved, solution=solution, carried=carried, motion=motion, name=_named(args))
    return lines + [line for path in args.save for line in saved(path)]


def _named(args: argparse.Namespace) -> str:
    """Return suite and number of a problem, which is named by its number alone; else ""."""
    return f"{args.suite} {args.problem}" if args.suite else ""


def _saved(
    path: Path,
    solution: "Solution | TaskSolution",
    carried: Sequence[Any],
    motion: "Trajectory | None",
    name: str,
) -> list[str]:
    """Write a file of --save; return a line on it.

    Args:
        path: the file, whose suffix names what is written.
        solution: what is shown.
        carried: objects that are shown in the hand beside those of the problem.
        motion: motion along the path, which a page shows; None: the path.
        name: title of a page; "": the name of the problem.
    """
    if path.suffix == STATES_SUFFIX:
        if not isinstance(solution, Solution) or not solution.path:
            return []
        rows = solution.problem.robot.joint_names, *solution.path.states.tolist()
        write_text(path, csv_table(rows))
        return [f"path written to {path}"]
    if path.suffix == FILM_SUFFIX:
        from cvqmpt_lab.features.pictures.picture import film_solution

        film_solution(solution, path, carried=carried, progress=ProgressBar("film"))
        return [f"film written to {path}"]
    if path.suffix == PAGE_SUFFIX:
        from cvqmpt_lab.features.pictures.web_page import save_page

        save_page(solution, path, carried, motion=motion, name=name)
        size = path.stat().st_size / 1e6
        return [
            f"page written to {path} ({size:.1f} MB); open it in a browser, no network is needed"
        ]
    from cvqmpt_lab.features.pictures.recording import log_solution

    log_solution(solution, path, carried)
    return [f"recording written to {path}; open it with: rerun {path}"]


def serve(args: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C."""
    from cvqmpt_lab.features.studio.studio import studio  # half a second to import

    problem = _of_page(args)
    compile_kernels(compiling())
    page = studio(problem, args.port, _named(args))
    interrupts: list[int] = []
    # Python would lose a KeyboardInterrupt that comes while it collects garbage
    signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    print(f"{page}; Ctrl-C ends it", flush=True)
    while not interrupts:  # waiting on a lock would miss a signal that comes just before
        time.sleep(0.2)
    page.stop()


def _of_page(args: argparse.Namespace) -> PlanningProblem:
    """Return the problem of a file or suite, or else a template problem for the named robot."""
    name_file(args)
    if not any((args.suite, args.problem_file, args.task_file)):
        if (source := robot_source(args)) is not None:
            from cvqmpt_lab.benchmarks.templates import problem_template  # half a second to import

            return PlanningProblem.from_dict(problem_template(source))
        args.suite = "place-task"
    if isinstance(problem := chosen_problem(args), PlanningProblem):
        return problem
    raise InvalidInputError(
        f"{args.suite or args.task_file} has tasks of several phases; studio is for problems"
    )
