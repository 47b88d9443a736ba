"""Checks of a user's constraint before it is used; an error is one line."""

import contextlib
import io
import threading
import warnings

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, InvalidProblemError
from cvqmpt_lab.base.modules import described
from cvqmpt_lab.constraints.function import FunctionConstraint, differences
from cvqmpt_lab.constraints.region_constraint import FunctionMember
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import log

TOLERANCE = 5e-4  # of |F| in certificates, `certificate.CERTIFICATE_TOLERANCE`


def check_function(function: FunctionMember, robot: Robot, start: np.ndarray) -> None:
    """Refuse a function that planning cannot use; one that passed is not checked again.

    Args:
        function: the constraint; others than `FunctionConstraint` are not checked.
        robot: the robot with n joints.
        start: (n,) [rad or m].
    """
    if not isinstance(function, FunctionConstraint):
        return
    key = robot.kinematics_digest, start.tobytes()
    if key in function.accepted:
        return
    what, k, n = f"constraint {function.name}", function.dim, robot.dof
    if k >= n:
        raise InvalidProblemError(
            f"{what}: F has {k} entries and {robot.name} {n} joints: none is left to move; give at "
            f"most {n - 1}"
        )
    _first_call(function, what, start)
    draws = robot.random_configurations(np.random.default_rng(0), 20)
    states = np.concatenate([start[None], draws])
    with np.errstate(all="ignore"):  # the error says where it is not finite
        values, own = function.own_values(states), function.values(states)
        slopes, measured = function.slopes(states), differences(function.own_values, states)
    for name, found in (("F", values), ("the Jacobian", slopes[:1])):
        finite = np.isfinite(found).reshape(len(found), -1).all(axis=1)
        if not finite.all():
            q = states[finite.argmin()]
            raise InvalidProblemError(f"{what}: {name} is not finite at {_numbers(q)}")
    apart = np.abs(values - own).max()
    if not apart <= 1e-9 * (1.0 + np.abs(values).max()):
        raise InvalidProblemError(f"{what}: F of numba and of Python differ by {apart:.2g}")
    _refuse_kinks(function, what, start, measured[0])
    _warn_of_squares(function, what, values[0], measured)
    off = np.abs(slopes - measured).reshape(len(states), -1).max(axis=1)
    scale = 1.0 + np.abs(measured).reshape(len(states), -1).max(axis=1)
    worst = int((off / scale).argmax())
    if not off[worst] <= 1e-4 * scale[worst]:
        raise InvalidProblemError(
            f"{what}: its Jacobian differs from central differences by {off[worst]:.3g} at "
            f"{_numbers(states[worst])}; correct it, or leave it out"
        )
    singular = np.linalg.svd(measured, compute_uv=False)
    if (singular[:, -1] <= 1e-7 * np.maximum(singular[:, 0], 1e-3)).all():
        raise InvalidProblemError(
            f"{what}: dF/dq has no full rank at any of {len(states)} states; its singular values "
            f"at the start are {_numbers(singular[0])}: leave out entries that others imply"
        )
    if function.bound is not None:
        _refuse_small_bound(function, what, states, measured)
    function.accepted.add(key)


