"""`cvqmpt problems`: list or write a suite's problems, write a template, import or fetch others.

`cvqmpt ik`: free configurations on the manifold for a pose or region, for a problem file.
`cvqmpt fk`: pose of the hand at a configuration.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    UnknownChoiceError,
    located,
    mapping,
    require_choice,
)
from cvqmpt_lab.base.files import (
    json_object,
    json_text,
    make_folder,
    read_json_object,
    read_text,
    write_text,
)
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.item import ExecutedProblem, SensedProblem, UnsolvableProblem
from cvqmpt_lab.benchmarks.motion_bench import BENCH_ARCHIVE, BENCH_HANDS, fetch
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.cli.options import (
    EXACTLY_ONE_OF,
    FLAG,
    SEED,
    Options,
    ProgressBar,
    log,
    one_of,
    option,
    positive_int,
    refuse_changed,
    refuse_given,
    writable_file,
)
from cvqmpt_lab.cli.problem_arguments import (
    chosen_robot,
    configuration,
    name_file,
    robot_source,
)
from cvqmpt_lab.cli.problem_options import CODE, ROBOT, ROBOT_DETAILS, pose_region
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, find_in_region
from cvqmpt_lab.constraints.named import Region, rpy_of, upper_axis
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.planning.usable import why_no_goal
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.urdf import read_urdf


def run(args: argparse.Namespace) -> None:
    """Refuse options that do not go with the action, and run it."""
    goes_with = {
        "problems": ("list", "export"),
        "out": ("export", "import"),
        "goals": ("export",),
        "robot": ("new",),
        "task": ("new",),
        "door": ("new",),
        "urdf": ("new",),
    }
    for name, actions in goes_with.items():
        if args.action not in actions:
            refuse_given(args, [name], f"goes with {' or '.join(actions)}, not with {args.action}")
    if args.action != "new":
        why = f"describes the robot of a new problem: it goes with new, not with {args.action}"
        refuse_changed(args, ROBOT_DETAILS, why)
    ACTIONS[args.action](args)


def _new(args: argparse.Namespace) -> None:
    path = Path(args.what)
    if path.exists():
        raise InvalidInputError(f"{path} exists already; name another file")
    from cvqmpt_lab.benchmarks.task_template import task_template
    from cvqmpt_lab.benchmarks.templates import problem_template, with_limits

    if args.urdf is not None and args.end_effector is None and not args.end_effectors:
        args.end_effector = read_urdf(args.urdf, args.package_dir).likely_end_effectors()[0]
        print(f"end effector {args.end_effector} is a guess; --end-effector chooses another")
    robot, notes = with_limits(robot_source(args) or {"name": "panda"})
    if args.task or args.door:
        kind, made = "task", task_template(robot, "door" if args.door else "drawer")
    else:
        kind, made = "problem", problem_template(robot)
    schema = made["$schema"]
    write_text(writable_file(path), json_text({**made, "name": path.stem}) + "\n")
    schemas = Path(__file__).parents[1] / "schemas"  # cvqmpt_lab holds cli
    write_text(path.parent / schema, read_text(schemas / schema))
    for note in notes:
        print(note)
    if kind == "problem":
        problem = PlanningProblem.load(path)
        print("\n".join(hand_lines(problem.robot, problem.start)))
    print(
        f"{path} written, and {schema} for editors; plan it with: cvqmpt plan --{kind}-file {path}"
    )


def _import(args: argparse.Namespace) -> None:
    """Convert a scene of MoveIt to a json file for a problem or `plan --scene`."""
    from cvqmpt_lab.scene.moveit_scenes import read_moveit_scene  # its meshes take 0.3 s to import

    source = Path(args.what)
    path = args.out or Path(f"{source.stem}.json")
    if path.exists():
        raise InvalidInputError(f"{path} exists already; name another file with --out")
    scene, frame = read_moveit_scene(source)
    write_text(writable_file(path), json_text(to_plain(scene)) + "\n")
    named = f"frame {frame!r}" if frame else "the file's frame"
    print(
        f"{path} written: {len(scene.objects)} objects; {named} is used as the world, at whose "
        "origin the robot's base stands unless --base moves it"
    )
    print(
        f'use it in a problem, "scene": "{path.name}", or in: cvqmpt plan --scene {path} --start '
        f"Q --goal Q"
    )


def _fetch(args: argparse.Namespace) -> None:
    """Download MotionBenchMaker's problems into the cache."""
    require_choice("set of problems", args.what, ["motion-bench"])
    print(f"{fetch()}: 700 problems each of {', '.join(BENCH_HANDS)}")
    print(f"MotionBenchMaker, from {BENCH_ARCHIVE} on the package index, Apache-2.0")
    print("list them, with those that collide: cvqmpt problems list motion-bench")


