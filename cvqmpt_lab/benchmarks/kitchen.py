"""The kitchen of the place and multi-sequence tasks, built from its dimensions.

World frame: robot base link, +x towards the back wall of the kitchen, +y to the left, z up; metres
and radians. With the dimensions of `kitchen.toml` every piece agrees with the kitchen of the
published experiment code within 5 mm. Names of rows and doors ("dagger", "sektion", "hitman",
"indigo") are those of that kitchen: dagger and indigo are right of the range, above and below the
counter; sektion and hitman are left of it. Cabinets are hollow and have no back panel: the back
wall closes them.
"""

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.base.values import FloatArray, Length
from cvqmpt_lab.scene.scene import Articulation, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder

KITCHEN_DIMENSIONS: Mapping[str, float] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text()
)
"""Dimensions of the published kitchen [m] and range of its doors [rad], by name."""
Span = tuple[float, float]
Piece = SceneObject | Articulation


def kitchen(
    changes: Mapping[str, float] | None = None, door_angles: Mapping[str, float] | None = None
) -> Scene:
    """Build the kitchen with the robot's pedestal and the floor, which is not an obstacle.

    Hinges: "dagger_door_left" (the only one that the tasks open: -1.57 to place, -0.45 pi in the
    multi-sequence task), "{dagger,chewie}_door_right", "chewie_door_left", "baker_door",
    "indigo_door_{left,right}". Sliders: "{hitman,indigo}_drawer_{top,bottom}".

    Args:
        changes: dimensions in place of those of `kitchen.toml`, by name.
        door_angles: values of articulations by name, hinges [rad], drawers [m]; default 0: closed.
    """
    p = _dimensions(changes or {})
    pieces: list[Piece] = [
        *_walls(p),
        *_range(p),
        *_wall_cabinets("sektion", p),
        *_wall_door("baker_door", "sektion", 2, -1, p),
        *_wall_door("chewie_door_right", "sektion", 0, -1, p),
        *_wall_door("chewie_door_left", "sektion", 1, +1, p),
        *_wall_cabinets("dagger", p),
        *_wall_door("dagger_door_left", "dagger", 1, +1, p),
        *_wall_door("dagger_door_right", "dagger", 0, -1, p),
        *_base_cabinet("hitman", p.left_y, (p.left_y, p.left_y + p.left_countertop_width), p),
        *_drawers("hitman", p),
        *_base_cabinet("indigo", p.right_y, (p.right_wall_y, p.right_y + p.base_width), p),
        *_drawers("indigo", p),
        *_base_door("indigo_door_right", p.right_y, -1, p),
        *_base_door("indigo_door_left", p.right_y + p.cabinet_width, +1, p),
    ]
    scene = Scene(
        name="kitchen",
        objects=tuple(piece for piece in pieces if isinstance(piece, SceneObject)),
        articulations=tuple(piece for piece in pieces if isinstance(piece, Articulation)),
    )
    for name, value in (door_angles or {}).items():
        scene = scene.with_joint(name, value)
    return scene


def _dimensions(changes: Mapping[str, float]) -> SimpleNamespace:
    """Return given and derived dimensions; InvalidInputError if they do not fit together."""
    p = SimpleNamespace(**KITCHEN_DIMENSIONS)
    for name, value in changes.items():
        require_choice("dimension of the kitchen", name, KITCHEN_DIMENSIONS)
        kind = float if name.endswith(("_x", "_y", "_z")) else Length
        setattr(p, name, from_plain(kind, value, f"kitchen dimension {name}"))
    p.base_width = 2.0 * p.cabinet_width
    p.cabinet_back_x = p.back_wall_x - p.cabinet_wall_gap
    # right ends of the cabinets left and right of the range
    p.left_y = p.range_y + 0.5 * p.range_width + p.range_side_gap
    p.right_y = p.range_y - 0.5 * p.range_width - p.range_side_gap - p.base_width
    p.right_wall_y = p.right_y - p.right_counter_gap
    # face of the doors and front panels of the base cabinets, and their upper edge
    p.base_face_x = p.cabinet_back_x - p.base_cabinet_depth - p.base_front_gap - p.door_thickness
    p.base_front_top_z = p.base_cabinet_bottom_z + p.base_cabinet_height - p.base_front_reveal
    # height of each of the two front panels of the left base cabinet
    covered = p.base_front_top_z - p.base_cabinet_bottom_z
    p.hitman_front_height = 0.5 * covered - p.stacked_front_gap
    p.indigo_door_top_z = p.base_front_top_z - 2.0 * (p.indigo_front_height + p.stacked_front_gap)
    # rows of wall cabinets: number of cells, y of the right end, z of the bottom
    p.wall_rows = {
        "dagger": (2, p.right_y, p.dagger_bottom_z),
        "sektion": (3, p.left_y, p.sektion_bottom_z),
    }
    for fits, broken in _fitting_rules(p):
        if not fits:
            raise InvalidInputError(f"dimensions of the kitchen do not fit together: {broken}")
    return p