def _first_call(
    function: FunctionConstraint, what: str, start: np.ndarray, seconds: float = 10.0
) -> None:
    """Call F once at the start (n,): in a thread, as it may never return."""
    said, q = io.StringIO(), start.copy()
    failed: list[BaseException] = []

    def call() -> None:
        try:
            warnings.simplefilter("ignore")  # each is shown once, not at every call
            function.own_values(q)
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=call, daemon=True)
    with (
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # each is shown once, not at every call
        thread.start()
        thread.join(seconds)
    if thread.is_alive():
        raise InvalidProblemError(
            f"{what}: F does not return within {seconds:g} s; a search calls it thousands of times"
        )
    if failed:
        if "read-only" in str(failed[0]):
            raise InvalidProblemError(f"{what}: F changes its argument; let it work on q.copy()")
        if isinstance(failed[0], InvalidInputError):
            raise failed[0]
        raise InvalidProblemError(f"{what}: F raises {described(failed[0])} at the start")
    if not np.array_equal(q, start):
        raise InvalidProblemError(f"{what}: F changes its argument; let it work on q.copy()")
    if said.getvalue():
        raise InvalidProblemError(
            f"{what}: F prints {said.getvalue().strip()[:60]!r}; a search calls it thousands of "
            "times: take that out"
        )


def _refuse_kinks(
    function: FunctionConstraint, what: str, start: np.ndarray, slopes: np.ndarray
) -> None:
    """Refuse F whose one-sided differences at the start (n,) are apart."""
    step = 1e-6
    moved = start + step * np.concatenate([np.eye(len(start)), -np.eye(len(start))])
    here, there = function.own_values(start), function.own_values(moved)
    ahead, behind = np.split((there - here) / step, 2)
    apart = np.abs(ahead + behind)
    joint, entry = np.unravel_index(apart.argmax(), apart.shape)
    if apart.max() > 1e-2 * (1.0 + np.abs(slopes).max()):
        raise InvalidProblemError(
            f"{what}: entry {entry} is not differentiable at the start: its slopes along joint "
            f"{joint} are {-behind[joint, entry]:.4g} and {ahead[joint, entry]:.4g}; for "
            "max(0, g), |g| or a root give g itself, with its bounds: FunctionConstraint(..., "
            f"lower=..., upper=...); of a square g^2, the tolerance {TOLERANCE:g} lets g deviate "
            f"by {np.sqrt(TOLERANCE):.2g}"
        )


def _warn_of_squares(
    function: FunctionConstraint, what: str, values: np.ndarray, slopes: np.ndarray
) -> None:
    """Warn of entries that are 0 at the start, with slopes of 0 there and not elsewhere.

    Args:
        function: the constraint.
        what: its name in messages.
        values: F at the start (dim,).
        slopes: dF/dq (k, dim, n), at the start first.
    """
    if not function.equation:
        return
    steepest = np.abs(slopes).max(axis=2)
    flat = (np.abs(values) <= TOLERANCE) & (steepest[0] <= 0.1 * steepest.max(axis=0))
    # near g = 0, the slope of g^2 is 2 |g| times that of g
    flat &= steepest[0] ** 2 <= 40.0 * np.maximum(np.abs(values), 1e-9)
    if flat.any():
        log.warning(
            f"{what}: entry {int(flat.argmax())} is 0 at the start without a slope; if it is a "
            f"square g^2, its tolerance {TOLERANCE:g} lets g deviate by {np.sqrt(TOLERANCE):.2g}: "
            "give g itself, with its bounds: FunctionConstraint(..., lower=..., upper=...)"
        )


def _refuse_small_bound(
    function: FunctionConstraint, what: str, states: np.ndarray, slopes: np.ndarray
) -> None:
    """Refuse a bound that F exceeds at states (k, n) with slopes dF/dq (k, dim, n), or near them.

    A Lipschitz constant is compared with slopes; a function of two states with motions of 0.1, of
    all joints and of each joint alone.
    """
    bound, units = function.bound, f" {function.units}" if function.units else ""
    if isinstance(bound, int | float):
        steepest = np.linalg.norm(slopes, axis=2).max(axis=1)
        k = int(steepest.argmax())
        if steepest[k] > bound * (1.0 + 1e-6):
            raise InvalidProblemError(
                f"{what}: bound {bound:g} is too small: F changes by {steepest[k]:.4g}"
                f"{units} per rad or m at {_numbers(states[k])}"
            )
        return
    rng = np.random.default_rng(1)
    directions = rng.standard_normal(states.shape)
    directions *= 0.1 / np.linalg.norm(directions, axis=1, keepdims=True)
    n = states.shape[1]
    begins = np.concatenate([states, np.repeat(states[:1], n, axis=0)])
    ends = np.concatenate([states + directions, states[0] + 0.1 * np.eye(n)])
    for a, b in zip(begins, ends, strict=True):
        between = np.linspace(a, b, 11)
        largest = np.abs(function.own_residual(between)).max(axis=1)
        beyond = largest.max() - max(largest[0], largest[-1])
        (said,) = function.bound_between(np.array([a, b]))  # type: ignore[misc] # it has a bound
        if not said >= beyond - 1e-12:
            q = between[largest.argmax()]
            raise InvalidProblemError(
                f"{what}: bound {said:.4g} between two states is too small: F exceeds both ends by "
                f"{beyond:.4g}{units} at {_numbers(q)}"
            )


def _numbers(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{x:.4g}" for x in values) + "]"
