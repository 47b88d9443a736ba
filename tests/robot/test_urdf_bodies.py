"""A collision body that the parser of URDF files does not understand is refused, not left out."""

import pytest

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.robot.loading import load_robot

BOX = '<geometry><box size="0.1 0.12 0.08"/></geometry>'
CYLINDER = '<cylinder radius="0.04" length="0.3"/>'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            CYLINDER,
            '<cylinder radius="wide" length="0.3"/>',
            "link 'shoulder'.*radius of its cylinder is 'wide'",
        ),
        (CYLINDER, '<cylinder length="0.3"/>', "link 'shoulder'.*radius"),
        (CYLINDER, '<cylinder radius="-0.04" length="0.3"/>', "radius.*-0.04.*more than 0"),
        (CYLINDER, '<capsule radius="0.04" length="0.3"/>', "unknown shape 'capsule'"),
        (BOX, '<geometry><box size="0.1 0.12"/></geometry>', "link 'carriage'.*'0.1 0.12'.*3 finite"),
        (BOX, '<geometry><box size="0.1 nan 0.08"/></geometry>', "3 finite"),
        (BOX, "<geometry/>", "0 shapes"),
        (BOX, "", "0 shapes"),
        (BOX, BOX.replace("</", '<sphere radius="1"/></'), "2 shapes"),
        ('<origin xyz="0 0 0.05"/>', '<origin xyz="0 0 x"/>', "link 'base'.*xyz of its origin is '0 0 x'"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 nan 0"/>', "joint 'rail'.*axis is '0 nan 0'"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "joint 'rail'.*give a direction"),
    ],
)
def test_what_is_not_understood_is_refused_by_name(slider_arm_urdf, tmp_path, capfd, old, new, words):
    text = slider_arm_urdf.read_text()
    assert old in text
    path = tmp_path / "arm.urdf"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(CvqmptError, match=words):
        load_robot(path, "tool")
    assert capfd.readouterr().err == "", "the parser was not asked"
