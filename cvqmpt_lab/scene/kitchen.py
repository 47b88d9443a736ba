"""The kitchen of the place and multi-sequence tasks, built from parameters.

World frame: robot base link, +x towards the kitchen's back wall, +y to the left as the robot looks
at it, z up; metres and radians. The default parameters reproduce the kitchen of the published
experiment code piece by piece within 5 mm. Row and door names ("dagger", "sektion", "hitman",
"indigo") are the ones of that kitchen: dagger and indigo are right of the range, above and below
the counter; sektion and hitman are left of it. Cabinets are hollow and have no back panel: the back
wall closes them.
"""

from collections.abc import Iterator, Mapping

from cvqmpt_lab.scene.kitchen_parameters import WALL_CELLS, KitchenParameters
from cvqmpt_lab.scene.objects import (
    Assembly,
    Span,
    articulated,
    bar_y,
    box,
    cylinder,
    handle,
    hinged,
    oriented,
    shrunk,
)
from cvqmpt_lab.scene.scene import Scene, SceneObject


def kitchen(
    parameters: KitchenParameters | None = None, door_angles: Mapping[str, float] | None = None
) -> Scene:
    """Build the kitchen with the robot's pedestal and the floor, which is visible but no obstacle.

    Hinges: "dagger_door_left" (the only one opened in the tasks: -1.57 to place, -0.45 pi in the
    multi-sequence task), "{dagger,chewie}_door_right", "chewie_door_left", "baker_door",
    "indigo_door_{left,right}". Sliders: "{hitman,indigo}_drawer_{top,bottom}".

    parameters: dimensions; None: the published kitchen.
    door_angles: values of articulations by name, hinges [rad], drawers [m]; default 0, closed.
    """
    p = KitchenParameters() if parameters is None else parameters
    parts = [
        Assembly([*_room(p), *_range(p)]),
        Assembly(_wall_cabinets("sektion", p)),
        _wall_door("baker_door", "sektion", 2, -1, p),
        _wall_door("chewie_door_right", "sektion", 0, -1, p),
        _wall_door("chewie_door_left", "sektion", 1, +1, p),
        Assembly(_wall_cabinets("dagger", p)),
        _wall_door("dagger_door_left", "dagger", 1, +1, p),
        _wall_door("dagger_door_right", "dagger", 0, -1, p),
        Assembly(
            _base_cabinet("hitman", p.left_y, (p.left_y, p.left_y + p.left_countertop_width), p)
        ),
        *_drawers("hitman", p),
        Assembly(_base_cabinet("indigo", p.right_y, (p.right_wall_y, p.right_y + p.base_width), p)),
        *_drawers("indigo", p),
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


def _range(p: KitchenParameters) -> list[SceneObject]:
    """Return the range (block, control panel, four plates, four knobs) and the extractor hood."""
    back_x = p.back_wall_x - p.range_wall_gap
    front_x, top_z, half = back_x - p.range_depth, p.range_top_z, 0.5 * p.range_width
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


def _row_corner(row: str, p: KitchenParameters) -> Span:
    """Right end (y) and bottom (z) of a row of wall cabinets."""
    return (p.right_y, p.dagger_bottom_z) if row == "dagger" else (p.left_y, p.sektion_bottom_z)


def _wall_cabinets(row: str, p: KitchenParameters) -> list[SceneObject]:
    """Return the boards of a row of wall cabinets: bottom, top and two sides for each cell."""
    right_y, bottom_z = _row_corner(row, p)
    board, width = p.board_thickness, p.cabinet_width
    x = (p.cabinet_back_x - p.wall_cabinet_depth, p.cabinet_back_x)
    z = (bottom_z, bottom_z + p.wall_cabinet_height)
    pieces = []
    for cell in range(WALL_CELLS[row]):
        y = (right_y + cell * width, right_y + (cell + 1) * width)
        inner = (y[0] + board, y[1] - board)
        name = f"{row}/cell{cell}"
        pieces += [
            box(f"{name}_bottom", x, inner, (z[0], z[0] + board)),
            box(f"{name}_top", x, inner, (z[1] - board, z[1])),
            box(f"{name}_side_right", x, (y[0], inner[0]), z),
            box(f"{name}_side_left", x, (inner[1], y[1]), z),
        ]
    return pieces


def _wall_door(name: str, row: str, cell: int, hinge_side: int, p: KitchenParameters) -> Assembly:
    """Return the door of a wall cabinet cell, hinged at its left (+1) or right (-1) front edge."""
    row_y, bottom_z = _row_corner(row, p)
    cell_y, back_x = row_y + cell * p.cabinet_width, p.cabinet_back_x - p.wall_cabinet_depth
    y = shrunk((cell_y, cell_y + p.cabinet_width), 0.5 * p.door_gap)
    z = shrunk((bottom_z, bottom_z + p.wall_cabinet_height), 0.5 * p.door_gap)
    face_x = back_x - p.door_thickness
    bar = (face_x - p.wall_handle_standoff, bar_y(y, hinge_side, p.wall_handle_side_inset))
    objects = [
        box(f"{name}/panel", (face_x, back_x), y, z),
        *handle(name, (*bar, z[0] + p.wall_handle_end_inset + 0.5 * p.handle_length), "z", p),
    ]
    hinge_y = cell_y + (p.cabinet_width if hinge_side > 0 else 0.0)
    return hinged(name, objects, (back_x, hinge_y), hinge_side, p)


def _base_door(name: str, cell_y: float, hinge_side: int, p: KitchenParameters) -> Assembly:
    """Return a door below the right base cabinet's drawers, hinged left (+1) or right (-1)."""
    y = shrunk((cell_y, cell_y + p.cabinet_width), 0.5 * p.door_gap)
    z = (p.base_cabinet_bottom_z - p.base_door_overhang, p.indigo_door_top_z)
    x = (p.base_face_x, p.base_face_x + p.door_thickness)
    bar = (x[0] - p.base_handle_standoff, bar_y(y, hinge_side, p.base_handle_side_inset))
    objects = [
        box(f"{name}/panel", x, y, z),
        *handle(name, (*bar, z[1] - p.base_handle_end_inset - 0.5 * p.handle_length), "z", p),
    ]
    hinge_y = cell_y + (
        p.cabinet_width - p.base_hinge_inset if hinge_side > 0 else p.base_hinge_inset
    )
    return hinged(name, objects, (0.5 * sum(x), hinge_y), hinge_side, p)


def _base_cabinet(
    name: str, right_y: float, counter_y: Span, p: KitchenParameters
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


def _drawers(cabinet: str, p: KitchenParameters) -> Iterator[Assembly]:
    """Yield a cabinet's two drawers; hitman's fill it and have trays, indigo's are low."""
    top_z, height = p.base_front_top_z, p.indigo_front_height
    if cabinet == "hitman":
        height = p.hitman_front_height
    for place in ("top", "bottom"):
        yield _drawer(cabinet, f"{cabinet}_drawer_{place}", (top_z - height, top_z), p)
        top_z = top_z - height - p.stacked_front_gap


def _drawer(cabinet: str, name: str, front_z: Span, p: KitchenParameters) -> Assembly:
    """Return a drawer: front panel, handle, two sides, back, bottom and hitman's tray."""
    middle_z, tray = 0.5 * sum(front_z), cabinet == "hitman"
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
    T_world_joint = oriented("-x", (front_x[0], 0.5 * sum(y), middle_z))
    return articulated(name, "slider", T_world_joint, (0.0, p.drawer_travel), objects)
