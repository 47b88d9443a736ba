"""What the models predict for a start and goals: code sequences, their union and its Gaussians."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.models.decoding.beam_search import CodeSequence
from cvqmpt_lab.prediction.code_decoder import Refinement


@dataclass(frozen=True, eq=False)
class Prediction:
    """Code sequences to each of k goals, and the c codes of their union with their Gaussians.

    A goal's codes are those of its finished sequences, likeliest sequence first.
    """

    start: np.ndarray
    """(n,) [rad or m]."""
    goals: np.ndarray
    """(k, n) [rad or m]."""
    sequences: tuple[tuple[CodeSequence, ...], ...]
    """Of each goal, finished or not."""
    codes: np.ndarray
    """(c,) int64, indices into the dictionary."""
    goal_of: np.ndarray
    """(c,) int64, the goal each code is for."""
    z: np.ndarray
    """(c, code_dim), the codes' vectors of unit length; what the latent optimizer moves."""
    refinement: Refinement | None
    """What the model adds to each code's Gaussian; None when it has no refinement head."""
    mean_u: np.ndarray
    """(c, n), normalised joints."""
    covariance_u: np.ndarray
    """(c, n, n), normalised joints."""
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
        """Goals none of whose sequences reached the goal token; they have no codes."""
        return tuple(
            goal for goal, found in enumerate(self.sequences) if not any(one.finished for one in found)
        )


@dataclass(frozen=True, eq=False)
class CodeUnion:
    """Codes of each goal's finished sequences, and where each was found."""

    codes: np.ndarray
    """(c,) int64."""
    goal_of: np.ndarray
    """(c,) int64, the goal each code is for."""
    sequence: np.ndarray
    """(c,) int64, the row of `padded` it was found in ..."""
    place: np.ndarray
    """(c,) int64, ... and its place there."""
    padded: np.ndarray
    """(s, t) int64, the sequences that are used."""
    goal_of_sequence: np.ndarray
    """(s,) int64."""

    @classmethod
    def of(cls, sequences: tuple[tuple[CodeSequence, ...], ...], repeated: bool = False) -> "CodeUnion":
        """The union for each goal, its likeliest sequence first; repeated codes count once unless `repeated`."""
        entries: list[tuple[int, int, int, int]] = []
        used: list[tuple[int, tuple[int, ...]]] = []
        for goal, found in enumerate(sequences):
            seen: set[int] = set()
            finished = [one for one in found if one.finished]
            for one in sorted(finished, key=lambda sequence: -sequence.log_probability):
                count = len(entries)
                for spot, key in enumerate(one.codes):
                    if repeated or key not in seen:
                        seen.add(key)
                        entries.append((key, goal, len(used), spot))
                if len(entries) > count:
                    used.append((goal, one.codes))
        padded = np.zeros((len(used), max((len(codes) for _, codes in used), default=0)), dtype=np.int64)
        for row, (_, codes) in enumerate(used):
            padded[row, : len(codes)] = codes
        code, goal_of, sequence, place = np.array(entries, dtype=np.int64).reshape(-1, 4).T
        goal_of_sequence = np.array([goal for goal, _ in used], dtype=np.int64)
        return cls(code, goal_of, sequence, place, padded, goal_of_sequence)
