"""Plots along a path: each bounded entry of the constraint with its bounds, clearance, joints."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.constraints.report import displacements
from cvqmpt_lab.constraints.task_space_region import ROWS, UNITS
from cvqmpt_lab.poses import rotation_matrices
from cvqmpt_lab.problem import PlanningProblem


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves over the states of a path."""

    name: str  # of its entity, without spaces
    title: str  # with the unit
    curves: Mapping[str, np.ndarray]  # (m,), one value for each state, by names in the legend
    bounds: Mapping[str, float]  # that a curve may not cross, by names in the legend
    width: float = 2.5  # of curves [pixels]; bounds are thin

    @property
    def lines(self) -> dict[str, np.ndarray]:
        """Curves and bounds."""
        m = len(next(iter(self.curves.values())))
        return {**self.curves, **{name: np.full(m, at) for name, at in self.bounds.items()}}

    @property
    def extremes(self) -> tuple[float, float]:
        """Least and largest value; 0 and 1 without any."""
        values = np.concatenate([*self.lines.values()])
        values = values[np.isfinite(values)]
        return (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)


def plots_along(problem: PlanningProblem, states: np.ndarray) -> list[Plot]:
    """The plots of a path's states (m, n), clearance last but one, joints last.

    For each region with a bound on the tilt or one free rotation, the angle between its axis in w
    and the hand's. For every bounded entry of every region, the displacement between its bounds.
    The smallest distance between any two pieces that must not touch.
    """
    robot, tilts, found = problem.robot, [], []
    for k, region in enumerate(problem.constraint):
        x = displacements(robot, region, states)
        rows = set(region.bounded_rows.tolist())
        free = {5} if 6 in rows else {3, 4, 5} - rows
        if len(free) == 1:
            axis = free.pop() - 3
            cosine = rotation_matrices(x[:, 3:6])[:, axis, axis]
            tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            tilts.append(Plot(f"tilt/{k}", "tilt of the hand [deg]", {"tilt": tilt}, {}))
        number = f" of region {k}" if len(problem.constraint) > 1 else ""
        for row in map(int, region.bounded_rows):
            named = dict(
                zip(("lower bound", "upper bound"), region.bounds[row].tolist(), strict=True)
            )
            bounds = {name: bound for name, bound in named.items() if np.isfinite(bound)}
            title = f"{ROWS[row]}{number} against its bounds [{UNITS[row]}]"
            name = f"bounds/{k}_{ROWS[row].replace(' ', '_')}"
            found.append(Plot(name, title, {ROWS[row]: x[:, row]}, bounds))
    checker = problem.collision_checker()
    clearance = np.array([1e3 * checker.clearance(q) for q in states])
    joints = dict(zip(robot.joint_names, states.T, strict=True))
    return [
        *tilts,
        *found,
        Plot("clearance", "clearance [mm]", {"clearance": clearance}, {"contact": 0.0}),
        Plot("joints", "joints [rad] or [m]", joints, {}, width=2.0),
    ]
