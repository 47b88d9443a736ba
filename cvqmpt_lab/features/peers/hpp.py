"""Adapter of HPP (C++, pinocchio, coal): diffusing planner, continuous checks, random shortcuts.

HPP has no constraints with two-sided bounds, so the hand is kept exactly upright. If two hands hold
one object, their relative pose is a second constraint, which must leave no freedom. HPP's wheels
find their shared libraries only by LD_LIBRARY_PATH; here they are loaded one by one instead.
"""

import ctypes
import importlib
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio as pin

from cvqmpt_lab.features.peers import fixed_holds, upright_region, versions
from cvqmpt_lab.features.peers.world_files import urdf_of
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search.result import Budget

MADE_BY = versions("hpp", "hpp-python")


def _imported(module: str) -> ModuleType:
    """Import a module whose shared libraries are in the folder of pinocchio's."""
    return _with_libraries(partial(importlib.import_module, module))


def _with_libraries(attempt: Callable[[], Any], library: str = "") -> Any:
    """Call `attempt`; load missing shared libraries and their dependencies, and retry.

    library: the library that `attempt` loads, which must not be loaded again here.
    """
    parents = Path(str(pin.__file__)).resolve().parents
    folder = next(one for one in parents if (one / "libpinocchio_default.so").is_file())
    while True:
        try:
            return attempt()
        except (ImportError, OSError) as error:
            missing = re.match(r"(\S+): cannot open shared object file", str(error))
            if missing is None or missing[1] in (library, str(folder / library)):
                raise
            load = partial(ctypes.CDLL, str(folder / missing[1]), mode=ctypes.RTLD_GLOBAL)
            _with_libraries(load, missing[1])


@lru_cache(maxsize=4)
def _device(robot: Robot, scene: Scene, carried: tuple[Attachment, ...]) -> Any:
    device = _imported("pyhpp.pinocchio").Device("arm")
    loading = _imported("pyhpp.pinocchio.urdf")
    with tempfile.TemporaryDirectory() as folder:
        urdf, srdf = urdf_of(robot, scene, Path(folder), np.eye(4), carried)
        loading.loadModelFromString(device, 0, "", "anchor", urdf, srdf, pin.SE3.Identity())
    return device


def _kept(problem: PlanningProblem, device: Any) -> Any:
    """Return HPP's constraints: first hand upright, and fixed poses of hands on one object."""
    robot, held = problem.robot, fixed_holds(problem)
    core, constraints = _imported("pyhpp.core"), _imported("pyhpp.constraints")
    rest = tuple(part for part in problem.constraint if part not in held)
    region = upright_region(problem.changed(constraint=rest, attachments=()))
    # tolerance of a projection [m, rad], and its largest number of Newton steps
    projector = core.ConfigProjector(device, "kept", 1e-4, 40)

    def keep(function: Any, rows: Sequence[bool]) -> None:
        kinds = constraints.ComparisonTypes()
        kinds[:] = [constraints.ComparisonType.EqualToZero] * sum(rows)
        projector.add(constraints.Implicit(function, kinds, _bools([True] * sum(rows))), 0)

    (_, T_world_w), (link, T_link_hand) = region.links(robot)
    upright = (False, True, True)
    T_link_e = pin.SE3(T_link_hand @ np.linalg.inv(region.Tw_e))
    frames = T_link_e, pin.SE3(T_world_w)
    keep(constraints.Orientation("upright", device, link, *frames, _bools(upright)), upright)
    for part in held:
        (base, T_base_w), (link, T_link_hand) = part.links(robot)
        frames = pin.SE3(T_base_w), pin.SE3(T_link_hand @ np.linalg.inv(part.Tw_e))
        all_six = (True,) * 6
        together = constraints.RelativeTransformation(
            "held", device, base, link, *frames, _bools(all_six)
        )
        keep(together, all_six)
    kept = core.ConstraintSet(device, "kept")
    kept.addConstraint(projector)
    return kept


def _bools(values: Sequence[bool]) -> Any:
    """Return truth values as HPP's list."""
    found = pin.StdVec_Bool()
    found[:] = values
    return found


def _posed(problem: PlanningProblem) -> Any:
    """Return HPP's form of the problem."""
    core = _imported("pyhpp.core")
    device = _device(problem.robot, problem.scene, problem.carried)
    posed = core.Problem(device)
    posed.setConstraints(_kept(problem, device))
    for check in ("CollisionValidation", "JointBoundValidation"):
        posed.addConfigValidation(check)
    # allowed penetration [m], which must be positive
    posed.pathValidation(core.Progressive(device, 1e-3))
    # distance of projected states [rad]
    along = core.ProgressiveProjector(posed.distance(), posed.steeringMethod(), 0.2)
    posed.pathProjector(along)
    posed.initConfig(problem.start.copy())
    posed.addGoalConfig(problem.goals[0].copy())
    return posed


def plan(
    problem: PlanningProblem, budget: Budget, seed: int, spacing: float = 0.025
) -> np.ndarray | None:
    """Plan by `DiffusingPlanner` and `RandomShortcut`.

    Args:
        problem: problem with constraints that `_kept` supports, and one goal.
        budget: its `seconds` [s] are the time limit of search and shortcuts.
        seed: seed of C's random generator.
        spacing: distance between states of the path [rad]. On straight motions between states
            0.05 rad apart, the relative position of two hands changed by up to 0.4 mm, and the
            certificate allows 0.5 mm.

    Returns:
        States (m, n) [rad] of the path; None if none is found within the budget.
    """
    began = time.perf_counter()
    posed, core = _posed(problem), _imported("pyhpp.core")
    # HPP takes random numbers from C's rand
    ctypes.CDLL(None).srand(seed)
    search = core.DiffusingPlanner(posed)
    # no limit: only the time limit counts
    search.maxIterations(2**60)
    if budget.seconds is not None:
        search.timeOut(budget.seconds)
    try:
        path = search.solve()
    except RuntimeError:
        # raised at the time limit
        return None
    shortcuts = core.RandomShortcut(posed)
    if budget.seconds is not None:
        left = budget.seconds - (time.perf_counter() - began)
        if left <= 0.0:
            return None
        shortcuts.timeOut(left)
    path = shortcuts.optimize(path)
    count = max(2, int(np.ceil(path.length() / spacing)) + 1)
    return np.array([np.ravel(path.eval(t)[0]) for t in np.linspace(0.0, path.length(), count)])
