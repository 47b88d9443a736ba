"""External planners: found by name, called in a process of their own, their answers checked.

An external planner is a function (problem, budget, seed), or a class without arguments whose
instances are called so. It returns a path, an array (m, n) from the start to one of the goals
[rad or m], straight between its rows; None where it found none; or a
`search.planner_interface.Proposal`, from which the search of this package goes on. Only its answer
comes into this process (`external.process`): it cannot change what it is judged by.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib import metadata
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, one_line
from cvqmpt_lab.external.process import NoAnswer, PlannerProcess
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

GROUP = "cvqmpt.planners"  # of entry points


@dataclass(frozen=True)
class ExternalPlanner:
    """An external planner: all of its planning is the stage `predict`.

    It is late after 1.1 times its seconds and 0.1 s; after twice its seconds and 0.5 s its process
    is ended.
    """

    process: PlannerProcess
    made_by: str  # distributions and their versions, or the module's file

    def stages(self, problem: PlanningProblem, model: str = "") -> Stages:
        """Hand a problem over to the planner's process; not timed."""
        reason = ""
        try:
            self.process.hand_over(problem)
        except NoAnswer as error:
            reason = str(error)
        return Stages(predict=partial(self._predict, reason))

    def _predict(self, reason: str, query: Query, observation: Observation) -> Proposal:
        """Its path or proposal, or a failure; reason: why it did not get the problem, or ""."""
        budget, seconds = query.deadline.budget, query.deadline.budget.seconds
        failure: PlanStatus | None = None
        detail, proposal = "", Proposal(replace(query.uniform, name=self.made_by), as_is=True)
        try:
            if reason:
                raise NoAnswer(reason)
            limit = None if seconds is None else 2.0 * seconds + 0.5
            words, arrays = self.process.plan(budget, query.seed, seconds=limit)
            if "error" in words:
                raise NoAnswer(str(words["error"]))
            if seconds is not None and query.deadline.seconds > 1.1 * seconds + 0.1:
                failure = PlanStatus.OVERTIME
            elif "none" in words:
                failure = query.deadline.spent() or PlanStatus.NO_PATH
            else:
                proposal = answered(words, arrays, query.space.robot, proposal)
        except NoAnswer as error:
            failure = PlanStatus.OVERTIME if error.late else PlanStatus.PLANNER_ERROR
            detail = str(error)
        except InvalidInputError as error:
            failure, detail = PlanStatus.MALFORMED_PATH, str(error)
        late = ""
        if failure is PlanStatus.OVERTIME:
            late = f"{query.deadline.seconds:.3g} s where {seconds:g} s were given"
        told = filter(None, (late, detail or proposal.detail, self.process.note()))
        failure = failure or proposal.failure
        return replace(proposal, failure=failure, detail=one_line("; ".join(told)))


def answered(
    words: dict[str, Any], arrays: dict[str, np.ndarray], robot: Robot, path_alone: Proposal
) -> Proposal:
    """The proposal of an answer (see `external.worker.Worker.plan`).

    path_alone: the proposal of a path, without it. InvalidInputError: what it returned is no path
    and no proposal; NoAnswer: it cannot be read.
    """
    try:
        if "malformed" in words:
            raise InvalidInputError(str(words["malformed"]))
        path = JointPath(path_states(arrays["path"], robot)) if "path" in arrays else None
        if "name" not in words:
            return replace(path_alone, path=path)
        name, uniform = one_line(str(words["name"])), None
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
            failure=words["failure"] and PlanStatus(words["failure"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise NoAnswer(f"its answer cannot be read: {one_line(str(error))}") from error


def near_limits(rows: np.ndarray, robot: Robot, what: str, farthest: float = 100.0) -> np.ndarray:
    """Rows (k, n) that are finite, at most farthest [rad or m] outside the joint limits, as float.

    what: they are, for InvalidInputError.
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
    """States (m, n) of a path, some added, at most longest_step [rad or m] apart.

    Raises InvalidInputError for what is no path, and for one of more than `most` states.
    """
    states = near_limits(given, robot, "states")
    if len(states) < 2:
        raise InvalidInputError("it returned one state: give (m, n), m at least 2")
    steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
    parts = np.maximum(1, np.ceil(steps / longest_step)).astype(int)
    if parts.sum() >= most:
        raise InvalidInputError(
            f"it returned a path of {parts.sum() + 1} states, at most {longest_step:g} rad or m "
            f"apart; at most {most} are judged"
        )
    dense = [
        a + (b - a) * np.arange(k)[:, None] / k
        for a, b, k in zip(states, states[1:], parts, strict=False)
    ]
    return np.concatenate([*dense, states[-1:]])


@lru_cache(maxsize=32)
def external_planner(name: str) -> ExternalPlanner:
    """The external planner of that name; its process is started once, and again where it ended.

    Args:
        name: ``package.module:planner``, or the name of an entry point of a distribution.

    Raises InvalidInputError if there is none or several, or it cannot be imported or called.
    """
    address, distribution = name, ""
    if ":" not in name:
        entries = [entry for entry in _entry_points() if entry.name == name]
        if len(entries) != 1:
            who = ", ".join(_distribution(entry) for entry in entries)
            raise InvalidInputError(
                f"planner {name!r} is of {len(entries)} distributions, {who}: keep one of them"
            )
        address, distribution = entries[0].value, _distribution(entries[0])
    module, _, attribute = address.partition(":")
    process = PlannerProcess(name, module, attribute)
    words = process.start()
    made_by = words.get("made_by") or distribution or words.get("origin")
    return ExternalPlanner(process, one_line(str(made_by)))


def is_external(name: str) -> bool:
    """Whether the name is of the form of an external planner, or an entry point has it."""
    return ":" in name or name in entry_point_names()


def entry_point_names() -> list[str]:
    """Names of external planners that installed distributions declare."""
    return sorted({entry.name for entry in _entry_points()})


def refuse_clash(name: str, own: Collection[str]) -> None:
    """Raise InvalidInputError if the name is one of this package's and an entry point's, too."""
    for entry in _entry_points():
        if entry.name == name and name in own:
            raise InvalidInputError(
                f"planner {name!r} of {_distribution(entry)} has the name of one of ours: rename "
                f"it in its entry points {GROUP}, or call it {entry.value}"
            )


@lru_cache(maxsize=1)
def _entry_points() -> tuple[metadata.EntryPoint, ...]:
    unique = {(entry.name, entry.value): entry for entry in metadata.entry_points(group=GROUP)}
    return tuple(unique.values())


def _distribution(entry: metadata.EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"
