"""The kitchen of the place and multi-sequence tasks, built from parameters.

World frame: robot base link, +x towards the kitchen's back wall, +y to the left as the robot looks at
it, z up; metres and radians. The default parameters reproduce the kitchen of the published experiment
code piece by piece within 5 mm. Row and door names ("dagger", "sektion", "hitman", "indigo") are the
ones of that kitchen: dagger and indigo are right of the range, above and below the counter; sektion
and hitman are left of it. Cabinets are hollow and have no back panel: the back wall closes them.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.scene import Articulation, Scene, SceneObject, pose
from cvqmpt_lab.scene.shapes import Box, Cylinder, FloatArray, finite_number, positive_length

Span = tuple[float, float]

WALL_CELLS = {"dagger": 2, "sektion": 3}
"""Cells of each row of wall cabinets, counted from its right end (-y)."""


@dataclass(frozen=True)
class KitchenParameters:
    """Dimensions of the kitchen [m] and the door range [rad]; the defaults are the published kitchen.

    Fields whose name ends in `_x`, `_y` or `_z` are world coordinates; all others are positive sizes.
    Cabinets stand against the back wall, to the left and right of the range; moving or resizing one
    piece moves what is attached to it.
    """

    # Room.
    back_wall_x: float = 0.867  # front face of the back wall
    back_wall_width: float = 3.5  # starts at the outer face of the right wall
    right_wall_length: float = 0.914
    wall_thickness: float = 0.130
    wall_height: float = 2.750
    wall_bottom_z: float = -0.623
    floor_z: float = -0.750  # top of the floor
    floor_side: float = 200.0
    floor_thickness: float = 10.0
    # Robot pedestal.
    pedestal_x: float = -0.050
    pedestal_side: float = 0.250
    pedestal_height: float = 0.750
    pedestal_top_z: float = -0.010
    # Range (stove) and hood.
    range_y: float = 0.260  # middle
    range_width: float = 0.760
    range_depth: float = 0.710
    range_height: float = 0.920
    range_top_z: float = 0.172
    range_wall_gap: float = 0.012
    range_side_gap: float = 0.035  # to the cabinets left and right
    plate_height: float = 0.001
    front_plate_radius: float = 0.125
    front_plate_side_inset: float = 0.170  # plate axis from the range's side
    front_plate_front_inset: float = 0.290  # plate axis from the range's front
    back_plate_radius: float = 0.080
    back_plate_side_inset: float = 0.125
    back_plate_front_inset: float = 0.540
    control_panel_depth: float = 0.125
    control_panel_thickness: float = 0.004
    knob_radius: float = 0.025
    knob_height: float = 0.025
    outer_knob_side_inset: float = 0.050
    inner_knob_side_inset: float = 0.125
    hood_depth: float = 0.560
    hood_height: float = 0.660
    hood_bottom_z: float = 0.767
    hood_into_wall: float = 0.053  # how deep the hood's back is let into the wall
    # Cabinets.
    cabinet_width: float = 0.381  # one cell; a base cabinet is two cells wide
    cabinet_wall_gap: float = 0.001
    board_thickness: float = 0.019
    wall_cabinet_depth: float = 0.366
    wall_cabinet_height: float = 0.762
    dagger_bottom_z: float = 0.6265
    sektion_bottom_z: float = 0.7275
    base_cabinet_depth: float = 0.610
    base_cabinet_height: float = 0.763
    base_cabinet_bottom_z: float = -0.622
    base_back_thickness: float = 0.040
    # Countertops; the right one reaches the right wall.
    countertop_depth: float = 0.650
    countertop_thickness: float = 0.037
    left_countertop_width: float = 1.200
    right_counter_gap: float = 0.073  # from the right cabinets to the right wall
    # Doors and drawers.
    door_thickness: float = 0.019  # also the front panels of drawers
    door_gap: float = 0.001  # how much narrower and lower than its cabinet a door is
    door_range: float = 1.57  # [rad]
    base_front_gap: float = 0.003  # from a base cabinet to its doors and front panels
    base_front_reveal: float = 0.0065  # from the cabinet's top to the first front panel
    stacked_front_gap: float = 0.0035  # between fronts above each other
    base_hinge_inset: float = 0.006  # hinge from the cabinet's side; it lies mid-panel
    base_door_overhang: float = 0.0065  # how far indigo's doors reach below the cabinet
    indigo_front_height: float = 0.124  # front panels of the drawers above indigo's doors
    drawer_travel: float = 0.400
    drawer_length: float = 0.512
    drawer_height: float = 0.086
    drawer_board_thickness: float = 0.005
    drawer_bottom_thickness: float = 0.001
    drawer_side_gap: float = 0.013  # drawer to the cabinet's side boards
    hitman_drawer_lift: float = 0.034  # drawer above the lower edge of its front panel
    tray_thickness: float = 0.012
    tray_lift: float = 0.007  # tray above the drawer's lower edge
    # Handles: a bar on two posts. Stand-off: bar axis from the panel's face.
    handle_length: float = 0.245
    handle_diameter: float = 0.015
    post_length: float = 0.040
    post_diameter: float = 0.010
    post_spacing: float = 0.155
    wall_handle_standoff: float = 0.040
    wall_handle_side_inset: float = 0.050  # bar axis from the door's free edge
    wall_handle_end_inset: float = 0.0075  # lower end of the bar above the door's lower edge
    base_handle_standoff: float = 0.042
    base_handle_side_inset: float = 0.060
    base_handle_end_inset: float = 0.0315  # upper end of the bar below the door's upper edge
    drawer_handle_standoff: float = 0.0345
    hitman_handle_drop: float = 0.039  # bar axis below the front panel's upper edge

    def __post_init__(self) -> None:
        for field in fields(self):
            number = getattr(self, field.name)
            if field.name.endswith(("_x", "_y", "_z")):
                finite_number(number, f"KitchenParameters.{field.name}")
            else:
                positive_length(number, f"KitchenParameters.{field.name}")
        for fits, broken in _fitting_rules(self):
            if not fits:
                raise InvalidInputError(f"KitchenParameters do not fit together: {broken}")

    @property
    def cabinet_back_x(self) -> float:
        """Back face of all cabinets."""
        return self.back_wall_x - self.cabinet_wall_gap

    @property
    def left_y(self) -> float:
        """Right end of the cabinets left of the range."""
        return self.range_y + 0.5 * self.range_width + self.range_side_gap

    @property
    def right_y(self) -> float:
        """Right end of the cabinets right of the range."""
        return self.range_y - 0.5 * self.range_width - self.range_side_gap - self.base_width

    @property
    def right_wall_y(self) -> float:
        """Face of the right wall."""
        return self.right_y - self.right_counter_gap

    @property
    def base_width(self) -> float:
        """Width of a base cabinet."""
        return 2.0 * self.cabinet_width

    @property
    def base_face_x(self) -> float:
        """Face of the doors and front panels of the base cabinets."""
        return self.cabinet_back_x - self.base_cabinet_depth - self.base_front_gap - self.door_thickness

    @property
    def base_front_top_z(self) -> float:
        """Upper edge of the uppermost front panels."""
        return self.base_cabinet_bottom_z + self.base_cabinet_height - self.base_front_reveal

    @property
    def hitman_front_height(self) -> float:
        """Height of each of the two front panels that cover the left base cabinet."""
        covered = self.base_front_top_z - self.base_cabinet_bottom_z
        return 0.5 * covered - self.stacked_front_gap

    @property
    def indigo_door_top_z(self) -> float:
        """Upper edge of the doors below the right drawers."""
        return self.base_front_top_z - 2.0 * (self.indigo_front_height + self.stacked_front_gap)


class _Part(NamedTuple):
    """Pieces of furniture that move together, and how; None for fixed ones."""

    objects: list[SceneObject]
    articulation: Articulation | None = None


def kitchen(
    parameters: KitchenParameters | None = None, door_angles: Mapping[str, float] | None = None
) -> Scene:
    """Build the kitchen with the robot's pedestal and the floor.

    The floor is visible but not an obstacle. Articulations: the hinges "dagger_door_left" (the only
    one opened in the tasks: -1.57 to place, -0.45 pi in the multi-sequence task), "dagger_door_right",
    "chewie_door_left", "chewie_door_right", "baker_door", "indigo_door_left", "indigo_door_right" and
    the sliders "{hitman,indigo}_drawer_{top,bottom}".

    Parameters
    ----------
    parameters : KitchenParameters, optional
        Dimensions; the published kitchen if left out.
    door_angles : mapping of str to float, optional
        Values of articulations by name, hinges [rad], drawers [m]; all others are closed (0).

    Raises
    ------
    UnknownChoiceError
        If a name in `door_angles` is not an articulation.
    InvalidInputError
        If a value is outside its articulation's range.
    """
    p = KitchenParameters() if parameters is None else parameters
    parts = [
        _Part([*_room(p), *_range(p), *_hood(p)]),
        _Part(_wall_cabinets("sektion", p.left_y, p.sektion_bottom_z, p)),
        _wall_door("baker_door", "sektion", 2, -1, p),
        _wall_door("chewie_door_right", "sektion", 0, -1, p),
        _wall_door("chewie_door_left", "sektion", 1, +1, p),
        _Part(_wall_cabinets("dagger", p.right_y, p.dagger_bottom_z, p)),
        _wall_door("dagger_door_left", "dagger", 1, +1, p),
        _wall_door("dagger_door_right", "dagger", 0, -1, p),
        _Part(_base_cabinet("hitman", p.left_y, (p.left_y, p.left_y + p.left_countertop_width), p)),
        *_hitman_drawers(p),
        _Part(_base_cabinet("indigo", p.right_y, (p.right_wall_y, p.right_y + p.base_width), p)),
        *_indigo_drawers(p),
        _base_door("indigo_door_right", p.right_y, -1, p),
        _base_door("indigo_door_left", p.right_y + p.cabinet_width, +1, p),
    ]
    scene = Scene(
        name="kitchen",
        objects=tuple(item for part in parts for item in part.objects),
        articulations=tuple(part.articulation for part in parts if part.articulation is not None),
    )
    for name, value in (door_angles or {}).items():
        scene = scene.with_joint(name, value)
    return scene


def _room(p: KitchenParameters) -> list[SceneObject]:
    """Return the pedestal, the floor and the two walls."""
    half, outer_y = 0.5 * p.pedestal_side, p.right_wall_y - p.wall_thickness
    wall_z = (p.wall_bottom_z, p.wall_bottom_z + p.wall_height)
    back_x = (p.back_wall_x, p.back_wall_x + p.wall_thickness)
    floor = (-0.5 * p.floor_side, 0.5 * p.floor_side)
    pedestal_z = (p.pedestal_top_z - p.pedestal_height, p.pedestal_top_z)
    return [
        _box("robot_pedestal", (p.pedestal_x - half, p.pedestal_x + half), (-half, half), pedestal_z),
        _box("floor", floor, floor, (p.floor_z - p.floor_thickness, p.floor_z), obstacle=False),
        _box("walls/back", back_x, (outer_y, outer_y + p.back_wall_width), wall_z),
        _box("walls/right", (back_x[0] - p.right_wall_length, back_x[0]), (outer_y, p.right_wall_y), wall_z),
    ]


def _range(p: KitchenParameters) -> list[SceneObject]:
    """Return the range's block, control panel, four stove plates and four knobs."""
    back_x = p.back_wall_x - p.range_wall_gap
    front_x, top_z, half = back_x - p.range_depth, p.range_top_z, 0.5 * p.range_width
    y = (p.range_y - half, p.range_y + half)
    panel_x, panel_z = (front_x, front_x + p.control_panel_depth), top_z + p.control_panel_thickness
    pieces = [
        _box("range/block", (front_x, back_x), y, (top_z - p.range_height, top_z)),
        _box("range/control_panel", panel_x, y, (top_z, panel_z)),
    ]
    plates = {
        "front": (p.front_plate_front_inset, p.front_plate_side_inset, p.front_plate_radius),
        "back": (p.back_plate_front_inset, p.back_plate_side_inset, p.back_plate_radius),
    }
    knobs = {"outer": p.outer_knob_side_inset, "inner": p.inner_knob_side_inset}
    knob_x, knob_z = 0.5 * sum(panel_x), panel_z + 0.5 * p.knob_height
    for side, sign in (("left", +1), ("right", -1)):
        for row, (from_front, inset, radius) in plates.items():
            centre = (front_x + from_front, p.range_y + sign * (half - inset), top_z + 0.5 * p.plate_height)
            pieces.append(_cylinder(f"range/plate_{row}_{side}", radius, p.plate_height, centre))
        for which, inset in knobs.items():
            centre = (knob_x, p.range_y + sign * (half - inset), knob_z)
            pieces.append(_cylinder(f"range/knob_{which}_{side}", p.knob_radius, p.knob_height, centre))
    return pieces


