"""`cvqmpt model`: report on weights, or convert published weights.

`cvqmpt train`: train a dictionary, a transformer or MPNet; needs torch and numpy only.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_installed
from cvqmpt_lab.base.files import read_json_object
from cvqmpt_lab.benchmarks.results.provenance import provenance
from cvqmpt_lab.cli.options import (
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
    refuse_given,
)
from cvqmpt_lab.vqmpt.weights import (
    CONFIG_FILE,
    MPNET,
    SHIPPED,
    TRAINED_FOLDER,
    TRANSFORMER,
    read_description,
    read_model,
    resolve_model,
    robot_signature,
    weights_digest,
)


def model(args: argparse.Namespace) -> None:
    """Report on weights, or convert them and report."""
    if args.action == "info":
        refuse_given(args, ("dictionary_dir", "ar_dir", "out"), "is for import; leave it out")
    if args.action == "import":
        refuse_given(args, ["model"], "is for info; give --out for the imported model")
        for name in ("dictionary_dir", "ar_dir", "out"):
            folder = getattr(args, name)
            if folder is None:
                raise InvalidInputError(f"import: give --{name.replace('_', '-')} DIR")
            if name != "out":
                _refuse_own_weights(folder)
        if args.out.exists() and (not args.out.is_dir() or any(args.out.iterdir())):
            raise InvalidInputError(f"{args.out} exists and is not empty; choose another --out")
        require_installed("torch", "cvqmpt model import", "train")
        # training shares this file and needs no pinocchio
        from cvqmpt_lab.robot.load import robot_from_source
        from cvqmpt_lab.vqmpt.checkpoint import import_published, save_checkpoint

        robot = robot_signature(robot_from_source({"name": "panda"}))
        published = import_published(args.dictionary_dir, args.ar_dir, robot)
        save_checkpoint(args.out, published)
    found = _info(resolve_model(args.out if args.action == "import" else args.model))
    print(json.dumps(found, indent=2) if args.json else "\n".join(_summary(found)))


def _refuse_own_weights(folder: Path) -> None:
    """Refuse a folder that `cvqmpt train` wrote: its weights are used as they are."""
    for weights in (folder, folder / TRAINED_FOLDER):
        if (weights / CONFIG_FILE).is_file():
            raise InvalidInputError(
                f"{weights} has weights of this toolkit, which need no import; they are described "
                f"by: cvqmpt model info --model {weights}"
            )


def _info(folder: Path) -> dict[str, Any]:
    """Read and check a folder of weights; return its description as plain json."""
    stored, description = read_model(folder), read_description(folder)
    for part, arrays in stored.parts.items():
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise InvalidInputError(
                    f"{folder / part}.safetensors: {name} has NaN or infinite values; train or "
                    "fetch the weights again"
                )
    if TRANSFORMER in stored.parts:
        # imported here because it loads compiled functions
        from cvqmpt_lab.vqmpt.codebook import require_own_dictionary

        require_own_dictionary(stored)
    if stored.architecture == MPNET:
        from cvqmpt_lab.vqmpt.mpnet_rollouts import MPNetNetwork

        MPNetNetwork(stored)  # refuses arrays that do not fit the configuration
    parts = {
        f"{name}.safetensors": {
            "bytes": (folder / f"{name}.safetensors").stat().st_size,
            "numbers": sum(array.size for array in arrays.values()),
            "sha256": description["sha256"][name],
        }
        for name, arrays in stored.parts.items()
    }
    return {
        "folder": str(folder),
        "sha256": weights_digest(folder),
        "architecture": stored.architecture,
        "robot": to_plain(stored.robot, complete=True),
        "parts": parts,
        "model": to_plain(stored.config, complete=True),
        "metadata": dict(stored.metadata),
    }


def _summary(found: dict[str, Any]) -> list[str]:
    """Return the lines of the report on weights, from the json of `_info`."""
    robot, config, metadata = found["robot"], found["model"], found["metadata"]
    kind = f", {config['kind']}" if "kind" in config else ""
    digest = robot["kinematics"] or "not recorded"
    lines = [
        f"folder        {found['folder']}",
        f"architecture  {found['architecture']}{kind}",
        f"robot         {robot['name']}, {len(robot['lower'])} joints, kinematics {digest}",
        f"sha256        {found['sha256']}",
    ]
    names = robot["joints"] or [str(joint) for joint in range(len(robot["lower"]))]
    limits = zip(names, robot["lower"], robot["upper"], strict=True)
    lines += [f"    {name:20} {lower:8g} .. {upper:g}" for name, lower, upper in limits]
    lines += ["", f"{'file':28} {'bytes':>12} {'numbers':>12}"]
    lines += [
        f"{name:28} {part['bytes']:>12,} {part['numbers']:>12,}"
        for name, part in found["parts"].items()
    ]
    listed = ("source", "stage", "seed", "train_paths", "validation_paths", "epochs")
    shown = {name: metadata[name] for name in listed if name in metadata}
    losses = metadata.get("losses")
    shown |= losses if isinstance(losses, dict) else {}
    return [
        *lines,
        "",
        *(
            f"{name:44} {x:.6g}" if isinstance(x, float) else f"{name:44} {x}"
            for name, x in shown.items()
            if x is not None
        ),
        "",
        f"all sizes and training settings: cvqmpt model info --model {found['folder']} --json",
    ]


MODEL: Options = {
    "action": option(
        "info: report on weights; import: convert published VQ-MPT folders (MPNet folders cannot "
        "be converted: train MPNet)",
        type=one_of("action", ("info", "import")),
    ),
    "--model": option(
        f"info: {', '.join(SHIPPED)}, or the folder of a model (vq_mpt)", metavar="DIR"
    ),
    "--json": option("info: print everything as json", **FLAG),
    "--dictionary-dir": option("import: folder of the published stage 1", type=Path, metavar="DIR"),
    "--ar-dir": option("import: folder of the published stage 2", type=Path, metavar="DIR"),
    "--out": option("import: folder to write, new or empty", type=Path, metavar="DIR"),
}


# copied from `training.profiles`, which needs torch
STAGES = ("stage1", "mpnet", "transformer", "published")
PROFILE_NAMES = ("smoke", "compact", "published")


def train(args: argparse.Namespace) -> None:
    """Train a network, and show its loss and the remaining time."""
    require_installed("torch", "cvqmpt train", "train")
    from cvqmpt_lab.training.profiles import Profile, profile_named
    from cvqmpt_lab.training.trainer import Effort, run_training

    profile = profile_named(args.profile)
    if args.config is not None:
        profile = from_plain(Profile, read_json_object(args.config), "profile")
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
        effort=Effort(args.epochs, args.minutes, args.workers, args.device),
        metadata={"command": command, "provenance": origin},
        report=ProgressBar(args.stage),
    )
    for name, value in (progress.rows[-1] if progress.rows else {}).items():
        print(f"{name:40} {'' if value is None else format(value, '.6g')}")
    if not progress.finished:
        log("stopped after --minutes; repeat the command to continue")
    print(f"model in {args.out / 'model'}, curves in {args.out / 'curves.csv'}")


TRAIN: Options = {
    "stage": option(f"what to train: {', '.join(STAGES)}", type=one_of("stage", STAGES)),
    ONE_OF: {
        "--profile": option(f"one of {', '.join(PROFILE_NAMES)} (compact)", default="compact"),
        "--config": option(
            "json file with a profile of your own, in the form of --print-config",
            type=Path,
            metavar="FILE",
        ),
    },
    "--print-config": option("print the profile as json and stop", **FLAG),
    "--data": option("folder written by `cvqmpt data generate`", type=Path, metavar="DIR"),
    "--out": option(
        "folder for state, curves and model/; continued if it exists", type=Path, metavar="DIR"
    ),
    "--dictionary": option(
        "for the stages transformer (trained on labels) and published (the authors' architecture, "
        "trained on paths or labels): the folder --out of stage1 (the shipped dictionary)",
        type=Path,
        metavar="DIR",
    ),
    "--seed": option(
        "seed; training repeats exactly on a CPU (0)", type=not_negative_int, default=0, metavar="S"
    ),
    "--epochs": option(
        "total number of epochs (given by the profile)", type=positive_int, metavar="N"
    ),
    "--minutes": option("stop and save after M minutes", type=positive, metavar="M"),
    "--device": option("cpu, cuda, or auto (auto)", default="auto"),
    "--workers": option(
        "processes that prepare batches (0: none)", type=not_negative_int, default=0, metavar="J"
    ),
}
COMMANDS = {"model": (model, MODEL), "train": (train, TRAIN)}
