"""A learned sampler as a product of choices: who predicts codes, which Gaussians they become, how
these are moved.

    predictor   transformer: the scene transformer; published: the authors' architecture;
                random: any codes; oracle: codes of a path that ignores the constraint
    Gaussians   decoded: g(z) = N(mu, Sigma) as the decoder has them;
                wide: around each code's node of the roadmap, no direction narrower than WIDTH
    update      none; algorithm-2: codes moved by gradient towards F(q) = 0;
                projected: every mean is projected onto F(q) = 0
    sequences   likeliest: the best of the transformer's beams to each goal (paper);
                all-beams: all three
    cloud       own-cloud: the scene's; other-cloud: that of another scene; no-cloud: no points

Sampled from is the mixture of the codes' Gaussians and one around each goal that was asked about,
all equally likely (paper, eqn. sample_dist, and its code), and a uniform share.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError

PREFIX = "cvq:"
PREDICTORS = ("transformer", "published", "random", "oracle")
GAUSSIANS = ("decoded", "wide")
UPDATES = ("none", "algorithm-2", "projected")
SEQUENCES = ("likeliest", "all-beams")
CLOUDS = ("own-cloud", "other-cloud", "no-cloud")
WORDS = {"gaussians": GAUSSIANS, "update": UPDATES, "sequences": SEQUENCES, "cloud": CLOUDS}
UNIFORM = "uniform="
WIDE_SHARE = 0.15  # uniform share that wide Gaussians get where none is given


@dataclass(frozen=True, kw_only=True)
class SamplerChoice:
    """One product."""

    predictor: str  # of PREDICTORS
    gaussians: str = "decoded"  # of GAUSSIANS
    update: str = "none"  # of UPDATES
    cloud: str = "own-cloud"  # of CLOUDS
    # of samples between the joint limits; at 0 a planner is not probabilistically complete
    uniform_share: float = 0.0
    sequences: str = "likeliest"  # of SEQUENCES; of the transformer

    def __post_init__(self) -> None:
        for name, known in {"predictor": PREDICTORS, **WORDS}.items():
            if getattr(self, name) not in known:
                raise UnknownChoiceError(f"{name} of a learned sampler", getattr(self, name), known)
        if self.sequences == "all-beams" and self.predictor != "transformer":
            raise InvalidInputError(
                f"all-beams goes with predictor transformer, not {self.predictor}"
            )
        if not 0.0 <= self.uniform_share <= 1.0:
            raise InvalidInputError(
                f"uniform share {self.uniform_share} of a learned sampler: give 0 to 1"
            )

    @classmethod
    def of(cls, text: str) -> Self:
        """From words joined by "+", such as ``random+wide+projected+uniform=0.15``:
        the predictor first.
        """
        predictor, *words = text.split("+")
        found: dict[str, Any] = {}
        for word in words:
            kind = next((kind for kind, known in WORDS.items() if word in known), None)
            kind = "uniform_share" if word.startswith(UNIFORM) else kind
            if kind is None:
                known = [*(word for words in WORDS.values() for word in words), f"{UNIFORM}0.15"]
                raise UnknownChoiceError(f"part of planner {PREFIX}{text}", word, known)
            if kind in found:
                raise InvalidInputError(
                    f"planner {PREFIX}{text} has two parts of one kind, {word!r} is the second"
                )
            found[kind] = _share(word) if kind == "uniform_share" else word
        if found.get("gaussians") == "wide":
            found.setdefault("uniform_share", WIDE_SHARE)
        return cls(predictor=predictor, **found)


def _share(word: str) -> float:
    try:
        return float(word.removeprefix(UNIFORM))
    except ValueError as error:
        raise InvalidInputError(
            f"{word!r}: give a number from 0 to 1 behind {UNIFORM!r}"
        ) from error


NAMED: Mapping[str, SamplerChoice] = {
    "cvq-mpt": SamplerChoice.of("transformer+decoded"),
    "opt-cvq-mpt": SamplerChoice.of("transformer+decoded+algorithm-2"),
    "cvq-published": SamplerChoice.of("published+decoded"),
    "cvq-wide": SamplerChoice.of("transformer+wide+projected+all-beams"),
}
"""Products that planners are named after. The first three are the paper's, the last is ours."""
