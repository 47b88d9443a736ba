"""Shortest duration of a motion along a curve by toppra, an independent time scaling."""

import numpy as np
import toppra
from toppra.algorithm import TOPPRA
from toppra.constraint import (
    DiscretizationType,
    JointAccelerationConstraint,
    JointTorqueConstraint,
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


def toppra_duration(curve, velocity, acceleration, dynamics=None, effort=None):
    """Duration [s] on the curve's grid; velocity, acceleration, effort: limits (n,)."""
    toppra.setup_logging("ERROR")
    velocities, accelerations = (np.stack([-x, x], axis=1) for x in (velocity, acceleration))
    how = DiscretizationType.Interpolation
    constraints = [
        JointVelocityConstraint(velocities),
        JointAccelerationConstraint(accelerations, how),
    ]
    if dynamics is not None:

        def efforts(q, v, a):
            return dynamics.efforts(*np.array([q, v, a])[:, None])[0]

        friction, between = np.zeros(len(effort)), np.stack([-effort, effort], axis=1)
        constraints.append(JointTorqueConstraint(efforts, between, friction, how))
    scaling = TOPPRA(constraints, Curve(curve), gridpoints=curve.grid)
    _, speed, _ = scaling.compute_parameterization(0.0, 0.0)
    return float((2.0 * np.diff(curve.grid) / (speed[1:] + speed[:-1])).sum())


def weak_efforts(problem, states):
    """Return limits (n,) [Nm] a little above the efforts that hold the states of the path."""
    still = np.zeros_like(states)
    return 1.1 * np.abs(problem.dynamics.efforts(states, still, still)).max(axis=0) + 2.0
