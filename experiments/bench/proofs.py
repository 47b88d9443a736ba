"""How proofs of motions fare: agreement with the certificate, changed proofs, time and size.

    python -m cvqmpt_lab.experiments.bench.proofs --motions 100 --changes 10

Motions of five arms among random obstacles are judged and proven. A proof of a certified motion
must be accepted by the checker, and no motion that is refused may have one. Then proofs are changed
at random: the checker must refuse them, or what they still say must be true at dense states, by
pinocchio and coal.
"""

import argparse
import copy
import hashlib
import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import csv_table
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.certificate.certificate import FaultKind
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.motion.judge import judge
from cvqmpt_lab.features.motion.trajectory import Motion, Trajectory, read_motion, save_trajectory
from cvqmpt_lab.features.proof.cvqmpt_check import Proof, Refused
from cvqmpt_lab.features.proof.write_proof import proof_of, urdf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere

ARMS = ("panda", "ur5", "xarm7", "kinova", "so-arm101")
# what a proof does not contain, so that it cannot disagree
NOT_PROVEN = {
    FaultKind.JERK,
    FaultKind.EFFORT,
    FaultKind.TORQUE_RATE,
    FaultKind.VELOCITY_JUMP,
    FaultKind.STEP,
}
DENSE = 300  # states at which a changed proof that is accepted is compared


class Case(NamedTuple):
    """A motion and its proof."""

    problem: PlanningProblem
    motion: Path
    proof: dict[str, Any]


def problem_of(rng: np.random.Generator, arm: str) -> tuple[PlanningProblem, np.ndarray]:
    """Return a random problem of an arm, and three states (3, n) of a motion."""
    source: dict[str, Any] = {"name": arm, "acceleration_limits": 10.0, "velocity_limits": 2.0}
    robot = robot_from_source({**source, "effort_limits": 1e6})
    middle = 0.5 * (robot.lower + robot.upper)
    low, high = np.maximum(robot.lower, middle - 2.5), np.minimum(robot.upper, middle + 2.5)
    start = rng.uniform(low, high)
    states = np.clip(start + rng.normal(0.0, 0.25, (3, robot.dof)).cumsum(axis=0), low, high)
    reach = robot.reach
    objects = []
    for k in range(int(rng.integers(0, 8))):
        size = rng.uniform(0.05, 0.25, 3) * reach
        shapes = Box(tuple(size.tolist())), Sphere(0.5 * size[0]), Cylinder(0.4 * size[0], size[1])
        at = rng.uniform(-0.8, 0.8, 3) * reach + (0.0, 0.0, 0.4 * reach)
        T = pose(at, *rng.uniform(-3.0, 3.0, 1))
        objects.append(SceneObject(f"body{k}", shapes[int(rng.integers(0, 3))], T))
    regions: tuple[TaskSpaceRegion, ...] = ()
    if rng.random() < 0.5:
        bounds = np.array([[-0.4, 0.4], [-np.inf, np.inf], [-0.4, 0.4], *[[-np.inf, np.inf]] * 3])
        bounds[:3] *= reach
        bounds[5] = (-2.0, 2.0) if rng.random() < 0.3 else (-np.inf, np.inf)
        T0 = robot.pose(states[1])
        tilt = float(rng.uniform(0.3, 2.0))
        regions = (TaskSpaceRegion(T0, np.eye(4), bounds, tilt=tilt),)
    scene = Scene("random bodies", tuple(objects))
    clearance = 0.01 if rng.random() < 0.3 else 0.0
    problem = PlanningProblem(
        arm, robot, scene, states[0], states[-1:], constraint=regions, clearance=clearance
    )
    return problem, states


def with_more_bounds(
    rng: np.random.Generator, problem: PlanningProblem, middle: np.ndarray
) -> PlanningProblem:
    """Return a problem some of whose regions also bound turns on one side, or where a hand looks.

    Args:
        rng: random numbers.
        problem: the problem.
        middle: state (n,) of a motion, which keeps the bounds.
    """
    robot, regions = problem.robot, list(problem.regions)
    if regions and rng.random() < 0.4:
        bounds = np.array(regions[0].Bw)
        bounds[3 + int(rng.integers(3))] = (-0.05, rng.uniform(0.2, 2.0))
        regions[0] = replace(regions[0], Bw=bounds)
    if rng.random() < 0.2:
        ahead = robot.pose(middle) @ pose((0.0, 0.0, rng.uniform(0.1, 0.5)))
        free = np.array([[-np.inf, np.inf]] * 6)
        most = float(rng.uniform(0.2, 1.5))
        regions.append(TaskSpaceRegion(ahead, np.eye(4), free, bearing=most))
    return replace(problem, constraint=tuple(regions))


