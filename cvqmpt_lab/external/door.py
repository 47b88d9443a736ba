"""External planners: found by name, called in a separate process, their results checked.

An external planner is a function (problem, budget, seed), or a class without constructor arguments
whose instances are such functions. It returns a path, an array (m, n) [rad or m] from the start to
one of the goals with straight segments between its rows; None if it found no path; or a
`search.planner_interface.Proposal`, with which the search of this package continues. A pair of one
of these and a mapping reports its work, see `external.counted`. Only plain data come back from its
process (`external.process`), so it cannot change the code that judges it.
"""

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, one_line
from cvqmpt_lab.base.polyline import cut, parts_within
from cvqmpt_lab.external.counted import counters_of
from cvqmpt_lab.external.names import distribution_of, entry_points
from cvqmpt_lab.external.process import NoReply, PlannerProcess
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.search.planner_interface import (
    GaussianMixture,
    Observation,
    Proposal,
    Query,
    Stages,
    Uniform,
)
from cvqmpt_lab.search.result import JointPath, PlanStatus


@dataclass(frozen=True)
class ExternalPlanner:
    """An external planner; its call is the stage `predict`.

    With a budget of t seconds it is over time after 1.1 t + 0.1 s, and its process is ended after
    2 t + 0.5 s.
    """

    process: PlannerProcess
    made_by: str  # distributions with versions, or the module's file with its digest

    def stages(self, problem: PlanningProblem, model: str = "") -> Stages:
        """Send a problem to the planner's process, which is not timed, and return its stages."""
        reason = ""
        try:
            self.process.hand_over(problem)
        except NoReply as error:
            reason = str(error)
        return Stages(predict=partial(self._predict, reason))

    def _predict(self, reason: str, query: Query, observation: Observation) -> Proposal:
        """Call the planner; return its path or proposal, or a failure.

        reason: why sending the problem failed, or "".
        """
        budget, seconds = query.deadline.budget, query.deadline.budget.seconds
        failure: PlanStatus | None = None
        detail = ""
        proposal = Proposal(replace(query.uniform, name=self.made_by), as_is=True)
        try:
            if reason:
                raise NoReply(reason)
            if budget.seconds is None and budget.iterations is None:
                raise NoReply("a budget of cost counts operations of ours: give seconds")
            limit = None if seconds is None else 2.0 * seconds + 0.5
            words, arrays = self.process.plan(budget, query.seed, seconds=limit)
            proposal = replace(proposal, counters=counters_of(words))
            if "error" in words:
                raise NoReply(str(words["error"]))
            if seconds is not None and query.deadline.seconds > 1.1 * seconds + 0.1:
                failure = PlanStatus.OVERTIME
            elif "none" in words:
                failure = query.deadline.spent() or PlanStatus.NO_PATH
            else:
                proposal = proposal_of(words, arrays, query.space.robot, proposal)
        except NoReply as error:
            failure = PlanStatus.OVERTIME if error.late else PlanStatus.PLANNER_ERROR
            detail = str(error)
        except InvalidInputError as error:
            failure, detail = PlanStatus.MALFORMED_PATH, str(error)
        late = ""
        if failure is PlanStatus.OVERTIME:
            late = f"{query.deadline.seconds:.3g} s where {seconds:g} s were given"
        notes = filter(None, (late, detail or proposal.detail, self.process.note()))
        failure = failure or proposal.failure
        return replace(proposal, failure=failure, detail=one_line("; ".join(notes)))