def _hood(p: KitchenParameters) -> list[SceneObject]:
    """Return the extractor hood above the range."""
    back_x, half = p.back_wall_x + p.hood_into_wall, 0.5 * p.range_width
    x, y = (back_x - p.hood_depth, back_x), (p.range_y - half, p.range_y + half)
    return [_box("extractor_hood", x, y, (p.hood_bottom_z, p.hood_bottom_z + p.hood_height))]


def _wall_cabinets(row: str, right_y: float, bottom_z: float, p: KitchenParameters) -> list[SceneObject]:
    """Return the boards of a row of wall cabinets: bottom, top and two sides for each cell."""
    board, width = p.board_thickness, p.cabinet_width
    x = (p.cabinet_back_x - p.wall_cabinet_depth, p.cabinet_back_x)
    z = (bottom_z, bottom_z + p.wall_cabinet_height)
    pieces = []
    for cell in range(WALL_CELLS[row]):
        y = (right_y + cell * width, right_y + (cell + 1) * width)
        inner = (y[0] + board, y[1] - board)
        name = f"{row}/cell{cell}"
        pieces += [
            _box(f"{name}_bottom", x, inner, (z[0], z[0] + board)),
            _box(f"{name}_top", x, inner, (z[1] - board, z[1])),
            _box(f"{name}_side_right", x, (y[0], inner[0]), z),
            _box(f"{name}_side_left", x, (inner[1], y[1]), z),
        ]
    return pieces


