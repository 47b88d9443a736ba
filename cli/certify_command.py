"""`cvqmpt certify`: certify a path or trajectory from any source, or all paths of a run again."""

import argparse
import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import Modules, csv_table, read_json_object, write_text
from cvqmpt_lab.base.reports import Entry, Report
from cvqmpt_lab.base.values import Array, FloatArray
from cvqmpt_lab.cli.motion_arguments import constraint_of
from cvqmpt_lab.cli.options import (
    FLAG,
    REPEATED,
    Options,
    file_of_kind,
    log,
    option,
    positive,
    refuse_given,
)
from cvqmpt_lab.cli.problem_arguments import (
    chosen_problem,
    chosen_robot,
    configuration,
    end_velocities,
)
from cvqmpt_lab.cli.problem_options import PROBLEM, ROBOT, velocity_options
from cvqmpt_lab.features.motion.alone import problem_of_motion, robot_moving
from cvqmpt_lab.features.motion.bags import is_bag
from cvqmpt_lab.features.motion.judge import ClearanceAt, Judgement, clearance_along, evenly, judge
from cvqmpt_lab.features.motion.limit_use import Ends, LimitUse, share_text
from cvqmpt_lab.features.motion.motion_check import dry_run, with_limits_of
from cvqmpt_lab.features.motion.record import record, report_of
from cvqmpt_lab.features.motion.trajectory import Motion, read_motion
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.features.tasks.world import phase_problems
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene, check_extent
from cvqmpt_lab.scene.scene_files import read_attachments, read_scene


def run(args: argparse.Namespace) -> int:
    """Certify and print; return 1 if anything is refused or not proven."""
    if args.path.suffix == ".parquet" or (args.path / "meta" / "info.json").is_file():
        raise InvalidInputError(
            f"{args.path} belongs to a data set; give its folder: cvqmpt audit FOLDER --robot NAME"
        )
    if args.path.is_dir() and not is_bag(args.path):
        why = "goes with one motion; give its file"
        refuse_given(args, ["save", "request", "scene", "attachments", "proof"], why)
    if (args.path / "task.json").is_file():
        return _certify_task(args)
    if args.path.is_dir() and not is_bag(args.path):
        of_one = ["topic", "constraint", "tolerance", "problem"]
        of_one += ["start_velocity", "end_velocity", "part"]
        refuse_given(args, of_one, "goes with one motion; give its file")
        folder = None if args.suite is None else Path(args.suite)
        of_file = (args.robot, args.current, args.clearance)
        if any(given is not None for given in of_file) or not (folder or args.path).is_dir():
            raise InvalidInputError(
                "the rows of a run name their problems and robots; give the directory alone, or "
                "with the folder of its problem files"
            )
        return _certify_run(args.path, folder, args.json)
    motion = _motion(args)
    if args.request is not None:
        return _told(args, motion, *_by_request(args, motion))
    if args.suite is None and args.robot is not None:
        return _told(args, motion, *_alone(args, motion))
    if args.suite is None:
        raise InvalidInputError(
            f"{args.path} is a motion of which robot? Give --robot NAME|URDF|robot.json to judge "
            "it alone, or a problem file, a suite or --request, which have start and goals, too"
        )
    why = "goes with --robot alone or --request; a problem has its own"
    refuse_given(args, ["scene", "attachments"], why)
    problem = chosen_problem(args)
    if not isinstance(problem, PlanningProblem):
        raise InvalidInputError(
            f"{args.suite or args.task_file} is a task; certify the directory of a run, the folder "
            "that plan --trajectory wrote for a task, or one problem"
        )
    problem = with_limits_of(problem, motion)
    ends = _ends(args, motion, problem)
    return _told(args, motion, problem, judge(motion, problem, ends=ends, exact_clearance=True))


def _motion(args: argparse.Namespace) -> Motion:
    """Read the motion; say which file is meant where a problem or a list of motions is given."""
    try:
        return read_motion(args.path, args.topic)
    except InvalidInputError:
        data = dict[str, Any]()
        if args.path.suffix == ".json":
            with contextlib.suppress(InvalidInputError):
                data = read_json_object(args.path)
        if str(data.get("schema", "")).startswith("cvqmpt-"):
            motion = args.suite or "MOTION"
            raise InvalidInputError(
                f"{args.path} is a problem or task file, no motion; the motion comes first: cvqmpt "
                f"certify {motion} {args.path}"
            ) from None
        if "steps" in data:
            raise InvalidInputError(
                f"{args.path} lists the motions of a task; give its folder: cvqmpt certify "
                f"{args.path.parent} {args.suite or 'TASK.json'}"
            ) from None
        raise