def _list(args: argparse.Namespace) -> None:
    """Print a line for each problem."""
    for index, problem in _problems(args):
        print(f"{index}: start {' '.join(f'{x:.3f}' for x in problem.start)}")


def _export(args: argparse.Namespace) -> None:
    """Write a file for each problem."""
    if args.out is None:
        raise InvalidInputError("export needs --out DIR")
    make_folder(args.out)
    for index, problem in _problems(args):
        comment = {}
        if args.goals and isinstance(problem, PlanningProblem) and problem.goal_region is not None:
            problem = with_drawn_goals(problem)
            comment = {
                "_comment": "These goals are used as they are; delete them to sample new ones from "
                "goal_region."
            }
        text = json_text({**comment, **problem.to_dict()}) + "\n"
        write_text(args.out / f"{args.what}-{index:03d}.json", text)


def _problems(args: argparse.Namespace) -> Iterator[tuple[int, PlanningProblem | Task]]:
    """Yield the suite's problems with their index; print and count unsolvable ones."""
    if os.sep in args.what:
        raise UnknownChoiceError("suite", args.what, SUITES)
    suite = suite_named(args.what)
    indices = suite.problems[: args.problems]
    bar, unsolvable = ProgressBar(f"{args.action} {suite.name}"), 0
    for done, index in enumerate(indices, start=1):
        problem = suite.item(index)
        if isinstance(problem, UnsolvableProblem):
            unsolvable += 1
            print(f"{index}: unsolvable, {problem.reason}")
        else:
            if isinstance(problem, SensedProblem | ExecutedProblem):
                problem = problem.problem
            yield index, problem
        if args.action == "export":
            bar(done, len(indices))
    print(f"{len(indices) - unsolvable} problems, {unsolvable} unsolvable")


ACTIONS: Mapping[str, Callable[[argparse.Namespace], None]] = {
    "list": _list,
    "export": _export,
    "new": _new,
    "import": _import,
    "fetch": _fetch,
}
OPTIONS: Options = {
    "action": option(", ".join(ACTIONS), type=one_of("action", ACTIONS)),
    "what": option(
        f"suite: {', '.join(SUITES)}; with new: the file to write; with import: a scene of MoveIt "
        "(scene, yaml); with fetch: motion-bench"
    ),
    "--problems": option("only the first N (all)", type=positive_int, metavar="N"),
    "--out": option(
        "folder for the json files (with export); the file to write (with import)",
        type=Path,
        metavar="DIR|S.json",
    ),
    "--goals": option("write sampled goals in addition to the goal region (with export)", **FLAG),
    "--task": option("write a task that opens a drawer (with new)", **FLAG),
    "--door": option("write a task that opens a door (with new)", **FLAG),
    "robot of the new problem (the panda)": ROBOT,
}


def fk(args: argparse.Namespace) -> None:
    """Print the pose of each hand at a configuration."""
    robot = chosen_robot(args, args.problem_file)
    q = configuration(robot, "Q", args.q)
    if args.json:
        poses = {hand: robot.pose(q, hand).tolist() for hand in robot.end_effectors}
        print(json_text({"joints": list(robot.joint_names), "q": q.tolist(), "poses": poses}))
    else:
        print("\n".join(hand_lines(robot, q)))
    outside = robot.joint_outside_limits(q)
    if outside is not None:
        log(f"joint {outside[0]} is outside its limits by {outside[1]:.4g} [rad or m]")


