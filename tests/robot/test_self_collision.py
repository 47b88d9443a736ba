"""Link pairs that are left out without an SRDF: the reasons."""

import pytest
from refusals import refused

from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.robot.self_collision import OVERLAP


@pytest.mark.slow
def test_mirrored_arms_leave_out_the_same_overlaps():
    """Of a wrist 1.3 mm deep in the link before last, coal saw 99.95 % left and 0.1 % right."""
    arms = (robot_from_source({"name": f"tiago-dual-{side}"}) for side in ("left", "right"))
    overlaps = ([pair for pair in arm.left_out_pairs if OVERLAP in pair.reason] for arm in arms)
    left, right = ({(pair.first, pair.second) for pair in pairs} for pairs in overlaps)
    assert ("arm_right_6_link", "wrist_right_ft_link") in right
    assert {tuple(name.replace("left", "right") for name in pair) for pair in left} == right


@pytest.mark.parametrize(
    ("text", "pattern"), [("<robot", "cannot read SRDF"), ("<a/>", "root <a>")]
)
def test_a_file_that_is_no_srdf_is_named(slider_arm_urdf, tmp_path, text, pattern):
    (tmp_path / "bad.srdf").write_text(text)
    refused(pattern, load_robot, slider_arm_urdf, "tool", srdf=tmp_path / "bad.srdf")
