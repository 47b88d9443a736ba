"""The dimensions of the kitchen, and the rules that make its pieces fit together."""

import math
from dataclasses import dataclass

from cvqmpt_lab.codec import Checked
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.values import Length

WALL_CELLS = {"dagger": 2, "sektion": 3}  # cells of each row, counted from its right end (-y)


@dataclass(frozen=True, eq=False)
class KitchenParameters(Checked):
    """Dimensions of the kitchen [m] and door range [rad]; defaults: the published kitchen.

    Fields whose name ends in `_x`, `_y` or `_z` are world coordinates; all others are positive
    sizes. Cabinets stand against the back wall, to the left and right of the range; moving or
    resizing one piece moves what is attached to it.
    """

    # Room.
    back_wall_x: float = 0.867  # front face of the back wall
    back_wall_width: Length = 3.5  # starts at the outer face of the right wall
    right_wall_length: Length = 0.914
    wall_thickness: Length = 0.130
    wall_height: Length = 2.750
    wall_bottom_z: float = -0.623
    floor_z: float = -0.750  # top of the floor
    floor_side: Length = 200.0
    floor_thickness: Length = 10.0
    # Robot pedestal.
    pedestal_x: float = -0.050
    pedestal_side: Length = 0.250
    pedestal_height: Length = 0.750
    pedestal_top_z: float = -0.010
    # Range (stove) and hood.
    range_y: float = 0.260  # middle
    range_width: Length = 0.760
    range_depth: Length = 0.710
    range_height: Length = 0.920
    range_top_z: float = 0.172
    range_wall_gap: Length = 0.012
    range_side_gap: Length = 0.035  # to the cabinets left and right
    plate_height: Length = 0.001
    front_plate_radius: Length = 0.125
    front_plate_side_inset: Length = 0.170  # plate axis from the range's side
    front_plate_front_inset: Length = 0.290  # plate axis from the range's front
    back_plate_radius: Length = 0.080
    back_plate_side_inset: Length = 0.125
    back_plate_front_inset: Length = 0.540
    control_panel_depth: Length = 0.125
    control_panel_thickness: Length = 0.004
    knob_radius: Length = 0.025
    knob_height: Length = 0.025
    outer_knob_side_inset: Length = 0.050
    inner_knob_side_inset: Length = 0.125
    hood_depth: Length = 0.560
    hood_height: Length = 0.660
    hood_bottom_z: float = 0.767
    hood_into_wall: Length = 0.053  # how deep the hood's back is let into the wall
    # Cabinets.
    cabinet_width: Length = 0.381  # one cell; a base cabinet is two cells wide
    cabinet_wall_gap: Length = 0.001
    board_thickness: Length = 0.019
    wall_cabinet_depth: Length = 0.366
    wall_cabinet_height: Length = 0.762
    dagger_bottom_z: float = 0.6265
    sektion_bottom_z: float = 0.7275
    base_cabinet_depth: Length = 0.610
    base_cabinet_height: Length = 0.763
    base_cabinet_bottom_z: float = -0.622
    base_back_thickness: Length = 0.040
    # Countertops; the right one reaches the right wall.
    countertop_depth: Length = 0.650
    countertop_thickness: Length = 0.037
    left_countertop_width: Length = 1.200
    right_counter_gap: Length = 0.073  # from the right cabinets to the right wall
    # Doors and drawers.
    door_thickness: Length = 0.019  # also the front panels of drawers
    door_gap: Length = 0.001  # how much narrower and lower than its cabinet a door is
    door_range: Length = 1.57  # [rad]
    base_front_gap: Length = 0.003  # from a base cabinet to its doors and front panels
    base_front_reveal: Length = 0.0065  # from the cabinet's top to the first front panel
    stacked_front_gap: Length = 0.0035  # between fronts above each other
    base_hinge_inset: Length = 0.006  # hinge from the cabinet's side; it lies mid-panel
    base_door_overhang: Length = 0.0065  # how far indigo's doors reach below the cabinet
    indigo_front_height: Length = 0.124  # front panels of the drawers above indigo's doors
    drawer_travel: Length = 0.400
    drawer_length: Length = 0.512
    drawer_height: Length = 0.086
    drawer_board_thickness: Length = 0.005
    drawer_bottom_thickness: Length = 0.001
    drawer_side_gap: Length = 0.013  # drawer to the cabinet's side boards
    hitman_drawer_lift: Length = 0.034  # drawer above the lower edge of its front panel
    tray_thickness: Length = 0.012
    tray_lift: Length = 0.007  # tray above the drawer's lower edge
    # Handles: a bar on two posts. Stand-off: bar axis from the panel's face.
    handle_length: Length = 0.245
    handle_diameter: Length = 0.015
    post_length: Length = 0.040
    post_diameter: Length = 0.010
    post_spacing: Length = 0.155
    wall_handle_standoff: Length = 0.040
    wall_handle_side_inset: Length = 0.050  # bar axis from the door's free edge
    wall_handle_end_inset: Length = 0.0075  # lower end of the bar above the door's lower edge
    base_handle_standoff: Length = 0.042
    base_handle_side_inset: Length = 0.060
    base_handle_end_inset: Length = 0.0315  # upper end of the bar below the door's upper edge
    drawer_handle_standoff: Length = 0.0345
    hitman_handle_drop: Length = 0.039  # bar axis below the front panel's upper edge

    def _check(self) -> None:
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
        return (
            self.cabinet_back_x
            - self.base_cabinet_depth
            - self.base_front_gap
            - self.door_thickness
        )

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


