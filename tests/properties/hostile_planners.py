"""Planners that try to change the judge, to stop other planners, or return invalid results.

`HOSTILE` lists them; each returns `beyond`, a path that must not be certified, if it returns.
"""

import builtins
import contextlib
import ctypes
import gc
import itertools
import os
import pickle
import random
import signal
import sys
import threading
import time

import numpy as np
import safetensors.numpy

from cvqmpt_lab.certificate import certificate
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search import planner_interface
from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal, Uniform


def through(problem, q):
    """Return a path from the start through q."""
    return np.array([problem.start, q, problem.goals[0]])


def beyond(problem):
    """Return a path 0.4 rad beyond all limits and back, through any obstacles."""
    return through(problem, problem.robot.upper + 0.4)


def attack(function):
    """A planner that attacks, and returns what the attack returns, or `beyond`."""

    def planner(problem, budget, seed):
        path, answer = beyond(problem), function(problem)
        return path if answer is None else answer

    HOSTILE.append(function.__name__)
    return planner


def write(*changes):
    """Add a number to each read-only array."""
    for array, change in changes:
        array.setflags(write=True)
        array += change


def patches(owner, **values):
    """An attack that replaces attributes of a module or class."""

    def function(problem):
        for name, value in values.items():
            setattr(owner, name, value)

    return function


def raises(error):
    """An attack that raises an error."""

    def function(problem):
        raise error

    return function


class Unusual(BaseException):
    def __str__(self):
        os._exit(3)


class Own:
    """A distribution that would be sampled in the process of the judge."""

    name = "own"

    def sample(self, rng, count):
        os._exit(1)


class Liar:
    """An answer whose shape is not that of its data."""

    def __array__(self, *arguments, **options):
        gc.disable()
        return np.broadcast_to(np.nan, (10**6, 10**6))


TICKS = itertools.count(0, -1000)
BACKWARDS = dict.fromkeys(("perf_counter", "monotonic", "time"), lambda: float(next(TICKS)))
NO_ROWS = {"residual": lambda self, q: np.zeros((len(q), 0))}
SHORT = {
    "writes_limits": lambda problem: write((problem.robot.lower, -0.5), (problem.robot.upper, 0.5)),
    "patches_the_clock": patches(time, **BACKWARDS),
    "ends_its_process": lambda problem: os._exit(0),
    "raises_its_own_base_exception": raises(BaseException("neither Exception nor exit")),
    "goes_ten_million_radians_away": lambda problem: through(problem, problem.start + 1e7),
    "replaces_the_scene": lambda problem: object.__setattr__(problem, "scene", Scene("empty", ())),
    "empties_the_scene": lambda problem: object.__setattr__(problem.scene, "objects", ()),
    "patches_the_checker": patches(CollisionChecker, in_collision=lambda *_: False),
    "patches_the_constraint": patches(RegionConstraint, **NO_ROWS),
    "patches_builtins": patches(builtins, len=lambda *_: 0, max=lambda *_: 0),
    "raises_keyboard_interrupt": raises(KeyboardInterrupt),
    "raises_what_cannot_be_printed": raises(Unusual),
    "is_killed": lambda problem: os.kill(os.getpid(), signal.SIGKILL),
    "reads_address_zero": lambda problem: ctypes.string_at(0),
    "asks_for_ten_gigabytes": lambda problem: np.ones(10 * 2**27),
    "never_leaves_compiled_code": lambda problem: ctypes.PyDLL(None).sleep(600),
    "closes_all_files": lambda problem: os.closerange(0, 256),
    "answers_other_bytes": patches(safetensors.numpy, save=lambda arrays: pickle.dumps(print)),
    "answers_two_gigabytes": patches(safetensors.numpy, save=lambda arrays: bytes(2**31)),
    "returns_a_million_states": lambda problem: np.linspace(*beyond(problem)[[0, 2]], 1_000_000),
    "returns_what_lies_about_its_shape": lambda problem: Liar(),
    "proposes_code": lambda problem: Proposal(Own()),
    "proposes_wrong_shapes": lambda problem: Proposal(Uniform(np.zeros(3), np.ones(4))),
}
HOSTILE = []
for name, function in SHORT.items():
    function.__name__ = name
    globals()[name] = attack(function)


@attack
def leaves_busy_threads(problem):
    def spin():
        while True:
            pass

    for _ in range(3):
        threading.Thread(target=spin, daemon=True).start()


@attack
def writes_the_kinematics(problem):
    kinematics = problem.robot.kinematics
    write((kinematics.rotation, 0.1), (kinematics.translation, 0.1))


@attack
def writes_the_limits_of_pinocchio(problem):
    model = problem.robot.model
    model.lowerPositionLimit, model.upperPositionLimit = np.full((2, 7), ((-9.0,), (9.0,)))


@attack
def patches_the_certificate(problem):
    valid = certificate.Certificate((), 0.0, 0.0, 1.0, 2)
    certificate.certify = lambda *_, **__: valid
    from cvqmpt_lab.planning import pipeline

    pipeline.certify = certificate.certify


@attack
def patches_numpy(problem):
    np.linalg.norm = lambda *_, **__: 0.0
    np.diff = np.abs = lambda *_, **__: np.zeros(1)


@attack
def patches_random_numbers(problem):
    random.seed(1)
    np.random.default_rng = lambda *_: None


@attack
def patches_the_planner_interface(problem):
    planner_interface.search = planner_interface.Deadline.spent = lambda *_: None


@attack
def never_ends_and_catches_everything(problem):
    while True:
        with contextlib.suppress(BaseException):
            time.sleep(100.0)


@attack
def writes_to_its_connections(problem):
    for file in range(3, 20):
        with contextlib.suppress(OSError):
            os.write(file, pickle.dumps(exit) * 100)


@attack
def proposes_no_numbers(problem):
    mixture = GaussianMixture(np.zeros((1, 7)), np.eye(7)[None], np.ones(1))
    mixture.means[:] = np.nan
    return Proposal(mixture)


@attack
def forks_and_floods_standard_output(problem):
    if os.fork() == 0:
        while True:
            os.write(1, b"0" * 2**16)


@attack
def changes_where_it_runs(problem):
    os.environ.clear()
    os.chdir("/")
    sys.path.clear()
    signal.signal(signal.SIGALRM, signal.SIG_IGN)


@attack
def calls_itself_without_end(problem):
    sys.setrecursionlimit(10**9)

    def deeper(n):
        return deeper(n + 1) + np.array(n)

    return deeper(0)


@attack
def changes_this_file_in_memory(problem):
    for module in [*sys.modules.values()]:
        if getattr(module, "__name__", "").startswith("cvqmpt_lab."):
            vars(module).clear()
