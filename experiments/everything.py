"""All that is reported, as a list of experiments: every suite and the controls, in several amounts."""

from collections.abc import Mapping
from dataclasses import dataclass

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.methods.table import CONTROLS, PLANNERS
from cvqmpt_lab.planning.result import Budget
from experiments.run import Experiment
from experiments.suites.suite import SUITES

CONTROLS_FOLDER = "controls"
CONTROLLED = ("birrt", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq", *CONTROLS)
SLOW = ("atlas-rrt", "tb-rrt")
"""Planners that spend most of their time in runs that time out."""
QUICK = tuple(name for name in PLANNERS if name not in SLOW)
HEADED = ("birrt", "ompl-projected", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq")
ISOLATED = ("straight-line", "cvq-wrong-cloud")
"""Controls that say what helps in scenes of other families."""
FAMILY = tuple(name for name in QUICK if name not in ("ompl-projected", "mpnet")) + ISOLATED
ON_OTHER_ROBOTS = ("birrt", "ompl-projected")


@dataclass(frozen=True)
class Amount:
    """How much of a suite is run; several amounts of one folder add up."""

    folder: str
    """Of its results: the suite's name, or `CONTROLS_FOLDER`."""
    problems: int | None = None
    """The first ones; all when None."""
    seeds: int = 1
    cutoff: float = 10.0
    """[s]."""
    planners: tuple[str, ...] | None = None
    """Those of the suite when None."""

    @property
    def suite(self) -> str:
        """What is run."""
        return "place-task" if self.folder == CONTROLS_FOLDER else self.folder


CONTROLS_OF = Amount(CONTROLS_FOLDER, 60, cutoff=5.0, planners=CONTROLLED)
FAMILIES = tuple(name for name in SUITES if name.startswith("family-"))
ROBOTS = tuple(name for name in SUITES if name.startswith("robots-"))
FULL = (
    Amount("place-task", seeds=5),
    CONTROLS_OF,
    Amount("multi-sequence", seeds=5),
    Amount("place-task-with-can"),
    Amount("sensor"),
    Amount("constraints", cutoff=5.0),
    Amount("place-task-single-goal", cutoff=5.0),
    *(Amount(name, cutoff=3.0, planners=(*PLANNERS, *ISOLATED)) for name in FAMILIES),
    *(Amount(name) for name in ROBOTS),
    Amount("sensor-robustness", cutoff=3.0),
    Amount("open-door"),
)
HOUR = (
    Amount("place-task"),
    CONTROLS_OF,
    Amount("multi-sequence", seeds=3, planners=QUICK),
    Amount("sensor"),
    Amount("constraints", cutoff=5.0),
    Amount("place-task-single-goal", cutoff=5.0, planners=QUICK),
    *(Amount(name, cutoff=3.0, planners=FAMILY) for name in FAMILIES),
    *(Amount(name, planners=ON_OTHER_ROBOTS) for name in ROBOTS),
    Amount("sensor-robustness", cutoff=3.0),
    Amount("place-task", seeds=5, planners=QUICK),
    Amount("multi-sequence", seeds=5, planners=QUICK),
    Amount("multi-sequence"),
    Amount("place-task-with-can", planners=QUICK),
)
SMALL = (
    Amount("place-task", 10, cutoff=2.0),
    Amount("multi-sequence", 2, cutoff=2.0, planners=HEADED),
    Amount("sensor", 2, cutoff=2.0),
    Amount("place-task-with-can", 5, cutoff=2.0, planners=HEADED),
    Amount("family-shelves", 3, cutoff=2.0, planners=HEADED),
    Amount("robots-ur5", 3, cutoff=2.0, planners=ON_OTHER_ROBOTS),
    Amount("constraints", 8, cutoff=2.0),
    Amount(CONTROLS_FOLDER, 3, cutoff=2.0, planners=CONTROLLED),
)
PROFILES: Mapping[str, tuple[Amount, ...]] = {"full": FULL, "hour": HOUR, "small": SMALL}
"""What a night, about an hour and ten minutes on two cores are enough for; an hour's is what is committed."""


@dataclass(frozen=True)
class Part:
    """The experiment of one amount, and the command line that runs it alone."""

    folder: str
    experiment: Experiment
    command: tuple[str, ...]
    """Without --out and --jobs."""


def parts(profile: str) -> tuple[Part, ...]:
    """What is run, in order; UnknownChoiceError lists the profiles."""
    if profile not in PROFILES:
        raise UnknownChoiceError("profile", profile, PROFILES)
    return tuple(map(_part, PROFILES[profile]))


def _part(amount: Amount) -> Part:
    suite = SUITES[amount.suite]
    words = [
        "cvqmpt",
        "reproduce",
        suite.name,
        "--seeds",
        str(amount.seeds),
        "--cutoff",
        f"{amount.cutoff:g}",
    ]
    words += [] if amount.problems is None else ["--problems", str(amount.problems)]
    words += [] if amount.planners is None else ["--planners", ",".join(amount.planners)]
    experiment = Experiment(
        suite=suite.name,
        problems=tuple(suite.problems[: amount.problems]),
        planners=amount.planners or tuple(suite.planners),
        seeds=tuple(range(amount.seeds)),
        budget=Budget(seconds=amount.cutoff),
    )
    return Part(amount.folder, experiment, tuple(words))
