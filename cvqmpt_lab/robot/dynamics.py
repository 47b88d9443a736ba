"""Inverse dynamics of an arm and its loads: efforts of a motion, and bounds between samples.

    tau = M(q) q'' + C(q, q') q' + g(q)

A motion that takes `slower` times as long needs efforts (tau - g) / slower^2 + g. The model has
neither friction nor inertia of rotors, nor forces of a door.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import comb
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.errors import InvalidInputError, few
from cvqmpt_lab.robot.kinematics import Kinematics
from cvqmpt_lab.robot.robot import JointLimits, Robot, axis_frames, in_link


class Load(NamedTuple):
    """Mass and inertia of an object fixed to an end effector."""

    T_hand_object: np.ndarray  # (4, 4) [m]
    mass: float  # [kg]
    centre: np.ndarray  # (3,) centre of mass in the object's frame [m]
    tensor: np.ndarray  # (3, 3) inertia about the centre of mass [kg m^2]
    end_effector: str | None = None  # None: the robot's first one


def loaded_model(robot: Robot, loads: Iterable[Load]) -> pin.Model:
    """Return a robot's model with the load's mass added to the links that carry it."""
    model = robot.model.copy()
    for load in loads:
        name = load.end_effector or robot.end_effector
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        inertia = pin.Inertia(load.mass, load.centre, load.tensor)
        held = frame.placement * pin.SE3(load.T_hand_object)
        model.appendBodyToJoint(frame.parentJoint, inertia, held)
    return model


@dataclass(frozen=True, eq=False)
class Dynamics:
    """Rigid-body model of an arm; its loads are parts of the links that carry them.

    The effort of a planned joint is its motor's, which also moves the joints that mimic it.
    """

    model: pin.Model
    kinematics: Kinematics

    @staticmethod
    def of(robot: Robot, loads: Iterable[Load] = ()) -> Dynamics | None:
        """Return a robot's dynamics; None if no effort is limited, see `without_effort_limit`."""
        if robot.weightless or np.isinf(robot.limits["effort"]).all():
            return None
        return Dynamics(loaded_model(robot, loads), robot.kinematics)

    def efforts(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return efforts tau (k, n) [Nm or N] at q, v = q', a = q'' (k, n)."""
        data, k = self.model.createData(), self.kinematics
        states = k.joint_values(q), k.joint_changes(v), k.joint_changes(a)
        rows = zip(*(np.ascontiguousarray(x) for x in states), strict=True)
        found = np.array([pin.rnea(self.model, data, *row) for row in rows])
        return k.summed(k.multiplier * found.reshape(states[0].shape))

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return the efforts g(q) (k, n) [Nm or N] that hold the arm still at q (k, n)."""
        still = np.zeros_like(q)
        return self.efforts(q, still, still)

    def weights(self, q: np.ndarray, limits: JointLimits) -> np.ndarray:
        """Return g(q) as `gravity` does; refuse it if it reaches the effort limit of a joint."""
        efforts = self.gravity(q)
        assert limits.effort is not None
        k, joint = np.unravel_index(int((np.abs(efforts) / limits.effort).argmax()), q.shape)
        if abs(efforts[k, joint]) >= limits.effort[joint]:
            raise InvalidInputError(
                f"joint {limits.joint_names[joint]!r} needs {abs(efforts[k, joint]):.3g} of "
                f"{limits.effort[joint]:.3g} Nm to stand still: carry less, raise --effort, or "
                "plan another path"
            )
        return efforts

    def curvature(self, places: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return an upper bound of |tau''| (k, n) [Nm/s^2 or N/s^2] on each of k motion pieces.

        Vectors of the links are bounded by their lengths, with derivatives up to the fourth: a
        vector r fixed to a link with angular velocity w has r' = w x r, and the k-th derivative of
        a product x y is at most sum_m C(k, m) |x^(m)| |y^(k - m)|.

        Args:
            places: (k, n) upper bounds of |q| [rad or m].
            rates: (4, k, n) upper bounds of the first to fourth derivatives of q.
        """
        model, rows, k = self.model, range(1, self.model.njoints), self.kinematics
        gains = np.abs(k.multiplier)
        places = gains * places[..., k.entry] + np.abs(k.offset)
        rates = gains * rates[..., k.entry]
        still = np.zeros((5, rates.shape[1]))
        turns, axes = [still[:4]], [still[:4]]
        moves, arms = [still], [still]
        forces, moments = [still[:3]], [still[:3]]
        slides = [joint.shortname().startswith("JointModelP") for joint in model.joints]
        for i in rows:
            parent, placement = model.parents[i], model.jointPlacements[i]
            axis = _attached(1.0, turns[parent])
            arm = _attached(float(np.linalg.norm(placement.translation)), turns[parent])
            turn = turns[parent]
            if slides[i]:
                stroke = np.concatenate([places[None], rates])[:, :, i - 1]
                arm = arm + _product(axis, stroke)
            else:
                turn = turn + _product(axis[:4], rates[:, :, i - 1])
            body = model.inertias[i]
            lever = _attached(float(np.linalg.norm(body.lever)), turn)
            move = moves[parent] + arm
            # m (c'' - g) and its derivatives
            force = body.mass * (move + lever)[2:]
            force[0] += body.mass * float(np.linalg.norm(model.gravity.linear))
            # the angular momentum is I w; I = R I_0 R^T has the derivative I' = w x I - I x w
            inertia = float(np.linalg.eigvalsh(body.inertia).max())
            tensor = _attached(inertia, 2.0 * turn)[:4]
            moments.append(_product(lever[:3], force) + _product(tensor, turn)[1:])
            forces.append(force)
            turns.append(turn)
            moves.append(move)
            axes.append(axis)
            arms.append(arm)
        found = np.empty(rates.shape[1:])
        for i in reversed(rows):
            found[:, i - 1] = _product(axes[i][:3], forces[i] if slides[i] else moments[i])[2]
            parent = model.parents[i]
            moments[parent] = moments[parent] + moments[i] + _product(arms[i][:3], forces[i])
            forces[parent] = forces[parent] + forces[i]
        return k.summed(gains * found)


def link_inertias(robot: Robot) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return mass [kg], centre of mass (3,) [m] and inertia (3, 3) [kg m^2] of each joint's body.

    Joints that mimic others have one, too. Bodies of later joints are not included. Vectors are in
    the joint frames of `Robot.kinematics`, whose z axis is the joint's axis; the inertia is about
    the centre of mass.
    """
    frames = axis_frames(robot.model)
    bodies = [
        pin.SE3(in_link(frames, joint, pin.SE3.Identity())[1]).act(inertia)
        for joint, inertia in enumerate(list(robot.model.inertias)[1:], start=1)
    ]
    return [(body.mass, body.lever, body.inertia) for body in bodies]


def without_effort_limit(robot: Robot) -> str:
    """Return which of the arm's efforts are not limited and why; "" if all are limited."""
    if names := robot.weightless:
        return f"efforts not limited: the URDF states no mass of the links of {', '.join(names)}"
    own = robot.kinematics.order[: robot.dof]
    stated = zip(
        robot.joint_names,
        robot.limits["effort"],
        np.array(robot.model.upperEffortLimit)[own],
        strict=True,
    )
    # a door's joint has no motor: its limit is infinite in the model, too
    odd = [f"{name} ({x:g})" for name, limit, x in stated if np.isinf(limit) and np.isfinite(x)]
    return f"effort not limited: {', '.join(odd)} not plausible in the URDF" if odd else ""


def too_weak(robot: Robot, samples: int = 500) -> str:
    """Return which joints cannot hold the arm up with their effort limits; "" if all can.

    samples: number of random configurations.
    """
    dynamics = Dynamics.of(robot)
    if dynamics is None:
        return ""
    limits, names = robot.limits["effort"], robot.joint_names
    q = robot.random_configurations(np.random.default_rng(0), samples)
    needed = np.abs(dynamics.gravity(q))
    most, weak = needed.max(axis=0), (needed >= limits).mean(axis=0)
    found = [
        f"{names[k]!r} needs up to {most[k]:.3g} of {limits[k]:.3g} {robot.unit_of(k, 'Nm')} "
        f"(too much in {100.0 * weak[k]:.2g} % of random configurations)"
        for k in np.flatnonzero(weak).tolist()
    ]
    return (
        f"the arm cannot hold itself up everywhere: joint {few(found, 3)}; timed motions are "
        "refused there: correct effort in the URDF, or give --effort"
        if found
        else ""
    )


def _product(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return bounds of a product and its derivatives (k, ...) from its factors' bounds."""
    return np.array(
        [sum(comb(k, m) * x[m] * y[k - m] for m in range(k + 1)) for k in range(len(x))]
    )


def _attached(length: float, turn: np.ndarray) -> np.ndarray:
    """Return bounds of r and its derivatives (5, ...), fixed to a body of angular velocity `turn`.

    turn: (4, ...) bounds of the angular velocity and its derivatives.
    """
    r = np.full((5, *turn.shape[1:]), length)
    for k in range(1, 5):
        r[k] = sum(comb(k - 1, m) * turn[m] * r[k - 1 - m] for m in range(k))
    return r
