"""Planners: certified paths, repeatability, budgets, exceptions; checks that disagree."""

import gc
import time
import weakref
from dataclasses import astuple, replace
from itertools import pairwise

import numpy as np
import pytest
from process_memory import in_use
from refusals import refused

from cvqmpt_lab.base.errors import CvqmptError, InvalidProblemError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.passages import maze_problem
from cvqmpt_lab.benchmarks.results.store import states_hash
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.collision import arrays
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
from cvqmpt_lab.planning.planners import PLANNERS, planner_named
from cvqmpt_lab.scene.scene import Attachment, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder
from cvqmpt_lab.search.birrt import DRAW_MODES, BiRRT, GrowingTrees, enlarged_trees, grow, plant
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.ompl_planners import OMPL_STATE_SPACES, OmplSearch
from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal, Query, Uniform
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace, Tolerances

# these may fail: their time or number of rollouts is limited
LENIENT = dict.fromkeys(("atlas-rrt", "tb-rrt", "ompl-bkpiece"), PlanStatus.TIMEOUT)
LENIENT |= dict.fromkeys(("mpnet", "ompl-mpnet"), PlanStatus.ITERATION_LIMIT)
# one goal after the other: each gets a limit
LENIENT |= dict.fromkeys(("ompl-uniform", "ompl-opt-cvq-dense"), PlanStatus.COST_LIMIT)
OURS = ("birrt", "guided-birrt")
ENOUGH = Budget(iterations=20_000)


def plan(problem, method, budget, seed=0, backend="compiled"):
    """Return the result of the search of a method, which is given by name or object."""
    return solve(problem, method, budget, seed, backend=backend).plan


def sampling(distribution):
    """Return `birrt` with a given sampling distribution."""
    return Method.simple("birrt", predict=lambda query, observation: Proposal(distribution))


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_solves_a_place_problem(problem, name):
    plan(problem, name, Budget(iterations=1))  # compiles what is not cached
    solution = solve(problem, planner_named(name), Budget(seconds=20.0), seed=1)
    result = solution.plan
    assert result.seconds < 25.0 and result.vertices > 0 and "exact checks" not in result.detail
    if result.path is None:
        assert result.status is LENIENT[name]
        assert solution.simplified is None and solution.certificate is None and not solution.solved
        return
    # projections to iterations; other counts are zero without a tree and without clearances
    assert result.status is PlanStatus.SOLVED and min(astuple(result.counters)[:4]) > 0
    assert solution.certificate.reasons == () and solution.solved
    # not simplified
    assert name in LENIENT or certify(problem, result.path).reasons == ()
    np.testing.assert_array_equal(result.path.states[0], problem.start)
    assert (problem.goals == result.path.states[-1]).all(axis=1).any()


def test_backends_find_the_same_path(problem):
    """If coal and the kernels agree on every state, the path is the same.

    Only the number of checks differs: known distances clear parts of a motion at once.
    """
    compiled = plan(problem, "birrt", ENOUGH)
    exact = plan(problem, "birrt", ENOUGH, backend="exact")
    assert states_hash(compiled.path.states) == states_hash(exact.path.states)
    assert compiled.counters.projections == exact.counters.projections
    assert compiled.counters.state_checks < exact.counters.state_checks


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize(
    ("seconds", "iterations"), [(None, 1), (1e-9, None), (1e-9, 1000), (1000.0, 1)]
)
def test_spent_budgets_are_named_and_give_no_path(problem, name, seconds, iterations):
    status = PlanStatus.TIMEOUT if seconds == 1e-9 else PlanStatus.ITERATION_LIMIT
    result = plan(problem, name, Budget(seconds=seconds, iterations=iterations), seed=1)
    assert result.status is status and result.path is None
    if name in ("birrt", "ompl-projected") and status is PlanStatus.ITERATION_LIMIT:
        assert result.counters.iterations == 1