def hand_lines(robot: Robot, q: np.ndarray) -> list[str]:
    """Return a line on the pose of each hand at a configuration (n,), and its axis that is up."""
    lines = []
    for hand in robot.end_effectors:
        T = robot.pose(q, hand)
        angles = rpy_of(T[:3, :3])
        at, rpy = (
            " ".join(f"{x:.4f}" for x in values.round(4) + 0.0) for values in (T[:3, 3], angles)
        )
        axis = upper_axis(T)
        up = abs(T[2, "xyz".index(axis[-1])])
        leans = np.degrees(np.arccos(min(up, 1.0)))
        lines.append(
            f"hand        {hand}: {at} m, roll pitch yaw {rpy} rad; its axis {axis} points up "
            f"most, {leans:.1f} deg from the vertical"
        )
    return lines


def ik(args: argparse.Namespace) -> int:
    """Sample and print configurations; return 1 if there is none."""
    name_file(args)
    if args.suite is not None or args.problem_file is None:
        raise InvalidInputError(f"ik needs a problem file, P.json, not {args.suite or 'nothing'}")
    data = read_json_object(args.problem_file, "problem file")
    region = _region(args, data)
    data["robot"] = robot_source(args, args.problem_file) or data.get("robot")
    with located(str(args.problem_file)):
        data = PlanningProblem.with_named_files(data, args.problem_file.parent)
        robot = robot_from_source(mapping(data.get("robot"), "robot"))
        middle = 0.5 * (robot.lower + robot.upper)  # used as start, which may be missing
        given = {**data, "start": middle, "start_region": None, "goals": [], "goal_region": region}
        problem = PlanningProblem.from_dict(given)
    found = find_in_region(
        problem.robot,
        region,
        problem.collision_checker(SAMPLE_MARGIN_M),
        np.random.default_rng(args.seed),
        args.count,
        max_poses=max(100, 10 * args.count),
        within=problem.constraint,
        distinct=0.01,  # Newton's method ends much closer to a posture [rad or m]
    )
    configurations = found.configurations.tolist()
    if args.json:
        print(
            json_text({"joints": list(problem.robot.joint_names), "configurations": configurations})
        )
    else:
        print("\n".join(json.dumps(q) for q in configurations))
        postures = f"{len(configurations)} posture{'s' * (len(configurations) != 1)}"
        print(f"{postures} found, {args.count} asked; {found.outcome}")
        if not configurations:
            print(why_no_goal(replace(problem, goal_region=region)))
    return 0 if configurations else 1


def _region(args: argparse.Namespace, data: dict) -> TaskSpaceRegion:
    """Return the region of --pose or --region."""
    if args.pose is not None:
        return args.pose
    if args.region in ("goal_region", "start_region"):
        if args.region not in data:
            raise InvalidInputError(
                f"{args.problem_file} has no {args.region!r}; write one after --region"
            )
        with located(f"{args.problem_file}"):
            return from_plain(Region, data[args.region], args.region)
    return from_plain(Region, json_object(args.region, "--region"), "--region")


IK: Options = {
    "suite": option(
        "problem file: robot, scene, constraint and attachments; start and goals may still be "
        "missing",
        nargs="?",
        metavar="P.json",
    ),
    "--problem-file": option("the same", type=Path, metavar="P.json"),
    EXACTLY_ONE_OF: {
        "--pose": option(
            "end-effector pose in the world: [m], roll, pitch, yaw [rad]",
            type=partial(pose_region, "--pose"),
            metavar="'X Y Z R P Y'",
        ),
        "--region": option("region as json, or goal_region or start_region of the file"),
    },
    "--count": option(
        "largest number of configurations; two that differ only by full turns of joints count as "
        "one (1)",
        type=positive_int,
        default=1,
        metavar="N",
    ),
    **SEED,
    "--json": option("print one json object", **FLAG),
    **CODE,
    "another robot for --problem-file": ROBOT,
}
FK: Options = {
    "q": option("configuration, or a group_state of the SRDF [rad or m]", metavar="Q"),
    "problem_file": option("problem file with the robot", nargs="?", type=Path, metavar="P.json"),
    "--json": option("print one json object, with matrices", **FLAG),
    "the robot (the panda)": ROBOT,
}
COMMANDS = {"problems": (run, OPTIONS), "ik": (ik, IK), "fk": (fk, FK)}
