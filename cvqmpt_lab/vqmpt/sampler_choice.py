"""A learned sampler as a product of choices: predictor of codes, their Gaussians, their update.

    predictor   transformer: the scene transformer; published: the authors' architecture;
                random: any codes; uniform: none, samples anywhere between the joint limits;
                oracle: codes of a path that ignores the constraint; solved: those of the shortest
                of six solutions, a bound;
                transformer-lines: straight lines to the transformer's goals; nearest-lines: to the
                three nearest goals
    Gaussians   decoded: g(z) = N(mu, Sigma) as the decoder has them;
                wide: around each code's node of the roadmap, no direction narrower than 1.1 rad;
                along: N(q, std^2 I) every 0.4 rad along the sequence's nodes, from start to goal
    std         of Gaussians along a sequence [rad]
    reading     merged: the codes of a sequence as predicted;
                every-waypoint: codes of all states, 0.13 rad apart, along the sequence's nodes, as
                the authors encode paths; runs of equal codes are one
    update      none; algorithm-2: codes moved by gradient towards F(q) = 0;
                printed: the same by plain gradient steps, where codes that got worse stay moved;
                projected: every mean is projected onto F(q) = 0
    sequences   likeliest: the best of the transformer's beams to each goal (paper);
                all-beams: all three
    cloud       own-cloud: the scene's; other-cloud: that of another scene; no-cloud: no points
    draws       projected-draws: onto F(q) = 0 before trees extend towards them (paper);
                raw-draws: not; free-draws: projected, and drawn again where they collide
    reach       of extensions towards a draw [rad]; inf as printed
    goals       goals-together: the cheapest three are asked about, the search gets all;
                goals-apart: one after the other, each with a query and an equal share of the budget
                (paper: 20 goals, 2.5 s each)

Sampled from is the mixture of the codes' Gaussians and one around each goal that was asked about,
all equally likely (paper, eqn. sample_dist, and its code), and a uniform share. Gaussians `along`
hold the goals already.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError, require_choice

PREFIX = "cvq:"
CHOICES = {
    "predictor": (
        *("transformer", "published", "random", "uniform"),
        *("oracle", "solved", "transformer-lines", "nearest-lines"),
    ),
    "gaussians": ("decoded", "wide", "along"),
    "reading": ("merged", "every-waypoint"),
    "update": ("none", "algorithm-2", "printed", "projected"),
    "sequences": ("likeliest", "all-beams"),
    "cloud": ("own-cloud", "other-cloud", "no-cloud"),
    "draws": ("projected-draws", "raw-draws", "free-draws"),
    "goals": ("goals-together", "goals-apart"),
}
# field: its word before "=", and what stands behind it
NUMBERS = {
    "uniform_share": ("uniform", "0 to 1"),
    "std": ("std", "above 0 [rad]"),
    "reach": ("reach", "above 0 [rad], or inf"),
}


@dataclass(frozen=True, kw_only=True)
class SamplerChoice:
    """One product of choices; values of all fields but the share are in CHOICES."""

    predictor: str
    gaussians: str = "decoded"
    update: str = "none"
    cloud: str = "own-cloud"
    uniform_share: float = 0.0  # of all samples; at 0 planners are not probabilistically complete
    sequences: str = "likeliest"  # of the transformer
    reading: str = "merged"
    draws: str = "projected-draws"
    reach: float = math.inf  # of extensions towards a draw [rad]
    goals: str = "goals-together"
    std: float = 0.9  # [rad] of Gaussians along a sequence, from tuning

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            require_choice(f"{name} of a learned sampler", getattr(self, name), known)
        along, every = self.gaussians == "along", self.reading == "every-waypoint"
        if self.sequences == "all-beams" and self.predictor != "transformer":
            raise InvalidInputError(
                f"all-beams goes with predictor transformer, not {self.predictor}"
            )
        # predictors without configurations from start to goal
        if (along or every) and self.predictor in ("published", "random", "uniform"):
            word = "along" if along else "every-waypoint"
            raise InvalidInputError(
                f"{word} needs a path or sequence: predictor {self.predictor} has none"
            )
        # codes of these are read along the way
        of_ways = self.predictor in ("solved", "transformer-lines", "nearest-lines")
        if of_ways and not (along or every):
            raise InvalidInputError(
                f"predictor {self.predictor} has no codes of its own: add every-waypoint or along"
            )
        if self.update != "none" and (along or self.predictor == "uniform"):
            word = "along" if along else "uniform"
            raise InvalidInputError(
                f"{self.update} moves codes: {word} has none; leave one of them out"
            )
        if not 0.0 <= self.uniform_share <= 1.0:
            raise InvalidInputError(
                f"uniform share {self.uniform_share} of a learned sampler: give 0 to 1"
            )
        if not self.reach > 0.0:
            raise InvalidInputError(
                f"reach {self.reach} of a learned sampler: give more than 0 [rad]; inf is no limit"
            )
        if not 0.0 < self.std < math.inf:
            raise InvalidInputError(
                f"std {self.std} of a learned sampler: give a number above 0 [rad]"
            )

    @classmethod
    def of(cls, text: str, wide_share: float = 0.15) -> Self:
        """Read words joined by "+", such as ``random+wide+projected+uniform=0.15``.

        Args:
            text: the predictor, then at most one word of each other kind.
            wide_share: uniform share of wide Gaussians and of those along a sequence where none is
                given.

        Raises:
            InvalidInputError: a word is unknown, or the second of its kind.
        """
        predictor, *words = text.split("+")
        others = {kind: known for kind, known in CHOICES.items() if kind != "predictor"}
        kinds = {word: kind for kind, known in others.items() for word in known}
        found: dict[str, Any] = {}
        for word in words:
            name, is_number, number = word.partition("=")
            numbers = [field for field, (said, _) in NUMBERS.items() if is_number and said == name]
            kind = numbers[0] if numbers else kinds.get(word)
            if kind is None:
                known = [*kinds, "uniform=0.15", "std=0.9", "reach=1"]
                raise UnknownChoiceError(f"part of planner {PREFIX}{text}", word, known)
            if kind in found:
                raise InvalidInputError(
                    f"planner {PREFIX}{text} has two parts of one kind, {word!r} is the second"
                )
            found[kind] = word
            if kind in NUMBERS:
                try:
                    found[kind] = float(number)
                except ValueError as error:
                    raise InvalidInputError(
                        f"{word!r}: give a number, {NUMBERS[kind][1]}, behind '{name}='"
                    ) from error
        if found.get("gaussians") in ("wide", "along"):
            found.setdefault("uniform_share", wide_share)
        return cls(predictor=predictor, **found)


PRINTED = "decoded+every-waypoint+goals-apart"  # how the paper reads sequences and tries goals
NAMED: Mapping[str, SamplerChoice] = {
    "cvq-mpt": SamplerChoice.of(f"transformer+{PRINTED}"),
    "opt-cvq-mpt": SamplerChoice.of(f"transformer+{PRINTED}+algorithm-2"),
    "cvq-published": SamplerChoice.of("published+decoded+goals-apart"),
    "cvq-wide": SamplerChoice.of("transformer+wide+projected+all-beams+reach=1"),
    "cvq-tuned": SamplerChoice.of("transformer+along+all-beams+free-draws+reach=1"),
}
"""Products that planners are named after. The first three are the paper's, the others are ours."""
