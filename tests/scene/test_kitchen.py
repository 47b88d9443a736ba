"""The kitchen has the measured dimensions and joints of the published one."""

import numpy as np
import pytest
from refusals import table

from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.scene.shapes import Box

TOLERANCE = 0.005  # [m]


def measured(name):
    """Rows of numbers [m or rad] by the name in their first column."""
    rows = ([*row.values()] for row in table(name))
    return {name: np.array(numbers, dtype=float) for name, *numbers in rows}


# centre and size of the box around a piece [m], all doors closed
CLOSED = measured("kitchen_pieces")
OPENED = {  # centres of the parts of dagger_door_left at -1.57 rad [m]
    "panel": (0.310, -0.145, 1.007),
    "handle_bar": (0.170, -0.096, 0.757),
    "handle_post_lower": (0.170, -0.116, 0.679),
    "handle_post_upper": (0.170, -0.116, 0.835),
}

# x, y of the vertical axis [m], range [rad]
HINGES = measured("kitchen_hinges")
DRAWERS = ("hitman_drawer_top", "hitman_drawer_bottom", "indigo_drawer_top", "indigo_drawer_bottom")


def bounds(item):
    """Lower and upper corner (3,) of the axis-aligned box around a box or cylinder in the world."""
    R, centre = item.T_world_object[:3, :3], item.T_world_object[:3, 3]
    if isinstance(item.shape, Box):
        half = np.abs(R) @ np.array(item.shape.size) / 2
    else:
        along = np.abs(R[:, 2])
        half = along * item.shape.height / 2 + item.shape.radius * np.sqrt(
            1.0 - np.minimum(along, 1.0) ** 2
        )
    return centre - half, centre + half


@pytest.mark.parametrize("name", CLOSED)
def test_pieces_are_where_they_were_measured(name):
    lower, upper = bounds(kitchen()[name])
    centre, size = np.split(CLOSED[name], 2)
    np.testing.assert_allclose((lower + upper) / 2, centre, atol=TOLERANCE)
    np.testing.assert_allclose(upper - lower, size, atol=TOLERANCE)


def test_the_opened_door_is_where_it_was_measured():
    scene = kitchen(door_angles={"dagger_door_left": -1.57})
    for part, centre in OPENED.items():
        T = scene[f"dagger_door_left/{part}"].T_world_object
        np.testing.assert_allclose(T[:3, 3], centre, atol=TOLERANCE, err_msg=part)
    unmoved = [item for item in kitchen() if not item.name.startswith("dagger_door_left/")]
    assert all(scene[item.name] == item for item in unmoved)


def test_hinges_have_the_measured_axes_and_ranges():
    scene = kitchen()
    assert {j.name for j in scene.articulations if j.kind == "hinge"} == set(HINGES)
    for name, (x, y, lower, upper) in HINGES.items():
        joint = scene.articulation(name)
        np.testing.assert_allclose(joint.T_world_joint[:2, 3], (x, y), atol=0.001, err_msg=name)
        np.testing.assert_array_equal(joint.T_world_joint[:3, 2], (0.0, 0.0, 1.0))
        assert (joint.lower, joint.upper, joint.value) == (lower, upper, 0.0)
        assert set(joint.moves) == {item.name for item in scene if item.name.startswith(f"{name}/")}
        opened = scene.with_joint(name, lower + upper)
        panels = [each[f"{name}/panel"].T_world_object[0, 3] for each in (scene, opened)]
        assert panels[1] < panels[0] - 0.15, "the door opens towards the robot"


@pytest.mark.parametrize("name", DRAWERS)
def test_drawers_slide_out_of_their_cabinet(name):
    scene = kitchen()
    pulled = kitchen(door_angles={name: 0.4})
    for item in scene:
        shift = pulled[item.name].T_world_object[:3, 3] - item.T_world_object[:3, 3]
        expected = (-0.4, 0.0, 0.0) if item.name.startswith(f"{name}/") else (0.0, 0.0, 0.0)
        np.testing.assert_allclose(shift, expected, atol=1e-12, err_msg=item.name)
