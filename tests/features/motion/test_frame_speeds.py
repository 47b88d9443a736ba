"""Speed limits of frames: speeds, their bounds, motions that keep them, motions that do not."""

from dataclasses import replace

import numpy as np
import pytest
from features.motion.test_trajectory import random_motion
from refusals import refused

from cvqmpt_lab.certificate.certificate import FaultKind
from cvqmpt_lab.features.motion.frame_speeds import FrameSpeeds, with_frame_limits
from cvqmpt_lab.features.motion.limit_use import frame_uses
from cvqmpt_lab.features.motion.motion_check import (
    certified_motion,
    dry_run,
    speed_within_limits,
    trajectory_faults,
)
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import FrameLimit

LIMITS = {"panda_hand": FrameLimit(1.0), "panda_link4": FrameLimit(None, 1.5)}
FULL = TimingSettings(speed=1.0)


@pytest.fixture(scope="module")
def limited(problem):
    return replace(problem, robot=with_frame_limits(problem.robot, LIMITS))


@pytest.mark.parametrize("name", ["panda", "tiago", "pr2-left"])
def test_speeds_are_those_of_poses_and_their_bounds_hold(name):
    """Compare with differences of pinocchio's poses on random quintics; tiago and PR2 slide."""
    robot = robot_from_source({"name": name})
    robot = with_frame_limits(robot, {robot.end_effector: FrameLimit(1.0, 1.0)})
    curve, frames = random_motion(robot), FrameSpeeds(robot)
    times, h = np.linspace(1e-3, curve.x[-1] - 1e-3, 40), 1e-6
    before, after = (robot.poses(curve(times + dt)) for dt in (-h, h))
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1) / (2.0 * h)
    turned = after[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)
    half = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1)
    seen = np.stack([moved, np.linalg.norm(half, axis=1) / (2.0 * h)], axis=1)
    np.testing.assert_allclose(frames.speeds(curve(times), curve(times, 1)), seen, rtol=1e-5)
    dense = np.linspace(0.0, curve.x[-1], 20_000)
    most = frames.speeds(curve(dense), curve(dense, 1)).max(axis=0)
    proven = [use.value for use in frame_uses(robot, curve)]
    assert (proven >= most * (1.0 - 1e-12)).all() and (proven <= 1.01 * most + 1e-3).all()


def test_motions_keep_the_speeds_of_frames(limited, solution):
    free = certified_motion(solution.problem, solution.path, FULL)
    assert {"panda_hand", "panda_link4"} <= {
        text.split()[0] for text in trajectory_faults(limited, free)
    }
    motion = certified_motion(limited, solution.path, FULL)
    every = motion.at(np.arange(0.0, motion.duration, 1e-3))
    shares = FrameSpeeds(limited.robot).shares(every.positions, every.velocities)
    assert 0.95 < shares.max() <= 1.0 and motion.duration > free.duration
    kinds = (free.positions, free.times, free.velocities, free.accelerations)
    fast = Motion(free.joint_names, *kinds)
    assert FaultKind.FRAME_SPEED in {f.kind for f in dry_run(limited, fast).certificate.faults}
    slower = speed_within_limits(limited, fast)
    assert dry_run(limited, fast.at_speed(slower)).certificate.valid
    assert not dry_run(limited, fast.at_speed(slower + 0.01)).certificate.valid


def test_a_problem_file_keeps_the_limits_of_frames(limited, tmp_path):
    limited.save(tmp_path / "p.json")
    assert PlanningProblem.load(tmp_path / "p.json").robot.frame_limits == LIMITS


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ({"hand": {"speed": 1.0}}, "frame of robot .* in frame_limits 'hand'"),
        ({"panda_hand": {"speed": 0.0}}, "frame_limits.panda_hand.speed is 0.0"),
        ({"panda_hand": {}}, "neither 'speed' nor 'turning_speed'"),
    ],
)
def test_wrong_limits_of_frames_are_one_line(limits, told):
    refused(told, robot_from_source, {"name": "panda", "frame_limits": limits})
