"""`cvqmpt data`: make training data."""

import argparse
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.benchmarks.families import FAMILIES
from cvqmpt_lab.cli.options import (
    Options,
    ProgressBar,
    compiling,
    not_negative_int,
    one_of,
    option,
    own_command,
    positive_int,
)
from cvqmpt_lab.cli.problem_arguments import robot_source
from cvqmpt_lab.cli.problem_options import ROBOT
from cvqmpt_lab.experiments.executors import Lost, local_processes
from cvqmpt_lab.experiments.run import default_jobs
from cvqmpt_lab.planning.warm_up import compile_kernels
from cvqmpt_lab.training.generation import PathRecipe, SceneRecipe, Shard, generate
from cvqmpt_lab.training.roadmap_labels import RoadmapRecipe

LABELS: Mapping[str, type[SceneRecipe]] = {"paths": PathRecipe, "roadmap": RoadmapRecipe}


def run(args: argparse.Namespace) -> None:
    """Generate the shards that are missing in --out."""
    families = tuple(args.family.split(","))
    robot = robot_source(args)
    more: dict[str, Any] = {}
    if robot is not None:
        more["robot"] = robot
    if args.dictionary is not None:
        if args.labels != "roadmap":
            raise InvalidInputError("--dictionary is for --labels roadmap; leave it out")
        more["model"] = args.dictionary
    recipe = LABELS[args.labels](args.scenes, args.paths_per_scene, families, args.seed, **more)
    compile_kernels(compiling())

    def in_processes(make: Callable[[int], Shard], numbers: list[int]) -> Iterator[Shard]:
        with local_processes(args.jobs) as executor:
            for number, shard in executor.results(make, numbers):
                if isinstance(shard, Lost):
                    raise CvqmptError(f"shard {number}: {shard.detail}; finished shards are kept")
                yield shard

    generate(recipe, args.out, own_command(), ProgressBar("data"), in_processes)
    print((args.out / "README.md").read_text())


OPTIONS: Options = {
    "action": option("generate", type=one_of("action", ("generate",))),
    "--scenes": option(
        "number of scenes over all families", type=positive_int, required=True, metavar="N"
    ),
    "--paths-per-scene": option(
        "pairs of start and goal tried per scene (50)", type=positive_int, default=50, metavar="M"
    ),
    "--family": option(
        f"families of scenes: {', '.join(FAMILIES)} (all in turn)",
        default=",".join(FAMILIES),
        metavar="A,B",
    ),
    "--labels": option(
        f"{' or '.join(LABELS)}: near-shortest paths, or free nodes and edges of a roadmap and its "
        "shortest paths (paths)",
        type=one_of("kind of labels", LABELS),
        default="paths",
    ),
    "--dictionary --model": option(
        "dictionary for --labels roadmap: folder --out of `cvqmpt train stage1` (the shipped one "
        "of the Panda)",
        metavar="DIR",
    ),
    "--seed": option("seed of scenes and paths (0)", type=not_negative_int, default=0),
    "--jobs": option(
        "processes (one per core)", type=positive_int, default=default_jobs(), metavar="J"
    ),
    "--out": option(
        "folder of the data; continued if it exists", type=Path, required=True, metavar="DIR"
    ),
    **ROBOT,
}
COMMANDS = {"data": (run, OPTIONS)}