def test_unknown_settings_of_the_tree_search_are_refused():
    choices = "draws of a tree search 'some'; valid choices: raw, projected, free"
    refused(choices, BiRRT, draws="some", error=CvqmptError)
    for reach in (0.0, float("nan")):
        refused(f"reach {reach}: give the longest extension", BiRRT, reach=reach)


def searched(problem, space, budget, distribution=None, goals=None, **settings):
    """Return the result of the tree search, by default with uniform samples."""
    rng = np.random.default_rng(0)
    distribution = distribution or Uniform(problem.robot.lower, problem.robot.upper)
    goals = problem.goals if goals is None else goals
    query = Query.of(space, problem.start, goals, budget, rng)
    return BiRRT(**settings).search(query, distribution)


def test_trees_that_never_meet_do_not_fill_the_memory(problem):
    trees = plant(problem.start, problem.goals, 4096)
    assert enlarged_trees(trees).nodes.shape[1] == 2 * trees.nodes.shape[1]
    with pytest.raises(MemoryError, match=r"21 nodes, which have not met, .* a smaller cutoff"):
        enlarged_trees(trees, trees.nodes.nbytes)


def test_trees_are_enlarged_when_full(problem):
    """Steps of 2 mrad need more nodes than the initial capacity of 4096."""
    space = ConstrainedSpace.of(problem, tolerances=Tolerances(step=0.002))
    result = searched(problem, space, ENOUGH, step=0.002)
    sizes = [len(tree.nodes) for tree in result.trees]
    assert max(sizes) > 4096 and sum(sizes) == result.vertices
    assert certify(problem, result.path).valid


@pytest.mark.parametrize("backend", ["compiled", "exact"])
def test_a_budget_in_seconds_is_kept_to_a_tenth_of_a_second(problem, backend):
    """A search without a solution: obstacles enclose the goal."""
    uniform = Uniform(problem.robot.lower, problem.robot.lower + 0.3)
    how = {"goals": problem.goals[:1] + 1e-3, "reach": 0.2}
    space = ConstrainedSpace.of(problem, backend)
    for _ in range(3):  # a search may have waited for a busy machine
        began = time.perf_counter()
        result = searched(problem, space, Budget(seconds=0.5), uniform, **how)
        took = time.perf_counter() - began
        assert result.status is PlanStatus.TIMEOUT and result.counters.iterations > 0
        if took < 0.6:
            break
    assert took < 0.6


def test_any_distribution_is_sampled_and_named_and_its_samples_clipped(problem, solution):
    means = solution.path.states[::20]
    uniform = Uniform(problem.robot.lower, problem.robot.upper)
    guide = GaussianMixture.equal(means, 0.05 * np.eye(7), uniform, 0.1, "gaussian-mixture")
    result = plan(problem, sampling(guide), ENOUGH)
    assert result.status is PlanStatus.SOLVED and result.sampler == "gaussian-mixture"
    assert plan(problem, "birrt", Budget(iterations=1)).sampler == "uniform"
    outside = Uniform(np.full(7, -9.0), np.full(7, 9.0), "outside")
    result = plan(problem, sampling(outside), ENOUGH, seed=1)
    assert result.sampler == "outside" and certify(problem, result.path).valid


def test_extensions_are_counted_by_their_ends(problem):
    """Extensions of one step add one node each; of longer ones there are far fewer than nodes."""
    roots = 1 + len(problem.goals)
    result = searched(problem, ConstrainedSpace.of(problem), Budget(iterations=40), step=100.0)
    assert result.counters.extensions == result.vertices - roots > 0
    result = searched(problem, ConstrainedSpace.of(problem), Budget(iterations=40))
    assert 0 < 3 * result.counters.extensions < result.vertices - roots
    result = plan(problem, "ompl-projected", ENOUGH)
    assert 1 <= result.vertices - result.counters.extensions - 1 <= len(problem.goals)


