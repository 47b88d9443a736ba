"""`cvqmpt ik`: free configurations on the manifold for a pose or region, for a problem file."""

import argparse
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from cli.options import EXACTLY_ONE_OF, FLAG, SEED, Options, option, positive_int
from cli.problem_options import pose_region
from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, find_in_region
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.errors import InvalidInputError, located, mapping
from cvqmpt_lab.files import json_object, json_text, read_json_object
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source


def run(args: argparse.Namespace) -> int:
    """Sample, print; exit code 1 when there is none."""
    data = read_json_object(args.problem_file, "problem file")
    region = _region(args, data)
    with located(str(args.problem_file)):
        data = PlanningProblem.with_named_files(data, args.problem_file.parent)
        robot = robot_from_source(mapping(data.get("robot"), "robot"))
        middle = 0.5 * (robot.lower + robot.upper)  # stands for a start that may still be missing
        given = {**data, "start": middle, "start_region": None, "goals": [], "goal_region": region}
        problem = PlanningProblem.from_dict(given)
    found = find_in_region(
        problem.robot,
        region,
        problem.collision_checker(SAMPLE_MARGIN),
        np.random.default_rng(args.seed),
        args.count,
        max_poses=max(100, 10 * args.count),
        within=problem.constraint,
    )
    configurations = found.configurations.tolist()
    if args.json:
        print(
            json_text({"joints": list(problem.robot.joint_names), "configurations": configurations})
        )
    else:
        print("\n".join(json.dumps(q) for q in configurations))
        print(f"{len(configurations)} of {args.count} configurations; {found.outcome}")
        if not configurations:
            print(replace(problem, goal_region=region).why_no_goal())
    return 0 if configurations else 1


def _region(args: argparse.Namespace, data: dict) -> TaskSpaceRegion:
    """The region asked for."""
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


OPTIONS: Options = {
    "--problem-file": option(
        "robot, scene, constraint and attachments; start and goals may still be missing",
        type=Path,
        metavar="P.json",
        required=True,
    ),
    EXACTLY_ONE_OF: {
        "--pose": option(
            "end-effector pose in the world: [m], roll, pitch, yaw [rad]",
            type=partial(pose_region, "--pose"),
            metavar="'X Y Z R P Y'",
        ),
        "--region": option("as in a problem file; or goal_region or start_region of the file"),
    },
    "--count": option("how many at most (1)", type=positive_int, default=1, metavar="N"),
    **SEED,
    "--json": option("print one json object", **FLAG),
}
COMMANDS = {"ik": (run, OPTIONS)}
