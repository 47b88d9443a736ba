"""Paths as sequences of codes, both ways, with what a sequence model has to predict."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class CodeSequences:
    """Sequences (b, ...) without consecutive repeats, at most t codes of each."""

    codes: Tensor
    """(b, t) int64, padded with code 0."""
    targets: Tensor
    """(b, t + 1) int64: the next code after the start token and after each code, the goal class after the last."""
    visible: Tensor
    """(b, t + 1) bool: False where there is nothing to predict."""


def code_sequences(codes: Tensor, counts: Tensor, most: int, goal_class: int) -> CodeSequences:
    """Both directions of paths given by the codes of their waypoints.

    Parameters
    ----------
    codes
        (p, w) int64, padded.
    counts
        (p,) waypoints of each path.
    most
        Codes of a sequence; longer ones are cut and do not predict their end.

    Returns
    -------
    2 p sequences: path 0 forwards, path 0 backwards, path 1 forwards, ...
    """
    p, w = codes.shape
    real = torch.arange(w, device=codes.device) < counts[:, None]
    begins = real.clone()
    begins[:, 1:] &= codes[:, 1:] != codes[:, :-1]
    run = (begins.cumsum(1) - 1).clamp(min=0)
    lengths = begins.sum(1)
    packed = codes.new_zeros(p, w + 1).scatter_(1, torch.where(real, run, w), codes)[:, :w]
    place = torch.arange(w, device=codes.device)
    backwards = packed.gather(1, (lengths[:, None] - 1 - place) % w)
    both = torch.stack((packed, backwards), 1).flatten(0, 1)
    lengths = lengths.repeat_interleave(2)
    t = min(int(lengths.max()), most)
    step = torch.arange(w + 1, device=codes.device)
    targets = torch.cat((both, both[:, :1]), 1).masked_fill(step == lengths[:, None], goal_class)
    visible = step <= lengths[:, None]
    both = both.masked_fill(place >= lengths[:, None], 0)
    return CodeSequences(both[:, :t], targets[:, : t + 1], visible[:, : t + 1])
