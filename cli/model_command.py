"""`cvqmpt model`: report on weights, convert published ones."""

import argparse
import json
from pathlib import Path
from typing import Any

from cli.options import FLAG, Options, one_of, option
from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.errors import InvalidInputError, require_installed
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.vqmpt.weights import (
    SHIPPED,
    TRANSFORMER,
    read_description,
    read_model,
    resolve_model,
    robot_signature,
    weights_digest,
)


def run(args: argparse.Namespace) -> None:
    """Report on weights, or convert them and report."""
    if args.action == "import":
        for name in ("dictionary_dir", "ar_dir", "out"):
            if getattr(args, name) is None:
                raise InvalidInputError(f"import: give --{name.replace('_', '-')} DIR")
        _import(args.dictionary_dir, args.ar_dir, args.out)
    found = _info(resolve_model(args.out if args.action == "import" else args.model))
    print(json.dumps(found, indent=2) if args.json else "\n".join(_summary(found)))


def _import(dictionary_dir: Path, ar_dir: Path, out: Path) -> None:
    """Convert published folders, weights of the Panda."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InvalidInputError(f"{out} is there and not empty; choose another --out")
    require_installed("torch", "cvqmpt model import", "train")
    from cvqmpt_lab.vqmpt.checkpoint import import_published, save_checkpoint

    robot = robot_signature(robot_from_source({"name": "panda"}))
    save_checkpoint(out, import_published(dictionary_dir, ar_dir, robot))


def _info(folder: Path) -> dict[str, Any]:
    """Everything a folder of weights holds but the weights, which are read and checked."""
    model, description = read_model(folder), read_description(folder)
    if TRANSFORMER in model.parts:
        from cvqmpt_lab.vqmpt.codebook import require_own_dictionary  # compiles

        require_own_dictionary(model)
    parts = {
        f"{name}.safetensors": {
            "bytes": (folder / f"{name}.safetensors").stat().st_size,
            "numbers": sum(array.size for array in arrays.values()),
            "sha256": description["sha256"][name],
        }
        for name, arrays in model.parts.items()
    }
    return {
        "folder": str(folder),
        "sha256": weights_digest(folder),
        "architecture": model.architecture,
        "robot": to_plain(model.robot, complete=True),
        "parts": parts,
        "model": to_plain(model.config, complete=True),
        "metadata": dict(model.metadata),
    }


def _summary(found: dict[str, Any]) -> list[str]:
    """The lines a person reads."""
    robot, model, metadata = found["robot"], found["model"], found["metadata"]
    kind = f", {model['kind']}" if "kind" in model else ""
    digest = robot["kinematics"] or "not recorded"
    lines = [
        f"folder        {found['folder']}",
        f"architecture  {found['architecture']}{kind}",
        f"robot         {robot['name']}, {len(robot['lower'])} joints, kinematics {digest}",
        f"sha256        {found['sha256']}",
    ]
    names = robot["joints"] or [str(joint) for joint in range(len(robot["lower"]))]
    for name, lower, upper in zip(names, robot["lower"], robot["upper"], strict=True):
        lines.append(f"    {name:20} {lower:8g} .. {upper:g}")
    lines += ["", f"{'file':28} {'bytes':>12} {'numbers':>12}"]
    for name, part in found["parts"].items():
        lines.append(f"{name:28} {part['bytes']:>12,} {part['numbers']:>12,}")
    told = ("source", "stage", "seed", "train_paths", "validation_paths", "epochs")
    shown = {name: metadata[name] for name in told if name in metadata}
    losses = metadata.get("losses")
    shown |= losses if isinstance(losses, dict) else {}
    lines.append("")
    for name, x in shown.items():
        if x is not None:
            lines.append(f"{name:44} {x:.6g}" if isinstance(x, float) else f"{name:44} {x}")
    return [
        *lines,
        "",
        f"sizes and training in full: cvqmpt model info --model {found['folder']} --json",
    ]


OPTIONS: Options = {
    "action": option(
        "info or import published VQ-MPT folders (MPNet's cannot be: train it)",
        type=one_of("action", ("info", "import")),
    ),
    "--model": option(
        f"info: {', '.join(SHIPPED)}, or the folder of a model (vq_mpt)", metavar="DIR"
    ),
    "--json": option("info: everything, as json", **FLAG),
    "--dictionary-dir": option("import: published stage 1", type=Path, metavar="DIR"),
    "--ar-dir": option("import: published stage 2", type=Path, metavar="DIR"),
    "--out": option("import: folder to write, new or empty", type=Path, metavar="DIR"),
}
COMMANDS = {"model": (run, OPTIONS)}