def _wall_door(name: str, row: str, cell: int, hinge_side: int, p: KitchenParameters) -> _Part:
    """Return the door of one wall cabinet cell, hinged at its left (+1) or right (-1) front edge."""
    row_y, bottom_z = {
        "dagger": (p.right_y, p.dagger_bottom_z),
        "sektion": (p.left_y, p.sektion_bottom_z),
    }[row]
    cell_y, back_x = row_y + cell * p.cabinet_width, p.cabinet_back_x - p.wall_cabinet_depth
    y = _inset((cell_y, cell_y + p.cabinet_width), 0.5 * p.door_gap)
    z = _inset((bottom_z, bottom_z + p.wall_cabinet_height), 0.5 * p.door_gap)
    face_x = back_x - p.door_thickness
    bar = (face_x - p.wall_handle_standoff, _bar_y(y, hinge_side, p.wall_handle_side_inset))
    objects = [
        _box(f"{name}/panel", (face_x, back_x), y, z),
        *_handle(name, (*bar, z[0] + p.wall_handle_end_inset + 0.5 * p.handle_length), "z", p),
    ]
    hinge_y = cell_y + (p.cabinet_width if hinge_side > 0 else 0.0)
    return _hinged(name, objects, (back_x, hinge_y), hinge_side, p)


