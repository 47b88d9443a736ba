"""What runs in the process of an external planner: it is imported, made and called only here.

Messages from the process that plans are pickled: ("make", name, module, attribute),
("hand_over", problem) and ("plan", budget, seed), of which the first word is a method of `Worker`.
Answers are plain data, in the safetensors format: arrays by name, and json as the array "words".
The length of each, 8 bytes, goes ahead.
"""

import importlib
import json
import os
import pickle
import signal
import socket
import sys
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
from cvqmpt_lab.base.processes import end_with_parent, limit_memory, one_thread
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace

Answer: TypeAlias = tuple[dict[str, Any], dict[str, np.ndarray]]  # words, and arrays by name
LENGTH = 8  # bytes of a length
MOST_BYTES = 2**26  # of an answer


def main(connection: int, parent: int, most_memory: int = 2**33) -> None:
    """Answer the messages of process `parent`, which come through a socket.

    most_memory: bytes of this process; half of the machine's where that is less.
    """
    # here, because planning without external planners imports this file and does not need it
    import safetensors.numpy

    end_with_parent(parent, signal.SIGKILL)
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit_memory(min(most_memory, machine // 2))
    worker, stream = Worker(), socket.socket(fileno=connection).makefile("rwb")
    while size := int.from_bytes(stream.read(LENGTH)):
        message = stream.read(size)
        try:
            name, *arguments = pickle.loads(message)
            words, arrays = getattr(worker, name)(*arguments)
            sys.stdout.flush()
        except CvqmptError as error:
            words, arrays = {"refused": str(error), "error": described(error)}, {}
        # what a planner may raise to end the process: SystemExit, KeyboardInterrupt, its own
        except BaseException as error:
            words, arrays = {"error": described(error)}, {}
        arrays["words"] = np.frombuffer(json.dumps(words).encode(), dtype=np.uint8)
        data = safetensors.numpy.save(arrays)
        stream.write(len(data).to_bytes(LENGTH) + data)
        stream.flush()


class Worker:
    """A planner and the problem that it plans for."""

    def __init__(self) -> None:
        self.planner: Any = None
        self.problem: PlanningProblem | None = None

    def make(self, name: str, module_name: str, attribute: str) -> Answer:
        """Import and make the planner; answers who made it."""
        module = imported(name, module_name)
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
                "a class of such"
            )
        self.planner = planner
        made_by = one_line(str(getattr(module, "MADE_BY", "")))
        return {"made_by": made_by, "origin": origin(module_name)}, {}

    def hand_over(self, problem: PlanningProblem) -> Answer:
        """Take a problem; prepare for it what our own planners have before their clock starts."""
        self.problem = problem
        problem.collision_checker()
        _ = problem.manifold.regions
        # the planner may use our search
        if "cvqmpt_lab.search.birrt" in sys.modules:
            compile_all()
            ConstrainedSpace(problem)
        return {}, {}

    def plan(self, budget: Budget, seed: int) -> Answer:
        """Call the planner; answers its path or proposal as words and arrays."""
        assert self.problem is not None
        with one_thread():
            answer = self.planner(self.problem, budget, seed)
        if answer is None:
            return {"none": True}, {}
        if isinstance(answer, Proposal):
            return of_proposal(answer)
        must = f"give an array (m, {self.problem.robot.dof})"
        try:
            states = np.array(answer, dtype=float, order="C")
        except (TypeError, ValueError):
            return {"malformed": f"it returned {shown(answer)}: {must}"}, {}
        if states.nbytes > MOST_BYTES // 2:
            most = f"at most {MOST_BYTES // 16} numbers"
            return {"malformed": f"it returned an array {states.shape}: {must}, {most}"}, {}
        return {}, {"path": states}


def of_proposal(proposal: Proposal) -> Answer:
    """What of a proposal can be sent: distributions of ours, path and words."""
    drawn = proposal.distribution
    words: dict[str, Any] = {"name": drawn.name, "detail": proposal.detail}
    words["fallback"] = proposal.fallback
    words["failure"] = proposal.failure and proposal.failure.value
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


def described(error: BaseException) -> str:
    """Type and text of an error of others."""
    try:
        return one_line(f"{type(error).__name__}: {error}")
    except BaseException:
        return type(error).__name__


def imported(name: str, module: str) -> Any:
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
    except BaseException as error:
        raise InvalidInputError(
            f"planner {name}: importing {module} raises {described(error)}"
        ) from error


def origin(module: str) -> str:
    """Distribution and version of a module; the digest of its file where it is of none."""
    top = module.partition(".")[0]
    owners = sorted(set(metadata.packages_distributions().get(top, ())))
    if owners:
        return ", ".join(f"{owner} {metadata.version(owner)}" for owner in owners)
    path = Path(sys.modules[module].__file__ or "")
    if not path.is_file():
        return module
    return f"{path.name} sha256 {sha256(path.read_bytes()).hexdigest()[:16]}"
