"""How sequences are decoded and what the mixture is made of: our choices, and the authors'."""

from dataclasses import dataclass
from typing import get_args

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.models.decoding.beam_search import Scoring


@dataclass(frozen=True, kw_only=True)
class PredictorSettings:
    """How sequences are decoded and what the mixture is made of.

    Defaults were chosen on the tuning environments; the authors' are `AS_PUBLISHED`.
    """

    beams: int = 3
    """K of the paper's eqn. prob_eqn."""
    scoring: Scoring = "log-probability"
    """What beams are ranked by, see `beam_search`."""
    max_length: int | None = None
    """Tokens predicted at most, the goal token included; None for the model's own length."""
    goal_gaussian: bool = True
    """Also a Gaussian of 10 % of each joint's range around every goal (published code; the paper has none)."""
    repeated_codes: bool = False
    """A code that a goal's sequences hold several times counts as often in the mixture (published code)."""
    uniform_share: float = 0.5
    """Of samples drawn uniformly between the joint limits; 0 leaves the mixture without a tail."""
    uniform_without_codes: bool = False
    """Sample uniformly when no sequence reaches a goal (published code), else around the goals alone."""
    std_floor: float | None = 0.8
    """Gaussians are widened until no direction is narrower than this [rad]; None to leave them."""
    scenes: int = 8
    """How many encoded clouds are kept."""
    name: str = "cvq-mpt"

    def __post_init__(self) -> None:
        if self.scoring not in get_args(Scoring):
            raise UnknownChoiceError("scoring", self.scoring, get_args(Scoring))
        for name in ("beams", "scenes"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} of the predictor is {getattr(self, name)}; give at least 1")
        if not 0.0 <= self.uniform_share <= 1.0:
            raise InvalidInputError(f"uniform_share of the predictor is {self.uniform_share}; give 0 to 1")
        if self.std_floor is not None and not self.std_floor > 0.0:
            raise InvalidInputError(
                f"std_floor of the predictor is {self.std_floor}; give more than 0 rad, or None"
            )


AS_PUBLISHED = PredictorSettings(
    scoring="published",
    repeated_codes=True,
    uniform_share=0.0,
    uniform_without_codes=True,
    std_floor=None,
    name="cvq-as-published",
)
"""What the authors' code does."""
