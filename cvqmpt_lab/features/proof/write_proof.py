"""Write the proof of a certified motion, which the checker `cvqmpt_check.py` accepts."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import write_text
from cvqmpt_lab.collision.directions import Directions
from cvqmpt_lab.features.motion.limit_use import Ends
from cvqmpt_lab.features.proof import cvqmpt_check
from cvqmpt_lab.features.proof.claims import claims
from cvqmpt_lab.features.proof.cvqmpt_check import SCHEMA, Proof, Refused
from cvqmpt_lab.features.proof.planes import Planes
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.source import read_source

CURE = "give the motion as json of a JointTrajectory, as plan --trajectory writes it, csv or npz"
CHECKER = Path(cvqmpt_check.__file__)


def urdf_of(problem: PlanningProblem) -> Path:
    """Return the URDF of a problem's robot."""
    return Path(read_source(problem.robot.source).urdf)


def write_proof(
    path: Path, problem: PlanningProblem, motion: Path, ends: Ends | None = None
) -> str:
    """Write the proof of a certified motion; return the command that checks it.

    Args:
        path: file of the proof.
        problem: robot, scene and constraint.
        motion: file of the motion.
        ends: with which it was judged; None: it rests at its ends.

    Raises InvalidInputError if no proof is found, or it cannot be about this robot or file.
    """
    proof = proof_of(problem, motion, ends)
    write_text(path, json.dumps(proof, separators=(",", ":"), allow_nan=False) + "\n")
    return f"python {CHECKER} {path} --urdf {urdf_of(problem)} --motion {motion}"


def proof_of(problem: PlanningProblem, motion: Path, ends: Ends | None = None) -> dict[str, Any]:
    """Return the proof of a certified motion, see `write_proof`."""
    urdf = urdf_of(problem).read_bytes()
    directions = Directions(problem.robot, problem.scene, problem.carried)
    told = claims(problem, directions, urdf)
    if motion.is_dir():
        raise InvalidInputError(f"{motion} is a folder; a proof is about one file: {CURE}")
    given = motion.read_bytes()
    scene = json.dumps(told["obstacles"], separators=(",", ":")).encode()
    files = {"robot": urdf, "motion": given, "scene": scene}
    told = {
        "schema": SCHEMA,
        "robot": problem.robot.name,
        "scene": problem.scene.name,
        "motion": motion.name,
        "sha256": {name: hashlib.sha256(data).hexdigest() for name, data in files.items()},
        **told,
        "ends": _ends_of_spline(ends or Ends(), problem.robot.dof),
        "not_compared": [],
        "planes": [],
    }
    try:
        proof = Proof(told, urdf, given)
    except (Refused, KeyError, LookupError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"the checker cannot read {motion}, or the robot ({error}): {CURE}"
        ) from error
    names = _names(directions, told["carried"])
    compared = _compared(problem, directions, proof, names)
    told["not_compared"] = [*_left_out(problem, directions, proof, names, compared)]
    told["planes"] = Planes(proof, directions, names).found(compared)
    try:
        proof.check()
    except Refused as refused:
        raise InvalidInputError(f"no proof that others can check is found: {refused}") from refused
    return told


def _ends_of_spline(ends: Ends, dof: int) -> list[list[float] | None]:
    """Return velocities at both ends of a spline through positions; None: q'' is 0 there."""
    free = (ends.moving, ends.start_velocity), (ends.part, ends.end_velocity)
    return [
        None if any_velocity and v is None else np.zeros(dof).tolist() if v is None else v.tolist()
        for any_velocity, v in free
    ]


def _names(directions: Directions, carried: Sequence[dict[str, Any]]) -> list[str]:
    """Return the proof's names of the pieces of the robot and of its loads."""
    own = len(directions.names) - len(carried)
    return [*directions.names[:own], *(item["name"] for item in carried)]


def _compared(
    problem: PlanningProblem, directions: Directions, proof: Proof, names: Sequence[str]
) -> list[int]:
    """Return the numbers of the pieces that are compared with obstacles: moving ones."""
    hidden = {piece.name for piece in problem.robot.links if piece.self_only}
    return [
        k
        for k, name in enumerate(names)
        if proof.robot.moves[proof.bodies[name].row] and directions.names[k] not in hidden
    ]


def _left_out(
    problem: PlanningProblem,
    directions: Directions,
    proof: Proof,
    names: Sequence[str],
    compared: Sequence[int],
) -> Iterator[list[str]]:
    """Yield the pairs that move against each other and are not compared, with the reason.

    Args:
        problem: the robot.
        directions: its bodies and pairs.
        proof: the proof's bodies.
        names: their names.
        compared: numbers of the pieces that are compared with obstacles.
    """
    moves = [proof.robot.moves[proof.bodies[name].row] for name in names]
    reasons = {frozenset(pair[:2]): pair.reason for pair in problem.robot.left_out_pairs}
    kept, known = {frozenset(pair) for pair in directions.pairs}, set[frozenset[str]]()
    for i, k in combinations(range(len(names)), 2):
        if moves[i] == moves[k] or frozenset((i, k)) in kept:
            continue
        pieces, links = (names[i], names[k]), (proof.links[names[i]], proof.links[names[k]])
        pair = links if frozenset(links) in reasons else pieces
        reason = reasons.get(frozenset(pair), "a load, and a hand or link that may touch it")
        if frozenset(pair) not in known:
            known.add(frozenset(pair))
            yield [*pair, reason]
    if directions.obstacles:
        for k, name in enumerate(names):
            if moves[k] and k not in compared:
                yield [name, "obstacles", "SRDF: not compared by default"]
