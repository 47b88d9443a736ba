"""Shortest duration of a motion along a curve by toppra, an independent time scaling."""

import numpy as np
import toppra
from toppra.algorithm import TOPPRA
from toppra.constraint import (
    DiscretizationType,
    JointAccelerationConstraint,
    JointVelocityConstraint,
)
from toppra.interpolator import AbstractGeometricPath


class Curve(AbstractGeometricPath):
    """Our curve with toppra's interface."""

    dof = path_interval = waypoints = None  # properties of the base class

    def __init__(self, curve):
        self.curve, self.dof = curve, curve.spline.c.shape[1]
        self.path_interval = np.array([0.0, curve.marks[-1]])

    def __call__(self, s, order=0):
        return self.curve.spline(s, order)


def toppra_duration(curve, velocity, acceleration):
    """Duration [s]; velocity, acceleration: limits (n,)."""
    toppra.setup_logging("ERROR")
    constraints = [
        JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        JointAccelerationConstraint(
            np.stack([-acceleration, acceleration], axis=1), DiscretizationType.Interpolation
        ),
    ]
    grid = np.unique(np.concatenate([curve.grid, 0.5 * (curve.grid[1:] + curve.grid[:-1])]))
    _, speed, _ = TOPPRA(constraints, Curve(curve), gridpoints=grid).compute_parameterization(
        0.0, 0.0
    )
    return float((2.0 * np.diff(grid) / (speed[1:] + speed[:-1])).sum())
