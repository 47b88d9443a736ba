"""Executions that must not count as planned, on a gantry whose right answers are seen at once."""

import json

import numpy as np
import pytest
import trimesh
from small_arms import carried, gantry, problem_of

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.cli.execute_command import _report
from cvqmpt_lab.features.motion.trajectory import Trajectory
from cvqmpt_lab.features.physics.execute import execute_motion
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source

pytest.importorskip("mujoco")
CUBE = carried("cargo", (0.04, 0.04, 0.04), (0.2, 0.0, 0.0), "left") | {"mass": 0.5}


def block(name, x, z=0.0, size=(0.1, 0.1, 0.1)):
    """An obstacle on the left rail, y = 0.5 m, in json."""
    shape = {"type": "box", "size": list(size)}
    return {"name": name, "shape": shape, "T_world_object": pose((x, 0.5, z)).tolist()}


def executed(
    folder, distance, hand="left", things=(), objects=(), begin=0.0, constraint=(), **limits
):
    """The execution of a motion of the left carriage from 0 to a distance [m] in 1 s."""
    states = np.zeros((2, 1 if hand == "left" else 2))
    states[1, 0] = distance
    problem = problem_of(folder, gantry(), states, (hand,), things, constraint, objects)
    if limits:
        robot = robot_from_source({**problem.robot.source, **limits})
        problem = problem.changed(robot=robot)
    still, times = np.zeros_like(states), np.array([begin, begin + 1.0])
    motion = Trajectory(problem.robot.joint_names, times, states, still, still)
    return execute_motion(problem, motion, "computed-torque")


def test_a_free_motion_is_executed_also_if_its_times_begin_later(tmp_path):
    for begin in (0.0, 2.0):
        found = executed(tmp_path, 0.3, things=[CUBE], begin=begin)
        assert found.faults == [] and found.off_path_m < 1e-4 and found.arrival_rad < 1e-3
        assert found.samples[-1].q == pytest.approx([0.3], abs=1e-3)


def test_what_the_load_meets_near_its_start_is_a_contact_and_its_support_is_not(tmp_path):
    """A block 5 mm ahead stops the arm within 2 cm of the start; the cargo slides on a table."""
    ahead = block("ahead", 0.2 + 0.02 + 0.005 + 0.05)
    found = executed(tmp_path, 0.3, things=[CUBE], objects=[ahead])
    assert ("ahead", "load") in found.pairs and any("arrive" in text for text in found.faults)
    table = block("table", 0.2, -0.02 - 0.0495, size=(0.1, 0.1, 0.1))  # 0.5 mm too high
    found = executed(tmp_path, 0.01, things=[CUBE], objects=[table])
    assert found.faults == []
    # it is no support of a load that was lifted: the same height, but further on
    later = block("later", 0.4, -0.02 - 0.0495, size=(0.1, 0.1, 0.1))
    found = executed(tmp_path, 0.5, things=[CUBE], objects=[later])
    assert ("later", "load") in found.pairs


def test_an_obstacle_called_load_is_an_obstacle(tmp_path):
    """The carriage, not its cargo, comes to it within 2 cm of the start."""
    found = executed(tmp_path, 0.018, things=[CUBE], objects=[block("load", 0.01 + 0.012 + 0.05)])
    assert ("left_0", "load") in found.pairs and "left_0 touches load" in found.faults[0]


def test_an_arm_that_is_too_weak_does_not_arrive(tmp_path):
    found = executed(tmp_path, 0.6, effort_limits=[0.1])
    assert found.arrival_rad > 0.1
    assert any("does not arrive: a joint ends" in text for text in found.faults)
    found = executed(tmp_path, 1.4, effort_limits=[0.1])
    assert any("does not follow: a joint is" in text for text in found.faults)


def test_a_load_touches_the_link_before_the_one_that_carries_it(tmp_path):
    """It hangs from the wrist and reaches 1 mm into the carriage, one joint before."""
    low = carried("low", (0.02, 0.02, 0.062), (0.0, 0.0, -0.06), "wrist") | {"mass": 0.1}
    found = executed(tmp_path, 0.3, hand="wrist", things=[low])
    assert ("left_0", "load") in found.pairs


def test_pieces_of_a_carried_mesh_share_its_mass_and_are_executed_together(tmp_path):
    bars = [trimesh.creation.box((0.2, 0.02, 0.02)), trimesh.creation.box((0.02, 0.02, 0.2))]
    bars[1].apply_translation((0.09, 0.0, 0.11))
    trimesh.util.concatenate(bars).export(tmp_path / "corner.stl")
    shape = {"type": "mesh_file", "path": "corner.stl"}
    item = {**CUBE, "name": "corner", "shape": shape, "mass": 3.0}
    problem = problem_of(tmp_path, gantry(), np.array([[0.0], [0.3]]), ("left",), [item])
    masses = [piece.mass for piece in problem.attachments]
    assert len(masses) > 1 and sum(masses) == pytest.approx(3.0)
    found = executed(tmp_path, 0.3, things=[item])
    assert found.faults == [] and found.off_path_m < 1e-4
    data = json.loads((tmp_path / "problem.json").read_text())
    assert PlanningProblem.from_dict(problem.to_dict()).attachments[0].mass == masses[0] < 3.0
    assert data["attachments"][0]["mass"] == 3.0


def coupling(upper, lower=0.0, **others):
    """A bound of the left carriage, as a joint coupling in json."""
    factors = {"left_rail": 1.0, **others}
    return {"joint-coupling": {"factors": factors, "lower": lower, "upper": upper}}


def test_couplings_of_joints_are_judged_and_those_of_width_0_are_stated(tmp_path):
    """Reports once said 0 rad and 0 m outside for any of them."""
    wide = coupling(0.2, lower=-1.0)
    found = executed(tmp_path, 0.3, constraint=[wide])
    (use,) = found.functions
    assert use.outside == pytest.approx(0.1, abs=1e-3) and np.isnan(use.off)
    assert found.faults == [f"left_rail from -1 to 0.2 is broken by {use.outside:.2g}"]
    assert executed(tmp_path, 0.15, constraint=[wide]).faults == []
    found = executed(tmp_path, 0.3, "wrist", constraint=[coupling(0.0, left_turn=-1.0)])
    (use,) = found.functions
    assert use.off == pytest.approx(0.3, abs=1e-3) and np.isnan(use.outside)
    assert found.faults == [] and found.data["functions"][0]["off"] == use.off
    told = [line for line in _report([found, found], "").lines if line.startswith("function")]
    assert told == [
        f"function    left_rail - left_turn from 0 to 0; at most {use.off:.2g} off: a controller "
        "cannot keep it exactly"
    ]


def test_the_deviation_from_values_that_a_region_fixes_is_stated(tmp_path):
    """The plane x = 0 has width 0, and the motion leaves it by 0.3 m."""
    plane = {"plane": {"normal": [1.0, 0.0, 0.0], "point": [0.0, 0.0, 0.0]}}
    found = executed(tmp_path, 0.3, constraint=[plane])
    assert found.fixed_off_m == pytest.approx(0.3, abs=1e-3) and np.isnan(found.fixed_off_rad)
    (line,) = (line for line in _report([found], "").lines if line.startswith("fixed"))
    assert line.startswith("fixed       at most 0.3 m off the values that bounds of width 0 fix")
