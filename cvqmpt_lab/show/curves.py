"""Plots along a path: each bounded entry of the constraint with its bounds, clearance, joints."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.constraints.report import ROWS, UNITS, displacements
from cvqmpt_lab.poses import rotation_matrices
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.show.meshes import Colour

BOUND_COLOUR: Colour = (0.80, 0.20, 0.20)


class Curve(NamedTuple):
    """One line of a plot."""

    values: np.ndarray  # (m,), one for each state of the path
    colour: Colour | None = None  # None: the viewer chooses
    width: float = 2.0  # [pixels]


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves over the states of a path."""

    name: str  # of its entity, without spaces
    title: str  # with the unit
    curves: Mapping[str, Curve]  # by their names in the legend

    @property
    def range(self) -> tuple[float, float]:
        """Of the vertical axis, with room for the legend above the curves."""
        low, high = self.extremes
        height = max(high - low, 1e-3)
        return low - 0.05 * height, high + 0.45 * height

    @property
    def extremes(self) -> tuple[float, float]:
        """Least and largest value; 0 and 1 without any."""
        values = np.concatenate([curve.values for curve in self.curves.values()])
        values = values[np.isfinite(values)]
        return (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)


def plots_along(problem: PlanningProblem, states: np.ndarray) -> tuple[Plot, ...]:
    """The plots of a path's states (m, n)."""
    joints = {name: Curve(states[:, j]) for j, name in enumerate(problem.robot.joint_names)}
    found = [*bound_plots(problem, states), clearance_plot(problem, states)]
    return (*found, Plot("joints", "joints [rad] or [m]", joints))


def bound_plots(problem: PlanningProblem, states: np.ndarray) -> list[Plot]:
    """For every bounded entry of every region, the displacement between its bounds."""
    found = []
    for k, region in enumerate(problem.constraint):
        x = displacements(problem.robot, region, states)
        for row in map(int, region.bounded_rows):
            curves = {ROWS[row]: Curve(x[:, row], width=2.5)}
            for label, bound in zip(("lower bound", "upper bound"), region.Bw[row], strict=True):
                if np.isfinite(bound):
                    curves[label] = Curve(np.full(len(states), float(bound)), BOUND_COLOUR, 1.0)
            number = f" of region {k}" if len(problem.constraint) > 1 else ""
            title = f"{ROWS[row]}{number} against its bounds [{UNITS[row]}]"
            found.append(Plot(f"bounds/{k}_{ROWS[row].replace(' ', '_')}", title, curves))
    return found


def tilt_plots(problem: PlanningProblem, states: np.ndarray) -> list[Plot]:
    """For each region with one free rotation, the angle between its axis in w and the hand's."""
    found = []
    for k, region in enumerate(problem.constraint):
        free = {3, 4, 5} - set(region.bounded_rows.tolist())
        if len(free) == 1:
            x = displacements(problem.robot, region, states)[:, 3:]
            axis = free.pop() - 3
            tilt = np.degrees(np.arccos(np.clip(rotation_matrices(x)[:, axis, axis], -1.0, 1.0)))
            found.append(
                Plot(f"tilt/{k}", "tilt of the hand [deg]", {"tilt": Curve(tilt, width=2.5)})
            )
    return found


def clearance_plot(problem: PlanningProblem, states: np.ndarray) -> Plot:
    """Smallest distance between any two pieces that must not touch."""
    checker = problem.collision_checker()
    distances = np.array([1e3 * checker.clearance(q) for q in states])
    curves = {
        "clearance": Curve(distances, width=2.5),
        "contact": Curve(np.zeros(len(states)), BOUND_COLOUR, 1.0),
    }
    return Plot("clearance", "clearance [mm]", curves)
