"""`cvqmpt problems`: list or write a suite's problems, write a template, import or fetch others.

`cvqmpt ik`: free configurations on the manifold for a pose or region, for a problem file.
`cvqmpt fk`: pose of the hand at a configuration.
"""

import argparse
import json
import os
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.codec import Document, from_plain, to_plain
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
    write_text,
)
from cvqmpt_lab.base.json_schema import json_schema
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.item import ExecutedProblem, Phases, SensedProblem, UnsolvableProblem
from cvqmpt_lab.benchmarks.motion_bench import BENCH_ARCHIVE, BENCH_HANDS, fetch
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.cli.options import (
    FLAG,
    ONE_OF,
    SEED,
    Options,
    ProgressBar,
    log,
    one_of,
    option,
    positive_int,
    refuse_given,
    writable_file,
)
from cvqmpt_lab.cli.problem_arguments import (
    chosen_robot,
    configuration,
    function_of_option,
    named_file,
    robot_source,
)
from cvqmpt_lab.cli.problem_options import CODE, FUNCTIONS, ROBOT, pose_region
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, find_in_region
from cvqmpt_lab.constraints.named import Region, rpy_of, upper_axis
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, symmetric_region
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.planning.usable import why_no_goal
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.dynamics import too_weak
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot

OPENED = ("drawer", "door")  # what the robot of a new task opens


def run(args: argparse.Namespace) -> None:
    """Refuse options that do not go with the action, and run it."""
    goes_with = {
        "problems": ("list", "export"),
        "out": ("export", "import"),
        "goals": ("export",),
        "robot": ("new", "import"),
        "task": ("new",),
        "constraint": ("new",),
    }
    for name, actions in goes_with.items():
        if args.action not in actions:
            refuse_given(args, [name], f"goes with {' or '.join(actions)}, not with {args.action}")
    ACTIONS[args.action](args)


def _new(args: argparse.Namespace) -> None:
    path = Path(args.what)
    if path.exists():
        raise InvalidInputError(f"{path} exists already; name another file")
    from cvqmpt_lab.benchmarks.task_template import task_template
    from cvqmpt_lab.benchmarks.templates import problem_template, with_limits

    robot, notes = with_limits(robot_source(args, print) or {"name": "panda"})
    kind: type[Document]
    functions = [function_of_option(text) for text in args.constraint]
    if args.task is not None:
        refuse_given(args, ["constraint"], "goes with a problem; a task states its own constraints")
        kind, made = Task, task_template(robot, args.task, ProgressBar(f"new {args.task}"))
    else:
        kind, made = PlanningProblem, problem_template(robot, functions)
    write_text(writable_file(path), json_text({**made, "name": path.stem}) + "\n")
    schema = _write_schema(path.parent, kind)
    for note in notes:
        print(note)
    if args.task is None:
        problem = PlanningProblem.load(path)
        if weak := too_weak(problem.robot):
            print(f"note: {weak}")
        print("\n".join(hand_lines(problem.robot, problem.start)))
    added = "".join(f" --constraint {shlex.quote(text)}" for text in args.constraint)
    for function in functions:
        print(f"constraint  start and goal keep {function.describe()}; the file does not name it")
    print(f"{path} written, and {schema} for editors; plan it with: cvqmpt plan {path}{added}")


def _write_schema(folder: Path, document: type[Document]) -> str:
    """Write the JSON schema of a kind of file for editors, and return its name."""
    name = f"{document.__name__.removeprefix('Planning').lower()}.schema.json"
    write_text(folder / name, json_text(json_schema(document)) + "\n")
    return name


def _import(args: argparse.Namespace) -> None:
    """Convert a scene of MoveIt to a json file for a problem or `plan --scene`."""
    from cvqmpt_lab.scene.moveit_scenes import read_moveit_scene  # its meshes take 0.3 s to import

    source = Path(args.what)
    path = args.out or Path(f"{source.stem}.json")
    if path.exists():
        raise InvalidInputError(f"{path} exists already; name another file with --out")
    robot = chosen_robot(args) if args.robot else None
    scene, frame = read_moveit_scene(source, robot)
    write_text(writable_file(path), json_text(to_plain(scene)) + "\n")
    named = f"frame {frame!r}" if frame else "the file's frame"
    if robot is not None:
        where = f"frames are those of {robot.name}"
    else:
        where = (
            f"{named} is used as the world, at whose origin the robot's base stands unless base in "
            "the field robot moves it"
        )
    print(f"{path} written: {len(scene.objects)} objects; {where}")
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
    schemas: dict[type[Document], str] = {}
    for index, problem in _problems(args):
        kind = type(problem)
        schemas[kind] = schemas.get(kind) or _write_schema(args.out, kind)
        beside = {"$schema": schemas[kind]}
        if args.goals and isinstance(problem, PlanningProblem) and problem.goal_region is not None:
            problem = with_drawn_goals(problem)
            beside["_comment"] = (
                "These goals are used as they are; delete them to sample new ones from goal_region."
            )
        text = json_text({**beside, **problem.to_dict()}) + "\n"
        write_text(args.out / f"{args.what}-{index.zfill(3)}.json", text)


def _problems(args: argparse.Namespace) -> Iterator[tuple[str, PlanningProblem | Task]]:
    """Yield the suite's problems with their index; print and count unsolvable ones.

    The index of a phase is followed by its name.
    """
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
        elif isinstance(problem, Phases):
            yield from ((f"{index}-{phase}", one) for phase, one in problem.problems.items())
        else:
            if isinstance(problem, SensedProblem | ExecutedProblem):
                problem = problem.problem
            yield str(index), problem
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
    "--task": option(
        "write a task that opens a drawer or a door (drawer), instead of a problem (with new)",
        nargs="?",
        const=OPENED[0],
        type=one_of("task", OPENED),
        metavar="|".join(OPENED),
    ),
    **FUNCTIONS,
    **ROBOT,
}


