"""Record of a certificate: verdict, what was compared, tolerances and digests, as json or lines."""

import hashlib
import json
import math
from collections import Counter
from importlib.metadata import version
from typing import Any

import numpy as np

from cvqmpt_lab.base.files import finite
from cvqmpt_lab.certificate.certificate import (
    END_TOLERANCE,
    LARGEST_STEP,
    TOLERANCE,
    Clearance,
    Deviation,
    FaultKind,
    Verdict,
)
from cvqmpt_lab.certificate.motion_check import DryRun
from cvqmpt_lab.collision.carried import carried_pairs, reach_with
from cvqmpt_lab.collision.exact import ROUNDING
from cvqmpt_lab.collision.solids import obstacles_within, solids
from cvqmpt_lab.geometry.polyline import distances_along
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import LeftOut
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.trajectory.trajectory import Motion


def record(problem: PlanningProblem, motion: Motion, found: DryRun) -> dict[str, Any]:
    """Json of a certificate with its tolerances, comparisons and digests; null for no number."""
    certificate = found.certificate
    faults = [
        {
            "kind": str(fault.kind),
            "text": fault.text,
            "state": fault.at,
            "time_s": None if fault.at is None else _time(found, fault.at),
        }
        for fault in certificate.faults
    ]
    moved, own = hashlib.sha256(), motion.of_joints(problem.robot.joint_names)
    for values in (own.positions, own.times, own.velocities, own.accelerations):
        if values is not None:
            numbers = np.ascontiguousarray(values, dtype="<f8").tobytes()
            moved.update(f"{values.shape}".encode() + numbers)
    # the problem's json leaves out fields with their default value
    asked = json.dumps(problem.to_dict(), sort_keys=True) + problem.robot.kinematics_digest
    return {
        "version": version("cvqmpt-lab"),
        "problem": problem.name,
        "problem_sha256": hashlib.sha256(asked.encode()).hexdigest(),
        "motion_sha256": moved.hexdigest(),
        "valid": certificate.valid,
        "verdict": str(certificate.verdict),
        "faults": faults,
        "apart_m": found.apart,
        "curve": found.curve,
        **finite(
            {
                name: value._asdict() if isinstance(value, Clearance | Deviation) else value
                for name, value in vars(certificate).items()
                if name != "faults"
            }
        ),
        "tolerances": {
            "constraint": TOLERANCE,
            "step_rad": LARGEST_STEP,
            "ends_rad": END_TOLERANCE,
            "margin_m": found.apart,
            "clearance_m": problem.clearance,
            "rounding_m": ROUNDING,
        },
        "compared": _compared(problem),
    }


