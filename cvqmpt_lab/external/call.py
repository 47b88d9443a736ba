"""Calling a planner of others: time, standard output and answer are checked, and whatever happens
is a result.

Its answer is a path, an array (m, n) from the start to one of the goals [rad or m], straight
between its rows; or None where it found none; or a `search.planner_interface.Proposal`, from which our search
goes on.
"""

import contextlib
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import IO, Any

import numpy as np

from cvqmpt_lab.errors import shown
from cvqmpt_lab.external.found import Found
from cvqmpt_lab.search.planner_interface import Observation, Proposal, Query
from cvqmpt_lab.search.result import JointPath, PlanStatus

LATE_SHARE, LATE_S = 0.1, 0.1  # of its seconds, and [s], by which a planner may be late
# of its seconds, and [s] more, after which it is interrupted
INTERRUPT_SHARE, INTERRUPT_S = 2.0, 0.5
AGAIN_S = 0.2  # [s] after which it is interrupted again
LONGEST_STEP = 0.1  # [rad] between states of a path, which are added on its straight segments
STDOUT = 1  # its file descriptor
SHOWN = 60  # characters of its output


class _Interrupted(BaseException):
    """Raised inside a planner whose time is long over; no Exception, which planners catch."""


class ExternalPlanner:
    """The stage `predict` of a planner of others: all of its planning."""

    def __init__(self, found: Found) -> None:
        self._found = found

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Call it with the problem, the whole budget and the seed of a query."""
        budget, seconds = query.deadline.budget, query.deadline.budget.seconds
        nothing = Proposal(replace(query.uniform, name=self._found.made_by), as_is=True)
        answer, failure, detail = None, None, ""
        with _output() as output:
            try:
                limit = None if seconds is None else INTERRUPT_SHARE * seconds + INTERRUPT_S
                with _interrupted_after(limit):
                    answer = self._found.planner(query.space.problem, budget, query.seed)
            except _Interrupted:
                failure, detail = PlanStatus.OVERTIME, "interrupted"
            except MemoryError:
                raise
            except (Exception, SystemExit) as error:
                failure, detail = PlanStatus.PLANNER_ERROR, f"{type(error).__name__}: {error}"
        took = query.deadline.seconds
        if seconds is not None and took > (1.0 + LATE_SHARE) * seconds + LATE_S and failure is None:
            failure = PlanStatus.OVERTIME
        if failure is PlanStatus.OVERTIME:
            detail = "; ".join(
                filter(None, (f"{took:.3g} s where {seconds:g} s were given", detail))
            )
        if failure is not None:
            return replace(nothing, failure=failure, detail=_joined(detail, output))
        if isinstance(answer, Proposal):
            return replace(answer, detail=_joined(answer.detail, output))
        if answer is None:
            ended = query.deadline.spent() or PlanStatus.NO_PATH
            return replace(nothing, failure=ended, detail=_joined("", output))
        states, trouble = _states(answer, query.space.robot.dof)
        if states is None:
            return replace(
                nothing, failure=PlanStatus.MALFORMED_PATH, detail=_joined(trouble, output)
            )
        return replace(nothing, path=JointPath(states), detail=_joined("", output))


def _states(answer: Any, n: int) -> tuple[np.ndarray | None, str]:
    """The states (m, n) of an answer, at most LONGEST_STEP apart; or None, and why it is no path."""
    try:
        states = np.array(answer, dtype=float)
    except (TypeError, ValueError):
        return None, f"it returned {shown(answer)}: give an array (m, {n})"
    if states.ndim != 2 or states.shape[1] != n or len(states) < 2:
        return None, f"it returned an array {states.shape}: give (m, {n}), m at least 2"
    if not np.isfinite(states).all():
        row = int(np.flatnonzero(~np.isfinite(states).all(axis=1))[0])
        return None, f"row {row} of {len(states)} that it returned is not finite"
    steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
    parts = np.maximum(1, np.ceil(steps / LONGEST_STEP)).astype(int)
    dense = [
        a + (b - a) * np.arange(k)[:, None] / k
        for a, b, k in zip(states, states[1:], parts, strict=False)
    ]
    return np.concatenate([*dense, states[-1:]]), ""


@contextlib.contextmanager
def _interrupted_after(seconds: float | None) -> Iterator[None]:
    """Raise `_Interrupted` after seconds, again and again; nothing in threads beside the main one.

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
        signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN_S)
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _output() -> Iterator[list[str]]:
    """Send what is written to standard output, by compiled code too, to standard error;
    a list for a word on it.
    """
    said: list[str] = []
    with tempfile.TemporaryFile() as kept, contextlib.ExitStack() as stack:
        sys.stdout.flush()
        own = os.dup(STDOUT)
        os.dup2(kept.fileno(), STDOUT)
        text = stack.enter_context(
            os.fdopen(os.dup(kept.fileno()), "w", encoding="utf-8", errors="replace")
        )
        try:
            with contextlib.redirect_stdout(text):
                yield said
        finally:
            text.flush()
            os.dup2(own, STDOUT)
            os.close(own)
            _pass_on(kept, said)


def _pass_on(kept: IO[bytes], said: list[str]) -> None:
    size = kept.seek(0, os.SEEK_END)
    if size:
        kept.seek(0)
        first = " ".join(kept.read(SHOWN).decode(errors="replace").split())
        said.append(f"wrote {size} bytes to standard output, shown on standard error: {first!r}")
        kept.seek(0)
        sys.stderr.write(kept.read().decode(errors="replace"))


def _joined(detail: str, output: list[str]) -> str:
    return "; ".join(filter(None, (detail, *output)))
