"""The parts of the attack; each module lists its CHECKS."""

from collections.abc import Mapping, Sequence
from importlib import import_module

from cvqmpt_lab.errors import UnknownChoiceError
from experiments.trust.check import Check

PARTS: Mapping[str, str] = {
    "determinism": "experiments.trust.determinism",
    "faults": "experiments.trust.faults",
    "long-runs": "experiments.trust.long_runs",
}
"""Module of each part; only those asked for are imported."""


def checks_of(part: str) -> Sequence[Check]:
    """Checks of a part; UnknownChoiceError lists the parts."""
    if part not in PARTS:
        raise UnknownChoiceError("part", part, PARTS)
    return import_module(PARTS[part]).CHECKS
