"""Record of a certificate as JSON or lines: verdict, numbers, comparisons, tolerances, digests."""

import hashlib
import json
import math
from collections import Counter
from importlib.metadata import version
from itertools import combinations
from typing import Any

import numpy as np

from cvqmpt_lab.base.files import finite
from cvqmpt_lab.base.polyline import distances_along
from cvqmpt_lab.base.reports import Report
from cvqmpt_lab.base.values import bound_text
from cvqmpt_lab.certificate.certificate import (
    CERTIFICATE_TOLERANCE,
    END_TOLERANCE_RAD,
    MAX_STEP_RAD,
    Clearance,
    Deviation,
    FaultKind,
)
from cvqmpt_lab.collision.carried import carried_pairs, pairs_of_carried, reach_with
from cvqmpt_lab.collision.exact import COAL_ROUNDING_M
from cvqmpt_lab.collision.solids import obstacles_within, solids
from cvqmpt_lab.features.motion.checked_curves import DryRun
from cvqmpt_lab.features.motion.limit_use import LimitUse, share_text
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.left_out import LeftOut
from cvqmpt_lab.robot.source import PATH_FIELDS
from cvqmpt_lab.scene.scene import Scene


def record_of(solution: Solution, given: PlanningProblem | None = None) -> dict[str, Any] | None:
    """Return the JSON of a solution's certificate, or None if it has no path.

    given: the problem of the user; None: the solution's.
    """
    if solution.path is None or solution.certificate is None:
        return None
    problem, states = given or solution.problem, solution.path.states
    motion = Motion(problem.robot.joint_names, states)
    return record(problem, motion, DryRun(solution.certificate, states))


def record(
    problem: PlanningProblem, motion: Motion, found: DryRun, slower: float | None = None
) -> dict[str, Any]:
    """Return the JSON of a certificate with its tolerances, comparisons and digests.

    Numbers that are not finite become null.

    Args:
        problem: the problem that the motion was judged for.
        motion: the path or trajectory.
        found: the check.
        slower: factor on the speed of a trajectory at which every limit holds, see
            `speed_within_limits`.
    """
    certificate, closest = found.certificate, found.certificate.closest
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
            moved.update(f"{values.shape}".encode())
            moved.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
    # the problem's JSON leaves out fields with their default value
    robot, data = problem.robot, problem.to_dict()
    # files of the robot count by their content, below, and not by their path
    data["robot"] = {
        name: value for name, value in data["robot"].items() if name not in PATH_FIELDS
    }
    stated = hashlib.sha256(json.dumps(data, sort_keys=True).encode())
    stated.update(robot.kinematics_digest.encode())
    for _, sha256 in robot.files:
        stated.update(sha256.encode())
    for function in problem.manifold.functions:  # the json has its address
        stated.update(function.code.encode())
    numbers = {
        "max_violation_rad": certificate.max_violation_rad,
        "max_violation_m": certificate.max_violation_m,
        "min_clearance_m": certificate.min_clearance_m,
        "states_checked": certificate.states_checked,
        "min_clearance_pair": closest.pair if closest else "",
        "min_clearance_at": closest.at if closest else None,
        "max_violation_function": certificate.max_violation_function,
        "constraint_states": certificate.constraint_states,
        "constraint_gap": certificate.constraint_gap,
        "unproven_rad": certificate.unproven_rad,
        "unproven_m": certificate.unproven_m,
        "obstacle_clearance": _fields(certificate.obstacle_clearance),
        "self_clearance": _fields(certificate.self_clearance),
        "tolerated": _fields(certificate.tolerated),
    }
    return {
        "version": version("cvqmpt-lab"),
        "problem": problem.name,
        "problem_sha256": stated.hexdigest(),
        "motion_sha256": moved.hexdigest(),
        "valid": certificate.valid,
        "verdict": str(certificate.verdict),
        "faults": faults,
        "apart_m": found.deviation_m,
        "curve": found.curve,
        "limits": [
            {
                "kind": str(use.kind),
                "of": use.of,
                "share": round(use.share, 6),
                "value": use.value,
                "limit": use.limit,
                "unit": use.unit,
                "time_s": use.time,
            }
            for use in found.uses
        ],
        "limits_hold_at_speed": None if motion.times is None else slower,
        "jerk": _jerk(problem, motion),
        **finite(numbers),
        "tolerances": {
            "constraint": CERTIFICATE_TOLERANCE,
            "step_rad": MAX_STEP_RAD,
            "ends_rad": END_TOLERANCE_RAD,
            "margin_m": found.deviation_m,
            "clearance_m": problem.clearance,
            "rounding_m": COAL_ROUNDING_M,
        },
        "compared": _compared(problem),
    }


