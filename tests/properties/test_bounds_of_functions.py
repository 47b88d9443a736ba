"""Functions of users whose bounds between states bound nothing at random places.

A function of random waves is evaluated here at 2 000 states of a motion.
"""

from itertools import pairwise

import numpy as np
import pytest

from cvqmpt_lab.base.errors import CvqmptError
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.constraints.function import FunctionConstraint
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import JointPath

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
NOTHING = Scene("nothing", ())
TOLERANCE = 5e-4  # of certificates
DENSE = 2000  # states judged on a motion
LIES = (np.nan, np.inf, -np.inf, -1e-9, -1.0, None, "1", True, 1j, [], [0.0, 0.0], np.float32(-2))


class Wave:
    """F = height sin^2(pi s / length) of the share s along a direction, 0 at states of a motion."""

    def __init__(self, rng, start, end, pieces):
        self.start, self.way = start, end - start
        self.pieces, dim = pieces, rng.integers(1, 3)
        self.heights = 10.0 ** rng.uniform(-5.5, -2.0, dim) * rng.choice([-1.0, 1.0], dim)
        self.dim = int(dim)

    def share(self, q):
        return (np.asarray(q) - self.start) @ self.way / (self.way @ self.way)

    def __call__(self, q):
        wave = np.sin(np.pi * self.pieces * self.share(q)) ** 2
        return wave[..., None] * self.heights

    @property
    def steepest(self):
        """A Lipschitz constant per rad."""
        return np.pi * self.pieces * np.abs(self.heights).max() / np.linalg.norm(self.way)


class Own(Constraint):
    """The same as a class of a user, whose bounds are an array."""

    dim = 0  # that of the wave, for each object

    def __init__(self, wave, bound):
        self.wave, self.bound, self.dim = wave, bound, wave.dim

    def residual(self, q):
        return self.wave(q)

    def jacobian(self, q):
        return np.zeros((*np.shape(q)[:-1], self.dim, 7)) + self.wave.way

    def describe(self):
        return "own = 0"

    def bound_between(self, states):
        return np.array([self.bound(a, b) for a, b in pairwise(states)])


def lying(rng, wave, places):
    """Return a bound that is none on random stretches, and the list of the lies that it told.

    places: how often it lies: "everywhere", "somewhere", "deep" (on short stretches) or "never".
    """
    lie, told = LIES[rng.integers(len(LIES))], []
    low = rng.uniform(0.0, 0.9)
    high = low + rng.uniform(0.02, 0.3)
    longest = np.linalg.norm(wave.way) / wave.pieces

    def bound(a, b):
        length, middle = np.linalg.norm(b - a), wave.share(0.5 * (a + b))
        lies = places == "everywhere" or (places == "somewhere" and low < middle < high)
        lies |= places == "deep" and length < 0.6 * longest
        if not lies:
            return 0.5 * wave.steepest * length
        told.append(lie)
        return lie

    return bound, told


@pytest.mark.promise(
    "no bound of a user's function that is nan, infinite, negative or no number certifies",
    "functions",
    ci=60,
    long=5000,
)
def test_bounds_that_bound_nothing(panda, trials):
    certified, wrong, errors = 0, {}, 0
    for number in range(trials):
        rng = np.random.default_rng(number)
        pieces = int(rng.integers(1, 12))
        way = rng.uniform(-0.03, 0.03, 7) * pieces**0.5
        states = np.linspace(HOME, HOME + way, pieces + 1)
        wave = Wave(rng, HOME, states[-1], pieces)
        bound, told = lying(rng, wave, ("everywhere", "somewhere", "deep", "never")[number % 4])
        made = Own(wave, bound)
        if rng.random() < 0.7:
            made = FunctionConstraint(wave.dim, wave, bound=bound, name="wave")
            made.accepted.add((panda.kinematics_digest, HOME.tobytes()))  # no check before the plan
        ends = NOTHING, HOME, states[-1:]
        try:
            valid = certify(
                PlanningProblem("p", panda, *ends, constraint=(made,)), JointPath(states)
            ).valid
        except CvqmptError as error:
            errors += 1
            assert told and str(error).isprintable(), (number, str(error))
            continue
        certified += valid
        most = np.abs(wave(np.linspace(HOME, states[-1], DENSE))).max()
        wrong |= {number: (most, told[:1])} if valid and (told or most > 1.01 * TOLERANCE) else {}
    assert wrong == {} and certified >= 0.1 * trials and errors >= 0.3 * trials


@pytest.mark.promise(
    "no bound of a user's function that is nan, infinite, negative or no number certifies",
    "functions",
    ci=40,
    long=1000,
)
def test_constants_that_bound_nothing(trials):
    """Lipschitz constants, among them those of numpy; one that is none is refused at once."""
    for number in range(trials):
        rng = np.random.default_rng(number)
        kind = (float, np.float64, np.float32, np.float16)[rng.integers(4)]
        value = kind(rng.choice([np.nan, np.inf, -np.inf, 0.0, -1.0, -rng.random()]))
        given = ([value], value, str(value), bool(number % 2), complex(1.0, rng.random()))[
            number % 5
        ]
        with pytest.raises(CvqmptError) as caught:
            FunctionConstraint(1, np.sin, bound=given)
        assert str(caught.value).isprintable()
