"""Pieces of furniture (boxes, cylinders, handles, doors, drawers) and household objects."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.kitchen_parameters import KitchenParameters
from cvqmpt_lab.scene.scene import Articulation, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder
from cvqmpt_lab.values import FloatArray

Span = tuple[float, float]


class Assembly(NamedTuple):
    """Pieces of furniture that move together, and how; None for fixed ones."""

    objects: list[SceneObject]
    articulation: Articulation | None = None


def handle(
    name: str, centre: tuple[float, float, float], axis: str, p: KitchenParameters
) -> list[SceneObject]:
    """Return a bar along `axis` ("y" or "z") at `centre`, and the two posts from it towards +x."""
    bar = cylinder(f"{name}/handle_bar", 0.5 * p.handle_diameter, p.handle_length, centre, axis)
    along = bar.T_world_object[:3, 2]
    ends = ("right", "left") if axis == "y" else ("lower", "upper")
    pieces = [bar]
    for end, sign in zip(ends, (-1, +1), strict=True):
        middle = centre + sign * 0.5 * p.post_spacing * along + (0.5 * p.post_length, 0.0, 0.0)
        post = f"{name}/handle_post_{end}"
        pieces.append(cylinder(post, 0.5 * p.post_diameter, p.post_length, middle, "x"))
    return pieces


def hinged(
    name: str, objects: list[SceneObject], hinge_xy: Span, hinge_side: int, p: KitchenParameters
) -> Assembly:
    """Return a door with a vertical hinge; left (+1) opens to -door_range, right (-1) to +."""
    limits = (-p.door_range, 0.0) if hinge_side > 0 else (0.0, p.door_range)
    return articulated(name, "hinge", pose((*hinge_xy, 0.0)), limits, objects)


def articulated(
    name: str,
    kind: Literal["hinge", "slider"],
    T_world_joint: FloatArray,
    limits: Span,
    objects: list[SceneObject],
) -> Assembly:
    """Return the objects with a closed (value 0) articulation that moves all of them."""
    moves = tuple(item.name for item in objects)
    return Assembly(
        objects, Articulation(name, kind, T_world_joint, *limits, value=0.0, moves=moves)
    )


def box(name: str, x: Span, y: Span, z: Span, obstacle: bool = True) -> SceneObject:
    """Return an upright box that fills the three world intervals."""
    centre = (0.5 * sum(x), 0.5 * sum(y), 0.5 * sum(z))
    return SceneObject(name, Box((x[1] - x[0], y[1] - y[0], z[1] - z[0])), pose(centre), obstacle)


def cylinder(
    name: str, radius: float, height: float, centre: Iterable[float], axis: str = "z"
) -> SceneObject:
    """Return a cylinder whose axis is a world axis."""
    return SceneObject(name, Cylinder(radius, height), oriented(axis, centre))


def oriented(axis: str, xyz: Iterable[float]) -> FloatArray:
    """Return the (4, 4) pose at `xyz` whose z points along a world axis: "x", "y", "z" or "-x"."""
    T = pose(xyz)
    columns = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2), "-x": (2, 1, 0)}[axis]
    T[:3, :3] = np.eye(3)[:, columns]
    if axis == "-x":
        T[:3, 2] *= -1.0
    return T


def shrunk(span: Span, margin: float) -> Span:
    """Return the interval made smaller by `margin` at both ends."""
    return span[0] + margin, span[1] - margin


def bar_y(panel_y: Span, hinge_side: int, inset: float) -> float:
    """Return the y of a vertical handle bar, `inset` from the panel's edge opposite its hinge."""
    return panel_y[0] + inset if hinge_side > 0 else panel_y[1] - inset


@dataclass(frozen=True)
class ObjectModel:
    """The collision shape of an object, and poses of shape and centre of mass in the link frame."""

    shape: Box | Cylinder  # centred on its own frame, parallel to the link frame
    shape_centre: tuple[float, float, float]  # middle of the shape in the link frame [m]
    com: tuple[float, float, float]  # centre of mass in the link frame [m]

    def at_com(self, name: str, position_com: Sequence[float], yaw: float = 0.0) -> SceneObject:
        """Return the object with centre of mass at `position_com` (3,) [m] and a `yaw` [rad]."""
        T_world_link = pose(position_com, yaw) @ pose(-np.array(self.com))
        return SceneObject(name, self.shape, T_world_link @ pose(self.shape_centre))


# YcbChipsCan as scaled in the published experiment code.
CAN = ObjectModel(
    Cylinder(0.0373, 0.242), shape_centre=(-0.005, 0.012, 0.1265), com=(-0.005, 0.010, 0.100)
)
# YcbCrackerBox.
CRACKER_BOX = ObjectModel(
    Box((0.0616, 0.1575, 0.2068)), (0.028, -0.011, -0.005), com=(0.030, -0.010, -0.020)
)
# YcbMustardBottle; the horizontal middle of its box is taken to be the centre of mass's.
MUSTARD_BOTTLE = ObjectModel(
    Box((0.0589, 0.0986, 0.1905)), (0.005, 0.005, 0.0125), (0.005, 0.005, -0.015)
)