def fk(args: argparse.Namespace) -> None:
    """Print the pose of each hand at a configuration."""
    files = [Path(word) for word in args.q if word.endswith(".json")]
    given = [word for word in args.q if not word.endswith(".json")]
    if len(files) > 1 or len(given) > 1:
        raise InvalidInputError(
            f"{' '.join(args.q)}: write one configuration Q, one file, or one of each"
        )
    file = files[0] if files else None
    robot = chosen_robot(args, file)
    q = configuration(robot, "Q", given[0] if given else "start", file)
    if args.json:
        poses = {name: robot.pose(q, name).tolist() for name in robot.hands}
        print(json_text({"joints": list(robot.joint_names), "q": q.tolist(), "poses": poses}))
    else:
        print("\n".join(hand_lines(robot, q)))
    outside = robot.joint_outside_limits(q)
    if outside is not None:
        log(f"joint {outside[0]} is outside its limits by {outside[1]:.4g} [rad or m]")


def hand_lines(robot: Robot, q: np.ndarray) -> list[str]:
    """Return a line on the pose of each hand at a configuration (n,), and its axis that is up.

    A tool has two lines: of its frame, and of the link that it is fixed to.
    """
    lines = []
    for name in robot.hands:
        T, kind = robot.pose(q, name), "link" if name in robot.tool_links else "hand"
        angles = rpy_of(T[:3, :3])
        at, rpy = (
            " ".join(f"{x:.4f}" for x in values.round(4) + 0.0) for values in (T[:3, 3], angles)
        )
        axis = upper_axis(T)
        up = abs(T[2, "xyz".index(axis[-1])])
        leans = np.degrees(np.arccos(min(up, 1.0)))
        lines.append(
            f"{kind}        {name}: {at} m, roll pitch yaw {rpy} rad; its axis {axis} points up "
            f"most, {leans:.1f} deg from the vertical"
        )
    return lines


def ik(args: argparse.Namespace) -> int:
    """Sample and print configurations; return 1 if there is none."""
    file = named_file(args.file)
    if file is None:
        raise InvalidInputError(f"ik needs a problem file, P.json, not {args.file}")
    data = read_json_object(file, "problem file")
    if data.get("schema") == Task.SCHEMA:
        kept = {name: value for name, value in data.items() if name in ("name", "robot", "scene")}
        data = {**kept, "schema": PlanningProblem.SCHEMA}
    region = _region(args, file, data)
    data["robot"] = robot_source(args) or data.get("robot")
    with located(str(file)):
        data = PlanningProblem.with_named_files(data, file.parent)
        robot = robot_from_source(mapping(data.get("robot"), "robot"))
        middle = 0.5 * (robot.lower + robot.upper)  # used as start, which may be missing
        given = {**data, "start": middle, "start_region": None, "goals": [], "goal_region": region}
        problem = PlanningProblem.from_dict(given)
    functions = map(function_of_option, args.constraint)
    problem = replace(problem, constraint=(*problem.constraint, *functions))
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


def _region(args: argparse.Namespace, file: Path, data: dict) -> TaskSpaceRegion:
    """Return the region of --pose or --region; by default the file's goal region.

    With functions of --constraint it is by default that of all poses.
    """
    if args.pose is not None:
        return args.pose
    if args.region is None and args.constraint:
        return symmetric_region(np.eye(4), np.eye(4), [FREE] * 6)
    name = {None: "goal_region", "goal": "goal_region", "start": "start_region"}.get(
        args.region, args.region
    )
    if name not in ("goal_region", "start_region"):
        return from_plain(Region, json_object(name, "--region"), "--region")
    if name in data:
        with located(f"{file}"):
            return from_plain(Region, data[name], name)
    point = name.removesuffix("_region")
    if data.get("start" if point == "start" else "goals"):
        robot = chosen_robot(args, file)
        pose = robot.pose(configuration(robot, "--region", point, file))
        return from_plain(Region, {"pose": {"at": pose.tolist()}}, name)
    raise InvalidInputError(f"{file} has no {name!r}; write one after --region")


IK: Options = {
    "file": option(
        "problem or task file: robot, scene, constraint and attachments; start and goals may still "
        "be missing",
        metavar="FILE",
    ),
    ONE_OF: {
        "--pose": option(
            "end-effector pose in the world: [m], roll, pitch, yaw [rad]",
            type=partial(pose_region, "--pose"),
            metavar="'X Y Z R P Y'",
        ),
        "--region": option(
            "region as json, or goal or start: that region of the file, or the pose of the end "
            "effector there (goal; with --constraint: anywhere)"
        ),
    },
    **FUNCTIONS,
    "--count": option(
        "largest number of configurations; two that differ only by full turns of joints count as "
        "one (1)",
        type=positive_int,
        default=1,
        metavar="N",
    ),
    **SEED,
    "--json": option("print one json object instead", **FLAG),
    **CODE,
    **ROBOT,
}
FK: Options = {
    "q": option(
        "configuration, a group_state of the SRDF, or start or goal of the file (start) [rad or "
        "m]; problem or task file with the robot",
        nargs="+",
        metavar="Q|FILE",
    ),
    "--json": option("print one json object instead, with matrices", **FLAG),
    **ROBOT,
}
COMMANDS = {"problems": (run, OPTIONS), "ik": (ik, IK), "fk": (fk, FK)}
