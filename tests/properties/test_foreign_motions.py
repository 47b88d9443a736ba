"""Motions of others: right ones in every form, and ones with one fault each, are told apart."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cvqmpt_lab import Budget, Motion, TimingSettings, certified_motion, judge, solve
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import displacements
from cvqmpt_lab.features.motion.frame_speeds import with_frame_limits
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import FrameLimit
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Sphere

TUNING = 1001, 1004, 1007, 1010  # problems that no result reports


@cache
def made(number):
    """Return a problem, its certified motion at half of the limits, and the judgement."""
    problem = place_problem(TUNING[number])
    solution = solve(problem, "birrt", Budget(iterations=20_000), seed=0)
    motion = certified_motion(solution.problem, solution.path, TimingSettings(speed=0.5))
    states = motion.positions, motion.times, motion.velocities, motion.accelerations
    whole = Motion(motion.joint_names, *states)
    return solution.problem, motion, whole, judge(whole, solution.problem)


def with_robot(problem, **source):
    return replace(problem, robot=robot_from_source({**problem.robot.source, **source}))


def as_it_is(rng, problem, plan, motion, judged):
    return problem, motion


def reordered(rng, problem, plan, motion, judged):
    """The same motion with its joints in another order."""
    order = rng.permutation(len(motion.joint_names))
    names = tuple(np.array(motion.joint_names)[order])
    kinds = (motion.positions, motion.velocities, motion.accelerations)
    q, v, a = (kind[:, order] for kind in kinds)
    return problem, Motion(names, q, motion.times, v, a)


def jittered(rng, problem, plan, motion, judged):
    """The same motion, read at its own times and at times between them."""
    more = np.sort(rng.uniform(0.0, plan.duration, 50))
    times = np.union1d(motion.times, more)
    return problem, Motion(motion.joint_names, *_at(plan, times))


def _at(plan, times):
    q, v, a = plan.at(times)
    return q, times, v, a


def _limit(judged, kind):
    return next(use for use in judged.check.uses if use.kind == kind)


def too_fast(rng, problem, plan, motion, judged):
    """The limit of one joint's velocity is exceeded by 0.2 %."""
    use = _limit(judged, "velocity")
    velocity = problem.robot.velocity_limits.copy()
    velocity[problem.robot.joint_names.index(use.of)] = use.value / 1.002
    return with_robot(problem, velocity_limits=velocity.tolist()), motion


def too_hard(rng, problem, plan, motion, judged):
    """The limit of one joint's acceleration is exceeded by 1.1 %: 1 % is left to cubics."""
    use = _limit(judged, "acceleration")
    limits = problem.robot.limits["acceleration"].copy()
    limits[problem.robot.joint_names.index(use.of)] = use.value / 1.011
    return with_robot(problem, acceleration_limits=limits.tolist()), motion


def _hand_within(problem, plan, share):
    """Return the problem with this share of the hand's largest speed, sampled densely, as limit."""
    h, times = 1e-6, np.linspace(1e-5, plan.duration - 1e-5, 5000)
    ahead, behind = (problem.robot.poses(plan.at(times + dt).positions) for dt in (h, -h))
    speeds = np.linalg.norm(ahead[:, :3, 3] - behind[:, :3, 3], axis=1) / (2.0 * h)
    limit = {"panda_hand": FrameLimit(share * float(speeds.max()))}
    return replace(problem, robot=with_frame_limits(problem.robot, limit))


def fast_hand(rng, problem, plan, motion, judged):
    """The hand exceeds its speed limit by 0.2 %."""
    return _hand_within(problem, plan, 1.0 / 1.002), motion


def hand_in_time(rng, problem, plan, motion, judged):
    """The hand stays 0.2 % below its speed limit: certified."""
    return _hand_within(problem, plan, 1.002), motion


def elsewhere(rng, problem, plan, motion, judged):
    """It begins 1e-5 rad from the start."""
    off = 1e-5 * np.sign(rng.standard_normal(problem.robot.dof))
    return replace(problem, start=problem.start + off), motion