def _base_door(name: str, cell_y: float, hinge_side: int, p: KitchenParameters) -> _Part:
    """Return a door of the right base cabinet, below its drawers, hinged at its left (+1) or right (-1)."""
    y = _inset((cell_y, cell_y + p.cabinet_width), 0.5 * p.door_gap)
    z = (p.base_cabinet_bottom_z - p.base_door_overhang, p.indigo_door_top_z)
    x = (p.base_face_x, p.base_face_x + p.door_thickness)
    bar = (x[0] - p.base_handle_standoff, _bar_y(y, hinge_side, p.base_handle_side_inset))
    objects = [
        _box(f"{name}/panel", x, y, z),
        *_handle(name, (*bar, z[1] - p.base_handle_end_inset - 0.5 * p.handle_length), "z", p),
    ]
    hinge_y = cell_y + (p.cabinet_width - p.base_hinge_inset if hinge_side > 0 else p.base_hinge_inset)
    return _hinged(name, objects, (0.5 * sum(x), hinge_y), hinge_side, p)


def _base_cabinet(name: str, right_y: float, counter_y: Span, p: KitchenParameters) -> list[SceneObject]:
    """Return a base cabinet (bottom, back, two sides) and the countertop above it."""
    back_x, board = p.cabinet_back_x, p.board_thickness
    x, y = (back_x - p.base_cabinet_depth, back_x), (right_y, right_y + p.base_width)
    z = (p.base_cabinet_bottom_z, p.base_cabinet_bottom_z + p.base_cabinet_height)
    counter_x = (back_x - p.countertop_depth, back_x)
    return [
        _box(f"{name}/bottom", x, y, (z[0], z[0] + board)),
        _box(f"{name}/back", (back_x - p.base_back_thickness, back_x), y, z),
        _box(f"{name}/side_right", x, (y[0], y[0] + board), z),
        _box(f"{name}/side_left", x, (y[1] - board, y[1]), z),
        _box(f"{name}/countertop", counter_x, counter_y, (z[1], z[1] + p.countertop_thickness)),
    ]


