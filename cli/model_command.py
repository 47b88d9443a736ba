"""`cvqmpt model`: look at weights, convert published ones."""

import argparse
import json
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.models.checkpoint import ARCHITECTURE, load_checkpoint, save_checkpoint
from cvqmpt_lab.models.mpnet.network import ARCHITECTURE as MPNET_ARCHITECTURE
from cvqmpt_lab.models.mpnet.network import load_mpnet
from cvqmpt_lab.models.published.checkpoint_import import import_published
from cvqmpt_lab.models.weights_folder import (
    CONFIG_FILE,
    Description,
    checkpoint_sha256,
    read_description,
    read_json_object,
)
from cvqmpt_lab.prediction.configurations import robot_signature
from cvqmpt_lab.prediction.shipped import shipped_model_folder
from cvqmpt_lab.robot.loading import robot_from_source

EXAMPLES = (
    "cvqmpt model info",
    "cvqmpt model info --model runs/stage2/model",
    "cvqmpt model import --dictionary-dir model1 --ar-dir stage2/model1 --out runs/published",
)
ACTIONS = ("info", "import")
WIDE = ("kinematics",)  # metadata that would fill a screen


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to do, with which folders."""
    parser.add_argument("action", help=", ".join(ACTIONS))
    parser.add_argument(
        "--model", type=Path, metavar="DIR", help="info: folder of weights (those of the package)"
    )
    parser.add_argument("--dictionary-dir", type=Path, metavar="DIR", help="import: published stage 1")
    parser.add_argument("--ar-dir", type=Path, metavar="DIR", help="import: published stage 2")
    parser.add_argument("--out", type=Path, metavar="DIR", help="import: folder to write, new or empty")


def run(args: argparse.Namespace) -> int:
    """Report on weights, or convert them and report."""
    if args.action not in ACTIONS:
        raise UnknownChoiceError("action", args.action, ACTIONS)
    if args.action == "import":
        for name in ("dictionary_dir", "ar_dir", "out"):
            if getattr(args, name) is None:
                raise InvalidInputError(f"import: give --{name.replace('_', '-')} DIR")
        _import(args.dictionary_dir, args.ar_dir, args.out)
        _print_info(args.out)
        return 0
    _print_info(shipped_model_folder() if args.model is None else args.model)
    return 0


def _import(dictionary_dir: Path, ar_dir: Path, out: Path) -> None:
    """Convert published folders, whose weights are the Panda's."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InvalidInputError(f"{out} is there and not empty; choose another --out")
    imported = import_published(dictionary_dir, ar_dir, robot_signature(robot_from_source({"name": "panda"})))
    report = imported.report
    print(f"{'state':20} {'tensors':>8} {'parameters':>12}")
    for state in report.states:
        print(f"{state.name:20} {state.tensors:>8} {state.parameters:>12,}")
    print(f"epochs: dictionary {report.dictionary_epoch}, sequence model {report.sequence_epoch}")
    print(f"not used: {', '.join(report.ignored) or 'nothing'}\n")
    save_checkpoint(out, imported.checkpoint)


def _print_info(folder: Path) -> None:
    """Print what a folder of weights holds, having read all of it."""
    description, parameters = _read(folder)
    robot = description.robot
    limits = ", ".join(f"{low:g}..{high:g}" for low, high in zip(robot.lower, robot.upper, strict=True))
    kind = f", {description.model['kind']}" if "kind" in description.model else ""
    print(f"folder        {folder}")
    print(f"architecture  {description.architecture}{kind}")
    print(f"robot         {robot.name}, joints {limits}")
    print(f"sha256        {checkpoint_sha256(folder)}")
    print(f"\n{'file':28} {'bytes':>12} {'parameters':>12}  sha256")
    for name, count in parameters.items():
        path = folder / f"{name}.safetensors"
        print(f"{path.name:28} {path.stat().st_size:>12,} {count:>12,}  {description.sha256[name]}")
    print(f"\nconfiguration\n{json.dumps(description.model, indent=2)}")
    shown = {name: "..." if name in WIDE and value else value for name, value in description.metadata.items()}
    print(f"\ntraining\n{json.dumps(shown, indent=2)}")


def _read(folder: Path) -> tuple[Description, dict[str, int]]:
    """Description of a folder, and how many parameters each part has; weights are read and checked."""
    architecture = str(read_json_object(folder / CONFIG_FILE).get("architecture"))
    if architecture == ARCHITECTURE:
        parts = load_checkpoint(folder).parts
    elif architecture == MPNET_ARCHITECTURE:
        parts = {"mpnet": load_mpnet(folder).network}
    else:
        raise UnknownChoiceError(
            f"architecture in {folder / CONFIG_FILE}", architecture, (ARCHITECTURE, MPNET_ARCHITECTURE)
        )
    counts = {name: sum(p.numel() for p in module.parameters()) for name, module in parts.items()}
    return read_description(folder, architecture), counts
