"""Compiled forward kinematics of a tree of hinges and sliders, on plain arrays.

Every joint turns about, or slides along, the z axis of its frame (`robot.axis_frames`). Row 0 of
every pose array is the world; joint j (from 0) is row j + 1. A configuration has one entry for each
planned joint; a joint that mimics one follows its entry.
"""

from math import factorial
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel

# Taylor coefficients of the sine, (-1)^k / (2 k + 1)!, and of the cosine, (-1)^k / (2 k)!
_S1, _S2, _S3, _S4, _S5, _S6, _S7 = ((-1.0) ** k / factorial(2 * k + 1) for k in range(1, 8))
_C2, _C3, _C4, _C5, _C6, _C7, _C8 = ((-1.0) ** k / factorial(2 * k) for k in range(2, 9))


@kernel(inline="machine")
def sine_and_cosine(angle):
    """Return sine and cosine of an angle [rad] below 1e5, to 1e-15; nan if it is not finite.

    x = angle - k pi / 2 in [-pi / 4, pi / 4] is computed by three exact subtractions, then
    sin x = x - x^3 / 3! + ... and cos x = 1 - x^2 / 2! + ...
    """
    k = np.floor(angle * (2.0 / np.pi) + 0.5)
    # pi / 2 as a sum of three doubles; the first two have 33 bits, so that k times them is exact
    x = angle - k * 1.5707963267341256
    x = (x - k * 6.077100506303966e-11) - k * 2.0222662487959506e-21
    z = x * x
    s = x + x * z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * (_S6 + z * _S7))))))
    c = 1.0 - z * (
        0.5 - z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * (_C6 + z * (_C7 + z * _C8))))))
    )
    quadrant = k - 4.0 * np.floor(0.25 * k)
    odd = quadrant == 1.0 or quadrant == 3.0
    sine = c if odd else s
    cosine = s if odd else c
    return (
        -sine if quadrant >= 2.0 else sine,
        -cosine if quadrant == 1.0 or quadrant == 2.0 else cosine,
    )


class Kinematics(NamedTuple):
    """A kinematic tree of joints, moved by n planned joints; the others mimic one of those.

    Joint j has the value multiplier[j] * q[entry[j]] + offset[j] in configuration q.
    """

    # pose row of the parent frame (0: world, j + 1: joint j)
    parent: Annotated[np.ndarray, "int64 joints"]
    # rotation of the joint frame in its parent frame at value 0
    rotation: Annotated[np.ndarray, "joints 3 3"]
    # origin of the joint frame in its parent frame at value 0 [m]
    translation: Annotated[np.ndarray, "joints 3"]
    prismatic: Annotated[np.ndarray, "bool joints"]  # True for a slider, False for a hinge
    lower: Annotated[np.ndarray, "n"]  # limit of a planned joint [rad or m]
    upper: Annotated[np.ndarray, "n"]  # limit of a planned joint [rad or m]
    moves: Annotated[np.ndarray, "bool joints p"]  # whether joint j moves pose row k
    entry: Annotated[np.ndarray, "int64 joints"]  # entry of a configuration that moves joint j
    multiplier: Annotated[np.ndarray, "joints"]  # 1 for a planned joint
    # -0.0 for a planned joint: adding it changes no bit [rad or m]
    offset: Annotated[np.ndarray, "joints"]
    # the n planned joints in the order of configurations, then the joints that mimic them
    order: Annotated[np.ndarray, "int64 joints"]

    def joint_values(self, q: np.ndarray) -> np.ndarray:
        """Return the values (..., joints) of all joints at configurations q (..., n)."""
        if len(self.parent) == len(self.lower):
            return q
        return self.joint_changes(q) + self.offset

    def joint_changes(self, change: np.ndarray) -> np.ndarray:
        """Return changes (..., joints) of all joints for changes or rates (..., n) of q."""
        if len(self.parent) == len(self.lower):
            return change
        return self.multiplier * change[..., self.entry]

    def summed(self, x: np.ndarray) -> np.ndarray:
        """Return sums (..., n) of x (..., joints) over the joints that each entry of q moves."""
        n = len(self.lower)
        total = np.array(x[..., self.order[:n]])
        for j in self.order[n:]:
            total[..., self.entry[j]] += x[..., j]
        return total