def _hitman_drawers(p: KitchenParameters) -> list[_Part]:
    """Return the two drawers, with trays, that fill the left base cabinet."""
    parts, top_z = [], p.base_front_top_z
    for place in ("top", "bottom"):
        z = (top_z - p.hitman_front_height, top_z)
        drawer_z, handle_z = z[0] + p.hitman_drawer_lift, z[1] - p.hitman_handle_drop
        parts.append(_drawer(f"hitman_drawer_{place}", p.left_y, z, drawer_z, handle_z, True, p))
        top_z = z[0] - p.stacked_front_gap
    return parts


def _indigo_drawers(p: KitchenParameters) -> list[_Part]:
    """Return the two low drawers, without trays, above the doors of the right base cabinet."""
    parts, top_z = [], p.base_front_top_z
    for place in ("top", "bottom"):
        z = (top_z - p.indigo_front_height, top_z)
        middle_z = 0.5 * sum(z)
        drawer_z = middle_z - 0.5 * p.drawer_height
        parts.append(_drawer(f"indigo_drawer_{place}", p.right_y, z, drawer_z, middle_z, False, p))
        top_z = z[0] - p.stacked_front_gap
    return parts


def _drawer(
    name: str,
    cabinet_y: float,
    front_z: Span,
    drawer_z: float,
    handle_z: float,
    tray: bool,
    p: KitchenParameters,
) -> _Part:
    """Return a drawer: front panel, handle, two sides, back, bottom and perhaps a tray.

    `cabinet_y` is the right side of its cabinet, `drawer_z` the lower edge of the drawer's box.
    """
    front_y = _inset((cabinet_y, cabinet_y + p.base_width), 0.5 * p.door_gap)
    y = _inset((cabinet_y, cabinet_y + p.base_width), p.board_thickness + p.drawer_side_gap)
    front_x = (p.base_face_x, p.base_face_x + p.door_thickness)
    x, z = (front_x[1], front_x[1] + p.drawer_length), (drawer_z, drawer_z + p.drawer_height)
    board = p.drawer_board_thickness
    handle_centre = (front_x[0] - p.drawer_handle_standoff, 0.5 * sum(y), handle_z)
    objects = [
        _box(f"{name}/front_panel", front_x, front_y, front_z),
        *_handle(name, handle_centre, "y", p),
        _box(f"{name}/side_right", x, (y[0], y[0] + board), z),
        _box(f"{name}/side_left", x, (y[1] - board, y[1]), z),
        _box(f"{name}/back", (x[1] - board, x[1]), y, z),
        _box(f"{name}/bottom", x, y, (z[0], z[0] + p.drawer_bottom_thickness)),
    ]
    if tray:
        tray_z = z[0] + p.tray_lift
        objects.append(_box(f"{name}/tray", x, y, (tray_z, tray_z + p.tray_thickness)))
    T_world_joint = _oriented("-x", (front_x[0], 0.5 * sum(y), 0.5 * sum(front_z)))
    return _articulated(name, "slider", T_world_joint, (0.0, p.drawer_travel), objects)


