"""`cvqmpt data`: make training data."""

import argparse
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from cli.options import ProgressBar, log, own_command, positive_int
from cli.robot_options import add_robot, robot_source
from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError
from cvqmpt_lab.labels.generation import PANDA, SceneRecipe, Shard, generate
from cvqmpt_lab.labels.path_labels import PathRecipe
from cvqmpt_lab.labels.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.scene.families import FAMILIES
from cvqmpt_lab.warm_up import compile_kernels
from experiments.executors import Lost, local_processes
from experiments.run import default_jobs

EXAMPLES = (
    "cvqmpt data generate --scenes 64 --paths-per-scene 8 --out data/small",
    "cvqmpt data generate --robot ur5 --scenes 1000 --paths-per-scene 50 --out data/ur5",
    "cvqmpt data generate --labels roadmap --scenes 20000 --out data/roadmap",
    "cvqmpt data generate --labels roadmap --robot kinova --scenes 70 --paths-per-scene 4 --out "
    "data/kinova",
    "cvqmpt data generate --labels roadmap --robot ur5 --dictionary runs/ur5 --scenes 4000 --out "
    "data/ur5-roadmap",
    "cvqmpt data generate --scenes 4000 --paths-per-scene 75 --family shelves,table --seed 1 "
    "--out data/furniture",
)
ACTIONS = ("generate",)
LABELS: Mapping[str, type[SceneRecipe]] = {"paths": PathRecipe, "roadmap": RoadmapRecipe}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """How much of what, and where to."""
    add = parser.add_argument
    add("action", help=", ".join(ACTIONS))
    add("--scenes", type=positive_int, required=True, metavar="N", help="scenes in all")
    tried = "paths tried per scene (50)"
    add("--paths-per-scene", type=positive_int, default=50, metavar="M", help=tried)
    family = f"of {', '.join(FAMILIES)} (all, in turn)"
    add("--family", default=",".join(FAMILIES), metavar="A,B", help=family)
    labels = "near-shortest paths, or free nodes and edges of a roadmap, and shortest paths (paths)"
    add("--labels", default="paths", help=f"{' or '.join(LABELS)}: {labels}")
    dictionary = (
        "labels roadmap: --out of `cvqmpt train stage1` (the shipped; free "
        "configurations of other arms)"
    )
    add("--dictionary", "--model", metavar="DIR", help=dictionary)
    add("--seed", type=int, default=0, help="another seed, other scenes and paths (0)")
    add(
        "--jobs",
        type=positive_int,
        default=default_jobs(),
        metavar="J",
        help="processes (one a core)",
    )
    add("--out", type=Path, required=True, metavar="DIR", help="folder; continued if it exists")
    add_robot(parser, "another robot than the Panda")


def run(args: argparse.Namespace) -> int:
    """Generate what is missing."""
    if args.action not in ACTIONS:
        raise UnknownChoiceError("action", args.action, ACTIONS)
    families, robot = tuple(args.family.split(",")), robot_source(args) or PANDA
    if args.labels not in LABELS:
        raise UnknownChoiceError("kind of labels", args.labels, LABELS)
    more = {}
    if args.dictionary is not None:
        if args.labels != "roadmap":
            raise InvalidInputError("--dictionary is for --labels roadmap; leave it out")
        more["model"] = args.dictionary
    recipe = LABELS[args.labels](
        args.scenes, args.paths_per_scene, families, args.seed, robot=robot, **more
    )
    compile_kernels(log)

    def in_processes(make: Callable[[int], Shard], numbers: list[int]) -> Iterator[Shard]:
        with local_processes(args.jobs) as executor:
            for number, shard in executor.results(make, numbers):
                if isinstance(shard, Lost):
                    raise CvqmptError(f"shard {number}: {shard.detail}; what was finished is kept")
                yield shard

    paths = generate(recipe, args.out, own_command(), ProgressBar("data"), in_processes)
    print((args.out / "README.md").read_text())
    print(f"{paths} paths in {args.out}")
    return 0
