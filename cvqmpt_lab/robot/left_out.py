"""Pairs of links that are not compared, with the reason."""

from collections.abc import Sequence
from typing import NamedTuple

from cvqmpt_lab.base.errors import few

# start of the reason why a pair is not checked: overlap in a share of random configurations
OVERLAP = "overlap in "


class LeftOut(NamedTuple):
    """Unchecked pair of links, or of a link and a piece of a door; and the reason.

    Reasons: "SRDF: " and the reason in the SRDF; "fixed to each other"; "also held by" (a load and
    a second hand); "adjacent" (one joint between them); "overlap in N % of random states" (the
    convex hulls are too large); "may touch" (hand and handle, named in the problem file); "casing"
    (a door and its fixed frame).
    """

    first: str
    second: str
    reason: str  # one of those above

    @classmethod
    def by_default(cls, first: str, second: str) -> "LeftOut":
        """Return a pair that an SRDF leaves out by the default of one of its links."""
        return cls(first, second, "SRDF: not compared by default")

    @staticmethod
    def named(pairs: "Sequence[LeftOut]") -> str:
        """Return the first few pairs in words, those that overlap in every state before others."""
        ordered = sorted(pairs, key=lambda pair: not pair.reason.startswith(OVERLAP))
        names = (f"{pair.first} and {pair.second}" for pair in ordered)
        return few(names, 3)
