"""The record of a certificate: verdict, what was compared, tolerances, digests;
and what differs between two.
"""

import hashlib
import json
from collections import Counter
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cli.options import finite
from cvqmpt_lab.certificate import END_TOLERANCE, LARGEST_STEP, TOLERANCE
from cvqmpt_lab.collision.exact import ROUNDING, carried_pairs, obstacles_within, reach_with, solids
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.motion_check import DryRun
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import LeftOut
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.trajectory.trajectory_files import Motion

DIGESTS = {"problem_sha256": "another problem", "motion_sha256": "another motion"}


def record(problem: PlanningProblem, motion: Motion, found: DryRun) -> dict[str, Any]:
    """Everything that a certificate says and rests on, as json; undefined numbers are null."""
    return {
        "version": version("cvqmpt-lab"),
        "problem": problem.name,
        "problem_sha256": _problem_digest(problem),
        "motion_sha256": _motion_digest(motion.of_joints(problem.robot.joint_names)),
        **_verdict(found),
        "apart_m": found.apart,
        "curve": found.curve,
        **finite(
            {name: value for name, value in vars(found.certificate).items() if name != "faults"}
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


def differences(now: dict[str, Any], path: Path) -> dict[str, list[Any]]:
    """Fields of a record that are not as in the file of an earlier one: [earlier, now].

    InvalidInputError: the file holds no record, or one of another problem or motion.
    """
    earlier = read_json_object(path, "certificate")
    for name, what in DIGESTS.items():
        if name not in earlier:
            raise InvalidInputError(
                f"certificate {path} has no {name}: give what `cvqmpt certify --json` printed"
            )
        if earlier[name] != now[name]:
            raise InvalidInputError(
                f"certificate {path} is of {what}: only two of one motion can be compared"
            )
    old, new = _flat(earlier), _flat(now)
    return {
        name: [old.get(name), new.get(name)]
        for name in sorted(old.keys() | new.keys())
        if not name.startswith("differences") and old.get(name) != new.get(name)
    }


def compared_lines(contents: dict[str, Any]) -> list[str]:
    """The lines about what was compared, of a record."""
    it, used = contents["compared"], contents["tolerances"]
    near = it["obstacles"] - len(it["out_of_reach"])
    reasons = Counter(pair["reason"] for pair in it["left_out"])
    left = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    return [
        f"compared    {it['moving_pieces']} moving and {it['carried_pieces']} carried pieces: "
        f"{it['own_pairs']} pairs "
        f"with each other, all with the {it['obstacle_pieces']} pieces of {near} obstacles in "
        f"reach, of "
        f"{it['obstacles']}",
        f"left out    {it['standing_pieces']} standing pieces against obstacles; of pairs of "
        f"links: {left or 'none'}",
        f"tolerances  constraint {used['constraint']:g} rad or m, step {used['step_rad']:g} rad, "
        f"ends "
        f"{used['ends_rad']:g} rad, margin {1e3 * used['margin_m']:.2g} mm, "
        f"clearance from obstacles {1e3 * used['clearance_m']:g} mm",
        f"record      version {contents['version']}, problem {contents['problem_sha256'][:12]}, "
        f"motion {contents['motion_sha256'][:12]}",
    ]


def _verdict(found: DryRun) -> dict[str, Any]:
    """The verdict and its faults, with times where there are some."""
    faults = []
    for fault in found.certificate.faults:
        time = None
        if found.times is not None and fault.at is not None:
            time = float(np.interp(fault.at, np.arange(len(found.times)), found.times))
        faults.append(
            {"kind": str(fault.kind), "text": fault.text, "state": fault.at, "time_s": time}
        )
    certificate = found.certificate
    return {"valid": certificate.valid, "verdict": str(certificate.verdict), "faults": faults}


def _compared(problem: PlanningProblem) -> dict[str, Any]:
    """Numbers of pieces, obstacles and pairs; obstacles and pairs left out, and on whose word."""
    robot, carried = problem.robot, problem.attachments
    links = robot.collision_model.geometryObjects
    pieces = [len(list(solids(item.name, item.shape, item.T_hand_object))) for item in carried]
    reach = reach_with(robot, carried) + problem.clearance
    alone = {item.name: Scene("one", (item,)) for item in problem.scene.obstacles}
    obstacles = {name: len(list(obstacles_within(scene, reach))) for name, scene in alone.items()}
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


def _problem_digest(problem: PlanningProblem) -> str:
    """Of the problem's json, from which fields with their default value are left out, and of the
    robot's kinematics.
    """
    text = json.dumps(problem.to_dict(), sort_keys=True) + problem.robot.kinematics_digest
    return hashlib.sha256(text.encode()).hexdigest()


def _motion_digest(motion: Motion) -> str:
    digest = hashlib.sha256()
    for values in (motion.positions, motion.times, motion.velocities, motion.accelerations):
        if values is not None:
            digest.update(
                f"{values.shape}".encode() + np.ascontiguousarray(values, dtype="<f8").tobytes()
            )
    return digest.hexdigest()


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Leaves of json by their names joined by dots; of pairs left out the reason by the pair."""
    if name == "compared.left_out":
        return {f"{name}.{pair['first']} and {pair['second']}": pair["reason"] for pair in value}
    if not isinstance(value, dict):
        return {name: value}
    parts = (_flat(item, f"{name}.{part}".strip(".")) for part, item in value.items())
    return {key: leaf for part in parts for key, leaf in part.items()}
