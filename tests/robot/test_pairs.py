"""Pairs of links that are compared: what often overlaps is named, with an SRDF as its cure."""

import numpy as np
import pytest
from refusals import refused
from small_arms import box, joint, problem_of

from cvqmpt_lab.benchmarks.place_task import door_problem
from cvqmpt_lab.benchmarks.templates import problem_template
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.robot.load import load_robot
from cvqmpt_lab.robot.pairs import cure_of_overlap, overlaps, srdf_text
from cvqmpt_lab.search.planner_interface import Budget


def telescope(stroke):
    """Five tubes in each other on a base that turns."""
    edges = (0.12, 0.105, 0.09, 0.075, 0.06)
    tubes = [box(f"t{k}", (0.3, edge, edge), (0.15, 0, 0)) for k, edge in enumerate(edges)]
    slides = [
        joint(f"s{k}", f"t{k - 1}", f"t{k}", "prismatic", (1, 0, 0), (0.05, 0, 0), stroke).replace(
            f'lower="{-stroke}"', 'lower="0"'
        )
        for k in range(1, 5)
    ]
    return (
        '<robot name="telescope">'
        + box("base", (0.2, 0.2, 0.4), (0, 0, 0.2))
        + "".join(tubes)
        + joint("turn", "base", "t0", "revolute", (0, 0, 1), (0, 0, 0.5))
        + "".join(slides)
        + '<link name="tool"/>'
        + joint("hold", "t4", "tool", "fixed", (1, 0, 0), (0.3, 0, 0))
        + "</robot>"
    )


RETRACT = np.array([(0.0, 0.24, 0.24, 0.24, 0.24), (1.0, 0.0, 0.0, 0.0, 0.0)])


def test_a_retracted_telescope_is_refused_with_a_cure_that_works(tmp_path):
    problem = problem_of(tmp_path, telescope(0.25), RETRACT, ["tool"])
    budget = Budget(iterations=2000)
    message = (
        r"goal 0 is in collision: t0_0 and t2_0; .*t0 and t2 overlap in [\d.]+ % of random states "
        r"and where all joints are 0; .*arm.urdf --end-effector tool --out telescope.srdf` writes"
    )
    refused(message, solve, problem, "birrt", budget, seed=0)
    (tmp_path / "telescope.srdf").write_text(srdf_text(problem.robot))
    allowed = load_robot(tmp_path / "arm.urdf", "tool", srdf=tmp_path / "telescope.srdf")
    before = {frozenset(pair[:2]) for pair in problem.robot.left_out_pairs}
    assert before < {frozenset(pair[:2]) for pair in allowed.left_out_pairs}
    assert {"SRDF: adjacent", "SRDF: overlap by design"} == {p[2] for p in allowed.left_out_pairs}
    solution = solve(problem.changed(robot=allowed), "birrt", budget, seed=0)
    assert solution.solved and cure_of_overlap(allowed) == ""


@pytest.mark.slow
def test_a_problem_that_is_not_found_names_the_links_that_overlap(tmp_path):
    (tmp_path / "short.urdf").write_text(telescope(0.12))
    robot = load_robot(tmp_path / "short.urdf", "tool")
    refused(r"t0 and t2 overlap in 9[\d.]+ %.*--out telescope.srdf", problem_template, robot.source)


def shutter(open_from, at=0.0):
    """A slide that overlaps a standing post until it has moved by a share of its stroke of 1 m."""
    return (
        '<robot name="shutter"><link name="base"/>'
        + box("post", (2.0 * open_from, 0.1, 0.1))
        + box("cart", (0.01, 0.01, 0.01), (0, 1, 0))
        + box("slide", (0.002, 0.1, 0.1))
        + joint("mount", "base", "post", "fixed", (1, 0, 0), (at, 0, 0))
        + joint("aside", "base", "cart", "prismatic", (0, 0, 1), (0, 0, 0), 0.01)
        + joint("along", "cart", "slide", "prismatic", (1, 0, 0), (0, 0, 0), 1.0)
        + "</robot>"
    )


@pytest.mark.parametrize("share", [0.9, 0.97, 0.995])
def test_no_pair_with_a_standing_body_is_left_out_though_it_often_overlaps(tmp_path, share):
    """From a share of 0.95 the pair was left out."""
    (tmp_path / "arm.urdf").write_text(shutter(share))
    robot = load_robot(tmp_path / "arm.urdf", "slide")
    assert {"post", "slide"} not in [{*pair[:2]} for pair in robot.left_out_pairs]
    (found,) = (one for one in overlaps(robot) if {one.first, one.second} == {"post", "slide"})
    assert abs(found.share - share) < 0.05 and found.by_design
    assert f"slide and post overlap in {100.0 * found.share:.3g} %" in cure_of_overlap(robot)


def test_links_that_only_sometimes_overlap_are_not_said_to_be_built_so(tmp_path):
    (tmp_path / "arm.urdf").write_text(shutter(0.3, at=0.7))
    robot = load_robot(tmp_path / "arm.urdf", "slide")
    assert any(one.share > 0.05 for one in overlaps(robot)) and cure_of_overlap(robot) == ""


def test_pairs_that_always_overlap_are_left_out_with_a_note(tmp_path):
    (tmp_path / "arm.urdf").write_text(shutter(1.1))
    robot = load_robot(tmp_path / "arm.urdf", "slide")
    assert ("slide", "post", "overlap in 100 % of random states") in robot.left_out_pairs
    assert any("compared by nobody" in note and "slide and post" in note for note in robot.notes)


def test_pieces_of_a_door_are_of_no_link():
    """Pinocchio gives them a frame number beyond all frames."""
    robot = door_problem(0).robot
    names = {name for one in overlaps(robot) for name in one[:2]}
    assert names <= {*robot.frame_names}
