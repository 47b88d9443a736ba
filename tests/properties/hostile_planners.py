"""Planners that try to change what they are judged by, to stop others, or to answer nonsense.

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

from cvqmpt_lab import certificate
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import RegionConstraint
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search import planner_interface
from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal, Uniform

HOSTILE = []


def beyond(problem):
    """0.4 rad beyond all limits and back, through whatever stands there."""
    return np.array([problem.start, problem.robot.upper + 0.4, problem.goals[0]])


def attack(function):
    """A planner that attacks, and returns what the attack returns, or `beyond`."""

    def planner(problem, budget, seed):
        path, answer = beyond(problem), function(problem)
        return path if answer is None else answer

    HOSTILE.append(function.__name__)
    return planner


def write(array, change):
    array.setflags(write=True)
    array += change


@attack
def writes_limits(problem):
    write(problem.robot.lower, -0.5)
    write(problem.robot.upper, 0.5)


@attack
def patches_the_clock(problem):
    ticks = itertools.count(0, -1000)
    time.perf_counter = time.monotonic = time.time = lambda: float(next(ticks))


@attack
def ends_its_process(problem):
    os._exit(0)


class Unusual(BaseException):
    def __str__(self):
        os._exit(3)


@attack
def raises_its_own_base_exception(problem):
    raise BaseException("neither Exception nor exit")


@attack
def goes_ten_million_radians_away(problem):
    return np.array([problem.start, problem.start + 1e7, problem.goals[0]])


@attack
def leaves_busy_threads(problem):
    def spin():
        while True:
            pass

    for _ in range(3):
        threading.Thread(target=spin, daemon=True).start()


@attack
def replaces_the_scene(problem):
    object.__setattr__(problem, "scene", Scene("empty", ()))


@attack
def empties_the_scene(problem):
    object.__setattr__(problem.scene, "objects", ())


@attack
def writes_the_kinematics(problem):
    write(problem.robot.kinematics.rotation, 0.1)
    write(problem.robot.kinematics.translation, 0.1)


@attack
def writes_the_limits_of_pinocchio(problem):
    model = problem.robot.model
    model.lowerPositionLimit, model.upperPositionLimit = np.full((2, 7), ((-9.0,), (9.0,)))


@attack
def patches_the_certificate(problem):
    valid = certificate.Certificate((), 0.0, 0.0, 1.0, 2)
    certificate.certify = lambda *_, **__: valid
    from cvqmpt_lab import pipeline

    pipeline.certify = certificate.certify


@attack
def patches_the_checker(problem):
    CollisionChecker.in_collision = lambda *_: False


@attack
def patches_the_constraint(problem):
    RegionConstraint.residual = lambda self, q: np.zeros((len(q), 0))


@attack
def patches_numpy(problem):
    np.linalg.norm = lambda *_, **__: 0.0
    np.diff = np.abs = lambda *_, **__: np.zeros(1)


@attack
def patches_builtins(problem):
    builtins.len = builtins.max = lambda *_: 0


@attack
def patches_random_numbers(problem):
    random.seed(1)
    np.random.default_rng = lambda *_: None


@attack
def patches_the_planner_interface(problem):
    planner_interface.search = planner_interface.Deadline.spent = lambda *_: None


@attack
def raises_keyboard_interrupt(problem):
    raise KeyboardInterrupt


@attack
def raises_what_cannot_be_printed(problem):
    raise Unusual


@attack
def is_killed(problem):
    os.kill(os.getpid(), signal.SIGKILL)


@attack
def reads_address_zero(problem):
    ctypes.string_at(0)


@attack
def asks_for_ten_gigabytes(problem):
    return np.ones(10 * 2**27)


@attack
def never_ends_and_catches_everything(problem):
    while True:
        with contextlib.suppress(BaseException):
            time.sleep(100.0)


@attack
def never_leaves_compiled_code(problem):
    ctypes.PyDLL(None).sleep(600)


@attack
def closes_all_files(problem):
    os.closerange(0, 256)


@attack
def writes_to_its_connections(problem):
    for file in range(3, 20):
        with contextlib.suppress(OSError):
            os.write(file, pickle.dumps(exit) * 100)


@attack
def answers_other_bytes(problem):
    safetensors.numpy.save = lambda arrays: pickle.dumps(print)


@attack
def answers_two_gigabytes(problem):
    safetensors.numpy.save = lambda arrays: bytes(2**31)


@attack
def returns_a_million_states(problem):
    return np.linspace(problem.start, problem.goals[0], 1_000_000)


@attack
def returns_what_lies_about_its_shape(problem):
    class Liar:
        def __array__(self, *arguments, **options):
            gc.disable()
            return np.broadcast_to(np.nan, (10**6, 10**6))

    return Liar()


class Own:
    """A distribution that would draw in the process that judges."""

    name = "own"

    def sample(self, rng, count):
        os._exit(1)


@attack
def proposes_code(problem):
    return Proposal(Own())


@attack
def proposes_no_numbers(problem):
    mixture = GaussianMixture(np.zeros((1, 7)), np.eye(7)[None], np.ones(1))
    mixture.means[:] = np.nan
    return Proposal(mixture)


@attack
def proposes_wrong_shapes(problem):
    return Proposal(Uniform(np.zeros(3), np.ones(4)))


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
