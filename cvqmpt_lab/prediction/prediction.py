"""What a sequence model predicts for a start and goals: code sequences, their union and its Gaussians."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from cvqmpt_lab.models.decoding.beam_search import CodeSequence


@dataclass(frozen=True, eq=False)
class Prediction:
    """A code sequence to each of k goals, and the c codes of those that are finished with their Gaussians."""

    goals: np.ndarray
    """(k, n) [rad or m]."""
    sequences: tuple[CodeSequence, ...]
    """To each goal, finished or not."""
    codes: np.ndarray
    """(c,) int64, indices into the dictionary."""
    goal_of: np.ndarray
    """(c,) int64, the goal each code is for."""
    z: np.ndarray
    """(c, code_dim), the codes' vectors of unit length; what the latent optimizer moves."""
    means: np.ndarray
    """(c, n) [rad]."""
    covariances: np.ndarray
    """(c, n, n) [rad^2]."""
    encode_seconds: float
    """From the cloud to tokens."""
    predict_seconds: float
    """From tokens to Gaussians."""
    cached: bool
    """Whether the scene was known."""

    @property
    def unfinished(self) -> tuple[int, ...]:
        """Goals whose sequence did not reach the goal token; they have no codes."""
        return tuple(goal for goal, found in enumerate(self.sequences) if not found.finished)


@dataclass(frozen=True, eq=False)
class CodeUnion:
    """Codes of the finished sequences."""

    codes: np.ndarray
    """(c,) int64."""
    goal_of: np.ndarray
    """(c,) int64, the goal each code is for."""

    @classmethod
    def of(cls, sequences: list[CodeSequence], repeated: bool = False) -> Self:
        """The codes to each goal in order; those that a sequence repeats count once unless `repeated`."""
        of_goal = [
            (one.codes if repeated else tuple(dict.fromkeys(one.codes))) if one.finished else ()
            for one in sequences
        ]
        codes = np.array([code for codes in of_goal for code in codes], dtype=np.int64)
        return cls(codes, np.repeat(np.arange(len(of_goal)), [len(codes) for codes in of_goal]))