def _handle(
    name: str, centre: tuple[float, float, float], axis: str, p: KitchenParameters
) -> list[SceneObject]:
    """Return a bar along `axis` ("y" or "z") at `centre`, and the two posts from it towards +x."""
    bar = _cylinder(f"{name}/handle_bar", 0.5 * p.handle_diameter, p.handle_length, centre, axis)
    along = bar.T_world_object[:3, 2]
    ends = ("right", "left") if axis == "y" else ("lower", "upper")
    posts = [
        _cylinder(
            f"{name}/handle_post_{end}",
            0.5 * p.post_diameter,
            p.post_length,
            centre + sign * 0.5 * p.post_spacing * along + (0.5 * p.post_length, 0.0, 0.0),
            "x",
        )
        for end, sign in zip(ends, (-1, +1), strict=True)
    ]
    return [bar, *posts]


def _hinged(
    name: str, objects: list[SceneObject], hinge_xy: Span, hinge_side: int, p: KitchenParameters
) -> _Part:
    """Return a door with a vertical hinge: a left (+1) one opens to -door_range, a right (-1) one to +."""
    limits = (-p.door_range, 0.0) if hinge_side > 0 else (0.0, p.door_range)
    return _articulated(name, "hinge", pose((*hinge_xy, 0.0)), limits, objects)


def _articulated(
    name: str, kind: str, T_world_joint: FloatArray, limits: Span, objects: list[SceneObject]
) -> _Part:
    """Return the objects with a closed (value 0) articulation that moves all of them."""
    moves = tuple(item.name for item in objects)
    return _Part(objects, Articulation(name, kind, T_world_joint, *limits, value=0.0, moves=moves))


def _box(name: str, x: Span, y: Span, z: Span, obstacle: bool = True) -> SceneObject:
    """Return an upright box that fills the three world intervals."""
    centre = (0.5 * sum(x), 0.5 * sum(y), 0.5 * sum(z))
    return SceneObject(name, Box((x[1] - x[0], y[1] - y[0], z[1] - z[0])), pose(centre), obstacle)


def _cylinder(
    name: str, radius: float, height: float, centre: Iterable[float], axis: str = "z"
) -> SceneObject:
    """Return a cylinder whose axis is a world axis."""
    return SceneObject(name, Cylinder(radius, height), _oriented(axis, centre))


def _oriented(axis: str, xyz: Iterable[float]) -> FloatArray:
    """Return the (4, 4) pose at `xyz` whose own z points along a world axis: "x", "y", "z" or "-x"."""
    T = pose(xyz)
    columns = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2), "-x": (2, 1, 0)}[axis]
    T[:3, :3] = np.eye(3)[:, columns]
    if axis == "-x":
        T[:3, 2] *= -1.0
    return T


