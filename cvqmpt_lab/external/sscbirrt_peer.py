"""sscbirrt (C++, MuJoCo, analytical inverse kinematics by ssik): CBiRRT on a task-space region, its
defaults.

Its regions bound roll, pitch and yaw; its paths are smoothed by itself.
"""

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from sscbirrt import mujoco as sscbirrt
from sscbirrt.config import CBiRRTConfig
from tsr import TSR

from cvqmpt_lab.external.upright import once_a_world, rpy_box, upright_region
from cvqmpt_lab.external.world_files import HAND, mjcf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget

FOREVER = 1e6  # [s]


class _World(NamedTuple):
    model: Any
    data: Any
    arm: Any


@once_a_world
def _world(problem: PlanningProblem) -> _World:
    text = mjcf_of(problem)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.xml"
        path.write_text(text)
        model = mujoco.MjModel.from_xml_string(text)
        arm = sscbirrt.Arm(model, list(problem.robot.joint_names), HAND, mjcf=path)
    return _World(model, mujoco.MjData(model), arm)


def plan(problem: PlanningProblem, budget: Budget, seed: int) -> np.ndarray | None:
    """A path (m, n) [rad] by `sscbirrt.mujoco.plan`;
    None where it finds none in the budget's seconds.
    """
    region, world = upright_region(problem), _world(problem)
    kept = TSR(T0_w=region.T0_w, Tw_e=region.Tw_e, Bw=rpy_box(region))
    settings = CBiRRTConfig(timeout=budget.seconds or FOREVER)
    found = sscbirrt.plan(
        *world,
        start=problem.start,
        goal=problem.goals[0],
        constraint=kept,
        config=settings,
        seed=seed,
    )
    return np.array(found.path) if found.success else None