def _fitting_rules(p: SimpleNamespace) -> list[tuple[bool, str]]:
    """Return (whether the dimensions meet it, message if not) for every rule of a kitchen."""
    boards = 2.0 * p.board_thickness
    handle = p.handle_length
    half_range = 0.5 * p.range_width
    counter_z = p.base_cabinet_bottom_z + p.base_cabinet_height + p.countertop_thickness
    wall_door_height = p.wall_cabinet_height - p.door_gap
    base_door_height = p.indigo_door_top_z - (p.base_cabinet_bottom_z - p.base_door_overhang)
    drawer_width = p.base_width - boards - 2.0 * p.drawer_side_gap
    drawer_space = p.base_cabinet_depth - p.base_back_thickness + p.base_front_gap
    drawer_top = p.hitman_drawer_lift + p.drawer_height
    left_end = p.left_y + max(p.left_countertop_width, p.wall_rows["sektion"][0] * p.cabinet_width)
    wall_end = p.right_wall_y - p.wall_thickness + p.back_wall_width
    insets = (p.front_plate_side_inset, p.back_plate_side_inset)
    radii = (p.front_plate_radius, p.back_plate_radius)
    return [
        (p.cabinet_width > boards, "cabinet_width leaves no space between two boards"),
        (p.cabinet_width > p.door_gap, "door_gap is wider than cabinet_width"),
        (p.wall_cabinet_height > boards, "wall_cabinet_height leaves no space between two boards"),
        (
            p.wall_handle_side_inset < p.cabinet_width - p.door_gap,
            "wall_handle_side_inset is outside the door",
        ),
        (
            p.base_handle_side_inset < p.cabinet_width - p.door_gap,
            "base_handle_side_inset is outside the door",
        ),
        (p.post_spacing < handle, "post_spacing is not below handle_length"),
        (
            p.wall_handle_end_inset + handle <= wall_door_height,
            "wall_cabinet_height is below the handle",
        ),
        (
            p.base_handle_end_inset + handle <= base_door_height,
            "indigo's doors are too low for handles",
        ),
        (
            min(p.dagger_bottom_z, p.sektion_bottom_z) > counter_z,
            "wall cabinets reach into the countertop",
        ),
        (p.hood_bottom_z > p.range_top_z, "the hood reaches into the range"),
        (handle <= drawer_width, "drawers are narrower than their handles"),
        (
            drawer_width > 2.0 * p.drawer_board_thickness,
            "drawers are thinner than their sides",
        ),
        (p.drawer_height <= p.indigo_front_height, "indigo_front_height is below drawer_height"),
        (
            drawer_top <= p.hitman_front_height,
            "hitman's drawers are higher than their front panels",
        ),
        (
            p.drawer_length <= drawer_space,
            "drawer_length reaches through the back of the base cabinet",
        ),
        (p.drawer_travel <= p.drawer_length, "drawer_travel pulls the drawers out of the cabinet"),
        (
            p.countertop_depth >= p.base_cabinet_depth,
            "countertop_depth is below base_cabinet_depth",
        ),
        (
            p.left_countertop_width >= p.base_width,
            "left_countertop_width is below two cabinet widths",
        ),
        (left_end <= wall_end, "the left cabinets or countertop reach beyond back_wall_width"),
        (
            all(r <= i <= half_range - r for r, i in zip(radii, insets, strict=True)),
            "stove plates overlap",
        ),
        (
            p.pedestal_top_z - p.pedestal_height <= p.floor_z,
            "the pedestal ends above the floor",
        ),
        (p.door_range <= math.pi, "door_range turns the doors by more than half a turn"),
    ]


