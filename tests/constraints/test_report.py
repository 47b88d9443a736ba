"""Share of its bounds that a path uses, in words and numbers."""

import numpy as np
import pytest

from cvqmpt_lab.constraints.report import bound_usage, displacements
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright
from cvqmpt_lab.poses import pose


def test_the_largest_tilt_of_a_path_is_found_against_its_bound(solution):
    problem, states = solution.problem, solution.simplified.path.states
    uses = bound_usage(problem.robot, problem.constraint, states)
    assert [(use.region, use.row, use.unit) for use in uses] == [(0, 4, "rad"), (0, 5, "rad")]
    tilts = np.abs(displacements(problem.robot, problem.constraint[0], states)[:, 4:])
    assert [abs(use.value) for use in uses] == pytest.approx(tilts.max(axis=0))
    assert str(uses[0]) == f"rotation about y {tilts[:, 0].max():.3g} of 0.1 rad"


def test_a_bound_on_one_side_names_the_state_closest_to_it(panda):
    """Hand heights from above a table: the lowest one counts, however high the others are."""
    states = panda.random_configurations(np.random.default_rng(0), 20)
    Bw = np.array([[-np.inf, np.inf]] * 6)
    Bw[2, 0] = 0.0
    table = TaskSpaceRegion(pose((0.0, 0.0, -0.5)), np.eye(4), Bw)
    (use,) = bound_usage(panda, (upright(np.pi), table), states)
    lowest = min(panda.pose(q)[2, 3] for q in states) + 0.5
    assert use.value == pytest.approx(lowest) and (use.lower, use.upper) == (0.0, np.inf)
    assert str(use) == f"position z {lowest:.3g} of 0 to inf m"


def test_displacements_are_seen_from_the_frame_of_the_region(panda):
    beside = panda.pose(np.zeros(7)) @ pose((0.1, 0.0, 0.0))
    region = TaskSpaceRegion(beside, np.eye(4), np.zeros((6, 2)))
    found = displacements(panda, region, np.zeros((1, 7)))[0]
    np.testing.assert_allclose(found, [-0.1, 0, 0, 0, 0, 0], atol=1e-12)