def proposal_of(
    words: dict[str, Any], arrays: dict[str, np.ndarray], robot: Robot, path_alone: Proposal
) -> Proposal:
    """Build a proposal from the reply of a planner's process, see `external.worker.Worker.plan`.

    Args:
        words: fields of the reply that are no arrays.
        arrays: arrays of the reply by name.
        robot: the robot with n joints.
        path_alone: the proposal into which a returned path is put.

    Raises InvalidInputError if the planner returned neither path nor proposal, NoReply if the reply
    cannot be read.
    """
    try:
        if "malformed" in words:
            raise InvalidInputError(str(words["malformed"]))
        path = JointPath(path_states(arrays["path"], robot)) if "path" in arrays else None
        if "name" not in words:
            return replace(path_alone, path=path)
        failure = words["failure"] and PlanStatus(words["failure"])
        if failure is PlanStatus.SOLVED:
            raise InvalidInputError(
                "it returned a Proposal with failure SOLVED, which is no failure: give its path, "
                "or another PlanStatus"
            )
        name = one_line(str(words["name"]))
        uniform = None
        if "lower" in arrays:
            bounds = np.stack((arrays["lower"], arrays["upper"]))
            lower, upper = near_limits(np.sort(bounds, axis=0), robot, "bounds")
            uniform = Uniform(lower, upper, name)
        drawn: Any = uniform
        if "means" in arrays:
            means = near_limits(arrays["means"], robot, "means")
            rest = arrays["covariances"], arrays["weights"], uniform, float(words["share"])
            drawn = GaussianMixture(means, *rest, name)
        return Proposal(
            drawn,
            detail=str(words["detail"]),
            fallback=one_line(str(words["fallback"])),
            path=path,
            failure=failure,
            counters=path_alone.counters,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise NoReply(f"its reply cannot be read: {one_line(str(error))}") from error


def near_limits(rows: np.ndarray, robot: Robot, what: str, farthest: float = 100.0) -> np.ndarray:
    """Return rows as floats; refuse those that are not finite or far outside the joint limits.

    Args:
        rows: (k, n) [rad or m].
        robot: the robot with n joints.
        what: noun for the rows in the error message.
        farthest: largest allowed distance outside the joint limits [rad or m].
    """
    if rows.ndim != 2 or rows.shape[1] != robot.dof or len(rows) == 0:
        raise InvalidInputError(
            f"it returned {what} of shape {rows.shape}: give (m, {robot.dof}) [rad or m]"
        )
    rows = rows.astype(float)
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        raise InvalidInputError(
            f"row {finite.argmin()} of {len(rows)} of the {what} that it returned is not finite"
        )
    excess = np.maximum(robot.lower - rows, rows - robot.upper).max(axis=1)
    if excess.max() > farthest:
        worst = excess.argmax()
        raise InvalidInputError(
            f"row {worst} of {len(rows)} of the {what} that it returned is {excess[worst]:.4g} rad "
            f"or m outside the joint limits; more than {farthest:g} is no configuration"
        )
    return rows


def path_states(
    given: np.ndarray, robot: Robot, longest_step: float = 0.1, most: int = 50_000
) -> np.ndarray:
    """States (m, n) of a returned path, with states added so that steps are short.

    Args:
        given: the returned array.
        robot: the robot with n joints.
        longest_step: largest distance of neighbouring states [rad or m].
        most: largest number of states.

    Raises InvalidInputError if `given` is no path or needs more than `most` states.
    """
    states = near_limits(given, robot, "states")
    if len(states) < 2:
        raise InvalidInputError("it returned one state: give (m, n), m at least 2")
    parts = parts_within(states, longest_step)
    if parts.sum() >= most:
        raise InvalidInputError(
            f"it returned a path of {parts.sum() + 1} states, at most {longest_step:g} rad or m "
            f"apart; at most {most} are judged"
        )
    return cut(states, parts)


@lru_cache(maxsize=32)
def external_planner(name: str) -> ExternalPlanner:
    """Find an external planner and start its process, which starts again if it has ended.

    Args:
        name: ``package.module:planner``, or the name of an entry point of a distribution.

    Raises InvalidInputError if there is none or several, or it cannot be imported or called.
    """
    address, distribution = name, ""
    if ":" not in name:
        entries = [entry for entry in entry_points() if entry.name == name]
        if len(entries) != 1:
            who = ", ".join(distribution_of(entry) for entry in entries)
            raise InvalidInputError(
                f"planner {name!r} is in {len(entries)} distributions, {who}: keep one of them"
            )
        address, distribution = entries[0].value, distribution_of(entries[0])
    module, _, attribute = address.partition(":")
    process = PlannerProcess(name, module, attribute)
    words = process.start()
    made_by = words.get("made_by") or distribution or words.get("origin")
    return ExternalPlanner(process, one_line(str(made_by)))
