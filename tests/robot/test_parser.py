"""Parts of a URDF that planning does not need, and limits and masses that are not complete."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.convex import thickness
from cvqmpt_lab.robot.load import load_robot

ROBOT = '<robot name="slider_arm">'
LIFT_END = '<limit lower="-2" upper="2" effort="1" velocity="1"/>'
SPHERE = '<geometry><sphere radius="0.04"/></geometry>'
WRIST = '<link name="wrist">'
MOMENTS = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
MASS = f'<inertial><mass value="2"/>{MOMENTS}</inertial>'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (ROBOT, ROBOT.replace(">", ' version="2.0">')),
        (ROBOT, ROBOT + 2 * '<material name="grey"><color rgba="1 1 1 1"/></material>'),
        (ROBOT, ROBOT + '<material name="grey"/>'),
        (WRIST, WRIST + '<visual><geometry><prism side="1"/></geometry></visual>'),
        (WRIST, WRIST + f'<visual>{SPHERE}<material><color rgba="1 1 1 1"/></material></visual>'),
        (LIFT_END, LIFT_END + "<dynamics/>"),
        (LIFT_END, LIFT_END + '<dynamics damping="low"/>'),
        (LIFT_END, LIFT_END + '<safety_controller soft_lower_limit="-2" soft_upper_limit="2"/>'),
        (LIFT_END, LIFT_END + '<calibration rising="home"/>'),
        ('<parent link="wrist"/>', '<parent link="wrist"/><limit lower="0" upper="0"/>'),
    ],
)
def test_parts_that_planning_does_not_need_refuse_no_robot(edited, slider_arm, capfd, old, new):
    """pinocchio's parser dropped the link or the whole file."""
    robot = load_robot(edited((WRIST, WRIST + MASS), (old, new)), "tool")
    assert robot.kinematics_digest == slider_arm.kinematics_digest and robot.notes == []
    assert sum(body.mass for body in robot.model.inertias) == 2.0
    assert "rror" not in capfd.readouterr().err


def test_an_incomplete_inertia_counts_as_0_and_the_mass_stays(edited):
    """The parser dropped the mass with the link's bodies."""
    for moments in ("", '<inertia ixx="nan" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'):
        robot = load_robot(edited((WRIST, WRIST + MASS.replace(MOMENTS, moments))), "tool")
        assert robot.model.inertias[4].mass == 2.0
        assert np.isfinite(robot.model.inertias[4].inertia).all() and len(robot.links) == 6
        (note,) = robot.notes
        assert (
            note == "have moments of inertia that are missing or no numbers and count as 0: wrist"
        )
    for inertial in ("<inertial/>", f"<inertial>{MOMENTS}</inertial>"):
        robot = load_robot(edited((WRIST, WRIST + inertial)), "tool")
        (note,) = robot.notes
        assert note == "have an <inertial> without mass, which counts as 0: wrist"


@pytest.mark.parametrize(
    "given", ["", 'effort="-1" velocity="-1"', 'effort="1" velocity="inf"', 'effort="1"']
)
def test_velocities_and_efforts_that_are_no_limits_are_named(edited, slider_arm, given):
    """Some files state -1 or inf for joints without limits, others nothing."""
    limit = LIFT_END.replace('effort="1" velocity="1"', given)
    robot = load_robot(edited((LIFT_END, limit)), "tool", acceleration_limits=1.0)
    assert robot.kinematics_digest == slider_arm.kinematics_digest
    (note,) = robot.notes
    assert note.endswith("is not stated, -1 or infinite: no limit: lift")
    refused("velocity limits of 0 for lift", lambda: robot.joint_limits)
    nan = LIFT_END.replace('velocity="1"', 'velocity="nan"')
    refused(
        "'lift' of arm.urdf: velocity is nan; .*0 if it",
        load_robot,
        edited((LIFT_END, nan)),
        "tool",
    )


def test_a_hinge_without_limits_is_held(edited):
    """The option that the message named ended in an error of the parser."""
    urdf = edited((LIFT_END, ""))
    refused("'lift' has no <limit>; hold them: --lock lift=0", load_robot, urdf, "tool")
    robot = load_robot(urdf, "tool", locked={"lift": 0.5})
    assert robot.joint_names == ("rail", "bend", "twist") and robot.notes == []


def test_a_hinge_that_is_not_planned_may_turn_often(edited):
    """A wheel with limits of 1e6 rad refused the robot, also where nothing plans for it."""
    wide = (LIFT_END, LIFT_END.replace('"-2" upper="2"', '"-1e6" upper="1e6"'))
    refused(
        "from -1e.06 to 1e.06 rad, as if without limits: .*--lock lift=0",
        load_robot,
        edited(wide),
        "tool",
    )
    assert load_robot(edited(wide), "tool", locked={"lift": 0.0}).dof == 3


@pytest.mark.parametrize("place", [lambda x, y: (x, y, 0), lambda x, y: (x, 2, x + y)])
def test_a_flat_mesh_gets_a_thickness(edited, tmp_path, place):
    """A marker on a link, drawn as one sheet, refused the robot."""
    sheet = "".join("v {} {} {}\n".format(*place(x, y)) for x in (0, 0.1) for y in (0, 0.2))
    (tmp_path / "sheet.obj").write_text(f"{sheet}f 1 2 3\nf 2 3 4\n")
    robot = load_robot(
        edited((SPHERE, '<geometry><mesh filename="sheet.obj"/></geometry>')), "tool"
    )
    (piece,) = (piece for piece in robot.links if piece.name == "wrist_0")
    assert 1e-4 <= thickness(piece.vertices) <= 3e-4
    (note,) = robot.notes
    assert note.endswith("without thickness are larger than these: wrist_0 by up to 0.1 mm")


def test_a_file_without_any_joint_to_plan_for_says_so(tmp_path):
    """The message offered the base as end effector, which failed, too."""
    urdf = tmp_path / "table.urdf"
    urdf.write_text('<robot name="table"><link name="top"/></robot>')
    refused("no joint of table.urdf moves, it has 0 fixed ones", load_robot, urdf, "top")
