"""A learned sampler as a product of choices: predictor of codes, Gaussians, update and others.

    predictor   transformer: the scene transformer; published: the authors' architecture;
                random: random codes; uniform: no codes, samples anywhere within the joint limits;
                oracle: codes of a path that ignores the constraint; solved: the shortest of six
                solutions, a bound;
                transformer-lines: straight lines to the goals that the transformer chooses;
                nearest-lines: straight lines to the three nearest goals
    Gaussians   decoded: g(z) = N(mu, Sigma) of the decoder;
                wide: around each code's node of the roadmap, at least 1.1 rad in every direction;
                along: N(q, std^2 I) every 0.4 rad along the sequence's nodes, from start to goal
    std         standard deviation of Gaussians along a sequence [rad]
    reading     merged: the codes of a sequence as predicted;
                every-waypoint: the codes of all states, 0.13 rad apart, along the sequence's nodes,
                as the authors encode paths; repeated codes are left out
    update      none; algorithm-2: codes are moved by gradient towards F(q) = 0;
                printed: the same by plain gradient steps, and codes that got worse stay moved;
                projected: every mean is projected onto F(q) = 0
    sequences   likeliest: the transformer's best hypothesis for each goal (paper);
                all-beams: all three hypotheses
    cloud       own-cloud: of the scene; other-cloud: of another scene; no-cloud: no points
    draws       projected-draws: samples are projected onto F(q) = 0 before trees extend (paper);
                raw-draws: they are not; free-draws: projected, and drawn again if they collide
    reach       maximum length of extensions towards a sample [rad]; inf as printed
    half        both-halves: draws for both trees from the whole sequence (paper);
                own-half: for the tree from the start from its first half, for the one from the goal
                from the second half and around the goal
    chosen      any-draw (paper); clearest-draw: of eight draws the one whose body is least inside
                the cloud
    host        in-birrt: Algorithm 3 as the paper prints it;
                in-ompl: OMPL's RRTConnect, in which the paper ran its experiments
    goals       goals-together: sequences to the cheapest three goals, search for all goals;
                goals-apart: one goal after the other, each with a query and an equal share of the
                budget (paper: 20 goals, 2.5 s each);
                goals-again: goals-apart; all goals get short tries before any goal gets a long one
                goals-ranked: goals-again, the cheapest predicted goal first

The distribution is the mixture of the codes' Gaussians and of one around each predicted goal, all
of equal weight (paper, eqn. sample_dist, and its code), plus a uniform share. Gaussians `along` a
sequence include its goal.
"""

import math
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
    "goals": ("goals-together", "goals-apart", "goals-again", "goals-ranked"),
    "half": ("both-halves", "own-half"),
    "chosen": ("any-draw", "clearest-draw"),
    "host": ("in-birrt", "in-ompl"),
}


