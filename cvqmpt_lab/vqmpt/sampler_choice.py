"""A learned sampler as a product of choices: predictor of codes, their Gaussians, their update.

    predictor   transformer: the scene transformer; published: the authors' architecture;
                random: any codes; oracle: codes of a path that ignores the constraint
    Gaussians   decoded: g(z) = N(mu, Sigma) as the decoder has them;
                wide: around each code's node of the roadmap, no direction narrower than 1.1 rad
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
CHOICES = {
    "predictor": ("transformer", "published", "random", "oracle"),
    "gaussians": ("decoded", "wide"),
    "update": ("none", "algorithm-2", "projected"),
    "sequences": ("likeliest", "all-beams"),
    "cloud": ("own-cloud", "other-cloud", "no-cloud"),
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

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
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
    def of(cls, text: str, wide_share: float = 0.15) -> Self:
        """Read words joined by "+", such as ``random+wide+projected+uniform=0.15``.

        Args:
            text: the predictor, then at most one word of each other kind.
            wide_share: uniform share that wide Gaussians get where none is given.

        Raises:
            InvalidInputError: a word is unknown, or the second of its kind.
        """
        predictor, *words = text.split("+")
        kinds = {word: kind for kind, known in CHOICES.items() for word in known}
        kinds = {word: kind for word, kind in kinds.items() if kind != "predictor"}
        found: dict[str, Any] = {}
        for word in words:
            name, is_share, share = word.partition("uniform=")
            kind = "uniform_share" if is_share and not name else kinds.get(word)
            if kind is None:
                known = [*kinds, "uniform=0.15"]
                raise UnknownChoiceError(f"part of planner {PREFIX}{text}", word, known)
            if kind in found:
                raise InvalidInputError(
                    f"planner {PREFIX}{text} has two parts of one kind, {word!r} is the second"
                )
            found[kind] = word
            if kind == "uniform_share":
                try:
                    found[kind] = float(share)
                except ValueError as error:
                    raise InvalidInputError(
                        f"{word!r}: give a number from 0 to 1 behind 'uniform='"
                    ) from error
        if found.get("gaussians") == "wide":
            found.setdefault("uniform_share", wide_share)
        return cls(predictor=predictor, **found)


NAMED: Mapping[str, SamplerChoice] = {
    "cvq-mpt": SamplerChoice.of("transformer+decoded"),
    "opt-cvq-mpt": SamplerChoice.of("transformer+decoded+algorithm-2"),
    "cvq-published": SamplerChoice.of("published+decoded"),
    "cvq-wide": SamplerChoice.of("transformer+wide+projected+all-beams"),
}
"""Products that planners are named after. The first three are the paper's, the last is ours."""