def short(rng, problem, plan, motion, judged):
    """It stops before the goal, on the move or at rest."""
    times = motion.times[: rng.integers(len(motion.times) // 2, len(motion.times) - 20)]
    q, t, v, a = _at(plan, times)
    if rng.random() < 0.5:
        v[-1], a[-1] = 0.0, 0.0
    return problem, Motion(motion.joint_names, q, t, v, a)


def swinging(rng, problem, plan, motion, judged):
    """One velocity is wrong, so that the curve leaves its points."""
    v = motion.velocities.copy()
    v[rng.integers(100, len(v) - 100), rng.integers(7)] += 0.3
    return problem, replace(motion, velocities=v)


def beyond_a_limit(rng, problem, plan, motion, judged):
    """A position limit is passed by 1e-4 rad."""
    robot = problem.robot
    lower, upper = robot.lower.copy(), robot.upper.copy()
    j = int(np.argmax(np.ptp(motion.positions, axis=0)))
    inner = motion.positions[:, j]
    high = inner.max() > max(inner[0], inner[-1])
    (upper if high else lower)[j] = inner.max() - 1e-4 if high else inner.min() + 1e-4
    ends = motion.positions[[0, -1]]
    if not ((lower <= ends) & (ends <= upper)).all():
        return None
    kinematics = robot.kinematics._replace(lower=lower, upper=upper)
    goals = np.array([q for q in problem.goals if ((lower <= q) & (q <= upper)).all()])
    bent = replace(robot, kinematics=kinematics)
    return replace(problem, robot=bent, goals=goals.reshape(-1, robot.dof)), motion


def tilted(rng, problem, plan, motion, judged):
    """The hand leans 1 mrad more than allowed, at one place at least."""
    region = problem.constraint[0]
    x = displacements(problem.robot, region, judged.check.states)
    rows = [row for row in region.bounded_rows if 3 <= row < 6]
    row = rows[int(np.argmax([np.abs(x[:, k]).max() for k in rows]))]
    Bw = region.Bw.copy()
    most = np.abs(x[:, row]).max() - 1.5e-3
    Bw[row] = -most, most
    ends = np.abs(x[[0, -1], row]).max()
    return (replace(problem, constraint=(region.changed(Bw=Bw),)), motion) if ends < most else None


def _ball(rng, problem, judged, depth):
    """Return the problem with a ball that a state meets by `depth` [m]; negative: all stay off."""
    states = judged.check.states[10:-10:4]
    hand = problem.robot.poses(states[::8])[:, :3, 3]
    centre = hand[rng.integers(len(hand))] + rng.uniform(-0.3, 0.3, 3)
    tiny = SceneObject("ball", Sphere(1e-3), pose(centre))
    checker = CollisionChecker(problem.robot, Scene("one", (tiny,)), problem.carried)
    least = min(checker.nearest_obstacle(q).distance for q in states) + 1e-3
    if least < 0.01:
        return None
    ball = SceneObject("ball", Sphere(least + depth), pose(centre))
    return replace(problem, scene=problem.scene.with_objects(ball))


def touching(rng, problem, plan, motion, judged):
    """A ball is 0.1 mm deep in the arm's way."""
    found = _ball(rng, problem, judged, 1e-4)
    return None if found is None else (found, motion)


def passing(rng, problem, plan, motion, judged):
    """A ball is 0.5 mm off the arm's way: certified."""
    found = _ball(rng, problem, judged, -5e-4)
    return None if found is None else (found, motion)


RIGHT = (as_it_is, reordered, jittered, hand_in_time, passing)
WRONG = {
    too_fast: "velocity",
    too_hard: "acceleration",
    fast_hand: "frame_speed",
    elsewhere: "start",
    short: "goal",
    swinging: "",
    beyond_a_limit: "limits",
    tilted: "manifold",
    touching: "collision",
}


@pytest.mark.promise("verdicts on motions of others are right", "motions", ci=14, long=2000)
def test_foreign_motions(trials, tmp_path):
    """Every fault is found, and named; no right motion is refused."""
    wrong, seen, cases = {}, 0, (*RIGHT, *WRONG)
    for number in range(trials):
        rng, change = np.random.default_rng(number), cases[number % len(cases)]
        problem, plan, motion, judged = made(number // len(cases) % len(TUNING))
        changed = change(rng, problem, plan, motion, judged)
        if changed is None:
            continue
        seen += 1
        found = judge(changed[1], changed[0]).check.certificate
        kinds = {str(fault.kind) for fault in found.faults}
        right = (
            found.valid if change in RIGHT else not found.valid and WRONG[change] in {*kinds, ""}
        )
        wrong |= {} if right else {(number, change.__name__): found.reasons}
    assert wrong == {} and seen >= 0.7 * trials