def _jerk(problem: PlanningProblem, motion: Motion) -> str | None:
    """Return whether jerk is judged, and why not; None for a path, which has no times."""
    if motion.times is None:
        return None
    if "jerk" not in problem.robot.limits:
        return "not judged: the robot has no jerk limits"
    if motion.accelerations is None:
        return "not judged: without accelerations in the file they jump between its points"
    return "judged"


def _fields(value: Clearance | Deviation | None) -> dict[str, Any] | None:
    """Return the fields of a named tuple by name; None for None."""
    return None if value is None else value._asdict()


def report_of(found: DryRun, contents: dict[str, Any]) -> Report:
    """Return the report of a record.

    Args:
        found: the check from which the record was made.
        contents: JSON of the record, see `record`.
    """
    certificate = found.certificate
    what = "path"
    if found.times is not None:
        share = share_text(found.uses)
        what = f"trajectory of {np.ptp(found.times):.3f} s{share}, as {found.curve} pieces"
    states = "x".join(map(str, np.shape(found.states)))
    word = "certified" if certificate.valid else f"not certified: {certificate.verdict}"
    lines = [("certificate", f"{word}; {what}, {states} states, problem {contents['problem']}")]
    for fault in certificate.faults:
        where = "" if fault.at is None else f", {_where(found, fault.at)}"
        lines.append(("fault", f"{fault.text}{where}"))
    if not certificate.valid and contents["limits_hold_at_speed"]:
        slower = contents["limits_hold_at_speed"]
        lines.append(("slower", f"at {slower:.2f} of this speed every limit holds"))
    lines += [
        (
            "limit",
            f"{use.words} used to {use.share:.3g} by {use.of} at {use.time:.4f} s{_size(use)}",
        )
        for use in found.uses
    ]
    if certificate.states_checked == 0:
        return Report.of(lines, lambda: contents)
    distances = [
        f"{what} {_distance(found, clearance)}"
        for what, clearance in (
            ("obstacles", certificate.obstacle_clearance),
            ("self", certificate.self_clearance),
        )
        if clearance
    ]
    distances = distances or ["there is no obstacle and no other piece to keep a distance from"]
    collides = any(fault.kind == FaultKind.COLLISION for fault in certificate.faults)
    proven = f"every state{' before the collision' if collides else ''} is proven"
    if certificate.constraint_gap:
        proven += " free"
    if certificate.unproven_rad > 0.0:
        proven = "not every state is proven"
    outside = ""
    if functions := contents["compared"]["functions"]:
        most = bound_text(certificate.max_violation_function, up=True)
        outside = f", {most} of {'; '.join(functions)}"
    curve = ""
    if found.deviation_m:
        apart = bound_text(1e3 * found.deviation_m, up=True)
        curve = f"; straight pieces within {apart} mm of the curve"
    compared, tolerances = contents["compared"], contents["tolerances"]
    jerk = contents["jerk"] or ""
    near = compared["obstacles"] - len(compared["out_of_reach"])
    reasons = Counter(pair["reason"] for pair in compared["left_out"])
    left = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    left += f": {LeftOut.named([LeftOut(**pair) for pair in compared['left_out']])}" if left else ""
    lines += [
        (
            "constraint",
            f"at most {bound_text(certificate.max_violation_rad, up=True)} rad, "
            f"{bound_text(certificate.max_violation_m, up=True)} m outside{outside}; "
            f"{CERTIFICATE_TOLERANCE:g} is allowed",
        ),
        *([("unproven", certificate.constraint_gap)] if certificate.constraint_gap else []),
        *(("clearance", distance) for distance in distances),
        *([("tolerates", str(certificate.tolerated))] if certificate.tolerated else []),
        *([("jerk", jerk)] if "accelerations" in jerk else []),
        ("resolution", f"{proven}, with {certificate.states_checked} checks{curve}"),
        (
            "compared",
            f"{compared['moving_pieces']} moving and {compared['carried_pieces']} carried "
            f"pieces: {compared['own_pairs']} pairs with each other; each of them with the "
            f"{compared['obstacle_pieces']} pieces of {near} obstacles in reach (of "
            f"{compared['obstacles']} obstacles)",
        ),
        (
            "left out",
            f"{compared['standing_pieces']} standing pieces with obstacles; pairs of "
            f"links: {left or 'none'}",
        ),
        *(("note", note) for note in compared["notes"]),
        (
            "tolerances",
            f"constraint {tolerances['constraint']:g} rad, m or unit of F, step "
            f"{tolerances['step_rad']:g} rad, ends {tolerances['ends_rad']:g} rad, margin "
            f"{1e3 * tolerances['margin_m']:.2g} mm, clearance from obstacles "
            f"{1e3 * tolerances['clearance_m']:g} mm",
        ),
        (
            "record",
            f"version {contents['version']}, problem {contents['problem_sha256'][:12]}, "
            f"motion {contents['motion_sha256'][:12]}",
        ),
    ]
    return Report.of(lines, lambda: contents)