@pytest.mark.parametrize("draws", ["raw", "projected", "free"])
def test_trees_extend_towards_what_is_made_of_draws(problem, draws):
    """Raw samples are unchanged; projected ones have F(q) = 0; "free" ones are also free."""
    space = ConstrainedSpace.of(problem)
    trees = plant(problem.start, problem.goals, 4096)
    drawn = Uniform(problem.robot.lower, problem.robot.upper).sample(np.random.default_rng(0), 60)
    made = drawn.copy()
    before = space.counters
    _, used_to, used = grow(space.arrays, trees, made, 0, 0.2, DRAW_MODES[draws])
    off = np.linalg.norm(problem.manifold.residual(made[:used_to]), axis=1)
    free = space.valid_batch(made[:used_to])
    assert space.counters.iterations - before.iterations == used_to
    counted = space.counters_since(before)
    projected = counted.draw_projections, counted.draw_newton_iterations
    if draws == "raw":
        assert used == used_to and (made == drawn).all() and off.min() > 0.01
        assert projected == (0, 0)
    else:
        for q in drawn[:used_to].copy():
            space.project(q)
        alone = space.counters_since(before)
        steps = alone.newton_iterations - counted.newton_iterations
        assert projected == (alone.projections - counted.projections, steps) and steps > used_to
        assert (off < 1e-3).sum() >= used > 0
        usable = (off < 1e-3) & (free | (draws == "projected"))
        assert usable.sum() == used


def test_draws_that_never_reach_the_constraint_end_with_that_reason(problem):
    """A constraint a kilometre away: no sample can be projected onto it."""
    region = TaskSpaceRegion(pose((1000.0, 0.0, 0.0)), np.eye(4), np.zeros((6, 2)))
    space = ConstrainedSpace.of(problem.changed(constraint=(region,)))
    result = searched(problem, space, Budget(iterations=50))
    assert result.status is PlanStatus.ITERATION_LIMIT and result.counters.iterations == 50
    assert result.detail == "none of 50 draws reached the constraint"


def test_without_a_constraint(problem):
    free = replace(problem, constraint=())
    solution = solve(free, "birrt", ENOUGH, seed=0)
    assert solution.solved and solution.plan.counters.projections == 0
    for name in ("ompl-projected", "atlas-rrt", "tb-rrt"):
        solutions = [solve(free, name, ENOUGH, seed=0) for _ in range(2)]
        assert all(found.solved and found.plan.sampler == "uniform" for found in solutions)
        assert np.array_equal(*(found.plan.path.states for found in solutions))


@pytest.mark.parametrize("name", PLANNERS)
def test_a_start_that_is_a_goal_is_solved(problem, name):
    there = replace(problem, goals=problem.start[None], goal_region=None)
    budget, optimize = Budget(seconds=10.0), Budget(seconds=0.02)
    solution = solve(there, planner_named(name), budget, seed=0, optimize=optimize)
    assert solution.solved and solution.path.length == 0.0 and solution.improvement is None


class Broken(CollisionChecker):
    """A real checker that raises at the hundredth call."""

    asked = 0

    def in_collision(self, q):
        self.asked += 1
        if self.asked == 100:
            raise KeyboardInterrupt("at question 100")
        return super().in_collision(q)


@pytest.mark.parametrize("name", PLANNERS)
def test_exceptions_in_state_checks_come_out(problem, name, monkeypatch):
    def broken(world, margin=0.0):
        return Broken(world.robot, world.scene, world.attachments, margin)

    monkeypatch.setattr(World, "checker", broken)
    with pytest.raises(KeyboardInterrupt, match="question 100"):
        plan(problem, name, Budget(seconds=20.0), seed=1, backend="exact")


