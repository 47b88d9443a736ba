"""All that is reported, as a list of experiments: every suite and the controls, in several amounts."""

from collections.abc import Mapping
from dataclasses import dataclass

from cvqmpt_lab.benchmarks.suite import SUITES, Suite
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.planners import CONTROLS, PLANNERS, WITHOUT_WEIGHTS
from cvqmpt_lab.search.result import Budget
from experiments import factorial
from experiments.run import Experiment

# for problems that no shipped weights fit, and for constraints that no model has seen
FREE_OF_WEIGHTS = tuple(name for name in PLANNERS if name in WITHOUT_WEIGHTS)
IN_A_NEW_KITCHEN = (
    "birrt",
    "ompl-projected",
    "cvq-mpt",
    "opt-cvq-mpt",
    "cvq-wide",
    "roadmap",
    "roadmap-cvq",
)
PLANNERS_OF: Mapping[str, tuple[str, ...]] = {  # of other suites all
    "place-task-mirrored": IN_A_NEW_KITCHEN,
    "constraints": ("birrt", "ompl-projected", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq"),
    "factorial": factorial.PLANNERS,
    "factorial-constraints": factorial.PLANNERS,
    "open-door": FREE_OF_WEIGHTS,
    "robots": ("birrt", "ompl-projected", "roadmap"),
    # the last three are entry points, see `experiments.peers`
    "peers": ("birrt", "roadmap", "roadmap-cvq", "roboplan", "sscbirrt", "hpp"),
}


def planners_of(suite: Suite) -> tuple[str, ...]:
    """What runs on a suite unless others are named; on a folder those that can serve all of it."""
    if not suite.digests:
        return PLANNERS_OF.get(suite.name, tuple(PLANNERS))
    problems = [suite.solvable(name) for name in suite.problems]
    return tuple(
        name
        for name, method in PLANNERS.items()
        if not any(method.incompatibility(problem) for problem in problems)
    )


CONTROLS_FOLDER = "controls"
CONTROLLED = ("birrt", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq", *CONTROLS)
SLOW = ("atlas-rrt", "tb-rrt")  # most of their time goes into runs that time out
QUICK = tuple(name for name in PLANNERS if name not in SLOW)
SOME = ("birrt", "ompl-projected", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq")
ISOLATED = (
    "straight-line",
    "roadmap-uniform-0",
    "roadmap-uniform-1",
    "roadmap-uniform-2",
)  # controls that say what helps in scenes of other families
FAMILY = (
    tuple(name for name in QUICK if name not in ("ompl-projected", "mpnet", "mpnet-bridged"))
    + ISOLATED
)


@dataclass(frozen=True)
class Amount:
    """How much of a suite is run; several amounts of one folder add up."""

    folder: str  # of its results: the suite's name, or `CONTROLS_FOLDER`
    problems: int | None = None  # the first ones; all when None
    seeds: int = 1
    cutoff: float = 10.0  # [s]
    planners: tuple[str, ...] | None = None  # those of the suite when None

    @property
    def suite(self) -> Suite:
        """What is run."""
        return SUITES["place-task" if self.folder == CONTROLS_FOLDER else self.folder]

    @property
    def experiment(self) -> Experiment:
        """Its runs."""
        return Experiment(
            suite=self.suite.name,
            problems=tuple(self.suite.problems[: self.problems]),
            planners=self.planners or planners_of(self.suite),
            seeds=tuple(range(self.seeds)),
            budget=Budget(seconds=self.cutoff),
        )

    @property
    def command(self) -> list[str]:
        """The command line that runs it alone, without --out and --jobs."""
        words = (
            f"cvqmpt reproduce {self.suite.name} --seeds {self.seeds} --cutoff {self.cutoff:g}"
        ).split()
        words += [] if self.problems is None else ["--problems", str(self.problems)]
        return words + ([] if self.planners is None else ["--planners", ",".join(self.planners)])


CONTROLS_OF = Amount(CONTROLS_FOLDER, 60, cutoff=5.0, planners=CONTROLLED)
FAMILIES = tuple(name for name in SUITES if name.startswith("family-"))
FACTORIAL = (Amount("factorial", seeds=3, cutoff=3.0), Amount("factorial-constraints", cutoff=2.0))
FULL = (
    Amount("place-task", seeds=5, planners=QUICK),
    Amount("multi-sequence", seeds=5, planners=QUICK),
    Amount("place-task-mirrored"),
    CONTROLS_OF,
    Amount("place-task-single-goal", cutoff=5.0, planners=QUICK),
    Amount("place-task-with-can", planners=QUICK),
    *FACTORIAL,
    Amount("constraints", cutoff=5.0),
    *(Amount(name, cutoff=3.0, planners=FAMILY) for name in FAMILIES),
    Amount("robots", seeds=3, cutoff=5.0),
    Amount("sensor", seeds=3, planners=QUICK),
    Amount("open-door"),
    Amount("place-task", seeds=3),
    Amount("multi-sequence"),
    Amount("sensor", seeds=3),
)
SMALL = (
    Amount("place-task", 10, cutoff=2.0),
    Amount("multi-sequence", 2, cutoff=2.0, planners=SOME),
    Amount("sensor", 2, cutoff=2.0),
    Amount("place-task-with-can", 5, cutoff=2.0, planners=SOME),
    Amount("family-shelves", 3, cutoff=2.0, planners=SOME),
    Amount("robots", 20, cutoff=2.0),
    Amount("constraints", 8, cutoff=2.0),
    Amount(CONTROLS_FOLDER, 3, cutoff=2.0, planners=CONTROLLED),
)
PROFILES: Mapping[str, tuple[Amount, ...]] = {"full": FULL, "small": SMALL}
"""What is committed, two hours on two cores, and a little of it, three minutes."""


def amounts(profile: str) -> tuple[Amount, ...]:
    """What is run, in order; UnknownChoiceError lists the profiles."""
    if profile not in PROFILES:
        raise UnknownChoiceError("profile", profile, PROFILES)
    return PROFILES[profile]
