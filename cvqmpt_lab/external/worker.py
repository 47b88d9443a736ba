"""Program of an external planner's process; only here the planner is imported and called.

Messages from the calling process are pickled: ("make", name, module, attribute),
("hand_over", problem) and ("plan", budget, seed); the first word is the name of a method of
`Worker`. Replies are plain data in the safetensors format: arrays by name, and the rest as json in
the array "words". Before each message and reply stand 8 bytes with its length.
"""

import json
import os
import pickle
import signal
import socket
import sys
from collections.abc import Mapping
from hashlib import sha256
from importlib import metadata
from inspect import isclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    UnknownChoiceError,
    one_line,
    shown,
)
from cvqmpt_lab.base.jit import compile_all
from cvqmpt_lab.base.modules import described, imported
from cvqmpt_lab.base.processes import end_with_parent, limit_memory, one_thread
from cvqmpt_lab.external.counted import counted, with_reported
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace

Reply: TypeAlias = tuple[dict[str, Any], dict[str, np.ndarray]]  # words, and arrays by name
LENGTH_BYTES = 8  # size of the length that precedes each message
MAX_REPLY_BYTES = 2**26


def main(connection: int, parent: int, most_memory: int = 2**33) -> None:
    """Reply to the messages of process `parent`, which arrive through a socket.

    Args:
        connection: file descriptor of the socket.
        parent: process id; this process ends with that one.
        most_memory: limit of this process's memory [bytes]; at most half of the machine's memory.
    """
    import safetensors.numpy  # `process` imports this file, and mostly does not need it

    end_with_parent(parent, signal.SIGKILL)
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit_memory(min(most_memory, machine // 2))
    worker, stream = Worker(), socket.socket(fileno=connection).makefile("rwb")
    while size := int.from_bytes(stream.read(LENGTH_BYTES)):
        message = stream.read(size)
        try:
            name, *arguments = pickle.loads(message)
            words, arrays = getattr(worker, name)(*arguments)
            sys.stdout.flush()
        except CvqmptError as error:
            words, arrays = {"refused": str(error), "error": described(error)}, {}
        # BaseException: a planner may raise SystemExit, KeyboardInterrupt or one of its own
        except BaseException as error:
            words, arrays = {"error": described(error)}, {}
        arrays["words"] = np.frombuffer(json.dumps(words).encode(), dtype=np.uint8)
        data = safetensors.numpy.save(arrays)
        stream.write(len(data).to_bytes(LENGTH_BYTES) + data)
        stream.flush()


class Worker:
    """A planner and its current problem."""

    def __init__(self) -> None:
        self.planner: Any = None
        self.problem: PlanningProblem | None = None

    def make(self, name: str, module_name: str, attribute: str) -> Reply:
        """Import and make the planner; the reply has "made_by" and "origin"."""
        module = imported(f"planner {name}", module_name)
        if not hasattr(module, attribute):
            public = {key: value for key, value in vars(module).items() if not key.startswith("_")}
            choices = [key for key, value in public.items() if callable(value)]
            raise UnknownChoiceError(f"planner of {module_name}", attribute, choices)
        planner = getattr(module, attribute)
        if isclass(planner):
            try:
                planner = planner()
            except BaseException as error:
                raise InvalidInputError(
                    f"planner {name}: making it without arguments raises {described(error)}"
                ) from error
        if not callable(planner):
            raise InvalidInputError(
                f"planner {name} is {shown(planner)}: give a function (problem, budget, seed), or "
                "a class whose instances are called so"
            )
        self.planner = planner
        made_by = one_line(str(getattr(module, "MADE_BY", "")))
        return {"made_by": made_by, "origin": origin(module_name)}, {}

    def hand_over(self, problem: PlanningProblem) -> Reply:
        """Take a problem and build what our own planners also have before their time starts."""
        self.problem = problem
        problem.collision_checker()
        _ = problem.manifold.regions
        # a planner that has imported our search may call it
        if "cvqmpt_lab.search.birrt" in sys.modules:
            compile_all()
            ConstrainedSpace.of(problem)
        return {}, {}

    def plan(self, budget: Budget, seed: int) -> Reply:
        """Call the planner; the reply has its path or proposal as words and arrays."""
        assert self.problem is not None
        with one_thread(), counted() as work:
            returned = self.planner(self.problem, budget, seed)
        counts = vars(work)
        # (path, counts): a path of two states has no names
        if isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Mapping):
            returned, reported = returned
            try:
                counts = with_reported(counts, reported)
            except InvalidInputError as error:
                return {"malformed": str(error)}, {}
        words, arrays = self.reply(returned)
        return {**words, "counts": counts}, arrays

    def reply(self, returned: Any) -> Reply:
        """Return what a planner returned as words and arrays."""
        assert self.problem is not None
        if returned is None:
            return {"none": True}, {}
        if isinstance(returned, Proposal):
            return reply_of(returned)
        must = f"give an array (m, {self.problem.robot.dof})"
        try:
            states = np.array(returned, dtype=float, order="C")
        except (TypeError, ValueError):
            return {"malformed": f"it returned {shown(returned)}: {must}"}, {}
        if states.nbytes > MAX_REPLY_BYTES // 2:
            most = f"at most {MAX_REPLY_BYTES // 16} numbers"
            return {"malformed": f"it returned an array {states.shape}: {must}, {most}"}, {}
        return {}, {"path": states}


def reply_of(proposal: Proposal) -> Reply:
    """Serialise a proposal: its path, words and distribution, which must be one of this package."""
    drawn = proposal.distribution
    words: dict[str, Any] = {
        "name": drawn.name,
        "detail": proposal.detail,
        "fallback": proposal.fallback,
        "failure": proposal.failure and proposal.failure.value,
    }
    arrays = {} if proposal.path is None else {"path": proposal.path.states}
    if type(drawn) is GaussianMixture:
        words["share"] = drawn.uniform_share
        arrays |= {name: getattr(drawn, name) for name in ("means", "covariances", "weights")}
    uniform = drawn if type(drawn) is Uniform else getattr(drawn, "uniform", None)
    if type(drawn) not in (Uniform, GaussianMixture) or not isinstance(uniform, Uniform | None):
        other = f"it returned a Proposal that draws from a {type(drawn).__name__}"
        cure = "give Uniform or GaussianMixture of cvqmpt_lab.search.planner_interface, or a path"
        return {"malformed": f"{other}: {cure}"}, {}
    if uniform is not None:
        arrays |= {"lower": uniform.lower, "upper": uniform.upper}
    return words, {name: np.array(array, dtype=float) for name, array in arrays.items()}


def origin(module: str) -> str:
    """Distribution and version of a module, or the digest of its file if it has none."""
    top = module.partition(".")[0]
    owners = sorted(set(metadata.packages_distributions().get(top, ())))
    if owners:
        return ", ".join(f"{owner} {metadata.version(owner)}" for owner in owners)
    path = Path(sys.modules[module].__file__ or "")
    if not path.is_file():
        return module
    return f"{path.name} sha256 {sha256(path.read_bytes()).hexdigest()[:16]}"