def _walls(p: SimpleNamespace) -> list[SceneObject]:
    """Return the pedestal, the floor and the two walls."""
    half, outer_y = 0.5 * p.pedestal_side, p.right_wall_y - p.wall_thickness
    wall_z = (p.wall_bottom_z, p.wall_bottom_z + p.wall_height)
    back_x = (p.back_wall_x, p.back_wall_x + p.wall_thickness)
    floor = (-0.5 * p.floor_side, 0.5 * p.floor_side)
    pedestal_z = (p.pedestal_top_z - p.pedestal_height, p.pedestal_top_z)
    return [
        box(
            "robot_pedestal", (p.pedestal_x - half, p.pedestal_x + half), (-half, half), pedestal_z
        ),
        box("floor", floor, floor, (p.floor_z - p.floor_thickness, p.floor_z), obstacle=False),
        box("walls/back", back_x, (outer_y, outer_y + p.back_wall_width), wall_z),
        box(
            "walls/right",
            (back_x[0] - p.right_wall_length, back_x[0]),
            (outer_y, p.right_wall_y),
            wall_z,
        ),
    ]


def _range(p: SimpleNamespace) -> list[SceneObject]:
    """Return the range (block, control panel, four plates, four knobs) and the extractor hood."""
    back_x = p.back_wall_x - p.range_wall_gap
    front_x, top_z = back_x - p.range_depth, p.range_top_z
    half = 0.5 * p.range_width
    y = (p.range_y - half, p.range_y + half)
    panel_x, panel_z = (front_x, front_x + p.control_panel_depth), top_z + p.control_panel_thickness
    pieces = [
        box("range/block", (front_x, back_x), y, (top_z - p.range_height, top_z)),
        box("range/control_panel", panel_x, y, (top_z, panel_z)),
    ]
    plates = {
        "front": (p.front_plate_front_inset, p.front_plate_side_inset, p.front_plate_radius),
        "back": (p.back_plate_front_inset, p.back_plate_side_inset, p.back_plate_radius),
    }
    knobs = {"outer": p.outer_knob_side_inset, "inner": p.inner_knob_side_inset}
    knob_x, knob_z = 0.5 * sum(panel_x), panel_z + 0.5 * p.knob_height
    for side, sign in (("left", +1), ("right", -1)):
        for row, (from_front, inset, radius) in plates.items():
            centre = (
                front_x + from_front,
                p.range_y + sign * (half - inset),
                top_z + 0.5 * p.plate_height,
            )
            pieces.append(cylinder(f"range/plate_{row}_{side}", radius, p.plate_height, centre))
        for which, inset in knobs.items():
            centre = (knob_x, p.range_y + sign * (half - inset), knob_z)
            pieces.append(
                cylinder(f"range/knob_{which}_{side}", p.knob_radius, p.knob_height, centre)
            )
    hood_x = p.back_wall_x + p.hood_into_wall
    hood_z = (p.hood_bottom_z, p.hood_bottom_z + p.hood_height)
    return [*pieces, box("extractor_hood", (hood_x - p.hood_depth, hood_x), y, hood_z)]


def _wall_cabinets(row: str, p: SimpleNamespace) -> Iterator[SceneObject]:
    """Yield the boards of a row of wall cabinets: bottom, top and two sides of each cell."""
    cells, right_y, bottom_z = p.wall_rows[row]
    board, width = p.board_thickness, p.cabinet_width
    x = (p.cabinet_back_x - p.wall_cabinet_depth, p.cabinet_back_x)
    z = (bottom_z, bottom_z + p.wall_cabinet_height)
    for cell in range(cells):
        y = (right_y + cell * width, right_y + (cell + 1) * width)
        inner = (y[0] + board, y[1] - board)
        name = f"{row}/cell{cell}"
        yield box(f"{name}_bottom", x, inner, (z[0], z[0] + board))
        yield box(f"{name}_top", x, inner, (z[1] - board, z[1]))
        yield box(f"{name}_side_right", x, (y[0], inner[0]), z)
        yield box(f"{name}_side_left", x, (inner[1], y[1]), z)


