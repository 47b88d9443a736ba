"""What the models predict for a start and goals: code sequences, their union and its Gaussians."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.models.decoding.beam_search import CodeSequence
from cvqmpt_lab.prediction.code_decoder import Refinement


@dataclass(frozen=True, eq=False)
class Prediction:
    """Code sequences to each of k goals, and the c codes of their union with their Gaussians.

    A goal's codes are the distinct ones of its finished sequences, likeliest sequence first.

    Attributes
    ----------
    start, goals: (n,), (k, n) [rad or m].
    sequences: of each goal, finished or not.
    codes, goal_of: (c,) int64, indices into the dictionary, and the goal each one is for.
    z: (c, code_dim), their vectors of unit length; what the latent optimizer moves.
    refinement: what the model adds to each code's Gaussian; None when it has no refinement head.
    mean_u, covariance_u: (c, n), (c, n, n), normalised joints.
    means, covariances: (c, n) [rad], (c, n, n) [rad^2].
    encode_seconds, predict_seconds: cloud to tokens, tokens to Gaussians. cached: the scene was known.
    """

    start: np.ndarray
    goals: np.ndarray
    sequences: tuple[tuple[CodeSequence, ...], ...]
    codes: np.ndarray
    goal_of: np.ndarray
    z: np.ndarray
    refinement: Refinement | None
    mean_u: np.ndarray
    covariance_u: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    encode_seconds: float
    predict_seconds: float
    cached: bool

    @property
    def unfinished(self) -> tuple[int, ...]:
        """Goals none of whose sequences reached the goal token; they have no codes."""
        return tuple(
            goal for goal, found in enumerate(self.sequences) if not any(one.finished for one in found)
        )


@dataclass(frozen=True, eq=False)
class CodeUnion:
    """Distinct codes of each goal's finished sequences, and where each was found first.

    codes, goal_of, sequence, place: (c,) int64. padded: (s, t) int64, the sequences that are used;
    goal_of_sequence: (s,).
    """

    codes: np.ndarray
    goal_of: np.ndarray
    sequence: np.ndarray
    place: np.ndarray
    padded: np.ndarray
    goal_of_sequence: np.ndarray

    @classmethod
    def of(cls, sequences: tuple[tuple[CodeSequence, ...], ...]) -> "CodeUnion":
        """The union for each goal, its likeliest sequence first."""
        entries: list[tuple[int, int, int, int]] = []
        used: list[tuple[int, tuple[int, ...]]] = []
        for goal, found in enumerate(sequences):
            seen: set[int] = set()
            finished = [one for one in found if one.finished]
            for one in sorted(finished, key=lambda sequence: -sequence.log_probability):
                count = len(seen)
                for spot, key in enumerate(one.codes):
                    if key not in seen:
                        seen.add(key)
                        entries.append((key, goal, len(used), spot))
                if len(seen) > count:
                    used.append((goal, one.codes))
        padded = np.zeros((len(used), max((len(codes) for _, codes in used), default=0)), dtype=np.int64)
        for row, (_, codes) in enumerate(used):
            padded[row, : len(codes)] = codes
        code, goal_of, sequence, place = np.array(entries, dtype=np.int64).reshape(-1, 4).T
        goal_of_sequence = np.array([goal for goal, _ in used], dtype=np.int64)
        return cls(code, goal_of, sequence, place, padded, goal_of_sequence)
