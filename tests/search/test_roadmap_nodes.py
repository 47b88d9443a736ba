"""Roadmaps of any robot: nodes, edges, cache, and difficult robots and scenes."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.templates import problem_template
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.robot.source import ARMS
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, PointCloud, Sphere
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.portfolio import Portfolio
from cvqmpt_lab.search.result import Budget, PlanStatus
from cvqmpt_lab.search.roadmap import ROADMAP_NEIGHBOURS, ROADMAP_NODES, spread_roadmap
from cvqmpt_lab.search.space import ConstrainedSpace

EMPTY = Scene("empty", ())


def fresh(robot, attachments=(), **options):
    """Return a roadmap that is not taken from a cache."""
    return spread_roadmap.__wrapped__(robot, attachments, **options)


def chain(kinds, reach):
    """Return a URDF of joints in series, each with a box; reach: range of a joint [m or rad]."""
    text = '<robot name="chain"><link name="l0"/>'
    for j, kind in enumerate(kinds, start=1):
        axis = " ".join("1" if a == j % 3 else "0" for a in range(3))
        text += f"""<link name="l{j}"><collision><origin xyz="0 0 0.05"/>
            <geometry><box size="0.03 0.03 0.06"/></geometry></collision></link>
            <joint name="j{j}" type="{kind}"><parent link="l{j - 1}"/><child link="l{j}"/>
            <origin xyz="0 0 0.1"/><axis xyz="{axis}"/>
            <limit lower="{-reach}" upper="{reach}" velocity="1" effort="1"/></joint>"""
    return text + "</robot>"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "cvqmpt_lab" / "roadmaps"


@pytest.fixture(scope="module")
def ur5():
    """Return an arm whose joints have a range of two turns, and its roadmap."""
    robot = robot_from_source({"name": "ur5"})
    return robot, fresh(robot)


def test_nodes_and_the_motions_along_links_are_free_and_near(ur5):
    robot, roadmap = ur5
    middle = 0.5 * (robot.lower + robot.upper)
    space = ConstrainedSpace.of(PlanningProblem("bare", robot, EMPTY, middle, middle[None]))
    assert roadmap.nodes.shape == (ROADMAP_NODES, 6) and roadmap.neighbours.shape == (
        ROADMAP_NODES,
        ROADMAP_NEIGHBOURS,
    )
    assert space.valid_batch(roadmap.nodes).all()
    for i in np.random.default_rng(0).choice(ROADMAP_NODES, 40, replace=False):
        to = roadmap.neighbours[i][roadmap.neighbours[i] >= 0]
        way = roadmap.nodes[to] - roadmap.nodes[i]
        way -= 2.0 * np.pi * np.round(way / (2.0 * np.pi))
        assert space.valid_batch(roadmap.nodes[i] + 0.5 * way).mean() > 0.99
        assert (np.diff(np.linalg.norm(way, axis=1)) >= 0).all()
    assert not np.array_equal(fresh(robot, draw=1).nodes, roadmap.nodes)


def test_joints_that_turn_twice_get_nodes_near_the_turn_of_the_start(ur5, panda):
    (robot, roadmap), start = ur5, np.full(6, 4.0)
    near = roadmap.near(start, robot).nodes
    assert (near >= robot.lower).all() and (near <= robot.upper).all()
    # the mean is a quarter turn, and more if limits cut off a part of a turn
    assert np.abs(near - start).mean() < 2.0
    roadmap = fresh(panda)
    assert roadmap.near(np.zeros(7), panda) is roadmap


@pytest.mark.parametrize("spoilt", ["other robot", "colliding"])
def test_a_foreign_or_wrong_file_of_the_cache_is_made_anew(cache, slider_arm, spoilt):
    """tests/robot/test_loading has truncated files."""
    fresh(robot_from_source({"name": "ur3"}))
    (foreign,) = cache.iterdir()
    made = fresh(slider_arm)
    (kept,) = set(cache.iterdir()) - {foreign}
    if spoilt == "colliding":
        with kept.open("wb") as file:
            np.savez(file, nodes=np.full_like(made.nodes, np.nan), neighbours=made.neighbours)
    else:
        kept.write_bytes(foreign.read_bytes())
    again = fresh(slider_arm)
    np.testing.assert_array_equal(again.nodes, made.nodes)
    np.testing.assert_array_equal(again.neighbours, made.neighbours)


def test_a_full_cache_keeps_nothing_and_a_roadmap_is_made(cache, slider_arm, monkeypatch):
    def refused(*arguments, **named):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(np, "savez", refused)
        made = fresh(slider_arm)
    assert len(made.nodes) > 0 and not list(cache.iterdir())
    np.testing.assert_array_equal(fresh(slider_arm).nodes, made.nodes)
    assert len(list(cache.iterdir())) == 1


@pytest.mark.parametrize(
    "kinds", [("revolute",), ("prismatic",), ("prismatic",) * 3, ("revolute",) * 12], ids=len
)
def test_robots_of_one_slider_or_twelve_joints_have_a_roadmap(tmp_path, kinds):
    (tmp_path / "chain.urdf").write_text(chain(kinds, reach=1.0 if len(kinds) == 1 else 0.4))
    robot = load_robot(tmp_path / "chain.urdf", f"l{len(kinds)}")
    start = np.full(robot.dof, -0.3)
    problem = PlanningProblem("chain", robot, EMPTY, start, -start[None])
    solution = solve(problem, "roadmap", Budget(seconds=5.0), seed=0)
    assert solution.solved and not solution.plan.fallback


def test_a_load_larger_than_the_robot_leaves_no_nodes_and_birrt_plans(slider_arm):
    none = fresh(slider_arm, (Attachment("block", Box((0.9, 0.9, 0.9)), np.eye(4)),))
    assert len(none.nodes) == 0
    start, goal = fresh(slider_arm).nodes[:2]
    problem = PlanningProblem("few", slider_arm, EMPTY, start, goal[None])
    few = Method.simple("few", search=Portfolio(roadmap=none, name="few", first=0, straight=0))
    solution = solve(problem, few, Budget(seconds=2.0), seed=0)
    assert solution.solved and solution.plan.fallback == "birrt: 0 nodes are no roadmap"


def test_where_every_edge_is_blocked_birrt_searches_within_the_budget(problem):
    """Balls fill the arm's workspace, but start and goal are free."""
    problem = replace(problem, constraint=(), goals=problem.goals[:1])
    ends = np.stack([problem.start, problem.goals[0]])
    centres = np.random.default_rng(0).uniform((-0.7, -0.7, 0.0), (0.7, 0.7, 1.2), (500, 3))
    balls = (SceneObject(f"ball {c}", Sphere(0.05), pose(tuple(c))) for c in centres)
    alone = ((ball, replace(problem, scene=Scene("ball", (ball,)))) for ball in balls)
    kept = [ball for ball, one in alone if ConstrainedSpace.of(one).valid_batch(ends).all()]
    blocked = replace(problem, scene=Scene("balls", tuple(kept)))
    plan = solve(blocked, "roadmap", Budget(seconds=0.5), 0).plan
    assert plan.status is PlanStatus.TIMEOUT and plan.fallback.startswith("birrt around ")
    assert plan.seconds < 1.0


