"""Motions of a hand along straight lines from pose to pose; the rest of the arm is free.

Postures are followed from pose to pose, a ladder of candidates: each is projected onto the next
pose (Algorithm 1), from where it is and from random states around it, so that a redundant arm can
move its elbow out of the way. The cheapest chain of postures is kept.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import rotation_vectors
from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE, Certificate, certify
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, sample_region
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import symmetric_region
from cvqmpt_lab.features.lines.along_line import AlongLine, Line
from cvqmpt_lab.features.motion.motion_check import certified_motion
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.motion.trajectory import Trajectory
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.joint_frames import poses_at_once
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import JointPath


class Leg(NamedTuple):
    """A certified path along one line."""

    line: AlongLine
    problem: PlanningProblem  # its constraint is the line with its tolerances
    path: JointPath
    certificate: Certificate


def follow_lines(
    robot: Robot,
    scene: Scene,
    poses: Sequence[np.ndarray],
    metres: float = 0.002,
    radians: float = 0.01,
    start: np.ndarray | None = None,
    seed: int = 0,
) -> list[Leg]:
    """Plan a path of the hand along straight lines through poses, and certify it.

    Args:
        robot: the robot.
        scene: obstacles.
        poses: two or more poses (4, 4) of the end effector in the world.
        metres: largest distance from the lines, above CERTIFICATE_TOLERANCE [m].
        radians: largest angle from the orientation interpolated along the line, above
            CERTIFICATE_TOLERANCE [rad].
        start: (n,) at the first pose [rad or m]; None: any posture.
        seed: of random states.

    Raises InvalidInputError with the place and the reason where a line cannot be followed.
    """
    if len(poses) < 2:
        raise InvalidInputError(f"{len(poses)} pose is no line: give two or more")
    # what the certificate allows beyond a constraint is taken off its tolerances, see `AlongLine`
    spare_m, spare_rad = metres - CERTIFICATE_TOLERANCE, radians - CERTIFICATE_TOLERANCE
    if not min(spare_m, spare_rad) > 0.0:
        raise InvalidInputError(
            f"tolerances of {metres:g} m and {radians:g} rad: lines are certified to "
            f"{CERTIFICATE_TOLERANCE:g} m and rad; give more than that for both"
        )
    lines = [Line(begin, end) for begin, end in pairwise(poses)]
    for k, line in enumerate(lines):
        if line.length < 1e-6 and np.linalg.norm(line.turn) < 1e-6:
            raise InvalidInputError(f"pose {k + 1} repeats pose {k}: leave one of the two out")
    # a straight joint motion strays from the line by about lever D^2 / 8, and turns the hand off
    # its orientation by about D^2 / 8
    stray = min(spare_m / max(robot.reach, 0.1), spare_rad)
    step = min(0.05, float(np.sqrt(2.0 * stray)))
    for last in (False, False, True):
        try:
            legs = list(_legs(robot, scene, lines, (metres, radians), start, seed, step))
            for k, leg in enumerate(legs):
                if not leg.certificate.valid:
                    reasons = "; ".join(leg.certificate.reasons)
                    raise InvalidInputError(f"the line from pose {k} to {k + 1}: {reasons}")
            return legs
        except InvalidInputError:
            if last:
                raise
            step *= 0.5
    raise AssertionError  # the last try returns or raises


def timed(legs: Sequence[Leg], settings: TimingSettings | None = None) -> Trajectory:
    """Return a fast certified motion along legs that does not rest at poses if it need not.

    Corners at poses are rounded within the tolerances of the lines. Where no such motion is
    certified, it rests at a pose, see `rests`.
    """
    settings = settings or TimingSettings()
    if any(v is not None for v in (settings.start_velocity, settings.end_velocity)):
        raise InvalidInputError("lines begin and end at rest: leave the velocities out")
    motions = _motions(legs, settings)
    whole, begun = motions[0], motions[0].duration
    for motion in motions[1:]:
        times = np.round(np.concatenate([whole.times, begun + motion.times[1:]]), 9)
        whole = Trajectory(
            motion.joint_names,
            times,
            np.concatenate([whole.positions, motion.positions[1:]]),
            np.concatenate([whole.velocities, motion.velocities[1:]]),
            np.concatenate([whole.accelerations, motion.accelerations[1:]]),
            max(whole.deviation, motion.deviation),
        )
        begun = float(times[-1])
    return whole


def rests(legs: Sequence[Leg], motion: Trajectory) -> list[int]:
    """Return the numbers of the poses between the first and the last at which a motion rests."""
    still = motion.positions[~motion.velocities.any(axis=1)]
    ends = (leg.path.states[-1] for leg in legs[:-1])
    # motions end at the posture up to rounding
    return [k for k, q in enumerate(ends, start=1) if (np.abs(still - q) < 1e-9).all(axis=1).any()]


def _motions(legs: Sequence[Leg], settings: TimingSettings) -> list[Trajectory]:
    """Return certified motions along legs, each from rest to rest; as few as are found.

    If no motion along all legs is certified, they are cut at the pose where the joints turn back,
    or else in two halves.
    """
    if len(legs) == 1:
        return [certified_motion(legs[0].problem, legs[0].path, settings)]
    near, whole = legs[0].line, legs[0].problem
    lines = [line for leg in legs for line in leg.line.lines]
    limits = near.metres, near.radians
    along = AlongLine(whole.robot, lines, *limits, allowed=CERTIFICATE_TOLERANCE)
    states = np.concatenate([legs[0].path.states, *(leg.path.states[1:] for leg in legs[1:])])
    problem = whole.changed(goals=states[-1:], constraint=(along,))
    # a rounded corner moves the hand by at most about the reach times the deviation of the joints
    spare = min(near.metres / max(whole.robot.reach, 0.1), near.radians)
    rounded = replace(settings, deviation=max(settings.deviation, 0.75 * spare))
    poses = [line.end for line in lines[:-1]]
    passed = partial(_missed, whole.robot, poses, limits)
    try:
        return [certified_motion(problem, JointPath(states), rounded, passed)]
    except InvalidInputError:
        steps = [np.diff(leg.path.states, axis=0) for leg in legs]
        cosines = [_cosine(one[-1], two[0]) for one, two in pairwise(steps)]
        sharpest = int(np.argmin(cosines))
        cut = 1 + sharpest if cosines[sharpest] < 0.0 else len(legs) // 2
        return _motions(legs[:cut], settings) + _motions(legs[cut:], settings)


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Return the cosine of the angle between two vectors (n,)."""
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12))


