"""Adapter of sscbirrt (C++, MuJoCo, analytical inverse kinematics by ssik): CBiRRT, defaults.

Its task-space regions bound roll, pitch and yaw. Its paths are already smoothed.
"""

import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.features.peers import rpy_box, upright_region, versions
from cvqmpt_lab.features.physics.mjcf import HAND_SITE, mjcf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget

MADE_BY = versions("sscbirrt", "sscbirrt", "mujoco", "ssik")

import mujoco
from sscbirrt import mujoco as sscbirrt
from sscbirrt.config import CBiRRTConfig
from tsr import TSR


@lru_cache(maxsize=4)
def _world(robot: Robot, scene: Scene) -> tuple[Any, Any, Any]:
    """Return MuJoCo's model and data, and sscbirrt's arm."""
    text = mjcf_of(robot, scene)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.xml"
        path.write_text(text)
        model = mujoco.MjModel.from_xml_string(text)
        arm = sscbirrt.Arm(model, list(robot.joint_names), HAND_SITE, mjcf=path)
    return model, mujoco.MjData(model), arm


def plan(problem: PlanningProblem, budget: Budget, seed: int) -> np.ndarray | None:
    """Return a path (m, n) [rad] by `sscbirrt.mujoco.plan`; None if none was found in time."""
    region = upright_region(problem)
    found = sscbirrt.plan(
        *_world(problem.robot, problem.scene),
        start=problem.start,
        goal=problem.goals[0],
        constraint=TSR(T0_w=region.T0_w, Tw_e=region.Tw_e, Bw=rpy_box(region)),
        config=CBiRRTConfig(timeout=budget.seconds or 1e6),
        seed=seed,
    )
    return np.array(found.path) if found.success else None