def _wall_door(name: str, row: str, cell: int, hinge_side: int, p: SimpleNamespace) -> list[Piece]:
    """Return the door of a wall cabinet cell, hinged at its left (+1) or right (-1) front edge."""
    _, row_y, bottom_z = p.wall_rows[row]
    cell_y, back_x = row_y + cell * p.cabinet_width, p.cabinet_back_x - p.wall_cabinet_depth
    z = shrunk((bottom_z, bottom_z + p.wall_cabinet_height), 0.5 * p.door_gap)
    x = (back_x - p.door_thickness, back_x)
    hinge = (back_x, cell_y + (p.cabinet_width if hinge_side > 0 else 0.0))
    bar_z = z[0] + p.wall_handle_end_inset + 0.5 * p.handle_length
    bar = (p.wall_handle_standoff, p.wall_handle_side_inset, bar_z)
    return _door(name, hinge_side, cell_y, x, z, hinge, bar, p)


def _base_door(name: str, cell_y: float, hinge_side: int, p: SimpleNamespace) -> list[Piece]:
    """Return a door below the right base cabinet's drawers, hinged left (+1) or right (-1)."""
    z = (p.base_cabinet_bottom_z - p.base_door_overhang, p.indigo_door_top_z)
    x = (p.base_face_x, p.base_face_x + p.door_thickness)
    inset = p.base_hinge_inset
    hinge = (0.5 * sum(x), cell_y + (p.cabinet_width - inset if hinge_side > 0 else inset))
    bar_z = z[1] - p.base_handle_end_inset - 0.5 * p.handle_length
    bar = (p.base_handle_standoff, p.base_handle_side_inset, bar_z)
    return _door(name, hinge_side, cell_y, x, z, hinge, bar, p)


def _door(
    name: str,
    hinge_side: int,
    cell_y: float,
    x: Span,
    z: Span,
    hinge: Span,
    bar: tuple[float, float, float],
    p: SimpleNamespace,
) -> list[Piece]:
    """Return a door with a vertical hinge and its articulation.

    Args:
        name: name of the articulation.
        hinge_side: +1: left, opens to -door_range; -1: right, opens to +door_range.
        cell_y: y of the right end of the cell that the door closes [m].
        x: interval of the panel [m].
        z: interval of the panel [m].
        hinge: x and y of the axis [m].
        bar: distance of the handle bar from the face of the panel, from its free edge, and z of the
            middle [m].
        p: dimensions.
    """
    y = shrunk((cell_y, cell_y + p.cabinet_width), 0.5 * p.door_gap)
    standoff, inset, bar_z = bar
    bar_y = y[0] + inset if hinge_side > 0 else y[1] - inset
    objects = [
        box(f"{name}/panel", x, y, z),
        *handle(name, (x[0] - standoff, bar_y, bar_z), "z", p),
    ]
    lower, upper = (-p.door_range, 0.0) if hinge_side > 0 else (0.0, p.door_range)
    moves = tuple(item.name for item in objects)
    T_world_joint = pose((*hinge, 0.0))
    return [*objects, Articulation(name, "hinge", T_world_joint, lower, upper, 0.0, moves)]


def _base_cabinet(
    name: str, right_y: float, counter_y: Span, p: SimpleNamespace
) -> list[SceneObject]:
    """Return a base cabinet (bottom, back, two sides) and the countertop above it."""
    back_x, board = p.cabinet_back_x, p.board_thickness
    x, y = (back_x - p.base_cabinet_depth, back_x), (right_y, right_y + p.base_width)
    z = (p.base_cabinet_bottom_z, p.base_cabinet_bottom_z + p.base_cabinet_height)
    counter_x = (back_x - p.countertop_depth, back_x)
    return [
        box(f"{name}/bottom", x, y, (z[0], z[0] + board)),
        box(f"{name}/back", (back_x - p.base_back_thickness, back_x), y, z),
        box(f"{name}/side_right", x, (y[0], y[0] + board), z),
        box(f"{name}/side_left", x, (y[1] - board, y[1]), z),
        box(f"{name}/countertop", counter_x, counter_y, (z[1], z[1] + p.countertop_thickness)),
    ]


def _drawers(cabinet: str, p: SimpleNamespace) -> Iterator[Piece]:
    """Yield the two drawers of a cabinet; those of hitman fill it, those of indigo are low."""
    top_z, height = p.base_front_top_z, p.indigo_front_height
    if cabinet == "hitman":
        height = p.hitman_front_height
    for place in ("top", "bottom"):
        yield from _drawer(cabinet, f"{cabinet}_drawer_{place}", (top_z - height, top_z), p)
        top_z = top_z - height - p.stacked_front_gap