def _told(
    args: argparse.Namespace, motion: Motion, problem: PlanningProblem, judged: Judgement
) -> int:
    """Print a judgement; return the exit code."""
    contents = record(problem, motion, judged.check, judged.speed)
    report, check = report_of(judged.check, contents), judged.check
    if args.save and not np.isfinite(check.states).all():
        raise InvalidInputError("the motion has states that are not finite: leave --save out")
    for path in args.save:
        if path.suffix == ".csv":
            rows = clearance_along(problem, check)
            write_text(path, csv_table([ClearanceAt._fields, *rows]))
            continue
        from cvqmpt_lab.features.pictures.web_page import path_html  # needed for pages alone

        moments, states = evenly(check, 200)
        times = None if check.times is None else moments
        verdict = report.lines[0].partition(";")[0]
        write_text(path, path_html(problem, states, verdict, times=times, lines=report.lines))
    print(json.dumps(report.data, indent=1, allow_nan=False) if args.json else report)
    if args.proof:
        _prove(args, motion, problem, judged)
    return 0 if judged.certified else 1


def _prove(
    args: argparse.Namespace, motion: Motion, problem: PlanningProblem, judged: Judgement
) -> None:
    """Write the proof of a certified motion; say how it is checked.

    Args:
        args: names the files of the proof and of the motion.
        motion: the motion.
        problem: what it was judged for.
        judged: the judgement.
    """
    from cvqmpt_lab.features.proof.write_proof import write_proof  # few motions need it

    if not judged.certified:
        log("no proof is written: the motion is not certified")
        return
    command = write_proof(args.proof, problem, args.path, _ends(args, motion, problem))
    log(f"proof written, check it by: {command}")


def _by_request(args: argparse.Namespace, motion: Motion) -> tuple[PlanningProblem, Judgement]:
    """Judge a motion by --request, among the obstacles of --scene."""
    from cvqmpt_lab.features.moveit_requests.motion_request import (
        judge_request,
        read_request,
    )

    if args.suite:
        raise InvalidInputError("--request states start, goals and constraint; give no problem")
    unused = ["current", "start_velocity", "end_velocity", "part", "clearance", "tolerance"]
    unused += ["constraint", "problem", "attachments"]
    refuse_given(args, unused, "does not go with --request, which states what the motion must keep")
    robot = chosen_robot(args)
    request = read_request(args.request, robot)
    if unstated := [name for name in robot.joint_names if name not in request.start]:
        of = f" of {', '.join(unstated)}" if request.start else ""
        log(f"the request states no start{of}: the motion may begin anywhere")
    scene = _scene(args, robot, request.fingers)
    return judge_request(motion, request, robot, scene, exact=True)


def _alone(args: argparse.Namespace, motion: Motion) -> tuple[PlanningProblem, Judgement]:
    """Judge a motion of a robot, without start and goals."""
    refuse_given(args, ["problem"], "goes with a suite; with --robot alone, leave it out")
    robot = robot_moving(chosen_robot(args), motion.joint_names or ())
    carried = () if args.attachments is None else read_attachments(args.attachments)
    scene = _scene(args, robot, {})
    check_extent(scene, robot.reach, f"scene {args.scene}")
    first = problem_of_motion(motion, robot).start
    problem = problem_of_motion(
        motion,
        robot,
        scene,
        [constraint_of(text, robot, first) for text in args.constraint],
        carried,
        args.clearance or 0.0,
    )
    ends = _ends(args, motion, problem)._replace(anywhere=True)
    return problem, judge(motion, problem, ends=ends, exact_clearance=True)


def _scene(args: argparse.Namespace, robot: Robot, fingers: Mapping[str, float]) -> Scene:
    """Return the obstacles of --scene; a note says that there are none without it.

    Args:
        args: parsed command line.
        robot: the robot.
        fingers: values of joints that the robot holds, of a scene of MoveIt [rad or m].
    """
    if args.scene is None:
        log("no --scene is given: the motion is compared with the robot itself alone")
        return Scene("no obstacles", ())
    if args.scene.suffix == ".json":
        return read_scene(args.scene)
    from cvqmpt_lab.scene.moveit_scenes import read_moveit_scene

    return read_moveit_scene(args.scene, robot, fingers)[0]