def _fitting_rules(p: KitchenParameters) -> list[tuple[bool, str]]:
    """Return (whether it holds, what is broken if not) of every rule of a consistent kitchen."""
    boards, handle, half_range = 2.0 * p.board_thickness, p.handle_length, 0.5 * p.range_width
    counter_z = p.base_cabinet_bottom_z + p.base_cabinet_height + p.countertop_thickness
    wall_door_height = p.wall_cabinet_height - p.door_gap
    base_door_height = p.indigo_door_top_z - (p.base_cabinet_bottom_z - p.base_door_overhang)
    drawer_width = p.base_width - boards - 2.0 * p.drawer_side_gap
    drawer_room = p.base_cabinet_depth - p.base_back_thickness + p.base_front_gap
    drawer_top = p.hitman_drawer_lift + p.drawer_height
    left_end = p.left_y + max(p.left_countertop_width, WALL_CELLS["sektion"] * p.cabinet_width)
    wall_end = p.right_wall_y - p.wall_thickness + p.back_wall_width
    insets = (p.front_plate_side_inset, p.back_plate_side_inset)
    radii = (p.front_plate_radius, p.back_plate_radius)
    return [
        (p.cabinet_width > boards, "cabinet_width leaves no room between two boards"),
        (p.cabinet_width > p.door_gap, "door_gap is wider than cabinet_width"),
        (p.wall_cabinet_height > boards, "wall_cabinet_height leaves no room between two boards"),
        (
            p.wall_handle_side_inset < p.cabinet_width - p.door_gap,
            "wall_handle_side_inset is off the door",
        ),
        (
            p.base_handle_side_inset < p.cabinet_width - p.door_gap,
            "base_handle_side_inset is off the door",
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
        (drawer_width > 2.0 * p.drawer_board_thickness, "drawers have no room between their sides"),
        (p.drawer_height <= p.indigo_front_height, "indigo_front_height is below drawer_height"),
        (
            drawer_top <= p.hitman_front_height,
            "hitman's drawers are higher than their front panels",
        ),
        (
            p.drawer_length <= drawer_room,
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
        (p.pedestal_top_z - p.pedestal_height <= p.floor_z, "the pedestal floats above the floor"),
        (p.door_range <= math.pi, "door_range turns the doors by more than half a turn"),
    ]