def save_as(kind: str, trajectory: Trajectory, folder: Path, name: str) -> Path:
    """Write a motion; return its file.

    kind: json, csv or npz, with all derivatives; "spline": a csv of positions; "path": without
    times.
    """
    if kind in ("json", "csv"):
        save_trajectory(trajectory, folder / f"{name}.{kind}")
        return folder / f"{name}.{kind}"
    if kind == "npz":
        np.savez(
            folder / f"{name}.npz",
            joint_names=np.array(trajectory.joint_names),
            t=trajectory.times,
            q=trajectory.positions,
            v=trajectory.velocities,
            a=trajectory.accelerations,
        )
        return folder / f"{name}.npz"
    columns, table = ["time"], np.column_stack([trajectory.times, trajectory.positions])
    if kind == "path":
        columns, table = [], trajectory.positions
    rows = [[*columns, *trajectory.joint_names], *table.tolist()]
    (folder / f"{name}.csv").write_text(csv_table(rows))
    return folder / f"{name}.csv"


def trajectory_of(
    rng: np.random.Generator, names: tuple[str, ...], states: np.ndarray
) -> Trajectory:
    """Return a motion through states (3, n), at rest at its ends; some are too fast."""
    longest = np.abs(np.diff(states, axis=0)).max()
    span = max(longest, 0.1) * rng.uniform(0.8, 4.0)
    velocity = np.zeros_like(states)
    velocity[1] = 0.3 * (states[2] - states[0]) / span
    times = np.array([0.0, span, 2.0 * span]).round(6)
    coarse = Trajectory(names, times, states, velocity, np.zeros_like(states))
    return coarse.sampled(float(rng.choice([0.02, 0.1, 10.0])))


def cases(rng: np.random.Generator, folder: Path, count: int, told: Counter) -> Iterator[Case]:
    """Yield proofs of certified motions; count agreement of checker and certificate."""
    more = np.random.default_rng(count)
    for k in range(count):
        arm = ARMS[k % len(ARMS)]
        problem, states = problem_of(rng, arm)
        problem = with_more_bounds(more, problem, states[1])
        trajectory = trajectory_of(rng, problem.robot.joint_names, states)
        kind = "json" if more.random() < 0.5 else str(more.choice(["csv", "npz", "spline", "path"]))
        file = save_as(kind, trajectory, folder, str(k))
        motion = read_motion(file)
        begin = time.process_time()
        judged = judge(motion, problem, exact_clearance=True)
        told["certificate [ms]"] += round(1e3 * (time.process_time() - begin))
        kinds = {fault.kind for fault in judged.check.certificate.faults}
        certified = judged.certified or (kinds and kinds <= NOT_PROVEN)
        begin = time.process_time()
        try:
            proof = proof_of(problem, file)
        except InvalidInputError as error:
            told[f"{'CERTIFIED' if certified else 'refused'}, no proof"] += 1
            if certified:
                clearance = judged.check.certificate.min_clearance_m
                print(f"motion {k} of {arm}, clearance {1e3 * clearance:.4g} mm: {error}")
            continue
        told["proof [ms]"] += round(1e3 * (time.process_time() - begin))
        text = json.dumps(proof, separators=(",", ":"))
        told["proof [bytes]"] += len(text)
        told["motion [ms]"] += round(1e3 * trajectory.duration)
        begin = time.process_time()
        answer = accepts(json.loads(text), problem, file.read_bytes())
        told["check [ms]"] += round(1e3 * (time.process_time() - begin))
        if not certified:
            print(f"motion {k} of {arm} is proven: {judged.check.certificate.reasons}")
        told[f"{'certified' if certified else 'REFUSED'}, {'yes' if answer else 'NO'}"] += 1
        told[f"certified, {kind}"] += 1
        if certified and answer and kind == "json":
            yield Case(problem, file, json.loads(text))