def _ends(args: argparse.Namespace, motion: Motion, problem: PlanningProblem) -> Ends:
    """Return the begin and end of a motion that the options state."""
    if motion.times is None:
        why = f"goes with a trajectory; {args.path} has no times"
        refuse_given(args, ["start_velocity", "end_velocity"], why)
    current = None
    if args.current is not None:
        current = configuration(problem.robot, "--current", args.current)
    if args.part and args.current is None and args.suite is not None:
        raise InvalidInputError(
            "--part: a part of a motion begins where the arm is: give --current"
        )
    if current is None:
        refuse_given(args, ["tolerance"], "is that of --current; give it")
    tolerance = args.tolerance or Ends().tolerance
    velocities = end_velocities(args, problem.robot)
    moving = args.part and current is None
    return Ends(current, tolerance, *velocities, args.part, moving=moving)


def _certify_task(args: argparse.Namespace) -> int:
    """Certify the motions of all phases of a task, in a folder of plan --trajectory."""
    why = "goes with one motion; a task states where it begins"
    refuse_given(args, ["current", "tolerance"], why)
    refuse_given(args, ["topic"], "goes with a recording; leave it out")
    refuse_given(args, ["clearance"], "goes with a problem; the hand of a task touches objects")
    why = "goes with one motion; those of a task begin and end at rest"
    refuse_given(args, ["start_velocity", "end_velocity", "part"], why)
    task = chosen_problem(args)
    if not isinstance(task, Task):
        raise InvalidInputError(f"{args.path} has the motions of a task, {task.name} is a problem")
    task, index = task.in_legs, args.path / "task.json"
    steps = from_plain(_Index, read_json_object(index, "index"), str(index)).steps
    files = {str(step["phase"]): step for step in steps if "file" in step and "phase" in step}
    names = [phase.name for _, phase in task.planned]
    if list(files) != names:
        raise InvalidInputError(
            f"{index} has motions of {', '.join(files) or 'no phase'}; task {task.name} has "
            f"{', '.join(names)}: give the task that was planned"
        )
    motions = [_motion_of(args.path, files[name], index) for name in names]
    problems = phase_problems(task, [motion.positions for motion in motions])
    records, entries, uses = [], list[Entry](), list[LimitUse]()
    for problem, motion in zip(problems, motions, strict=True):
        found = dry_run(problem, motion, exact_clearance=True)
        records.append(record(problem, motion, found))
        uses += found.uses
        report = report_of(found, records[-1]).only("certificate", "fault", "clearance")
        entries += report.entries
    valid = sum(contents["valid"] for contents in records)
    whole = valid == len(records)
    seconds = sum(float(np.ptp(motion.times)) for motion in motions if motion.times is not None)
    told = (
        f"{valid} of {len(records)} phases of {task.name} are certified, {seconds:.2f} "
        f"s of motion{share_text(uses)}"
    )
    entries.append(("task", told))
    report = Report.of(entries, lambda: {"valid": whole, "phases": records})
    print(json.dumps(report.data, indent=1, allow_nan=False) if args.json else report)
    return 0 if whole else 1


@dataclass(frozen=True)
class _Index:
    """Index of the motions of a task."""

    task: str
    speed: float
    steps: tuple[Mapping[str, Any], ...]  # phases in order; planned ones name a file


@dataclass(frozen=True, eq=False)
class _Held:
    """Motion of a door or drawer in the hand."""

    joint: str
    positions: Annotated[FloatArray, Array((None,))]  # (m,) [rad or m]
    velocities: Annotated[FloatArray, Array((None,))]  # (m,) [rad/s or m/s]
    accelerations: Annotated[FloatArray, Array((None,))]  # (m,) [rad/s^2 or m/s^2]