@pytest.mark.parametrize("manifold", OMPL_STATE_SPACES)
def test_ompl_keeps_nothing_of_a_run(problem, manifold):
    """A cycle through OMPL's objects, unseen by Python's collector, would stay for ever.

    The binding frees no state that Python allocates: 96 bytes each, 2 kB a run of 20 goals.
    """
    space, goals = ConstrainedSpace.of(problem), np.repeat(problem.goals[:1], 100, axis=0)
    search, rng = OmplSearch(manifold), np.random.default_rng(0)

    def run_nine_times(space):
        for _ in range(9):
            query = Query.of(space, problem.start, goals, Budget(iterations=1), rng)
            search.search(query, None)

    run_nine_times(space)
    before = in_use()
    run_nine_times(space)
    assert in_use() - before < 9 * 2000
    kept = weakref.ref(space)
    del space
    gc.collect()
    assert kept() is None


def test_checked_path_names_the_bad_segment(problem, solution):
    space, states = ConstrainedSpace.of(problem), solution.path.states
    good, bad = space.checked_path(states)
    assert bad == -1 and good.length == pytest.approx(solution.path.length, rel=1e-3)
    through_the_kitchen = np.array([*states[:5], problem.goals[3], *states[5:]])
    assert space.checked_path(through_the_kitchen) == (None, 4)


MARGIN = 1e-4  # [m] that planning keeps from obstacles


@pytest.fixture(scope="module")
def maze():
    return with_drawn_goals(maze_problem(0.06, 3))


def proofs(monkeypatch):
    """Record the rows of all motions that are proven."""
    found, checked_path = [], ConstrainedSpace.checked_path

    def recorded(space, states, proven=None, middle=None):
        proven = np.zeros(len(states) - 1, dtype=bool) if proven is None else proven
        before = proven.copy()
        path = checked_path(space, states, proven, middle)
        rows = zip(pairwise(states), proven & ~before, strict=True)
        found.extend(np.hstack(pair).tobytes() for pair, new in rows if new)
        return path

    monkeypatch.setattr(ConstrainedSpace, "checked_path", recorded)
    return found


@pytest.mark.parametrize("name", ["birrt", "cells", "roadmap"])
def test_no_motion_is_proven_twice(maze, name, monkeypatch):
    proven = proofs(monkeypatch)
    plan(maze, name, ENOUGH)
    # two nodes may hold the same state
    assert len(set(proven)) >= 0.99 * len(proven)
    assert (len(proven) == 0) == (name == "cells")  # which proves motions when it makes them


def test_proven_motions_pass_the_check_again(maze):
    """Also those of paths that failed, of which only a part is proven."""
    space = ConstrainedSpace.of(maze)
    query = Query.of(space, maze.start, maze.goals, ENOUGH, np.random.default_rng(1))
    growth = GrowingTrees(BiRRT(), query, query.uniform)
    growth.grow(query.deadline)
    trees = growth.trees
    tree, node = np.nonzero(trees.proven)
    assert len(node) > 20
    for which, child in zip(tree, node, strict=True):
        pair = trees.nodes[which, [trees.parent[which, child], child]]
        assert np.abs(pair).max() > 1e5 or space.checked_path(pair)[0] is not None


def test_a_path_with_proven_motions_is_the_path_of_a_full_check(problem, solution):
    space = ConstrainedSpace.of(problem)
    states = solution.plan.path.states[::3]
    whole, _ = space.checked_path(states)
    proven = np.zeros(len(states) - 1, dtype=bool)
    proven[1::2] = True
    checks = space.counters.state_checks
    parts, bad = space.checked_path(states, proven)
    assert bad == -1 and proven.all() and space.counters.state_checks > checks
    np.testing.assert_array_equal(whole.states, parts.states)
    checks = space.counters.state_checks
    np.testing.assert_array_equal(space.checked_path(states, proven)[0].states, whole.states)
    assert space.counters.state_checks == checks


def with_block(problem, q, distance):
    """Return a block beside the hand at q, with its centre at this distance [m]."""
    T_world_block = problem.robot.pose(q) @ pose((0.0, distance, 0.03))
    block = SceneObject("block", Box((0.04,) * 3), T_world_block)
    return replace(problem, scene=problem.scene.with_objects(block))


