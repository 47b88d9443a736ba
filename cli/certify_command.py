"""`cvqmpt certify`: judge a path or trajectory of anyone's, or every path of a run again."""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from cli.options import log, numbers, positive
from cli.robot_options import add_problem, problem_asked
from cvqmpt_lab.certificate import TOLERANCE, FaultKind, Verdict
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.motion_check import DryRun, dry_run
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.trajectory.trajectory_files import read_motion

EXAMPLES = (
    "cvqmpt certify path.csv place-task --problem 7",
    "cvqmpt certify path.json --problem-file mine.json --json",
    'cvqmpt certify motion.json place-task --problem 7 --current "0.1 -0.7 0 -2.3 0 1.6 0.8"',
    "cvqmpt certify runs/place-task",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to judge, and against which problem."""
    add = parser.add_argument
    what = "states, or a trajectory with times, which is dry-run too; or the directory of a run"
    add("path", type=Path, metavar="PATH.csv|PATH.json|DIR", help=what)
    add_problem(parser)
    add("--current", metavar="Q", help="where the arm stands now, in quotes [rad]: the motion begins there")
    start = "how far from there it may begin (0.01)"
    add("--tolerance", type=positive, default=0.01, metavar="RAD", help=start)
    add("--json", action="store_true", help="print one json object instead of the report")


def run(args: argparse.Namespace) -> int:
    """Judge and print; exit code 1 when anything is refused or not proven."""
    if args.path.is_dir():
        if args.suite or args.problem_file or args.current:
            raise InvalidInputError("the rows of a run name their problems; give the directory alone")
        return _certify_run(args.path, args.json)
    motion = read_motion(args.path)
    problem = problem_asked(args)
    if not isinstance(problem, PlanningProblem):
        raise InvalidInputError(
            f"suite {args.suite} is of tasks; certify the directory of a run, or one problem"
        )
    current = None if args.current is None else np.array(numbers("--current", args.current))
    found = dry_run(problem, motion, current, args.tolerance)
    if args.json:
        print(json.dumps(_data(found), indent=1, allow_nan=False))
    else:
        print("\n".join(_report(found, problem.name)))
    return 0 if found.certificate.valid else 1


def _where(found: DryRun, at: float) -> str:
    """A place for people: state, and time or distance along."""
    if found.times is not None:
        return f"at {np.interp(at, np.arange(len(found.times)), found.times):.4f} s"
    states, k = found.states[: int(at) + 2], int(at)
    with np.errstate(all="ignore"):
        steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
        along = steps[:k].sum() + (at - k) * (steps[k] if k < len(steps) else 0.0)
    return f"at state {at:.4g}, {along:.4f} rad along" if math.isfinite(along) else f"at state {at:.4g}"


def _report(found: DryRun, problem: str) -> list[str]:
    """The lines a person reads."""
    certificate = found.certificate
    what = (
        "path" if found.times is None else f"trajectory of {found.times[-1]:.3f} s, as {found.curve} pieces"
    )
    states = "x".join(map(str, np.shape(found.states)))
    verdict = {Verdict.VALID: "yes", Verdict.REFUSED: "NO"}.get(certificate.verdict, "NOT PROVEN")
    lines = [f"certified   {verdict}: {what}, {states} states, problem {problem}"]
    for fault in certificate.faults:
        where = "" if fault.at is None else f", {_where(found, fault.at)}"
        lines.append(f"fault       {fault.text}{where}")
    if certificate.states_checked == 0:
        return lines
    lines.append(
        f"constraint  at most {certificate.max_violation_rad:.2g} rad, {certificate.max_violation_m:.2g} m outside; "
        f"{TOLERANCE:g} is allowed"
    )
    lines.append(f"clearance   {1e3 * certificate.min_clearance_m:.2f} mm, the smallest found")
    return [*lines, f"resolution  {_resolution(found)}"]


def _resolution(found: DryRun) -> str:
    """Whether every state is known to be free, and by how many looks."""
    certificate = found.certificate
    collides = any(fault.kind == FaultKind.COLLISION for fault in certificate.faults)
    proven = f"no gaps: every state{' before that collision' if collides else ''} is proven"
    curve = f"; straight pieces within {1e3 * found.apart:.2g} mm of the curve" if found.apart else ""
    return f"{'gaps' if certificate.unproven_rad > 0.0 else proven}, by {certificate.states_checked} looks{curve}"


def _data(found: DryRun) -> dict[str, Any]:
    """The same for programs; undefined numbers are null."""
    certificate = found.certificate
    faults = []
    for fault in certificate.faults:
        time = None
        if found.times is not None and fault.at is not None:
            time = float(np.interp(fault.at, np.arange(len(found.times)), found.times))
        faults.append({"kind": str(fault.kind), "text": fault.text, "state": fault.at, "time_s": time})
    figures = {name: value for name, value in vars(certificate).items() if name != "faults"}
    for name, value in figures.items():
        figures[name] = value if value is not None and math.isfinite(value) else None
    return {
        "valid": certificate.valid,
        "verdict": str(certificate.verdict),
        "faults": faults,
        "apart_m": found.apart,
        "curve": found.curve,
        **figures,
    }


def _certify_run(directory: Path, as_json: bool) -> int:
    from experiments.recertify import recertify

    summary = {"paths": 0, "certified": 0, "refused": 0}
    troubles = []
    for verdict in recertify(directory):
        certified = verdict.certificate is not None and verdict.certificate.valid
        summary["paths"] += 1
        summary["certified" if certified else "refused"] += 1
        if verdict.trouble:
            key = verdict.row.key
            troubles.append(f"{key.problem} {key.planner} seed {key.seed}: {verdict.trouble}")
            log(troubles[-1])
    if as_json:
        print(json.dumps({**summary, "troubles": troubles}, indent=1))
    else:
        counted = ", ".join(f"{count} {what}" for what, count in summary.items())
        print(f"{counted}, {len(troubles)} unlike their rows")
    return 1 if troubles else 0
