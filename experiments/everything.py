"""All that is reported, as a list of experiments: every suite, the controls, and how much of each."""

from collections.abc import Mapping
from dataclasses import dataclass

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.methods.table import CONTROLS
from cvqmpt_lab.planning.result import Budget
from experiments.run import Experiment
from experiments.suites.table import SUITES

CONTROLLED = ("birrt", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq", *CONTROLS)
CONTROLS_FOLDER = "controls"


@dataclass(frozen=True)
class Amount:
    """How much of a suite is run."""

    problems: int | None = None
    """The first ones; all when None."""
    seeds: int = 1
    cutoff: float = 10.0
    """[s]."""


FULL: Mapping[str, Amount] = {
    **{name: Amount(cutoff=3.0 if name.startswith("family-") else 10.0) for name in SUITES},
    "place-task": Amount(seeds=5),
    "multi-sequence": Amount(seeds=5),
    "sensor-robustness": Amount(cutoff=3.0),
    CONTROLS_FOLDER: Amount(60, cutoff=5.0),
}
"""By results folder: a night on two cores."""
SMALL: Mapping[str, Amount] = {
    "place-task": Amount(12, cutoff=2.0),
    "multi-sequence": Amount(2, cutoff=2.0),
    "sensor": Amount(3, cutoff=2.0),
    "family-shelves": Amount(3, cutoff=2.0),
    "robots-ur5": Amount(3, cutoff=2.0),
    **({"constraints": Amount(6, cutoff=2.0)} if "constraints" in SUITES else {}),
    CONTROLS_FOLDER: Amount(4, cutoff=2.0),
}
PROFILES: Mapping[str, Mapping[str, Amount]] = {"full": FULL, "small": SMALL}


@dataclass(frozen=True)
class Part:
    """The experiment of one results folder, and the command line that runs it alone."""

    folder: str
    experiment: Experiment
    command: tuple[str, ...]
    """Without --out and --jobs."""


def parts(profile: str) -> tuple[Part, ...]:
    """What is run, in order; UnknownChoiceError lists the profiles."""
    if profile not in PROFILES:
        raise UnknownChoiceError("profile", profile, PROFILES)
    return tuple(_part(folder, amount) for folder, amount in PROFILES[profile].items())


def _part(folder: str, amount: Amount) -> Part:
    name = "place-task" if folder == CONTROLS_FOLDER else folder
    suite = SUITES[name]
    planners = CONTROLLED if folder == CONTROLS_FOLDER else tuple(suite.planners)
    words = ["cvqmpt", "reproduce", name, "--seeds", str(amount.seeds), "--cutoff", f"{amount.cutoff:g}"]
    words += [] if amount.problems is None else ["--problems", str(amount.problems)]
    words += ["--planners", ",".join(planners)] if folder == CONTROLS_FOLDER else []
    experiment = Experiment(
        suite=name,
        problems=tuple(suite.problems[: amount.problems]),
        planners=planners,
        seeds=tuple(range(amount.seeds)),
        budget=Budget(seconds=amount.cutoff),
    )
    return Part(folder, experiment, tuple(words))