def _size(use: LimitUse) -> str:
    """Return the size of a jump of velocity between straight lines in words, or ""."""
    if use.kind is not FaultKind.VELOCITY_JUMP:
        return ""
    return f", {use.value:.3g} of {use.limit:.3g} {use.unit} between straight lines"


def _distance(found: DryRun, clearance: Clearance) -> str:
    """Return a clearance as text: what was measured and what is proven."""
    if not clearance.measured:
        return _proven(clearance)
    measured = f"{1e3 * clearance.distance_m:.2f} mm, {_proven(clearance)}"
    return f"{measured}, {_where(found, clearance.at)}: {clearance.pair}"


def _proven(clearance: Clearance) -> str:
    """Return the lower bound on the distance over all states as text; it says if there is none."""
    if not math.isfinite(clearance.at_least_m):
        return (
            "the smallest distance found, not a proven bound" if clearance.measured else "unknown"
        )
    # rounded down to 0.01 mm
    return f"at least {math.floor(1e5 * max(clearance.at_least_m, 0.0)) / 100:.2f} mm everywhere"


def _where(found: DryRun, at: float) -> str:
    """Return a place as text: the time, or the state and its distance along the path."""
    if found.times is not None:
        return f"at {_time(found, at):.4f} s"
    states = found.states[: int(at) + 2]
    with np.errstate(all="ignore"):
        along = float(np.interp(at, np.arange(len(states)), distances_along(states)))
    distance = f", {along:.4f} rad along" if math.isfinite(along) else ""
    return f"at state {at:.4g}{distance}"


def _time(found: DryRun, at: float) -> float | None:
    """Return the time [s] at a place on a trajectory; None for a path."""
    if found.times is None:
        return None
    return float(np.interp(at, np.arange(len(found.times)), found.times))


def _compared(problem: PlanningProblem) -> dict[str, Any]:
    """Count pieces, obstacles and pairs; list obstacles and pairs left out, with the reason."""
    robot, carried = problem.robot, problem.carried
    links = robot.collision_model.geometryObjects
    pieces = [len(list(solids(item.name, item.shape, item.T_hand_object))) for item in carried]
    reach = reach_with(robot, carried) + problem.clearance
    obstacles = {
        item.name: len(list(obstacles_within(Scene("one", (item,)), reach)))
        for item in problem.scene.obstacles
    }
    pairs, between = carried_pairs(robot, carried), pairs_of_carried(robot, carried)
    left_out = [pair._asdict() for pair in robot.left_out_pairs]
    left_out += [
        LeftOut.by_default(piece.name, "obstacles")._asdict()
        for piece in robot.links
        if piece.self_only
    ]
    rows = [robot.hand(item.end_effector)[0] for item in carried]
    for i, piece in enumerate(robot.links):
        for k, (item, row) in enumerate(zip(carried, rows, strict=True)):
            if piece.self_only:
                left_out.append(LeftOut.by_default(piece.name, item.name)._asdict())
            elif (i, k) not in pairs:
                why = _why_left_out(piece.link, row)
                left_out.append(LeftOut(piece.name, item.name, why)._asdict())
    left_out += [
        LeftOut(carried[k].name, carried[m].name, _why_left_out(rows[k], rows[m]))._asdict()
        for k, m in combinations(range(len(carried)), 2)
        if (k, m) not in between
    ]
    own = sum(pieces[k] for _, k in pairs) + sum(pieces[k] * pieces[m] for k, m in between)
    return {
        "moving_pieces": sum(link.parentJoint > 0 for link in links),
        "standing_pieces": sum(link.parentJoint == 0 for link in links),
        "carried_pieces": sum(pieces),
        "obstacles": len(obstacles),
        "obstacle_pieces": sum(obstacles.values()),
        "out_of_reach": [name for name, count in obstacles.items() if count == 0],
        "own_pairs": len(robot.collision_model.collisionPairs) + own,
        "left_out": left_out,
        "links_without_body": list(robot.bodiless),
        "unseen": problem.scene.unseen,
        "functions": [function.describe() for function in problem.manifold.functions],
        "notes": problem.notes,
    }


def _why_left_out(row: int, other: int) -> str:
    """Return why a link or load is no pair with a load, by the pose rows that carry them."""
    return "fixed to each other" if row == other else "also held by"