def touching_distance(problem, q):
    """Return the smallest distance at which block and hand do not collide by coal; by bisection."""
    inside, outside = 0.05, 0.3
    for _ in range(40):
        middle = 0.5 * (inside + outside)
        touches = with_block(problem, q, middle).collision_checker().in_collision(q)
        inside, outside = (middle, outside) if touches else (inside, middle)
    return outside


@pytest.fixture(scope="module")
def tight(problem):
    """Return the place problem with a block half a planning margin from the hand at the start."""
    touching = touching_distance(problem, problem.start)
    return with_block(problem, problem.start, touching + 0.5 * MARGIN)


def test_a_start_closer_than_the_margin_is_doubtful_and_allowed(problem, tight):
    assert 0.0 < tight.collision_checker().clearance(tight.start) < MARGIN
    space = ConstrainedSpace.of(tight)
    assert space.doubtful == space.unconstrained().doubtful == ("start",)
    assert space.valid(tight.start) and all(space.valid(goal) for goal in tight.goals)
    far = touching_distance(problem, problem.start) + 5.0 * MARGIN
    for roomy in (problem, with_block(problem, problem.start, far)):
        assert ConstrainedSpace.of(roomy).doubtful == ()


def test_exact_checks_answer_near_it_only(tight):
    """A goal with the same problem is listed separately; coal checks states near the start."""
    space, exact = ConstrainedSpace.of(tight), tight.collision_checker()
    cautious = tight.collision_checker(MARGIN)
    rng = np.random.default_rng(0)
    near = tight.start + 1e-5 * rng.standard_normal((300, 7))
    expected = ~exact.in_collision_batch(near)
    assert (expected & cautious.in_collision_batch(near)).sum() > 50
    np.testing.assert_array_equal([space.valid(q) for q in near], expected)
    both = tight.changed(goals=np.array([*tight.goals[:2], tight.start]))
    assert ConstrainedSpace.of(both).doubtful == ("start", "goal 2")


def test_birrt_solves_from_a_doubtful_start_and_says_so(tight):
    space = ConstrainedSpace.of(tight)
    solution = solve(tight, "birrt", ENOUGH, seed=0)
    assert solution.plan.status is PlanStatus.SOLVED
    assert solution.plan.detail == "exact checks near start"
    assert solution.certificate.reasons == () and solution.solved
    assert certify(tight, solution.plan.path).valid
    assert space.checked_path(solution.path.states)[0] is not None


def test_what_touches_is_not_doubtful_but_refused(problem):
    blocked = with_block(problem, problem.start, touching_distance(problem, problem.start) - 1e-3)
    space = ConstrainedSpace.of(blocked)
    assert space.doubtful == () and not space.valid(blocked.start)
    told = r"start is in collision: .*block"
    refused(told, solve, blocked, "birrt", ENOUGH, seed=0, error=InvalidProblemError)


def test_what_is_too_large_to_carry_is_named_and_not_cut(panda, monkeypatch):
    monkeypatch.setattr(arrays, "robot_geometry", lambda *given: pytest.fail("it was cut"))
    for shape, x, message in (
        (Cylinder(3e5, 0.1), 0.0, r"attachment 'can' reaches 3e\+05 m, more than 20"),
        (Box((0.1,) * 3), 50.0, r"attachment 'can' reaches 50\.1 m, more than 20"),
        (Cylinder(5.0, 5.0), 0.0, r"'can' is .* 5 m large, too large to plan with: give sizes in"),
        (Box((15.0, 15.0, 0.01)), 0.0, r"attachment 'can' is 15 x 15 x .* m large"),
    ):
        can = Attachment("can", shape, pose((x, 0.0, 0.0)))
        refused(message, arrays.robot_arrays, panda, (can,))