def _inset(span: Span, margin: float) -> Span:
    """Return the interval made smaller by `margin` at both ends."""
    return span[0] + margin, span[1] - margin


def _bar_y(panel_y: Span, hinge_side: int, inset: float) -> float:
    """Return the y of a vertical handle bar, `inset` from the panel's edge opposite its hinge."""
    return panel_y[0] + inset if hinge_side > 0 else panel_y[1] - inset


def _fitting_rules(p: KitchenParameters) -> list[tuple[bool, str]]:
    """Return (kept, what is broken if not) for every rule that a consistent kitchen keeps."""
    boards, handle, half_range = 2.0 * p.board_thickness, p.handle_length, 0.5 * p.range_width
    counter_z = p.base_cabinet_bottom_z + p.base_cabinet_height + p.countertop_thickness
    wall_door_height = p.wall_cabinet_height - p.door_gap
    base_door_height = p.indigo_door_top_z - (p.base_cabinet_bottom_z - p.base_door_overhang)
    drawer_width = p.base_width - boards - 2.0 * p.drawer_side_gap
    left_end = p.left_y + max(p.left_countertop_width, WALL_CELLS["sektion"] * p.cabinet_width)
    wall_end = p.right_wall_y - p.wall_thickness + p.back_wall_width
    insets = (p.front_plate_side_inset, p.back_plate_side_inset)
    radii = (p.front_plate_radius, p.back_plate_radius)
    return [
        (p.cabinet_width > boards, "cabinet_width leaves no room between two boards"),
        (p.cabinet_width > p.door_gap, "door_gap is wider than cabinet_width"),
        (p.wall_cabinet_height > boards, "wall_cabinet_height leaves no room between two boards"),
        (p.wall_handle_side_inset < p.cabinet_width - p.door_gap, "wall_handle_side_inset is off the door"),
        (p.base_handle_side_inset < p.cabinet_width - p.door_gap, "base_handle_side_inset is off the door"),
        (p.post_spacing < handle, "post_spacing is not below handle_length"),
        (p.wall_handle_end_inset + handle <= wall_door_height, "wall_cabinet_height is below the handle"),
        (
            p.base_handle_end_inset + handle <= base_door_height,
            "indigo's doors are too low for their handles",
        ),
        (min(p.dagger_bottom_z, p.sektion_bottom_z) > counter_z, "wall cabinets reach into the countertop"),
        (p.hood_bottom_z > p.range_top_z, "the hood reaches into the range"),
        (handle <= drawer_width, "drawers are narrower than their handles"),
        (drawer_width > 2.0 * p.drawer_board_thickness, "drawers have no room between their sides"),
        (p.drawer_height <= p.indigo_front_height, "indigo_front_height is below drawer_height"),
        (
            p.hitman_drawer_lift + p.drawer_height <= p.hitman_front_height,
            "hitman's drawers are higher than their front panels",
        ),
        (
            p.drawer_length <= p.base_cabinet_depth - p.base_back_thickness + p.base_front_gap,
            "drawer_length reaches through the back of the base cabinet",
        ),
        (p.drawer_travel <= p.drawer_length, "drawer_travel pulls the drawers out of the cabinet"),
        (p.countertop_depth >= p.base_cabinet_depth, "countertop_depth is below base_cabinet_depth"),
        (p.left_countertop_width >= p.base_width, "left_countertop_width is below two cabinet widths"),
        (left_end <= wall_end, "the left cabinets or countertop reach beyond back_wall_width"),
        (all(r <= i <= half_range - r for r, i in zip(radii, insets, strict=True)), "stove plates overlap"),
        (p.pedestal_top_z - p.pedestal_height <= p.floor_z, "the pedestal floats above the floor"),
        (p.door_range <= math.pi, "door_range turns the doors by more than half a turn"),
    ]
