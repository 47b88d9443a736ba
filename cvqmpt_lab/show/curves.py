"""Plots along a path or task: the constraint with its bounds, clearance, joints."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.poses import rotation_matrices
from cvqmpt_lab.constraints.report import displacements
from cvqmpt_lab.constraints.task_space_region import ROWS, UNITS, TaskSpaceRegion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves over the states of a path."""

    name: str  # of its entity, without spaces
    title: str  # with the unit
    curves: Mapping[str, np.ndarray]  # (m,), one value for each state, by names in the legend
    bounds: Mapping[str, float]  # that a curve may not cross, by names in the legend
    width: float = 2.5  # of curves [pixels]; bounds are thin
    from_zero: bool = False  # of a quantity that is never negative: its axis starts at 0

    @property
    def lines(self) -> dict[str, np.ndarray]:
        """Curves and bounds."""
        m = len(next(iter(self.curves.values())))
        return {**self.curves, **{name: np.full(m, at) for name, at in self.bounds.items()}}

    @property
    def extremes(self) -> tuple[float, float]:
        """Least and largest value, with 0 if the axis starts there; 0 and 1 without any."""
        values = np.concatenate([*self.lines.values(), [0.0] if self.from_zero else []])
        values = values[np.isfinite(values)]
        return (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)


def plots_along(problem: PlanningProblem, states: np.ndarray) -> list[Plot]:
    """The plots of a path's states (m, n), clearance last but one, joints last.

    For each region with a bound on the tilt or one free rotation, the angle between its axis in w
    and the hand's, with its limit. For every other bounded entry of every region, the displacement
    between its bounds. The smallest distance between any two pieces that must not touch.
    """
    robot, tilts, found = problem.robot, [], []
    for k, region in enumerate(problem.constraint):
        x = displacements(robot, region, states)
        rows = set(region.bounded_rows.tolist())
        number = f" of region {k}" if len(problem.constraint) > 1 else ""
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
    checker = problem.collision_checker()
    clearance = np.array([checker.clearance(q) for q in states])
    return [*tilts, *found, *_usual(robot, states, clearance)]


def plots_over(moments: Sequence[tuple[Robot, np.ndarray, float]]) -> list[Plot]:
    """The plots of a task's moments: the hand's way, clearance, joints.

    Args:
        moments: the arm, its joints (n,) [rad or m], and its clearance [m], nan where unknown.
    """
    arm = moments[0][0]
    states, clearance = np.array([q for _, q, _ in moments]), np.array([c for *_, c in moments])
    hand = np.array([robot.pose(q)[:3, 3] for robot, q, _ in moments])
    path = Plot("path", "path of the hand [m]", dict(zip("xyz", hand.T, strict=True)), {})
    return [path, *_usual(arm, states, clearance)]


def _usual(robot: Robot, states: np.ndarray, clearance: np.ndarray) -> list[Plot]:
    """Plots of clearances (m,) [m] and states (m, n)."""
    joints = dict(zip(robot.joint_names, states.T, strict=True))
    curve, contact = {"clearance": 1e3 * clearance}, {"contact": 0.0}
    return [
        Plot("clearance", "clearance [mm]", curve, contact, from_zero=True),
        Plot("joints", "joints [rad] or [m]", joints, {}, width=2.0),
    ]


def _tilt_limit(region: TaskSpaceRegion, rows: set[int]) -> dict[str, float]:
    """The tilt [deg] that a region allows, by its name in the legend; none where it allows any."""
    if 6 in rows:
        return {"limit": math.degrees(region.bounds[6, 1])}
    # with a bounded rotation vector (a, b, c): sin(tilt / 2) <= |(a, b)| / 2
    corner = np.abs(region.bounds[[row for row in (3, 4, 5) if row in rows]]).max(axis=1)
    half = 0.5 * float(np.linalg.norm(corner))
    return {"largest by the bounds": math.degrees(2.0 * math.asin(half))} if half < 1.0 else {}