@kernel(inline="machine")
def forward_kinematics(kinematics, q, link_rotation, link_translation):
    """Write the pose of every joint frame.

    T_j = T_parent(j) T_joint(j) Rot_z(v_j) for a hinge, T_parent(j) T_joint(j) Trans_z(v_j) for a
    slider of value v_j; T_joint(j) consists of `rotation` and `translation` of `Kinematics`.

    Args:
        kinematics: the tree.
        q: configuration (n,) [rad or m].
        link_rotation: (p, 3, 3), p = joints + 1, overwritten; row 0 is the world.
        link_translation: (p, 3) [m], overwritten.
    """
    turn, offset = kinematics.rotation, kinematics.translation
    for a in range(3):
        link_translation[0, a] = 0.0
        for b in range(3):
            link_rotation[0, a, b] = 1.0 if a == b else 0.0
    for j in range(kinematics.parent.shape[0]):
        up = kinematics.parent[j]
        value = kinematics.multiplier[j] * q[kinematics.entry[j]] + kinematics.offset[j]
        if kinematics.prismatic[j]:
            cosine, sine, slide = 1.0, 0.0, value
        else:
            sine, cosine = sine_and_cosine(value)
            slide = 0.0
        z0, z1, z2 = turn[j, 0, 2], turn[j, 1, 2], turn[j, 2, 2]
        x0 = cosine * turn[j, 0, 0] + sine * turn[j, 0, 1]
        x1 = cosine * turn[j, 1, 0] + sine * turn[j, 1, 1]
        x2 = cosine * turn[j, 2, 0] + sine * turn[j, 2, 1]
        y0 = cosine * turn[j, 0, 1] - sine * turn[j, 0, 0]
        y1 = cosine * turn[j, 1, 1] - sine * turn[j, 1, 0]
        y2 = cosine * turn[j, 2, 1] - sine * turn[j, 2, 0]
        o0, o1, o2 = offset[j, 0] + slide * z0, offset[j, 1] + slide * z1, offset[j, 2] + slide * z2
        for a in range(3):
            r0, r1, r2 = link_rotation[up, a, 0], link_rotation[up, a, 1], link_rotation[up, a, 2]
            link_rotation[j + 1, a, 0] = r0 * x0 + r1 * x1 + r2 * x2
            link_rotation[j + 1, a, 1] = r0 * y0 + r1 * y1 + r2 * y2
            link_rotation[j + 1, a, 2] = r0 * z0 + r1 * z1 + r2 * z2
            link_translation[j + 1, a] = link_translation[up, a] + r0 * o0 + r1 * o1 + r2 * o2


@entry
def write_link_poses(
    kinematics: Kinematics,
    configurations: Annotated[np.ndarray, "count n"],
    rotations: Annotated[np.ndarray, "count rows 3 3"],
    translations: Annotated[np.ndarray, "count rows 3"],
):
    """Write the poses of all joint frames at several configurations.

    Args:
        kinematics: the tree.
        configurations: (count, n) [rad or m].
        rotations: (count, p, 3, 3), p = joints + 1, overwritten.
        translations: (count, p, 3) [m], overwritten.
    """
    for i in range(configurations.shape[0]):
        forward_kinematics(kinematics, configurations[i], rotations[i], translations[i])


def link_poses(kinematics: Kinematics, configurations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of all joint frames at configurations (m, n) [rad or m].

    Returns:
        Rotations (m, p, 3, 3) and translations (m, p, 3) [m], p = joints + 1.
    """
    m = len(configurations)
    rows = len(kinematics.parent) + 1
    rotations = np.empty((m, rows, 3, 3))
    translations = np.empty((m, rows, 3))
    write_link_poses(kinematics, configurations, rotations, translations)
    return rotations, translations
