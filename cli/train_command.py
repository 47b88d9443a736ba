"""`cvqmpt train`: train a dictionary, a transformer or MPNet; needs torch and numpy only."""

import argparse
import json
from pathlib import Path

from cli.options import (
    FLAG,
    ONE_OF,
    Options,
    ProgressBar,
    log,
    not_negative_int,
    one_of,
    option,
    own_command,
    positive,
    positive_int,
)
from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError, require_installed
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.results.provenance import provenance

# as in `training.profiles`, which needs torch
STAGES = ("stage1", "mpnet", "transformer", "published")
REMOVED = {
    "edge-model": "roadmaps of every arm use one fitted curve, cvqmpt_lab/search/edge_costs.py",
    "stage2": "train published learns the same from paths and from labels on a roadmap; give it "
    "the same --data and --dictionary",
}
PROFILE_NAMES = ("smoke", "compact", "published")


def run(args: argparse.Namespace) -> None:
    """Train, showing loss and time left."""
    require_installed("torch", "cvqmpt train", "train")
    from cvqmpt_lab.training.profiles import Profile, profile_named
    from cvqmpt_lab.training.trainer import run_training

    profile = profile_named(args.profile)
    if args.config is not None:
        plain = read_json_object(args.config)
        if isinstance(plain.get("published_model"), dict) and "dense" in plain["published_model"]:
            raise InvalidInputError(
                "published_model.dense was removed: train transformer learns which codes and edges "
                "are free; leave it out"
            )
        profile = from_plain(Profile, plain, "profile")
    if args.print_config:
        print(json.dumps(to_plain(profile, complete=True), indent=2))
        return
    for name in ("data", "out"):
        if getattr(args, name) is None:
            raise InvalidInputError(f"give --{name} DIR")
    command = own_command()
    origin = provenance(command, [args.seed])
    progress = run_training(
        args.stage,
        profile,
        args.data,
        args.out,
        dictionary=args.dictionary,
        seed=args.seed,
        epochs=args.epochs,
        minutes=args.minutes,
        workers=args.workers,
        device=args.device,
        metadata={"command": command, "provenance": origin},
        report=ProgressBar(args.stage),
    )
    for name, value in (progress.rows[-1] if progress.rows else {}).items():
        print(f"{name:40} {'' if value is None else format(value, '.6g')}")
    if not progress.finished:
        log("stopped after --minutes; the same command continues")
    print(f"model in {args.out / 'model'}, curves in {args.out / 'curves.csv'}")


OPTIONS: Options = {
    "stage": option(f"what to train: {', '.join(STAGES)}", type=one_of("stage", STAGES, REMOVED)),
    ONE_OF: {
        "--profile": option(f"of {', '.join(PROFILE_NAMES)} (compact)", default="compact"),
        "--config": option("a profile of your own, see --print-config", type=Path, metavar="FILE"),
    },
    "--print-config": option("print the profile as json and stop", **FLAG),
    "--data": option("what `cvqmpt data generate` wrote", type=Path, metavar="DIR"),
    "--out": option(
        "for state, curves and model/; continued if it is there", type=Path, metavar="DIR"
    ),
    "--dictionary": option(
        "transformer (from labels), published (the authors' architecture, from paths or labels): "
        "--out of stage1 (the shipped)",
        type=Path,
        metavar="DIR",
    ),
    "--seed": option("repeatable on a CPU (0)", type=not_negative_int, default=0, metavar="S"),
    "--epochs": option("in all (the profile's)", type=positive_int, metavar="N"),
    "--minutes": option("stop and save after M minutes", type=positive, metavar="M"),
    "--device": option("cpu, cuda, or auto (auto)", default="auto"),
    "--workers": option(
        "processes that prepare batches (0: none)", type=not_negative_int, default=0, metavar="J"
    ),
}
COMMANDS = {"train": (run, OPTIONS)}
