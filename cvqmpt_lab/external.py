"""External planners: found by name, called under a time limit, their answers checked.

An external planner is a function (problem, budget, seed), or a class without arguments whose
instances are called so. It returns a path, an array (m, n) from the start to one of the goals
[rad or m], straight between its rows; None where it found none; or a
`search.planner_interface.Proposal`, from which the search of this package goes on.
"""

import contextlib
import importlib
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from importlib import metadata
from inspect import isclass
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError, shown
from cvqmpt_lab.search.planner_interface import Observation, Proposal, Query
from cvqmpt_lab.search.result import JointPath, PlanStatus

GROUP = "cvqmpt.planners"  # of entry points


class _Interrupted(BaseException):
    """Raised in a planner whose time is over; not an Exception, which planners catch."""


@dataclass(frozen=True)
class ExternalPlanner:
    """The stage `predict` of an external planner: all of its planning.

    It is late after 1.1 times its seconds and 0.1 s, and interrupted after twice its seconds and
    0.5 s.
    """

    planner: Callable[..., Any]
    made_by: str  # distributions and their versions, or the module's file

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Propose a path, or the reason of a failure, for a query's problem, budget and seed."""
        budget, seconds = query.deadline.budget, query.deadline.budget.seconds
        interrupt_after = None if seconds is None else 2.0 * seconds + 0.5
        answer, failure, detail = None, None, ""
        with _redirected_output() as output:
            try:
                with _interrupted_after(interrupt_after):
                    answer = self.planner(query.space.problem, budget, query.seed)
            except _Interrupted:
                failure, detail = PlanStatus.OVERTIME, "interrupted"
            except MemoryError:
                raise
            except (Exception, SystemExit) as error:
                failure, detail = PlanStatus.PLANNER_ERROR, f"{type(error).__name__}: {error}"
        if seconds is not None and failure is not PlanStatus.PLANNER_ERROR:
            took = query.deadline.seconds
            if failure is not None or took > 1.1 * seconds + 0.1:
                failure = PlanStatus.OVERTIME
                late = f"{took:.3g} s where {seconds:g} s were given"
                detail = "; ".join(filter(None, (late, detail)))
        path = None
        if failure is None and isinstance(answer, Proposal):
            return replace(answer, detail="; ".join(filter(None, (answer.detail, *output))))
        if failure is None and answer is None:
            failure = query.deadline.spent() or PlanStatus.NO_PATH
        elif failure is None:
            try:
                path = JointPath(_states(answer, query.space.robot.dof))
            except InvalidInputError as error:
                failure, detail = PlanStatus.MALFORMED_PATH, str(error)
        return Proposal(
            replace(query.uniform, name=self.made_by),
            detail="; ".join(filter(None, (detail, *output))),
            path=path,
            failure=failure,
            as_is=True,
        )


@lru_cache(maxsize=32)
def external_planner(name: str) -> ExternalPlanner:
    """The external planner of that name, made once a process.

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
    module_name, _, attribute = address.partition(":")
    module = _imported(name, module_name)
    if not hasattr(module, attribute):
        public = {key: value for key, value in vars(module).items() if not key.startswith("_")}
        choices = [key for key, value in public.items() if callable(value)]
        raise UnknownChoiceError(f"planner of {module_name}", attribute, choices)
    planner = getattr(module, attribute)
    if isclass(planner):
        try:
            planner = planner()
        except Exception as error:
            raise InvalidInputError(
                f"planner {name}: making it without arguments raises {type(error).__name__}: "
                f"{error}"
            ) from error
    if not callable(planner):
        raise InvalidInputError(
            f"planner {name} is {shown(planner)}: give a function (problem, budget, seed), or a "
            "class of such"
        )
    made_by = getattr(module, "MADE_BY", "") or distribution or _origin(module_name)
    return ExternalPlanner(planner, made_by)


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


def _imported(name: str, module: str) -> Any:
    """A module; one in the folder from which the command was started is found, too."""
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    try:
        return importlib.import_module(module)
    except CvqmptError:
        # an adapter that says itself what is not installed
        raise
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            raise InvalidInputError(
                f"planner {name}: there is no module {error.name!r}; install it, or start in its "
                "folder"
            ) from error
        raise InvalidInputError(
            f"planner {name}: {module} needs {error.name!r}; install it"
        ) from error
    except Exception as error:
        raise InvalidInputError(
            f"planner {name}: importing {module} raises {type(error).__name__}: {error}"
        ) from error


def _origin(module: str) -> str:
    """Distribution and version of a module; the digest of its file where it is of none."""
    top = module.partition(".")[0]
    owners = sorted(set(metadata.packages_distributions().get(top, ())))
    if owners:
        return ", ".join(f"{owner} {metadata.version(owner)}" for owner in owners)
    path = Path(sys.modules[module].__file__ or "")
    if not path.is_file():
        return module
    return f"{path.name} sha256 {sha256(path.read_bytes()).hexdigest()[:16]}"


def _states(answer: Any, n: int, longest_step: float = 0.1) -> np.ndarray:
    """States (m, n) of an answer, some added, at most longest_step [rad or m] apart.

    Raises InvalidInputError for what is no path.
    """
    try:
        states = np.array(answer, dtype=float)
    except (TypeError, ValueError):
        raise InvalidInputError(f"it returned {shown(answer)}: give an array (m, {n})") from None
    if states.ndim != 2 or states.shape[1] != n or len(states) < 2:
        raise InvalidInputError(f"it returned an array {states.shape}: give (m, {n}), m at least 2")
    finite = np.isfinite(states).all(axis=1)
    if not finite.all():
        raise InvalidInputError(
            f"row {finite.argmin()} of {len(states)} that it returned is not finite"
        )
    steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
    parts = np.maximum(1, np.ceil(steps / longest_step)).astype(int)
    dense = [
        a + (b - a) * np.arange(k)[:, None] / k
        for a, b, k in zip(states, states[1:], parts, strict=False)
    ]
    return np.concatenate([*dense, states[-1:]])


@contextlib.contextmanager
def _interrupted_after(seconds: float | None, again_s: float = 0.2) -> Iterator[None]:
    """Raise `_Interrupted` after seconds, then every again_s; only in the main thread.

    Python alone can be interrupted. Compiled code that never returns ends with its process
    (`experiments.executors`).
    """
    if seconds is None or threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        raise _Interrupted

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds, again_s)
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _redirected_output(first_characters: int = 60) -> Iterator[list[str]]:
    """Send standard output, that of compiled code too, to standard error.

    The list gets one sentence about it where something was written.
    """
    notes: list[str] = []
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as kept:
        sys.stdout.flush()
        own = os.dup(1)  # the file descriptor of standard output
        os.dup2(kept.fileno(), 1)
        try:
            with contextlib.redirect_stdout(kept):
                yield notes
        finally:
            kept.flush()
            os.dup2(own, 1)
            os.close(own)
            size = kept.seek(0, os.SEEK_END)
            kept.seek(0)
            written = kept.read()
            if written:
                first = " ".join(written[:first_characters].split())
                notes.append(
                    f"wrote {size} bytes to standard output, shown on standard error: {first!r}"
                )
                sys.stderr.write(written)
