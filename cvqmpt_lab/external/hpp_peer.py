"""HPP (C++, pinocchio, coal): its diffusing planner with continuous collision checks, then its
random shortcuts.

HPP bounds nothing from two sides: the hand is kept upright exactly. Its wheels find their libraries
by LD_LIBRARY_PATH alone; here they are loaded one by one instead.
"""

import ctypes
import importlib
import re
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from cvqmpt_lab.external.upright import once_a_world, upright_region
from cvqmpt_lab.external.world_files import urdf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget

PENETRATION = 1e-3  # [m] that its continuous validation allows; it must be above 0
PROJECTION_STEP = 0.2  # [rad] between states that its path projector projects
TOLERANCE = 1e-4  # [rad] of a projection
PROJECTIONS = 40  # Newton steps
ITERATIONS = 2**60  # more than any time is enough for
SPACING = 0.05  # [rad] between states that are read off a path
MISSING = re.compile(r"(\S+): cannot open shared object file")


def _imported(module: str) -> ModuleType:
    """A module whose libraries lie in the folder of pinocchio's."""
    while True:
        try:
            return importlib.import_module(module)
        except ImportError as error:
            missing = MISSING.match(str(error))
            if missing is None:
                raise
            _load(missing[1])


def _load(library: str) -> None:
    """Load a shared library, after those that it needs."""
    path = _libraries() / library
    while True:
        try:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
            return
        except OSError as error:
            missing = MISSING.match(str(error))
            if missing is None or missing[1] == library or not path.is_file():
                raise
            _load(missing[1])


def _libraries() -> Path:
    """The folder lib that pinocchio's Python package lies in."""
    package = Path(str(sys.modules["pinocchio"].__file__)).resolve()
    return next(
        folder for folder in package.parents if (folder / "libpinocchio_default.so").is_file()
    )


class _Hpp(NamedTuple):
    core: ModuleType
    constraints: ModuleType
    robot: Any


@once_a_world
def _hpp(problem: PlanningProblem) -> _Hpp:
    device, core = _imported("pyhpp.pinocchio").Device("arm"), _imported("pyhpp.core")
    loading = _imported("pyhpp.pinocchio.urdf")
    with tempfile.TemporaryDirectory() as folder:
        urdf, srdf = urdf_of(problem, Path(folder), np.eye(4))
        loading.loadModelFromString(device, 0, "", "anchor", urdf, srdf, pin.SE3.Identity())
    return _Hpp(core, _imported("pyhpp.constraints"), device)


def _posed(problem: PlanningProblem, hpp: _Hpp) -> Any:
    """The problem in HPP."""
    region, (link, T_link_hand) = upright_region(problem), problem.robot.end_effector_link
    T_link_e = pin.SE3(T_link_hand @ np.linalg.inv(region.Tw_e))
    turns, both, kinds = pin.StdVec_Bool(), pin.StdVec_Bool(), hpp.constraints.ComparisonTypes()
    turns[:], both[:] = (False, True, True), (True, True)
    kinds[:] = [hpp.constraints.ComparisonType.EqualToZero] * 2
    tilt = hpp.constraints.Orientation(
        "upright", hpp.robot, link, T_link_e, pin.SE3(region.T0_w), turns
    )
    projector = hpp.core.ConfigProjector(hpp.robot, "upright", TOLERANCE, PROJECTIONS)
    projector.add(hpp.constraints.Implicit(tilt, kinds, both), 0)
    kept = hpp.core.ConstraintSet(hpp.robot, "upright")
    kept.addConstraint(projector)
    posed = hpp.core.Problem(hpp.robot)
    posed.setConstraints(kept)
    for check in ("CollisionValidation", "JointBoundValidation"):
        posed.addConfigValidation(check)
    posed.pathValidation(hpp.core.Progressive(hpp.robot, PENETRATION))
    posed.pathProjector(
        hpp.core.ProgressiveProjector(posed.distance(), posed.steeringMethod(), PROJECTION_STEP)
    )
    posed.initConfig(problem.start.copy())
    posed.addGoalConfig(problem.goals[0].copy())
    return posed


def plan(problem: PlanningProblem, budget: Budget, seed: int) -> np.ndarray | None:
    """A path (m, n) [rad] by `DiffusingPlanner` and `RandomShortcut`;
    None where there is none in the seconds.
    """
    began, hpp = time.perf_counter(), _hpp(problem)
    posed = _posed(problem, hpp)
    ctypes.CDLL(None).srand(seed)  # HPP draws by C's rand
    search = hpp.core.DiffusingPlanner(posed)
    search.maxIterations(ITERATIONS)
    if budget.seconds is not None:
        search.timeOut(budget.seconds)
    try:
        path = search.solve()
    except RuntimeError:  # what it raises when its time is over
        return None
    shortcuts = hpp.core.RandomShortcut(posed)
    if budget.seconds is not None:
        left = budget.seconds - (time.perf_counter() - began)
        if left <= 0.0:
            return None
        shortcuts.timeOut(left)
    path = shortcuts.optimize(path)
    along = np.linspace(0.0, path.length(), max(2, int(np.ceil(path.length() / SPACING)) + 1))
    return np.array([np.ravel(path.eval(t)[0]) for t in along])