def _missed(
    robot: Robot, poses: Sequence[np.ndarray], limits: tuple[float, float], motion: Trajectory
) -> list[str]:
    """Return which pose a motion does not pass in order within the tolerances; empty: none.

    Args:
        robot: the robot.
        poses: (4, 4) of its end effector, in order.
        limits: largest distance [m] and angle [rad] from each.
        motion: the motion.
    """
    shares = np.arange(4) / 4.0
    times = (motion.times[:-1, None] + shares * np.diff(motion.times)[:, None]).ravel()
    T, last = poses_at_once(robot, motion.curve(times)), 0
    for k, pose in enumerate(poses, start=1):
        moved = np.linalg.norm(T[last:, :3, 3] - pose[:3, 3], axis=1)
        near = last + np.flatnonzero(moved <= limits[0])
        turned = np.linalg.norm(rotation_vectors(pose[:3, :3].T @ T[near, :3, :3]), axis=1)
        near = near[turned <= limits[1]]
        if len(near) == 0:
            return [f"pose {k} is not passed within the tolerances"]
        last = int(near[0])
    return []


def _legs(
    robot: Robot,
    scene: Scene,
    lines: Sequence[Line],
    tolerances: tuple[float, float],
    start: np.ndarray | None,
    seed: int,
    step: float,
) -> Iterator[Leg]:
    """Yield the legs of the cheapest chain of postures, with steps of about `step` [rad]."""
    checker = CollisionChecker(robot, scene, margin=SAMPLE_MARGIN_M)
    states, ends = _postures(robot, checker, lines, start, seed, step)
    for line, (begin, end) in zip(lines, pairwise(ends), strict=True):
        path = JointPath(states[begin : end + 1])
        near = AlongLine(robot, line, *tolerances, allowed=CERTIFICATE_TOLERANCE)
        first, last = path.states[0], path.states[-1:]
        leg = PlanningProblem("line", robot, scene, first, last, constraint=(near,))
        yield Leg(near, leg, path, certify(leg, path))


