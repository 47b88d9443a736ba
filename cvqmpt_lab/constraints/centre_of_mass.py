"""Constraint `centre-of-mass`: the robot's centre of mass stays above a convex polygon."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, few
from cvqmpt_lab.base.jit import Pointer, entry
from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.constraints.bounded_rows import BoundedRows
from cvqmpt_lab.constraints.regions import FunctionRows
from cvqmpt_lab.robot.body_masses import BodyMasses
from cvqmpt_lab.robot.dynamics import Load
from cvqmpt_lab.robot.robot import Robot, axis_frames


@dataclass(frozen=True, eq=False)
class CentreOfMass:
    """Configurations whose centre of mass, with the load, lies above a convex polygon."""

    corners: np.ndarray  # (k, 2) in order, x and y in the world, whose z is up [m]
    margin: float = 0.0  # distance that it keeps from the edges [m]
    loads: tuple[Load, ...] = ()  # what the hands carry

    @cached_property
    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Normals N (k, 2) outwards and offsets d (k,): N c <= d inside; refuse other polygons."""
        along = np.roll(self.corners, -1, axis=0) - self.corners
        after = np.roll(along, -1, axis=0)
        turns = along[:, 0] * after[:, 1] - along[:, 1] * after[:, 0]
        # a star turns to one side only, too, but more than once around
        around = np.arctan2(turns, (along * after).sum(axis=1)).sum()
        one_side = (turns > 0.0).all() or (turns < 0.0).all()
        if len(along) < 3 or not one_side or abs(around) > 3.0 * np.pi:
            raise InvalidInputError(
                f"corners of centre-of-mass are {self.corners.tolist()}; give 3 or more of a "
                "convex polygon, in order, without repetition"
            )
        N = np.sign(turns[0]) * np.column_stack([along[:, 1], -along[:, 0]])
        N /= np.linalg.norm(N, axis=1, keepdims=True)
        return N, (N * self.corners).sum(axis=1) - self.margin

    def __post_init__(self) -> None:
        frozen(self.edges)

    def on(self, robot: Robot) -> "BalancedRobot":
        """Return the constraint for a robot; InvalidInputError: its URDF gives no masses."""
        if robot.weightless:
            raise InvalidInputError(
                f"centre-of-mass: robot {robot.name} has no mass at joint {few(robot.weightless)}: "
                "give each link of the URDF an <inertial>"
            )
        return BalancedRobot(self, robot)

    def reraise(self) -> None:
        """Do nothing: machine code raises no errors."""

    @property
    def named(self) -> dict[str, Any]:
        """The constraint as problem files write it, without the load."""
        return {"centre-of-mass": {"corners": self.corners.tolist(), "margin": self.margin}}

    def carrying(self, loads: tuple[Load, ...]) -> "CentreOfMass":
        """Return the constraint of a robot with a load."""
        return replace(self, loads=loads)


@dataclass(frozen=True, eq=False)
class BalancedRobot(BoundedRows):
    """The constraint for a robot: x = N c(q) <= d, with the centre of mass c = sum of m_b p_b."""

    given: CentreOfMass
    robot: Robot

    @cached_property
    def masses(self) -> BodyMasses:
        """The masses of the robot and its load."""
        return BodyMasses(self.robot, self.given.loads)

    @property
    def compiled(self) -> FunctionRows:
        """The products as machine code; parameters: see `_centre_above`."""
        m, k = self.masses.shares, self.robot.kinematics
        # pinocchio's joint axes are turned against the axes of compiled code
        frames = np.array(axis_frames(self.robot.model))
        turned = np.einsum("pji,pj->pi", frames, self.masses.centres)
        joints = np.column_stack([k.entry, k.multiplier, k.prismatic, k.moves])
        N, d = self.given.edges
        parts = [len(m)], N, np.column_stack([m, turned]), joints
        parameters = np.concatenate([np.ravel(part).astype(float) for part in parts])
        return FunctionRows(_centre_above.address, np.full(len(d), -np.inf), d, parameters)

    def values(self, q: np.ndarray) -> np.ndarray:
        """Return N c (b, k) at q (b, n) [m]."""
        return self.masses.centre(q)[:, :2] @ self.given.edges[0].T

    def slopes(self, q: np.ndarray) -> np.ndarray:
        """Return N dc/dq (b, k, n) at q (b, n)."""
        return self.given.edges[0] @ self.masses.centre_rates(q)[:, :2]

    def bound_between(self, states: np.ndarray) -> np.ndarray:
        """Return how far x can exceed its larger value at both ends, |c''| / 8 (k - 1,) [m]."""
        return self.masses.centre_bend(states) / 8.0

    def describe(self) -> str:
        """Return the constraint in words."""
        kept = f", {self.given.margin:g} m inside" if self.given.margin else ""
        return f"centre of mass above a polygon of {len(self.given.corners)} corners{kept}"


@entry(inline="never")
def _centre_above(
    derivative: int,
    n: int,
    m: int,
    q: Pointer,
    rotation: Pointer,
    translation: Pointer,
    parameters: Pointer,
    out: Pointer,
):
    """Write N c, or N dc/dq, see `FunctionRows`.

    The parameters are the number p of pose rows, N (m, 2), share of the mass and centre (p, 4), and
    (p - 1, 3 + p): of each joint its entry of q, multiplier, whether it slides, and what it moves.
    """
    p = int(parameters[0])
    bodies, joints = 1 + 2 * m, 1 + 2 * m + 4 * p
    for i in range(m * (n if derivative else 1)):
        out[i] = 0.0
    for j in range(p - 1 if derivative else 1):
        joint = joints + j * (3 + p)
        mass = x = y = z = 0.0
        for b in range(p):
            body, share = bodies + 4 * b, parameters[bodies + 4 * b]
            if share == 0.0 or (derivative and parameters[joint + 3 + b] == 0.0):
                continue
            u, v, w = parameters[body + 1], parameters[body + 2], parameters[body + 3]
            r, t = 9 * b, 3 * b
            mass += share
            x += share * (
                rotation[r] * u + rotation[r + 1] * v + rotation[r + 2] * w + translation[t]
            )
            y += share * (
                rotation[r + 3] * u + rotation[r + 4] * v + rotation[r + 5] * w + translation[t + 1]
            )
            z += share * (
                rotation[r + 6] * u + rotation[r + 7] * v + rotation[r + 8] * w + translation[t + 2]
            )
        if derivative:
            r, t = 9 * (j + 1), 3 * (j + 1)
            a, b, c = rotation[r + 2], rotation[r + 5], rotation[r + 8]
            x, y, z = (
                x - mass * translation[t],
                y - mass * translation[t + 1],
                z - mass * translation[t + 2],
            )
            if parameters[joint + 2] == 0.0:
                x, y = b * z - c * y, c * x - a * z
            else:
                x, y = mass * a, mass * b
        for i in range(m):
            value = parameters[1 + 2 * i] * x + parameters[2 + 2 * i] * y
            if derivative:
                out[i * n + int(parameters[joint])] += parameters[joint + 1] * value
            else:
                out[i] = value
    return 0