def _drawer(cabinet: str, name: str, front_z: Span, p: SimpleNamespace) -> list[Piece]:
    """Return a drawer: front panel, handle, two sides, back, bottom; in hitman also a tray."""
    middle_z = 0.5 * sum(front_z)
    tray = cabinet == "hitman"
    cabinet_y = p.left_y if tray else p.right_y
    drawer_z = front_z[0] + p.hitman_drawer_lift if tray else middle_z - 0.5 * p.drawer_height
    handle_z = front_z[1] - p.hitman_handle_drop if tray else middle_z
    front_y = shrunk((cabinet_y, cabinet_y + p.base_width), 0.5 * p.door_gap)
    y = shrunk((cabinet_y, cabinet_y + p.base_width), p.board_thickness + p.drawer_side_gap)
    front_x = (p.base_face_x, p.base_face_x + p.door_thickness)
    x, z = (front_x[1], front_x[1] + p.drawer_length), (drawer_z, drawer_z + p.drawer_height)
    board = p.drawer_board_thickness
    handle_centre = (front_x[0] - p.drawer_handle_standoff, 0.5 * sum(y), handle_z)
    objects = [
        box(f"{name}/front_panel", front_x, front_y, front_z),
        *handle(name, handle_centre, "y", p),
        box(f"{name}/side_right", x, (y[0], y[0] + board), z),
        box(f"{name}/side_left", x, (y[1] - board, y[1]), z),
        box(f"{name}/back", (x[1] - board, x[1]), y, z),
        box(f"{name}/bottom", x, y, (z[0], z[0] + p.drawer_bottom_thickness)),
    ]
    if tray:
        tray_z = z[0] + p.tray_lift
        objects.append(box(f"{name}/tray", x, y, (tray_z, tray_z + p.tray_thickness)))
    moves = tuple(item.name for item in objects)
    T_world_joint = oriented("-x", (front_x[0], 0.5 * sum(y), middle_z))
    return [*objects, Articulation(name, "slider", T_world_joint, 0.0, p.drawer_travel, 0.0, moves)]


def handle(
    name: str, centre: tuple[float, float, float], axis: str, p: SimpleNamespace
) -> list[SceneObject]:
    """Return the bar of a handle and its two posts, which point from the bar to +x.

    Args:
        name: name of the door or drawer.
        centre: centre of the bar (3,) [m].
        axis: direction of the bar, "y" or "z".
        p: dimensions.
    """
    bar = cylinder(f"{name}/handle_bar", 0.5 * p.handle_diameter, p.handle_length, centre, axis)
    along = bar.T_world_object[:3, 2]
    ends = ("right", "left") if axis == "y" else ("lower", "upper")
    pieces = [bar]
    for end, sign in zip(ends, (-1, +1), strict=True):
        middle = centre + sign * 0.5 * p.post_spacing * along + (0.5 * p.post_length, 0.0, 0.0)
        post = f"{name}/handle_post_{end}"
        pieces.append(cylinder(post, 0.5 * p.post_diameter, p.post_length, middle, "x"))
    return pieces


def box(name: str, x: Span, y: Span, z: Span, obstacle: bool = True) -> SceneObject:
    """Return a box with edges along the world axes.

    Args:
        name: name of the object.
        x: interval [m].
        y: interval [m].
        z: interval [m].
        obstacle: False: visible, but not an obstacle.
    """
    centre = (0.5 * sum(x), 0.5 * sum(y), 0.5 * sum(z))
    return SceneObject(name, Box((x[1] - x[0], y[1] - y[0], z[1] - z[0])), pose(centre), obstacle)


def cylinder(
    name: str, radius: float, height: float, centre: Iterable[float], axis: str = "z"
) -> SceneObject:
    """Return a cylinder along a world axis.

    Args:
        name: name of the object.
        radius: [m].
        height: [m].
        centre: (3,) [m].
        axis: "x", "y" or "z".
    """
    return SceneObject(name, Cylinder(radius, height), oriented(axis, centre))


def oriented(axis: str, xyz: Iterable[float]) -> FloatArray:
    """Return the (4, 4) pose at `xyz` [m] whose z is a world axis: "x", "y", "z" or "-x"."""
    columns = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2), "-x": (2, 1, 0)}[axis]
    sign = -1.0 if axis == "-x" else 1.0
    return rigid(np.eye(3)[:, columns] * (1.0, 1.0, sign), xyz)


def shrunk(span: Span, margin: float) -> Span:
    """Return the interval without `margin` [m] at both ends."""
    return span[0] + margin, span[1] - margin