def accepts(proof: dict[str, Any], problem: PlanningProblem, motion: bytes) -> bool:
    """Return whether the checker says yes."""
    try:
        Proof(proof, urdf_of(problem).read_bytes(), motion).check()
    except Refused:
        return False
    except Exception:
        return False
    return True


Change = Callable[[np.random.Generator, dict[str, Any]], None]


def _turn(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Turn one plane."""
    tree, leaf = _leaf(rng, proof)
    turned = np.array(tree[leaf]) + rng.normal(0.0, 10.0 ** rng.uniform(-2.0, 1.0), 3)
    tree[leaf] = (turned / np.linalg.norm(turned)).tolist()


def _swap(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Turn one plane round."""
    tree, leaf = _leaf(rng, proof)
    tree[leaf] = [-x for x in tree[leaf]]


def _leaf(rng: np.random.Generator, proof: dict[str, Any]) -> tuple[list[Any], int]:
    """Return a tree of planes, and the number of one of its leaves."""
    tree = proof["planes"][int(rng.integers(len(proof["planes"])))][2]
    leaves = [k for k, token in enumerate(tree) if isinstance(token, list)]
    return tree, int(rng.choice(leaves))


def _leave_out(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Leave one interval out."""
    tree, leaf = _leaf(rng, proof)
    del tree[leaf]


def _merge(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Replace a halved interval or group by one of its planes."""
    trees = [tree for *_, tree in proof["planes"] if len(tree) > 1]
    tree = trees[int(rng.integers(len(trees)))] if trees else proof["planes"][0][2]
    found = [
        k
        for k in range(len(tree) - 2)
        if isinstance(tree[k], str)
        and isinstance(tree[k + 1], list)
        and isinstance(tree[k + 2], list)
    ]
    k = int(rng.choice(found)) if found else 0
    tree[k : k + 3] = [tree[k + 1] if found else [1.0, 0.0, 0.0]]


def _pair(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Leave a pair of bodies out."""
    del proof["planes"][int(rng.integers(len(proof["planes"])))]


def _digest(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Change a digest."""
    name = str(rng.choice(["robot", "motion", "scene"]))
    proof["sha256"][name] = hashlib.sha256(proof["sha256"][name].encode()).hexdigest()


def _limit(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Halve or double a limit."""
    joint = str(rng.choice(proof["joints"]))
    kind = str(rng.choice(["lower", "upper", "velocity", "acceleration"]))
    value = proof["limits"][joint][kind]
    proof["limits"][joint][kind] = None if value is None else value * float(rng.choice([0.5, 2.0]))


def _bound(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Halve the bounds of a region, or the clearance's opposite: double it."""
    if not proof["regions"]:
        proof["clearance"] = 2.0 * proof["clearance"] + 0.05
        return
    for row in proof["regions"][0]["bounds"]:
        row[:] = [None if x is None else 0.5 * x for x in row]


def _body(rng: np.random.Generator, proof: dict[str, Any]) -> None:
    """Move an obstacle, with the right digest, or hold a joint elsewhere."""
    if not proof["obstacles"]:
        proof["joints"] = proof["joints"][::-1]
        return
    item = proof["obstacles"][int(rng.integers(len(proof["obstacles"])))]
    move = rng.normal(0.0, 0.1, 3)
    item["points"] = (np.array(item["points"]) + move).tolist()
    text = json.dumps(proof["obstacles"], separators=(",", ":"))
    proof["sha256"]["scene"] = hashlib.sha256(text.encode()).hexdigest()


CHANGES: dict[str, Change] = {
    "a plane turned": _turn,
    "a plane turned round": _swap,
    "an interval left out": _leave_out,
    "intervals merged": _merge,
    "a pair left out": _pair,
    "a digest": _digest,
    "a limit": _limit,
    "a bound": _bound,
    "an obstacle": _body,
}


def changed(rng: np.random.Generator, case: Case, kind: str) -> tuple[dict[str, Any], bytes]:
    """Return a changed proof, and the bytes of its motion."""
    proof, data = copy.deepcopy(case.proof), case.motion.read_bytes()
    if kind in CHANGES:
        CHANGES[kind](rng, proof)
        return proof, data
    size = 1e-6 if "1e-6" in kind else 10.0 ** rng.uniform(-3.0, 0.0)
    motion = json.loads(data)
    point = motion["points"][int(rng.integers(len(motion["points"])))]
    joint = int(rng.integers(len(point["positions"])))
    point["positions"][joint] += size * float(rng.choice([-1.0, 1.0]))
    data = json.dumps(motion).encode()
    if "digest" in kind:
        proof["sha256"]["motion"] = hashlib.sha256(data).hexdigest()
    return proof, data


KINDS = (*CHANGES, "motion by 1e-6", "motion by 1e-6, digest right", "motion by more, digest right")


def still_true(case: Case, proof: dict[str, Any], motion: Motion, beyond: float = 2e-5) -> bool:
    """Return whether what a changed proof says is true at dense states.

    Args:
        case: robot, scene and the unchanged proof.
        proof: the changed proof.
        motion: its motion.
        beyond: what may be missing at distances [m]; coal rounds.
    """
    robot = case.problem.robot
    motion = motion.of_joints(robot.joint_names)
    assert motion.times is not None and motion.velocities is not None
    assert motion.accelerations is not None
    curve = Trajectory(
        robot.joint_names, motion.times, motion.positions, motion.velocities, motion.accelerations
    )
    t = np.linspace(0.0, curve.duration, DENSE)
    q, v, a = curve.at(t)
    for name in proof["joints"]:
        limit, k = proof["limits"][name], robot.joint_names.index(name)
        ends = [
            np.inf if limit[kind] is None else abs(limit[kind])
            for kind in ("velocity", "acceleration")
        ]
        inside = (
            np.abs(v[:, k]).max() <= 1.002 * ends[0] and np.abs(a[:, k]).max() <= 1.02 * ends[1]
        )
        low = -np.inf if limit["lower"] is None else limit["lower"]
        high = np.inf if limit["upper"] is None else limit["upper"]
        if not (inside and q[:, k].min() >= low - 1e-5 and q[:, k].max() <= high + 1e-5):
            return False
    clearance = proof["clearance"] - beyond
    before = {item["name"]: np.array(item["points"]) for item in case.proof["obstacles"]}
    objects = list[SceneObject]()
    for item in proof["obstacles"]:
        found = case.problem.scene[item["name"]]
        T = found.T_world_object.copy()
        T[:3, 3] += (np.array(item["points"]) - before[item["name"]])[0]
        objects.append(SceneObject(found.name, found.shape, T))
    checker = CollisionChecker(robot, Scene("moved", tuple(objects)), (), 0.0, max(clearance, 0.0))
    if any(checker.in_collision(state) for state in q):
        return False
    for region, told in zip(case.problem.regions, proof["regions"], strict=True):
        from cvqmpt_lab.constraints.task_space_region import displacements

        x = displacements(robot, region, q)
        rows = np.array(told["bounds"], dtype=float)
        low = np.where(np.isnan(rows[:, 0]), -np.inf, rows[:, 0])
        high = np.where(np.isnan(rows[:, 1]), np.inf, rows[:, 1])
        if (np.maximum(low - x, x - high) > 6e-4).any():
            return False
    return True


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motions", type=int, default=100)
    parser.add_argument("--changes", type=int, default=10, help="of each proof and kind")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng, told = np.random.default_rng(args.seed), Counter[str]()
    outcomes = {kind: Counter[str]() for kind in KINDS}
    with tempfile.TemporaryDirectory() as name:
        for case in cases(rng, Path(name), args.motions, told):
            for kind in KINDS:
                for _ in range(args.changes):
                    proof, data = changed(rng, case, kind)
                    outcome = "refused"
                    if accepts(proof, case.problem, data):
                        file = Path(name) / "changed.json"
                        file.write_bytes(data)
                        true = still_true(case, proof, read_motion(file))
                        outcome = "still true" if true else "WRONG"
                    outcomes[kind][outcome] += 1
    for what, count in sorted(told.items()):
        print(f"{what:30} {count}")
    print(f"\n{'change':32}{'refused':>10}{'still true':>12}{'wrong':>8}")
    for kind, counts in outcomes.items():
        row = [counts[what] for what in ("refused", "still true", "WRONG")]
        print(f"{kind:32}{row[0]:10}{row[1]:12}{row[2]:8}")


if __name__ == "__main__":
    main()
