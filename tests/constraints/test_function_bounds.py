"""Functions of the user's own with bounds on F, and bounds between states that bound nothing."""

import numba
import numpy as np
import pytest
from own_constraints import circle
from refusals import refused

from cvqmpt_lab.certificate.certificate import FaultKind, certify
from cvqmpt_lab.cli.main import main
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.constraints.function import FunctionConstraint, differences
from cvqmpt_lab.constraints.function_checks import check_function
from cvqmpt_lab.constraints.function_files import function_given, load_function
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget, JointPath

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
EMPTY = Scene("empty", ())


def wave(q):
    """0 where joint 1 is 0 and 0.1, and 0.01 half way between."""
    return 0.01 * np.sin(np.pi * q[..., 0:1] / 0.1) ** 2 + 0.1 * q[..., 2:3]


def first(q):
    return q[..., :1]


def motion(robot, function, end, start=HOME):
    """Return a problem from the start to an end, and the straight motion."""
    problem = PlanningProblem("m", robot, EMPTY, start, end[None], constraint=(function,))
    return problem, JointPath(np.array([start, end]))


def still(value):
    """Return a bound that has the value where joint 4 stands still, and else a true bound."""
    return lambda a, b: value if a[3] == b[3] and a[0] == 0.0 and b[0] == 0.1 else 10.0


@pytest.mark.parametrize(
    "value",
    [np.nan, np.inf, -np.inf, -1e-3, None, "0", True, 1j, [0.0, 0.0], np.array([])],
    ids=repr,
)
def test_a_bound_that_bounds_nothing_is_refused_where_it_is_read(panda, value):
    function = FunctionConstraint(1, wave, bound=still(value), name="wave")
    end = HOME.copy()
    end[0] = 0.1
    refused("constraint wave: bound (is|raises)", motion, panda, function, end)
    # also where no check before the plan has read it
    function.accepted.add((panda.kinematics_digest, HOME.tobytes()))
    problem, path = motion(panda, function, end)
    refused("constraint wave: bound (is|raises)", certify, problem, path)
    refused("constraint wave: bound (is|raises)", problem.manifold.bound_between, path.states)


@pytest.mark.parametrize("bound", [np.nan, 0.0, -1.0, np.inf, "1", True, 1j, np.float32(-1.0)])
def test_a_lipschitz_constant_that_bounds_nothing_is_refused(bound):
    refused("bound is .*; give a Lipschitz", FunctionConstraint, 1, first, bound=bound)


def test_a_lipschitz_constant_of_any_number_type_is_compared_with_slopes(panda):
    steep = FunctionConstraint(1, lambda q: 9.0 * first(q), bound=np.float32(2.0))
    refused("bound 2 is too small", check_function, steep, panda, HOME)


class Own(Constraint):
    """A constraint class of a user, whose answers a test chooses."""

    dim = 1
    F = staticmethod(first)
    between = staticmethod(lambda states: np.full(len(states) - 1, 1e-6))

    def residual(self, q):
        return self.F(q)

    def jacobian(self, q):
        return np.broadcast_to(np.eye(7)[:1], (*np.shape(q)[:-1], 1, 7))

    def describe(self):
        return "own = 0"

    def bound_between(self, states):
        return self.between(states)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"between": lambda q: np.full(len(q) - 1, np.nan)}, "bound_between is nan from"),
        ({"between": lambda q: np.full(len(q) - 1, -1.0)}, "bound_between is -1 from"),
        ({"between": lambda q: np.zeros(1)}, r"bound_between has shape \(1,\)"),
        (
            {"between": lambda q: 1j * np.ones(len(q) - 1)},
            "bound_between raises .*complex numbers are",
        ),
        ({"between": lambda q: ["1"] * (len(q) - 1)}, "bound_between raises .*type <U1 are"),
        ({"between": lambda q: [None] * (len(q) - 1)}, "bound_between raises .*None.* is returned"),
        ({"between": lambda q: 1 // 0}, "bound_between raises ZeroDivisionError"),
        ({"between": lambda q: [[0.0], []]}, "bound_between raises .*inhomogeneous"),
        ({"F": lambda q: np.zeros((len(q), 2))}, r"shape \(.*, 2\); needed: \(.*, 1\)"),
        ({"F": lambda q: 0j * first(q)}, "F: complex numbers are returned"),
        ({"F": lambda q: first(q) > 9.0}, "F: True or False are returned"),
    ],
)
def test_answers_of_a_class_of_the_user_are_checked_by_the_certificate(panda, answer, message):
    own = Own()
    end = HOME.copy()
    end[1] += 0.3
    vars(own).update(answer)
    problem, path = motion(panda, own, end)
    refused(message, certify, problem, path)


def test_what_is_no_real_number_stops_planning_too(panda):
    """Beyond joint 1 at 0.2 F is complex, where no check before the plan has evaluated it."""
    calls = []

    def own(q):
        calls.append(q)
        return q[:1] + (1j if len(calls) > 3 else 0.0)

    manifold = RegionConstraint(panda, (FunctionConstraint(1, own, lambda q: np.eye(7)[:1]),))
    with pytest.raises(Exception, match="complex numbers are returned"):
        for _ in range(5):
            manifold.project(HOME + 0.3)


def test_a_compiled_function_that_leaves_out_an_entry_is_refused(panda):
    @numba.njit
    def half(q, out):
        out[0] = q[0]

    refused("F is not finite", check_function, FunctionConstraint(2, half), panda, HOME)


# ---------------------------------------------------------------- lower <= F <= upper


