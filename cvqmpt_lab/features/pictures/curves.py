"""Plots along a path or task: constraint with bounds, clearance, joints."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.poses import rotation_matrices
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.constraints.task_space_region import ROWS, UNITS, TaskSpaceRegion, displacements
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves over the states of a path."""

    name: str  # name of its entity in recordings, without spaces
    title: str  # with the unit
    curves: Mapping[str, np.ndarray]  # (m,), one value per state, by name in the legend
    bounds: Mapping[str, float]  # bounds of the curves, by name in the legend
    width: float = 2.5  # line width of curves [pixels]; bounds are thinner
    from_zero: bool = False  # whether the axis starts at 0, for quantities that are never negative

    @property
    def lines(self) -> dict[str, np.ndarray]:
        """Curves and bounds (m,), by name in the legend."""
        m = len(next(iter(self.curves.values())))
        return {**self.curves, **{name: np.full(m, at) for name, at in self.bounds.items()}}

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest finite value, with 0 if the axis starts there; else 0 and 1."""
        values = np.concatenate([*self.lines.values(), [0.0] if self.from_zero else []])
        values = values[np.isfinite(values)]
        return (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)


def plots_along(problem: PlanningProblem, states: np.ndarray) -> list[Plot]:
    """Plots of the states (m, n) of a path: tilts, other displacements, clearance and joints.

    A region with a bound on the tilt, or with one free rotation, has a plot of the angle between
    its axis in w and the same axis of the hand, with the limit. Every other bounded entry of a
    region has a plot of the displacement with its bounds. The clearance is the smallest distance of
    any two bodies that must not touch.
    """
    robot = problem.robot
    tilts, found = [], []
    for k, region in enumerate(problem.regions):
        x = displacements(robot, region, states)
        rows = set(region.bounded_rows.tolist())
        number = f" of region {k}" if len(problem.regions) > 1 else ""
        free = {5} if 6 in rows else {3, 4, 5} - rows
        if len(free) == 1:
            axis = free.pop() - 3
            cosine = rotation_matrices(x[:, 3:6])[:, axis, axis]
            tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            title = f"tilt of the hand{number} [deg]"
            limit = _tilt_limit(region, rows)
            tilts.append(Plot(f"tilt/{k}", title, {"tilt": tilt}, limit, from_zero=True))
        for row in sorted(rows - {6}):
            named = dict(
                zip(("lower bound", "upper bound"), region.bounds[row].tolist(), strict=True)
            )
            bounds = {name: bound for name, bound in named.items() if np.isfinite(bound)}
            title = f"{ROWS[row]}{number} against its bounds [{UNITS[row]}]"
            name = f"bounds/{k}_{ROWS[row].replace(' ', '_')}"
            found.append(Plot(name, title, {ROWS[row]: x[:, row]}, bounds))
    checker = checker_of(problem)
    clearance = np.array([checker.clearance(q) for q in states])
    return [*tilts, *found, *_clearance_and_joints(robot, states, clearance)]


def plots_over(moments: Sequence[tuple[Robot, np.ndarray, float]]) -> list[Plot]:
    """Plots over the frames of a task: position of the hand, clearance, joints.

    Args:
        moments: for each frame the arm, its joints (n,) [rad or m] and its clearance [m] or nan.
    """
    arm = moments[0][0]
    states = np.array([q for _, q, _ in moments])
    clearance = np.array([distance for _, _, distance in moments])
    hand = np.array([robot.pose(q)[:3, 3] for robot, q, _ in moments])
    path = Plot("path", "path of the hand [m]", dict(zip("xyz", hand.T, strict=True)), {})
    return [path, *_clearance_and_joints(arm, states, clearance)]


def _clearance_and_joints(robot: Robot, states: np.ndarray, clearance: np.ndarray) -> list[Plot]:
    """Plots of clearances (m,) [m] and of states (m, n)."""
    joints = dict(zip(robot.joint_names, states.T, strict=True))
    curve, contact = {"clearance": 1e3 * clearance}, {"contact": 0.0}
    return [
        Plot("clearance", "clearance [mm]", curve, contact, from_zero=True),
        Plot("joints", "joints [rad] or [m]", joints, {}, width=2.0),
    ]


def _tilt_limit(region: TaskSpaceRegion, rows: set[int]) -> dict[str, float]:
    """Largest tilt [deg] in a region, by its name in the legend; empty if any tilt is allowed."""
    if 6 in rows:
        return {"limit": math.degrees(region.bounds[6, 1])}
    # with a bounded rotation vector (a, b, c): sin(tilt / 2) <= |(a, b)| / 2
    corner = np.abs(region.bounds[[row for row in (3, 4, 5) if row in rows]]).max(axis=1)
    half = 0.5 * float(np.linalg.norm(corner))
    return {"largest by the bounds": math.degrees(2.0 * math.asin(half))} if half < 1.0 else {}
