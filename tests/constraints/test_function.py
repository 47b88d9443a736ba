"""Constraint functions of the user's own: planned, certified, read from files, refused."""

import json
import pickle
import sys
import time

import numba
import numpy as np
import own_constraints
import pytest
from own_constraints import bounded_circle, circle, on_circle
from refusals import refused

from cvqmpt_lab.base.modules import Code
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.cli.main import main
from cvqmpt_lab.constraints.function import FunctionConstraint, torch_constraint
from cvqmpt_lab.constraints.function_checks import check_function
from cvqmpt_lab.constraints.function_files import load_function
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import Budget, JointPath

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
GOAL = np.array([0.5, -0.785, 0.5, -2.356, 0.0, 1.571, 0.785])


@numba.njit
def compiled_circle(q):
    return np.array([q[0] ** 2 + (q[2] - 0.5) ** 2 - 0.25])


@numba.njit
def first_joint(q, out):
    out[0] = q[0]


@pytest.fixture(scope="module")
def around_the_pole(panda):
    """Return a problem with a thin wall between the two sides of the circle."""
    pole = SceneObject("pole", Box((0.05, 0.05, 1.2)), pose((0.45, 0.3, 0.6)))
    return PlanningProblem(
        "around", panda, Scene("pole", (pole,)), HOME, GOAL[None], constraint=(circle,)
    )


PLANNERS = "birrt roadmap cells ompl-projected atlas-rrt tb-rrt mpnet cvq-mpt opt-cvq-mpt"


@pytest.mark.parametrize("name", PLANNERS.split())
def test_every_planner_keeps_a_function(around_the_pole, name):
    found = solve(around_the_pole, name, Budget(seconds=30.0), seed=0)
    assert found.solved, found.report(name)
    assert np.abs(on_circle(found.path.spaced(0.01))).max() < 5e-4
    said = str(found.report(name))
    states = found.certificate.constraint_states
    assert f"constraint checked at {states} states, not proven between" in said and states > 100
    assert "not proven between" in found.verdict
    assert "µs a call; Jacobian by central differences" in said


def test_goals_of_a_region_keep_a_function_beside_a_region(panda, around_the_pole):
    level = TaskSpaceRegion(
        panda.pose(GOAL), np.eye(4), np.array([[-0.1, 0.1]] * 3 + [[-0.5, 0.5]] * 3)
    )
    problem = around_the_pole.changed(goals=np.empty((0, 7)), goal_region=level)
    found = solve(problem, "birrt", Budget(seconds=30.0), seed=0)
    assert found.solved and np.abs(on_circle(found.goals)).max() <= 1e-4


def test_with_a_bound_a_function_is_proven_between_states(around_the_pole):
    states = solve(around_the_pole, "birrt", Budget(seconds=30.0), seed=0).path.states
    proven = around_the_pole.changed(constraint=(bounded_circle(),))
    certificate = certify(proven, JointPath(states))
    assert certificate.valid and not certificate.constraint_gap
    # states 0.1 rad apart on a straight line leave the circle in between
    angles = np.linspace(-np.pi / 2, 0.0, 9)
    coarse = np.repeat(HOME[None], 9, axis=0)
    coarse[:, [0, 2]] = np.column_stack([np.cos(angles), 1.0 + np.sin(angles)]) * 0.5
    for problem in (proven, around_the_pole):
        certificate = certify(problem, JointPath(coarse))
        assert any("off the constraint circle" in text for text in certificate.reasons)


def test_compiled_and_torch_functions_are_the_python_function(panda):
    torch_circle = torch_constraint(1, on_circle, name="circle")
    assert torch_circle.code.count("def on_circle") == 2  # F and its Jacobian
    compiled = FunctionConstraint(1, compiled_circle)
    draws = panda.random_configurations(np.random.default_rng(0), 20)
    for own in (torch_circle, compiled):
        check_function(own, panda, HOME)
        np.testing.assert_allclose(own.residual(draws), on_circle(draws), atol=1e-12)
        np.testing.assert_allclose(own.jacobian(draws), circle.jacobian(draws), atol=1e-8)
        np.testing.assert_allclose(own.jacobian(draws[0]), circle.jacobian(draws[0]), atol=1e-8)
        manifolds = [RegionConstraint(panda, (one,)) for one in (circle, own)]
        for q in draws:
            np.testing.assert_allclose(*(each.project(q) for each in manifolds), atol=1e-7)


def test_a_function_is_known_by_its_source():
    def other(q):
        return on_circle(q) + 0.0

    own = {}
    for text in ("q[:1]", "q[1:2]"):
        exec(f"def F(q): return {text}", own)
        own[text] = FunctionConstraint(1, own["F"]).code
    codes = [FunctionConstraint(1, one).code for one in (on_circle, other, compiled_circle)]
    assert len({*codes, own["q[:1]"], own["q[1:2]"]}) == 5
    assert codes[0] == pickle.loads(pickle.dumps(FunctionConstraint(1, on_circle))).code
    assert codes[0].startswith("own_constraints:on_circle\ndef on_circle(q):")


def test_without_a_jacobian_a_projection_calls_python_hardly_more_often_than_it_steps(panda):
    calls = []

    def counted(q):
        calls.append(len(np.atleast_2d(q)))
        return on_circle(q)

    one_by_one = FunctionConstraint(1, lambda q: on_circle(q.reshape(7)))
    own = pickle.loads(pickle.dumps(circle))
    own._function = counted
    for q in panda.random_configurations(np.random.default_rng(0), 20):
        end = RegionConstraint(panda, (own,)).project(q)
        np.testing.assert_allclose(end, RegionConstraint(panda, (one_by_one,)).project(q))
    # 98 Newton steps; F alone at both ends of a projection, else with 14 states around it
    assert calls.count(15) <= 100 and calls.count(1) <= 42 + 2


