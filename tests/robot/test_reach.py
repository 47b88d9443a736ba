"""Robots that reach far: gantries are accepted with a note, lengths in other units are refused."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.robot.load import load_robot, robot_from_source

GANTRY = """<robot name="gantry"><link name="world"/><link name="car"/>{bridge}
<link name="l1"><collision><geometry><box size="0.1 0.1 {arm}"/></geometry></collision></link>
<link name="tool"/><link name="cart_x"/><link name="cart"/>
<joint name="gx" type="prismatic"><parent link="world"/><child link="bridge"/><axis xyz="1 0 0"/>
<limit lower="0" upper="{x}" effort="500" velocity="1"/></joint>
<joint name="gy" type="prismatic"><parent link="bridge"/><child link="car"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="{y}" effort="500" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="car"/><child link="l1"/><origin rpy="0.3 0 0"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="50" velocity="2"/></joint>
<joint name="jt" type="fixed"><parent link="l1"/><child link="tool"/>
<origin xyz="0 0 {arm}"/></joint>
<joint name="cart" type="prismatic"><parent link="world"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-20" upper="20" effort="50" velocity="2"/></joint>
<joint name="cart_x" type="fixed"><parent link="cart"/><child link="cart_x"/></joint></robot>"""


@pytest.fixture
def gantry(tmp_path):
    """Return a function that loads a gantry with an arm, beside a cart that planning holds."""

    def load(x, y, arm=0.5, bridge=(0.5, 0.5, 0.5), **options):
        box = f'<collision><geometry><box size="{" ".join(map(str, bridge))}"/></geometry>'
        link = f'<link name="bridge">{box}</collision></link>'
        path = tmp_path / "gantry.urdf"
        path.write_text(GANTRY.format(x=x, y=y, arm=arm, bridge=link))
        return load_robot(path, "tool", **options)

    return load


def test_strokes_across_each_other_are_not_added(gantry):
    """They were: 6 m and 4 m were 10 m."""
    robot = gantry(6.0, 8.5)
    ends = robot.poses(np.random.default_rng(0).uniform(robot.lower, robot.upper, (500, 3)))
    true = np.linalg.norm(ends[:, :3, 3], axis=1).max()
    assert true < robot.reach <= np.hypot(6.0, 8.5) + 0.51
    note = next(note for note in robot.notes if "reaches" in note)
    assert note.endswith(
        "because joint 'gx' slides to 6 m, joint 'gy' slides to 8.5 m; lengths are taken as metres"
    )
    assert "cart" not in note
    assert not any("reaches" in note for note in gantry(6.2, 4.2).notes)


def test_a_hall_with_a_wide_bridge_is_planned_for(gantry):
    from cvqmpt_lab.collision.arrays import robot_arrays

    robot = gantry(37.0, 16.0, bridge=(1.0, 17.0, 0.6))
    assert 40.0 < robot.reach < 50.0
    assert len(robot_arrays(robot).body_link) >= 2


@pytest.mark.parametrize(
    ("sizes", "told"),
    [
        ((370.0, 16.0), "slides to 370 m, .*at most 100 m; are all lengths in metres.*--lock"),
        ((3.0, 3.0, 50.0), "its arm is .* m long behind a hinge, at most 20 m; are all lengths"),
    ],
)
def test_lengths_in_other_units_are_refused(gantry, sizes, told):
    message = refused(told, gantry, *sizes)
    assert "cart" not in message


def test_joint_limits_make_a_long_slider_usable(gantry, tmp_path):
    limits = tmp_path / "limits.yaml"
    limits.write_text(
        "joint_limits: {gx: {has_position_limits: true, min_position: 0, max_position: 30}}"
    )
    held = gantry(370.0, 3.0, locked={"gx": 80.0})
    assert "joint 'gx' is held at 80 m" in held.notes[-1]
    narrowed = {"urdf": held.source["urdf"], "end_effector": "tool", "joint_limits": str(limits)}
    assert robot_from_source(narrowed).upper[0] == 30.0
