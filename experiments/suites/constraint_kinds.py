"""Kinds of constraints that no model was trained on: what the hand keeps at a pose that it can take, and carries."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.constraints.named import Line, Plane
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, upright
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box
from experiments.suites.door_task import handle_region
from experiments.suites.place_task import carried_can

TURN = 0.1  # [rad] that an orientation may be off
LEVEL = 0.02  # [rad] that a tray may tilt
EXACT = 0.002  # [m] off a plane, line or arc
LEVER = (0.15, 0.4)  # [m] from an arc's centre to the hand
ARC = 2.5  # [rad] of an arc, to either side
DOORS = ("dagger_door_left", "dagger_door_right")
AJAR, WIDE = 0.15, 1.5  # [rad] between which a door is moved
SWUNG = 0.6  # [rad] that it is moved at least
GRASP_TURN = 0.6  # [rad] that the hand may be turned about the handle, either way
TRIM = 0.02  # [m] cut off all round a door's panel, which fits its casing to half a millimetre
TRAY = Attachment("tray", Box((0.02, 0.24, 0.18)), pose((0.0, 0.0, 0.19)))


class Kept(NamedTuple):
    """What a problem asks of the hand."""

    region: TaskSpaceRegion
    """Where it must stay."""
    attachments: tuple[Attachment, ...] = ()
    """What it carries."""
    start: TaskSpaceRegion | None = None
    """Where it begins; None: somewhere in its region."""
    goal: TaskSpaceRegion | None = None
    """Where it ends; likewise."""


Keep = Callable[[np.ndarray, np.random.Generator], Kept]
"""Makes a constraint that a hand at a pose (4, 4) meets."""


def _upright(T: np.ndarray, rng: np.random.Generator) -> Kept:
    return Kept(upright())


def _fixed_orientation(T: np.ndarray, rng: np.random.Generator) -> Kept:
    return Kept(_turned_like(T, TURN))


def _pouring(T: np.ndarray, rng: np.random.Generator) -> Kept:
    """A can in the hand is tipped about the axis along which the fingers reach, which keeps its direction."""
    return Kept(_turned_like(T, FREE), (carried_can(),))


def _turned_like(T: np.ndarray, about_z: float) -> TaskSpaceRegion:
    """The hand at the orientation of T (4, 4) but for a turn about its z axis [rad], anywhere."""
    there = T.copy()
    there[:3, 3] = 0.0
    bound = np.array([FREE] * 3 + [TURN] * 2 + [about_z])
    return TaskSpaceRegion(there, np.eye(4), np.stack([-bound, bound], axis=1))


def _plane(T: np.ndarray, rng: np.random.Generator) -> Kept:
    return Kept(Plane(_direction(rng), tuple(T[:3, 3]), EXACT).region())


def _line(T: np.ndarray, rng: np.random.Generator) -> Kept:
    return Kept(Line(_direction(rng), tuple(T[:3, 3]), EXACT).region())


def _arc(T: np.ndarray, rng: np.random.Generator) -> Kept:
    """About an axis of any direction, the hand turning with it as with a crank."""
    axis = Line(_direction(rng), (0.0, 0.0, 0.0)).region().T0_w.copy()
    axis[:3, 3] = T[:3, 3] + rng.uniform(*LEVER) * axis[:3, 0]
    return Kept(_about(axis, T, ARC))


def _about(axis: np.ndarray, T: np.ndarray, turn: float) -> TaskSpaceRegion:
    """The hand at T (4, 4), carried about the z axis of a frame (4, 4) by at most a turn [rad] to either side."""
    bound = np.array([EXACT] * 3 + [LEVEL] * 2 + [turn])
    return TaskSpaceRegion(axis, np.linalg.inv(axis) @ T, np.stack([-bound, bound], axis=1))


def _tray(T: np.ndarray, rng: np.random.Generator) -> Kept:
    return Kept(upright(LEVEL), (TRAY,))


def _direction(rng: np.random.Generator) -> tuple[float, float, float]:
    """Uniform on the sphere."""
    x, y, z = rng.standard_normal(3)
    return float(x), float(y), float(z)


KINDS: Mapping[str, Keep] = {
    "upright": _upright,
    "fixed-orientation": _fixed_orientation,
    "plane": _plane,
    "line": _line,
    "arc": _arc,
    "tray": _tray,
    "pouring": _pouring,
}
"""By name, but for the door, whose constraint hangs on the scene."""


def held_door(rng: np.random.Generator) -> tuple[Scene, Kept]:
    """The kitchen without one of the shelf's doors, which hangs on its hinge and in the hand, held firmly.

    So the door is a thing that an arm of seven joints carries along an arc, and not, as in `door_task`, a joint.
    """
    scene, door = kitchen(), str(rng.choice(DOORS))
    hinge = scene.articulation(door)
    sign = 1.0 if hinge.upper > 0.0 else -1.0
    first = rng.uniform(AJAR, WIDE - SWUNG)
    angles = sign * rng.permutation((first, rng.uniform(first + SWUNG, WIDE)))
    in_bar = pose((0.0, 0.0, 0.0), rng.uniform(-GRASP_TURN, GRASP_TURN)) @ handle_region().Tw_e
    hands = [scene.with_joint(door, a)[f"{door}/handle_bar"].T_world_object @ in_bar for a in angles]
    begun = scene.with_joint(door, angles[0])
    parts = tuple(_carried(begun, name, hands[0]) for name in hinge.moves)
    start, goal = (TaskSpaceRegion(T, np.eye(4), np.zeros((6, 2))) for T in hands)
    kept = _about(hinge.T_world_joint, hands[0], WIDE)
    return scene.without(*hinge.moves), Kept(kept, parts, start, goal)


def _carried(scene: Scene, name: str, T: np.ndarray) -> Attachment:
    """A part of the door as it is seen from the hand at a pose (4, 4)."""
    item = scene[name]
    shape = item.shape
    if isinstance(shape, Box):
        thin, wide, high = shape.size
        shape = Box((thin, wide - 2 * TRIM, high - 2 * TRIM))
    return Attachment(name.rpartition("/")[2], shape, np.linalg.inv(T) @ item.T_world_object)
