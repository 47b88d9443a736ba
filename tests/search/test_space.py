"""The planning space where conservative state checks and the meshes disagree."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.collision import arrays
from cvqmpt_lab.errors import InvalidProblemError
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import Attachment, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace

MARGIN = 1e-4  # [m] that planning keeps from obstacles
ENOUGH = Budget(iterations=20_000)


def with_block(problem, q, distance):
    """A block beside the hand at q, its centre this far off [m]."""
    T_world_block = problem.robot.pose(q) @ pose((0.0, distance, 0.03))
    block = SceneObject("block", Box((0.04,) * 3), T_world_block)
    return replace(problem, scene=problem.scene.with_objects(block))


def touching_distance(problem, q):
    """Smallest distance at which the block is free of the hand for coal, by bisection."""
    inside, outside = 0.05, 0.3
    for _ in range(40):
        middle = 0.5 * (inside + outside)
        touches = with_block(problem, q, middle).collision_checker().in_collision(q)
        inside, outside = (middle, outside) if touches else (inside, middle)
    return outside


@pytest.fixture(scope="module")
def tight(problem):
    """The place problem with a block half a planning margin beside the hand at the start."""
    touching = touching_distance(problem, problem.start)
    return with_block(problem, problem.start, touching + 0.5 * MARGIN)


def test_nothing_is_doubtful_in_ordinary_problems(problem):
    far = touching_distance(problem, problem.start) + 5.0 * MARGIN
    for roomy in (problem, with_block(problem, problem.start, far)):
        assert ConstrainedSpace(roomy).doubtful == ()


def test_a_start_closer_than_the_margin_is_doubtful_and_allowed(tight):
    assert 0.0 < tight.collision_checker().clearance(tight.start) < MARGIN
    space = ConstrainedSpace(tight)
    assert space.doubtful == space.unconstrained().doubtful == ("start",)
    assert space.valid(tight.start) and all(space.valid(goal) for goal in tight.goals)


def test_exact_checks_answer_near_it_only(tight):
    """A goal in the same place needs its own name; coal checks the start's neighbours."""
    space, exact = ConstrainedSpace(tight), tight.collision_checker()
    cautious = tight.collision_checker(MARGIN)
    rng = np.random.default_rng(0)
    near = tight.start + 1e-5 * rng.standard_normal((300, 7))
    expected = ~exact.in_collision_batch(near)
    assert (expected & cautious.in_collision_batch(near)).sum() > 50
    np.testing.assert_array_equal([space.valid(q) for q in near], expected)
    both = tight.changed(goals=np.array([*tight.goals[:2], tight.start]))
    assert ConstrainedSpace(both).doubtful == ("start", "goal 2")


def test_birrt_solves_from_a_doubtful_start_and_says_so(tight):
    space = ConstrainedSpace(tight)
    solution = solve(tight, "birrt", ENOUGH, seed=0)
    assert solution.plan.status is PlanStatus.SOLVED
    assert solution.plan.detail == "exact checks near start"
    assert solution.certificate.reasons == () and solution.solved
    assert certify(tight, solution.plan.path, clearance=False).valid
    assert space.checked_path(solution.simplified.path.states)[0] is not None


def test_what_touches_is_not_doubtful_but_refused(problem):
    blocked = with_block(problem, problem.start, touching_distance(problem, problem.start) - 1e-3)
    space = ConstrainedSpace(blocked)
    assert space.doubtful == () and not space.valid(blocked.start)
    told = r"start is in collision: .*block"
    refused(told, solve, blocked, "birrt", ENOUGH, seed=0, error=InvalidProblemError)


@pytest.mark.parametrize(
    ("shape", "x", "message"),
    [
        (Cylinder(3e5, 0.1), 0.0, r"attachment 'can' reaches 3e\+05 m, more than 20"),
        (Box((0.1,) * 3), 50.0, r"attachment 'can' reaches 50\.1 m, more than 20"),
        (Cylinder(5.0, 5.0), 0.0, r"'can' is .* 5 m large, too large to plan with: give sizes in"),
        (Box((15.0, 15.0, 0.01)), 0.0, r"attachment 'can' is 15 x 15 x .* m large"),
    ],
)
def test_what_is_too_large_to_carry_is_named_and_not_cut(panda, monkeypatch, shape, x, message):
    monkeypatch.setattr(arrays, "robot_geometry", lambda *given: pytest.fail("it was cut"))
    refused(message, arrays.robot_arrays, panda, (Attachment("can", shape, pose((x, 0.0, 0.0))),))