def heights(robot):
    """Return the height of the hand as a function of q (n,) or (b, n)."""

    def height(q):
        z = robot.poses(np.atleast_2d(q))[:, 2, 3]
        return z[:, None] if np.ndim(q) == 2 else z

    return height


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_a_function_with_bounds_is_planned_and_proven(name):
    robot = robot_from_source({"name": name})
    height = heights(robot)
    start = {"panda": HOME, "ur5": np.array([0.0, -1.2, 1.0, 0.3, 0.5, 0.0])}[name]
    z = float(height(start)[0])
    goal = start.copy()
    goal[0] += 0.8
    goal[1] += 0.15
    low = min(z, float(height(goal)[0])) - 0.002
    above = FunctionConstraint(1, height, bound=2.0, lower=low, name="height", units="m")
    assert above.describe() == f"height >= {low:g} (1 entry [m])"
    problem = PlanningProblem("up", robot, EMPTY, start, goal[None], constraint=(above,))
    found = solve(problem, "birrt", Budget(seconds=30.0), seed=0)
    assert found.solved and not found.certificate.constraint_gap
    assert height(found.path.spaced(0.005)).min() >= low - 5e-4


def test_a_path_below_the_bound_is_refused_by_the_distance_itself(panda):
    """The hand is 20 mm too low half way; of the square, the tolerance would be 22 mm."""
    height = heights(panda)
    start, end = HOME - 0.05 * np.eye(7)[3], HOME + 0.05 * np.eye(7)[3]
    least = float(height(np.array([start, end])).max()) + 0.0002
    ends = {"lower": least - 0.0004, "name": "height", "units": "m"}
    for fields in ({}, {"bound": 2.0}):
        problem, path = motion(panda, FunctionConstraint(1, height, **fields, **ends), end, start)
        certificate = certify(problem, path)
        assert {fault.kind for fault in certificate.faults} >= {FaultKind.MANIFOLD}
        assert f"height >= {ends['lower']:g} (1 entry [m]) by" in certificate.reasons[0]


@numba.njit
def two_joints(q, out):
    out[0] = q[0]
    out[1] = q[1] * q[1]


@pytest.mark.parametrize("function", [two_joints, lambda q: q[..., :2] ** [1, 2]])
def test_the_residual_is_the_distance_outside_and_its_slope(panda, function):
    own = FunctionConstraint(2, function, lower=[-0.2, 0.1], upper=[0.3, None])
    assert own.describe().endswith("<= [0.3, inf] (2 entries)")
    manifold = RegionConstraint(panda, (own,))
    draws = np.random.default_rng(0).uniform(panda.lower, panda.upper, (20, 7))
    x = np.stack([draws[:, 0], draws[:, 1] ** 2], axis=1)
    expected = x - x.clip([-0.2, 0.1], [0.3, np.inf])
    np.testing.assert_allclose(manifold.residual(draws), expected, atol=1e-12)
    np.testing.assert_allclose(own.jacobian(draws), differences(own.residual, draws), atol=1e-6)
    for q in draws:
        end = manifold.project(q)
        assert -0.2001 <= end[0] <= 0.3001 and end[1] ** 2 >= 0.0999
        assert np.array_equal(end, q) == (np.abs(own.residual(q)).max() <= 1e-4)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"lower": 1.0, "upper": 0.0}, "entry 0 of F is bounded by lower 1, upper 0"),
        ({"lower": np.nan}, "lower nan"),
        ({"lower": np.inf}, "lower inf"),
        ({"lower": -np.inf}, "neither a lower nor an upper"),
        ({"lower": [0.0, 1.0]}, "lower has 2 numbers"),
        ({"upper": "1"}, "upper is '1'"),
        ({"upper": 1j}, "upper is 1j"),
    ],
)
def test_bounds_that_bound_nothing_are_refused(limits, message):
    refused(message, FunctionConstraint, 1, first, **limits)


def test_bounds_stand_in_files_and_on_the_command_line(tmp_path, monkeypatch, capsys):
    fields = {"lower": -0.3, "upper": None}
    assert load_function("own_constraints:circle") is circle  # it knows its address from now on
    own = load_function("own_constraints:circle", fields)
    assert own is not circle and circle.equation and own.describe().startswith("circle >= -0.3")
    assert own.source == ("own_constraints:circle", fields) and "bounds circle" in own.code
    made = load_function("own_constraints:bounded_circle", {"bound": 30.0, "upper": 0.1})
    assert made.bound == 30.0 and made.describe().startswith("circle <= 0.1")
    assert function_given('{"function": "own_constraints:circle", "upper": 2}').upper == 2.0
    refused("has no field radius", load_function, "own_constraints:circle", {"radius": 1.0})
    start, goal = ",".join(map(str, HOME)), ",".join(map(str, HOME + 0.2))
    ends = "plan", "--robot", "panda", "--start", start, "--goal", goal
    inside = '{"function": "own_constraints:circle", "lower": -0.5, "upper": 0.5}'
    assert main([*ends, "--constraint", inside]) == 0
    assert "-0.5 <= circle <= 0.5 (1 entry [rad^2])" in capsys.readouterr().out


def test_a_square_is_named_with_what_its_tolerance_becomes(panda, caplog):
    message = r"lower=..., upper=...\); of a square .* 0.0005 lets g deviate by 0.022"
    kinked = FunctionConstraint(1, lambda q: np.maximum(0.0, first(q)))
    refused(message, check_function, kinked, panda, HOME)
    squared = FunctionConstraint(1, lambda q: np.maximum(0.0, first(q) - 0.001) ** 2)
    check_function(squared, panda, HOME)
    assert "0.0005 lets g deviate by 0.022" in caplog.text
    caplog.clear()
    for smooth in (circle, FunctionConstraint(1, first)):
        check_function(smooth, panda, HOME)
    assert not caplog.text