def _postures(
    robot: Robot,
    checker: CollisionChecker,
    lines: Sequence[Line],
    start: np.ndarray | None,
    seed: int,
    step: float,
    kept: int = 24,
    spread: float = 0.1,
) -> tuple[np.ndarray, list[int]]:
    """Return postures (m, n) along the lines, and the indices of those at the poses.

    Args:
        robot: the robot.
        checker: of collisions.
        lines: the lines.
        start: (n,) at the first pose, or None.
        seed: of random states.
        step: distance of neighbouring postures, about [rad].
        kept: largest number of candidates at each place.
        spread: standard deviation of random states around a candidate [rad].
    """
    rng = np.random.default_rng(seed)
    q = _first(robot, checker, lines[0].begin, start, rng)
    costs = np.zeros(len(q))
    rungs, parents, ends = [q], [], [0]
    for k, line in enumerate(lines):
        turn = float(np.linalg.norm(line.turn))
        # a hand at half of the reach turns joints by about 2 / reach per metre, more near limits
        count = max(2, int(np.ceil((4.0 * line.length / max(robot.reach, 0.1) + turn) / step)))
        places = np.arange(1, count + 1) / count
        for s, T in zip(places.tolist(), line.at(places), strict=True):
            q, costs, parent, failed = _next(robot, checker, T, q, costs, rng, kept, spread)
            if len(q) == 0:
                raise InvalidInputError(
                    f"the line from pose {k} to {k + 1} cannot be followed beyond {s:.0%} of it: "
                    f"{failed}"
                )
            rungs.append(q)
            parents.append(parent)
        ends.append(len(rungs) - 1)
    k = int(costs.argmin())
    chain = [rungs[-1][k]]
    for rung, parent in zip(rungs[-2::-1], parents[::-1], strict=True):
        k = int(parent[k])
        chain.append(rung[k])
    return np.array(chain[::-1]), ends


def _first(
    robot: Robot,
    checker: CollisionChecker,
    T: np.ndarray,
    start: np.ndarray | None,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return free postures (k, n) at the first pose."""
    if start is not None:
        away = np.linalg.inv(T) @ robot.pose(start)
        if not np.allclose(away, np.eye(4), atol=1e-4):
            raise InvalidInputError("the start is not at the first pose: leave it out, or move it")
        return start[None]
    region = symmetric_region(T, np.eye(4), [0.0] * 6)
    found = sample_region(robot, region, checker, rng, count=20)
    if len(found.configurations) == 0:
        raise InvalidInputError(f"pose 0: {found.outcome}")
    return found.configurations


def _next(
    robot: Robot,
    checker: CollisionChecker,
    T: np.ndarray,
    q: np.ndarray,
    costs: np.ndarray,
    rng: np.random.Generator,
    kept: int,
    spread: float,
    longest: float = 0.1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Return candidates (k, n) at the next pose, costs, parents (k,), and why others failed.

    Args:
        robot: the robot.
        checker: of collisions.
        T: the next pose (4, 4).
        q: candidates (c, n) at the pose before [rad or m].
        costs: lengths (c,) of their paths [rad].
        rng: random numbers.
        kept: largest number of candidates.
        spread: of random states around a candidate [rad].
        longest: largest distance of neighbouring postures [rad].
    """
    constraint = RegionConstraint(robot, (symmetric_region(T, np.eye(4), [0.0] * 6),))
    found, reasons = list[tuple[float, int, np.ndarray]](), Counter[str]()
    for number, one in enumerate(q):
        for turn in range(2 if len(q) < kept else 1):
            seed = one + (spread * rng.standard_normal(robot.dof) if turn else 0.0)
            reached = constraint.project(np.clip(seed, robot.lower, robot.upper))
            if reached is None:
                reasons["no posture within the joint limits reaches it"] += 1
                continue
            moved = float(np.linalg.norm(reached - one))
            if moved > longest:
                reasons[f"joints would jump by {moved:.2g} rad"] += turn == 0
            elif checker.in_collision(reached):
                reasons[f"in collision: {checker.contact(reached)}"] += 1
            else:
                found.append((costs[number] + moved, number, reached))
    found.sort(key=lambda item: item[0])
    del found[kept:]
    why = reasons.most_common(1)[0][0] if reasons else "no posture is left"
    values, parents, states = zip(*found, strict=True) if found else ((), (), ())
    return np.array(states).reshape(-1, robot.dof), np.array(values), np.array(parents), why