def _motion_of(folder: Path, step: Mapping[str, Any], index: Path) -> Motion:
    """Return the motion of a step of the index, with that of the door in the hand."""
    motion = read_motion(folder / str(step["file"]))
    if "held" not in step:
        return motion
    where = f"{index}: steps of phase {step['phase']}: held"
    held = from_plain(_Held, step["held"], where)
    columns = held.positions, held.velocities, held.accelerations
    if any(len(column) != len(motion.positions) for column in columns):
        raise InvalidInputError(f"{where} has another number of states than {step['file']}")
    kinds = motion.positions, motion.velocities, motion.accelerations
    joined = [
        None if kind is None else np.column_stack([kind, column])
        for kind, column in zip(kinds, columns, strict=True)
    ]
    positions, velocities, accelerations = joined
    assert positions is not None
    names = None if motion.joint_names is None else (*motion.joint_names, held.joint)
    return Motion(names, positions, motion.times, velocities, accelerations)


def _certify_run(directory: Path, problems_dir: Path | None, as_json: bool) -> int:
    from cvqmpt_lab.experiments.replay import recertify

    summary = {"paths": 0, "certified": 0, "refused": 0}
    troubles = []
    for judged in recertify(directory, problems_dir):
        certified = judged.certificate is not None and judged.certificate.valid
        summary["paths"] += 1
        summary["certified" if certified else "refused"] += 1
        if judged.trouble:
            row = judged.row
            troubles.append(f"{row.problem} {row.planner} seed {row.seed}: {judged.trouble}")
            log(troubles[-1])
    if as_json:
        print(json.dumps({**summary, "troubles": troubles}, indent=1))
    else:
        print(
            f"{summary['paths']} paths, {summary['certified']} certified, {summary['refused']} "
            f"not certified, {len(troubles)} differ from their rows"
        )
    return 1 if troubles else 0


OPTIONS: Options = {
    "path": option(
        "states, or a trajectory, whose limits are checked too; the directory of a run; or the "
        "folder of a task's motions",
        type=Path,
        metavar="PATH.csv|json|yaml|npz|mcap|DIR",
    ),
    **PROBLEM,
    "--constraint": option(
        "a constraint function of your own, added to the problem; for --robot alone also a region: "
        f"{', '.join(Modules('constraints/by_name'))}, or one as json; orientations are those at "
        "the begin of the motion; repeatable",
        metavar="NAME[=VALUE]|JSON|MODULE:F",
        **REPEATED,
    ),
    "suite": option(
        "a suite (cvqmpt problems list), or a problem or task file; for the directory of a run of "
        "problem files, their folder; without it, --robot judges the motion alone",
        nargs="?",
        metavar="SUITE|FILE|DIR",
    ),
    **ROBOT,
    "--request": option(
        "MoveIt's MotionPlanRequest or Constraints instead of a problem, for --robot",
        type=Path,
        metavar="R.yaml|json",
    ),
    "--scene": option(
        "obstacles for --robot alone and for --request: a scene, or a PlanningScene of MoveIt",
        type=Path,
        metavar="S.json|yaml|scene",
    ),
    "--attachments": option(
        "what the hand carries, for --robot alone: a json file with a list of attachments, or one "
        "that has the field attachments, as problem files have",
        type=Path,
        metavar="F.json",
    ),
    "--topic": option(
        "topic of a recording (.mcap file or rosbag2 folder); default: the only topic that has "
        "motions",
        metavar="NAME",
    ),
    "--save": option(
        "write a page for a browser: the motion, its distances along time and this report; or as "
        "csv the distances from obstacles and of the robot from itself at 200 states, evenly in "
        "time; repeatable",
        type=partial(file_of_kind, "--save", (".html", ".csv")),
        metavar="MOTION.html|CLEARANCE.csv",
        **REPEATED,
    ),
    "--proof": option(
        "write a proof of a certified motion, which anybody can check without this toolkit",
        type=partial(file_of_kind, "--proof", (".json",)),
        metavar="P.json",
    ),
    "--current": option(
        "current configuration of the arm, in quotes [rad], or a file with a JointState; the "
        "motion must begin there",
        metavar="Q",
    ),
    "--tolerance": option(
        "largest distance between --current and the first state; default 0.01",
        type=positive,
        metavar="RAD",
    ),
    **velocity_options("a trajectory", "; any with --part"),
    "--part": option(
        "judge a part of a longer motion, such as a chunk of a policy: it begins at --current, not "
        "at the start of the problem, and need not end at a goal; without a problem and --current "
        "it may begin anywhere, at any velocity",
        **FLAG,
    ),
    "--json": option("print one json object instead, with every compared value", **FLAG),
}
COMMANDS = {"certify": (run, OPTIONS)}
