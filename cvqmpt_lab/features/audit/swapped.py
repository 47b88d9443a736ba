"""Episodes whose joints stand where two other joints of the other episodes stand: swapped columns.

Episodes of one data set begin alike, so that medians of a joint are close to each other. The spread
of a joint is 1.48 times the median distance of its medians from their median, at least SPREAD.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cvqmpt_lab.features.audit.rows import NOT_READ, REFUSED, Row

LEAST_EPISODES = 8
SPREAD = 0.05  # [rad or m]
FAR, NEAR = 5.0, 3.0  # spreads from the other episodes before and after the joints change places


def with_swapped_joints(rows: Sequence[Row]) -> list[Row]:
    """Return the rows; an episode with two joints that are swapped is refused."""
    kinds = dict[tuple[str, ...], list[int]]()
    for k, row in enumerate(rows):
        if row.verdict != NOT_READ and row.middle:
            kinds.setdefault(tuple(row.medians), []).append(k)
    found = list(rows)
    for names, places in kinds.items():
        if len(places) < LEAST_EPISODES:
            continue
        medians = np.array([list(rows[k].medians.values()) for k in places])
        for k, own in zip(places, medians, strict=True):
            pair = swapped_pair(own, medians)
            if pair is None or "swapped" in rows[k].kinds.split():
                continue
            first, second = (names[i] for i in pair)
            text = f"{first} and {second} are swapped: each stands where the other does in the "
            text += "other episodes"
            kinds_now = f"swapped {rows[k].kinds}".strip()
            found[k] = replace(
                rows[k], verdict=REFUSED, kinds=kinds_now, fault=text, joint=first, time_s=None
            )
    return found


def swapped_pair(own: np.ndarray, medians: np.ndarray) -> tuple[int, int] | None:
    """Return two joints of an episode that fit the others only if they change places, or None.

    Args:
        own: (n,) medians of the joints in the episode.
        medians: (k, n) of all episodes.
    """
    centre = np.median(medians, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(medians - centre), axis=0), SPREAD)
    off = np.abs(own - centre) / spread
    # (n, n) distance of the value of joint i from where joint j stands
    crossed = np.abs(own[:, None] - centre) / spread
    far = np.flatnonzero(off > FAR)
    pairs = [(i, j) for i in far for j in far if i < j]
    fits = [(i, j) for i, j in pairs if max(crossed[i, j], crossed[j, i]) < NEAR]
    return (int(fits[0][0]), int(fits[0][1])) if len(fits) == 1 else None
