"""Link pairs that are left out without an SRDF: the reasons, and their verified cache."""

import re
import tempfile
from itertools import product

import numpy as np
import pytest
import trimesh
from refusals import refused

from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.robot.self_collision import (
    OVERLAP,
)

TOOL = 'size="0.02 0.06 0.02"'


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.slow
def test_mirrored_arms_leave_out_the_same_overlaps():
    """Of a wrist 1.3 mm deep in the link before last, coal saw 99.95 % left and 0.1 % right."""
    arms = (robot_from_source({"name": f"tiago-dual-{side}"}) for side in ("left", "right"))
    overlaps = ([pair for pair in arm.left_out_pairs if OVERLAP in pair.reason] for arm in arms)
    left, right = ({(pair.first, pair.second) for pair in pairs} for pairs in overlaps)
    assert ("arm_right_6_link", "wrist_right_ft_link") in right
    assert {tuple(name.replace("left", "right") for name in pair) for pair in left} == right


def sheared(by):
    corners = product((-0.1, 0.1), (-0.05, 0.05), (-0.1, 0.1))
    return np.array([(x + by * z, y, z) for x, y, z in corners])


AXIS, OTHER_AXIS = '<axis xyz="0.6 0 0.8"/>', '<axis xyz="0.8 0 0.6"/>'


@pytest.mark.parametrize(
    ("before", "after"), [(AXIS, OTHER_AXIS), ("a.obj", "b.obj"), ('upper="1.5"', 'upper="1.4"')]
)
def test_another_robot_has_pairs_of_its_own(slider_arm_urdf, tmp_path, cache, before, after):
    """Another axis of a joint whose link has no body, a mirrored mesh, other limits."""
    for name, by in (("a.obj", 0.5), ("b.obj", -0.5)):
        trimesh.Trimesh(sheared(by)).convex_hull.export(tmp_path / name)
    cylinder = '<cylinder radius="0.04" length="0.3"/>'
    text = slider_arm_urdf.read_text().replace(cylinder, '<mesh filename="a.obj"/>')
    text = re.sub('<link name="elbow">.*', '<link name="elbow"/>', text)
    (tmp_path / "arm.urdf").write_text(text)
    load_robot(tmp_path / "arm.urdf", "tool")
    (tmp_path / "arm.urdf").write_text(text.replace(before, after))
    load_robot(tmp_path / "arm.urdf", "tool")
    assert len(list((cache / "cvqmpt_lab" / "self_collision").iterdir())) == 2


@pytest.mark.parametrize(
    "spoilt", [lambda kept, other: kept[: len(kept) // 2], lambda kept, other: other]
)
def test_a_spoilt_or_foreign_file_is_made_anew(slider_arm_urdf, edited, cache, spoilt):
    folder = cache / "cvqmpt_lab" / "self_collision"
    load_robot(edited((TOOL, 'size="0.4 0.4 0.4"')), "tool")
    (foreign,) = folder.iterdir()
    pairs = load_robot(slider_arm_urdf, "tool").left_out_pairs
    (kept,) = set(folder.iterdir()) - {foreign}
    whole = kept.read_bytes()
    kept.write_bytes(spoilt(whole, foreign.read_bytes()))
    assert load_robot(slider_arm_urdf, "tool").left_out_pairs == pairs
    assert kept.read_bytes() == whole


@pytest.mark.parametrize(
    ("text", "pattern"), [("<robot", "cannot read SRDF"), ("<a/>", "root <a>")]
)
def test_a_file_that_is_no_srdf_is_named(slider_arm_urdf, tmp_path, text, pattern):
    (tmp_path / "bad.srdf").write_text(text)
    refused(pattern, load_robot, slider_arm_urdf, "tool", srdf=tmp_path / "bad.srdf")