def test_a_new_scene_costs_nothing_and_a_cloud_may_have_a_million_points_or_be_left_out(problem):
    rng = np.random.default_rng(0)
    # close together: exact checks make a box of each occupied cell
    points = rng.uniform((0.4, -0.4, -0.3), (0.9, 0.4, -0.2), (10**6, 3))
    for count in (10**6, 1, 0):
        cloud = SceneObject("cloud", PointCloud(points[: max(count, 1)], 0.005), np.eye(4))
        seen = replace(problem, scene=Scene("cloud", (cloud,) if count else ()))
        solution = solve(seen, "roadmap", Budget(seconds=5.0), 0)
        assert solution.plan.status is PlanStatus.SOLVED and solution.plan.seconds < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_every_arm_plans_its_template_problem(name, request):
    if name in ("g1", "pr2", "talos", "tiago-dual") and not request.config.getoption("--long"):
        pytest.skip("two hands take 8 to 24 s each; baxter and tiago-pro have two, too")
    if robot_from_source({"name": name}).nothing_collides:
        told = "robot .*: none of the moving links has a collision body: --visual-as-collision"
        refused(told, problem_template, {"name": name})
        return
    problem = PlanningProblem.from_dict(problem_template({"name": name}))
    solution = solve(problem, "roadmap", Budget(seconds=10.0), seed=0)
    assert solution.solved