def report_lines(found: DryRun, contents: dict[str, Any]) -> list[str]:
    """The lines a person reads of a record and the check that it was made from."""
    certificate = found.certificate
    what = "path"
    if found.times is not None:
        what = f"trajectory of {found.times[-1]:.3f} s, as {found.curve} pieces"
    states = "x".join(map(str, np.shape(found.states)))
    verdict = {Verdict.VALID: "yes", Verdict.REFUSED: "NO"}.get(certificate.verdict, "NOT PROVEN")
    lines = [f"certified   {verdict}: {what}, {states} states, problem {contents['problem']}"]
    for fault in certificate.faults:
        where = "" if fault.at is None else f", {_where(found, fault.at)}"
        lines.append(f"fault       {fault.text}{where}")
    if certificate.states_checked == 0:
        return lines
    distances = [
        f"{what} {1e3 * room.distance_m:.2f} mm, {_at_least(room)}, {_where(found, room.at)}: "
        f"{room.pair}"
        for what, room in (
            ("obstacles", certificate.obstacle_clearance),
            ("self", certificate.self_clearance),
        )
        if room
    ]
    distances = distances or ["there is nothing to keep a distance from"]
    collides = any(fault.kind == FaultKind.COLLISION for fault in certificate.faults)
    proven = f"no gaps: every state{' before that collision' if collides else ''} is proven"
    if certificate.unproven_rad > 0.0:
        proven = "gaps"
    curve = ""
    if found.apart:
        curve = f"; straight pieces within {1e3 * found.apart:.2g} mm of the curve"
    it, used = contents["compared"], contents["tolerances"]
    near = it["obstacles"] - len(it["out_of_reach"])
    reasons = Counter(pair["reason"] for pair in it["left_out"])
    left = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    return [
        *lines,
        f"constraint  at most {certificate.max_violation_rad:.2g} rad, "
        f"{certificate.max_violation_m:.2g} m outside; {TOLERANCE:g} is allowed",
        *(f"clearance   {distance}" for distance in distances),
        *([f"tolerates   {certificate.tolerated}"] if certificate.tolerated else []),
        f"resolution  {proven}, by {certificate.states_checked} looks{curve}",
        f"compared    {it['moving_pieces']} moving and {it['carried_pieces']} carried pieces: "
        f"{it['own_pairs']} pairs with each other, all with the {it['obstacle_pieces']} pieces of "
        f"{near} obstacles in reach, of {it['obstacles']}",
        f"left out    {it['standing_pieces']} standing pieces against obstacles; of pairs of "
        f"links: {left or 'none'}",
        f"tolerances  constraint {used['constraint']:g} rad or m, step {used['step_rad']:g} rad, "
        f"ends {used['ends_rad']:g} rad, margin {1e3 * used['margin_m']:.2g} mm, clearance from "
        f"obstacles {1e3 * used['clearance_m']:g} mm",
        f"record      version {contents['version']}, problem {contents['problem_sha256'][:12]}, "
        f"motion {contents['motion_sha256'][:12]}",
    ]


def _at_least(room: Clearance) -> str:
    """What is proven of a least distance, in words."""
    if not math.isfinite(room.at_least_m):
        return "the least found"
    return f"at least {1e3 * max(room.at_least_m, 0.0):.2f} mm everywhere"


def _where(found: DryRun, at: float) -> str:
    """A place for people: state, and time or distance along."""
    if found.times is not None:
        return f"at {_time(found, at):.4f} s"
    states = found.states[: int(at) + 2]
    with np.errstate(all="ignore"):
        along = float(np.interp(at, np.arange(len(states)), distances_along(states)))
    distance = f", {along:.4f} rad along" if math.isfinite(along) else ""
    return f"at state {at:.4g}{distance}"


def _time(found: DryRun, at: float) -> float | None:
    """Time [s] at a fractional number of a trajectory's states; None for a path."""
    if found.times is None:
        return None
    return float(np.interp(at, np.arange(len(found.times)), found.times))


def _compared(problem: PlanningProblem) -> dict[str, Any]:
    """Numbers of pieces, obstacles and pairs; obstacles and pairs left out, and why."""
    robot, carried = problem.robot, problem.attachments
    links = robot.collision_model.geometryObjects
    pieces = [len(list(solids(item.name, item.shape, item.T_hand_object))) for item in carried]
    reach = reach_with(robot, carried) + problem.clearance
    obstacles = {
        item.name: len(list(obstacles_within(Scene("one", (item,)), reach)))
        for item in problem.scene.obstacles
    }
    pairs = carried_pairs(robot, carried)
    left_out = [pair._asdict() for pair in robot.left_out_pairs]
    left_out += [
        LeftOut(link.name, item.name, "fixed to each other")._asdict()
        for i, link in enumerate(links)
        for k, item in enumerate(carried)
        if (i, k) not in pairs
    ]
    return {
        "moving_pieces": sum(link.parentJoint > 0 for link in links),
        "standing_pieces": sum(link.parentJoint == 0 for link in links),
        "carried_pieces": sum(pieces),
        "obstacles": len(obstacles),
        "obstacle_pieces": sum(obstacles.values()),
        "out_of_reach": [name for name, count in obstacles.items() if count == 0],
        "own_pairs": len(robot.collision_model.collisionPairs) + sum(pieces[k] for _, k in pairs),
        "left_out": left_out,
    }