@dataclass(frozen=True, kw_only=True)
class SamplerChoice:
    """One combination of choices; texts are keys of CHOICES, see the module."""

    predictor: str
    gaussians: str = "decoded"
    update: str = "none"
    cloud: str = "own-cloud"
    uniform_share: float = 0.0  # share of all samples; 0 is not probabilistically complete
    sequences: str = "likeliest"
    reading: str = "merged"
    draws: str = "projected-draws"
    reach: float = math.inf  # [rad]
    goals: str = "goals-together"
    half: str = "both-halves"
    chosen: str = "any-draw"
    host: str = "in-birrt"
    std: float = 0.9  # [rad], tuned

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            require_choice(f"{name} of a learned sampler", getattr(self, name), known)
        along, every = self.gaussians == "along", self.reading == "every-waypoint"
        spread = "along" if along else "every-waypoint"
        codeless = "along" if along else "uniform"
        # predictors without configurations from start to goal
        pathless = self.predictor in ("published", "random", "uniform")
        # these have a path or lines instead of codes
        without_codes = self.predictor in ("solved", "transformer-lines", "nearest-lines")
        for broken, why in (
            (
                self.sequences == "all-beams" and self.predictor != "transformer",
                f"all-beams goes with predictor transformer, not {self.predictor}",
            ),
            (
                (along or every) and pathless,
                f"{spread} needs a path or sequence: predictor {self.predictor} has none",
            ),
            (
                without_codes and not (along or every),
                f"predictor {self.predictor} has no codes of its own: add every-waypoint or along",
            ),
            (
                self.update != "none" and (along or self.predictor == "uniform"),
                f"{self.update} moves codes: {codeless} has none; leave one of them out",
            ),
            (
                self.goals == "goals-ranked" and self.predictor != "transformer",
                f"goals-ranked goes with predictor transformer, not {self.predictor}",
            ),
            (
                self.host == "in-ompl" and self.draws == "raw-draws",
                "in-ompl: OMPL projects every draw; leave raw-draws out",
            ),
            (
                self.host == "in-birrt" and (self.half, self.chosen) != ("both-halves", "any-draw"),
                "own-half and clearest-draw are choices inside OMPL: add in-ompl",
            ),
            (
                self.half == "own-half" and (along or self.predictor == "uniform"),
                f"own-half divides codes: {codeless} has none",
            ),
            (
                self.half == "own-half" and self.goals == "goals-together",
                "own-half divides the sequence to one goal: add goals-apart, -again or -ranked",
            ),
            (
                not 0.0 <= self.uniform_share <= 1.0,
                f"uniform share {self.uniform_share} of a learned sampler: give 0 to 1",
            ),
            (
                not self.reach > 0.0,
                f"reach {self.reach} of a learned sampler: give more than 0 [rad]; inf is no limit",
            ),
            (
                not 0.0 < self.std < math.inf,
                f"std {self.std} of a learned sampler: give a number above 0 [rad]",
            ),
        ):
            if broken:
                raise InvalidInputError(why)

    @classmethod
    def of(cls, text: str, wide_share: float = 0.15) -> Self:
        """Read choices joined by "+", such as ``random+wide+projected+uniform=0.15``.

        Args:
            text: the predictor, then at most one choice of each other kind.
            wide_share: default of the uniform share for Gaussians that are wide or along a
                sequence.

        Raises:
            UnknownChoiceError: a choice is unknown.
            InvalidInputError: a kind has two choices, or a number is malformed.
        """
        numbers = {  # name before "=": field, and its valid numbers
            "uniform": ("uniform_share", "0 to 1"),
            "std": ("std", "above 0 [rad]"),
            "reach": ("reach", "above 0 [rad], or inf"),
        }
        predictor, *words = text.split("+")
        kinds = {
            word: kind for kind, known in CHOICES.items() if kind != "predictor" for word in known
        }
        found: dict[str, Any] = {}
        for word in words:
            name, equals, number = word.partition("=")
            value: str | float = word
            if equals and name in numbers:
                kind, valid = numbers[name]
                try:
                    value = float(number)
                except ValueError as error:
                    raise InvalidInputError(
                        f"{word!r}: give a number, {valid}, behind '{name}='"
                    ) from error
            elif word in kinds:
                kind = kinds[word]
            else:
                known = [*kinds, "uniform=0.15", "std=0.9", "reach=1"]
                raise UnknownChoiceError(f"part of planner {PREFIX}{text}", word, known)
            if kind in found:
                raise InvalidInputError(
                    f"planner {PREFIX}{text} has two parts of one kind, {word!r} is the second"
                )
            found[kind] = value
        if found.get("gaussians") in ("wide", "along"):
            found.setdefault("uniform_share", wide_share)
        return cls(predictor=predictor, **found)


NAMED_SAMPLERS = {
    "cvq-mpt": SamplerChoice.of("transformer+decoded+goals-apart"),
    "opt-cvq-mpt": SamplerChoice.of("transformer+decoded+goals-apart+algorithm-2"),
    "cvq-published": SamplerChoice.of("published+decoded+goals-apart"),
    "ompl-cvq": SamplerChoice.of("transformer+decoded+goals-apart+in-ompl"),
    "ompl-opt-cvq": SamplerChoice.of("transformer+decoded+goals-apart+algorithm-2+in-ompl"),
    "ompl-cvq-dense": SamplerChoice.of("transformer+decoded+every-waypoint+goals-apart+in-ompl"),
    "ompl-opt-cvq-dense": SamplerChoice.of(
        "transformer+decoded+every-waypoint+goals-apart+algorithm-2+in-ompl"
    ),
    "ompl-cvq-tuned": SamplerChoice.of(
        "transformer+decoded+every-waypoint+algorithm-2+goals-ranked"
        "+own-half+clearest-draw+free-draws+in-ompl"
    ),
    "ompl-cvq-published": SamplerChoice.of("published+decoded+goals-apart+in-ompl"),
    "cvq-wide": SamplerChoice.of("transformer+wide+projected+all-beams+reach=1"),
    "cvq-tuned": SamplerChoice.of("transformer+along+all-beams+free-draws+reach=1"),
}
"""Choices of planners with a name. ``ompl-...`` are the paper's experiments; the first three are
the same samplers in the search that the paper prints, Algorithm 3; wide and tuned ones are ours."""