def test_the_certificate_evaluates_the_python_function_of_a_compiled_one(around_the_pole):
    lying = FunctionConstraint(1, first_joint)
    assert lying.own_residual(HOME) == lying.residual(HOME)
    lying.own_residual = lambda q: np.ones((len(q), 1))
    problem = around_the_pole.changed(constraint=(lying,))
    reasons = certify(problem, JointPath(np.array([HOME, HOME]))).reasons
    assert any("off the constraint" in text for text in reasons)


def put(q):
    q[0] = 0.0
    return q[:1]


def at_random(q):
    raise ValueError("no manifold")


def talking(q):
    sys.stdout.write("here")
    return q[..., :1]


BAD = {
    "F has 7 entries and panda 7 joints": FunctionConstraint(7, lambda q: q),
    r"has shape \(2,\); needed: \(1,\)": FunctionConstraint(1, lambda q: q[:2]),
    "F is not finite at": FunctionConstraint(1, lambda q: q[..., :1] * np.nan),
    "not differentiable at the start: its slopes along joint 0 are -1 and 1": FunctionConstraint(
        1, lambda q: np.abs(q[..., :1])
    ),
    "no full rank at any of 21 states; its singular values": FunctionConstraint(
        2, lambda q: q[..., [0, 0]]
    ),
    "differs from central differences by 1 at": FunctionConstraint(
        1, lambda q: q[..., :1], lambda q: np.eye(7)[:1] * 2.0
    ),
    "bound 0.5 is too small: F changes by 1 per rad or m at": FunctionConstraint(
        1, lambda q: q[..., :1], bound=0.5
    ),
    "between two states is too small: F exceeds both ends by": FunctionConstraint(
        1, lambda q: np.cos(9.0 * q[..., :1]), bound=lambda a, b: 0.0
    ),
    "bound raises ZeroDivisionError: division by zero; it takes two states": FunctionConstraint(
        1, lambda q: q[..., :1], bound=lambda a, b: 1 / 0
    ),
    "its Jacobian raises ValueError: no manifold": FunctionConstraint(
        1, lambda q: q[..., :1], at_random
    ),
    "F is not finite at .0, -0.785": FunctionConstraint(1, lambda q: q[..., :1] / q[..., :1]),
    "F raises ValueError: no manifold": FunctionConstraint(1, at_random),
    "F raises TypeError: complex numbers": FunctionConstraint(1, lambda q: q[..., :1] + 1j),
    "prints 'here'": FunctionConstraint(1, talking),
    "changes its argument": FunctionConstraint(1, put),
}


@pytest.mark.parametrize("message", BAD)
def test_a_function_that_planning_cannot_use_is_refused(panda, message):
    refused(message, check_function, BAD[message], panda, HOME)


def test_a_function_that_blocks_is_refused(panda, monkeypatch):
    from cvqmpt_lab.constraints import function_checks

    blocking = FunctionConstraint(1, lambda q: time.sleep(2.0))
    refused(
        "does not return within 0.05 s",
        function_checks._first_call,
        blocking,
        "constraint F",
        HOME,
        0.05,
    )


def test_problem_files_name_functions_which_run_only_where_that_is_allowed(
    around_the_pole, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(Code, "allowed", False)
    own = load_function("own_constraints:bounded_circle", {"bound": 30.0})
    again = pickle.loads(pickle.dumps(own))
    assert again.bound == 30.0 and again.describe() == own.describe()
    file = tmp_path / "around.json"
    around_the_pole.changed(constraint=(own,)).save(file)
    assert json.loads(file.read_text())["constraint"] == [
        {"function": "own_constraints:bounded_circle", "bound": 30.0}
    ]
    path = tmp_path / "path.csv"
    plan = ["plan", str(file), "--planner", "birrt", "--margin", "0,0"]
    assert main(plan) == 2 and "--allow-code if you trust" in capsys.readouterr().err
    assert main([*plan, "--allow-code", "--save", str(path)]) == 0
    assert "certified (" in capsys.readouterr().out
    monkeypatch.setattr(Code, "allowed", False)
    around_the_pole.changed(constraint=()).save(file)
    certify_it = ["certify", str(path), str(file), "--constraint", "own_constraints:circle"]
    assert main(certify_it) == 0
    assert "not proven between" in capsys.readouterr().out
    for address, told in {
        "own_constraints:square": "unknown.*circle",
        "no_such:F": "there is no module 'no_such'",
        "own_constraints:on_circle": "missing a required argument: 'q'",
    }.items():
        refused(told, load_function, address)
    assert own_constraints.circle is circle


def test_a_folder_of_problems_that_name_functions_is_reproduced_where_that_is_allowed(
    around_the_pole, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(Code, "allowed", False)
    own = load_function("own_constraints:circle")
    folder, out = tmp_path / "own", str(tmp_path / "out")
    folder.mkdir()
    around_the_pole.changed(constraint=(own,)).save(folder / "around.json")
    few = ["--planners", "birrt", "--iterations", "20000", "--jobs", "1"]
    words = ["reproduce", str(folder), *few, "--out", out]
    assert main(words) == 2 and "--allow-code if you trust" in capsys.readouterr().err
    assert main([*words, "--allow-code"]) == 0
    assert main(["certify", out, str(folder), "--allow-code"]) == 0
    assert "1 paths, 1 certified" in capsys.readouterr().out
    monkeypatch.setattr(Code, "allowed", False)
    guard = ["check-tables", str(folder), "--jobs", "1"]
    assert main([*guard, "--update", "--planners", "birrt"]) == 2
    assert main([*guard, "--update", "--planners", "birrt", "--allow-code"]) == 0
    assert main([*guard, "--allow-code"]) == 0
