"""The check of a motion: of one curve between its points, and the worst of all its curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.certificate.certificate import Certificate, Clearance, Deviation
from cvqmpt_lab.features.motion.limit_use import LIMIT_OVERSHOOT, LimitUse


class DryRun(NamedTuple):
    """Certificate of a path or trajectory, with the faults of velocities, efforts and the like."""

    certificate: Certificate  # places of faults are numbers of `states`
    # (m, n) the certified states; of a trajectory, within CURVE_TOLERANCE of it [rad or m]
    states: np.ndarray
    # (m,) of the states, counted as those of the motion [s]; None for a path
    times: np.ndarray | None = None
    # largest distance of the robot's points from those on straight pieces between the states
    deviation_m: float = 0.0
    # "cubic", "quintic", "spline" or "linear", the worst one of those checked; "" for a path
    curve: str = ""
    uses: tuple[LimitUse, ...] = ()  # largest share of every limit, of a trajectory
    others: tuple[DryRun, ...] = ()  # checks of the other curves, where their states are others

    @property
    def limits_alone(self) -> bool:
        """Whether all faults are exceeded limits of rates and efforts, which slowing may cure."""
        return all(fault.kind in LIMIT_OVERSHOOT for fault in self.certificate.faults)


def worst_of(runs: Sequence[DryRun]) -> DryRun:
    """Return the check of the worst one of a motion's curves, with the worst numbers of all.

    A curve with a fault that slowing cannot cure is worst, then one with another fault, then the
    one with the least clearance. Its faults and states are returned; clearances, deviations from
    the constraint, what is tolerated and shares of limits are the worst ones of all curves.

    runs: checks of the curves; their times are those of one motion.
    """
    worst = min(runs, key=_rank)
    if len(runs) == 1:
        return worst
    certificates = [run.certificate for run in runs]

    def largest(name: str) -> float:
        return float(np.max([getattr(certificate, name) for certificate in certificates]))

    certificate = replace(
        worst.certificate,
        max_violation_rad=largest("max_violation_rad"),
        max_violation_m=largest("max_violation_m"),
        max_violation_function=largest("max_violation_function"),
        unproven_rad=largest("unproven_rad"),
        unproven_m=largest("unproven_m"),
        constraint_states=int(largest("constraint_states")),
        min_clearance_m=float(np.min([each.min_clearance_m for each in certificates])),
        obstacle_clearance=_least_clearance(runs, "obstacle_clearance", worst),
        self_clearance=_least_clearance(runs, "self_clearance", worst),
        tolerated=_least_deviation([each.tolerated for each in certificates]),
    )
    others = tuple(run for run in runs if run.states is not worst.states)
    return worst._replace(certificate=certificate, uses=_largest_uses(runs), others=others)


def _rank(run: DryRun) -> tuple[bool, bool, float]:
    """Return an order in which the worst check is the first; of refused ones the first given."""
    certificate = run.certificate
    return certificate.valid, run.limits_alone, _least(certificate) if certificate.valid else 0.0


def _least(certificate: Certificate) -> float:
    """Return the least distance that a certificate knows [m]: measured, else proven."""
    if not np.isnan(certificate.min_clearance_m):
        return certificate.min_clearance_m
    clearances = filter(None, (certificate.obstacle_clearance, certificate.self_clearance))
    return min((item.at_least_m for item in clearances), default=np.inf)


def _least_clearance(runs: Sequence[DryRun], name: str, worst: DryRun) -> Clearance | None:
    """Return the least clearance of one kind; its place is one on the states of `worst`."""
    found = [(getattr(run.certificate, name), run) for run in runs]
    known = [(clearance, run) for clearance, run in found if clearance is not None]
    if not known:
        return None
    proven = min(clearance.at_least_m for clearance, _ in known)
    measured = [(clearance, run) for clearance, run in known if clearance.measured]
    if not measured:
        return known[0][0]._replace(at_least_m=proven)
    least, run = min(measured, key=lambda item: item[0].distance_m)
    assert run.times is not None and worst.times is not None
    moment = np.interp(least.at, np.arange(len(run.times)), run.times)
    place = np.interp(moment, worst.times, np.arange(len(worst.times)))
    return least._replace(at_least_m=proven, at=float(place))


def _least_deviation(found: Sequence[Deviation | None]) -> Deviation | None:
    """Return the deviation that every curve tolerates; None if one of them is not known."""
    known = [deviation for deviation in found if deviation is not None]
    if len(known) < len(found):
        return None
    return Deviation(*(float(value) for value in np.min(known, axis=0)))


def _largest_uses(runs: Sequence[DryRun]) -> tuple[LimitUse, ...]:
    """Return the largest share of every limit on any curve, one of each kind and frame."""
    largest: dict[tuple[str, str], LimitUse] = {}
    for use in (use for run in runs for use in run.uses):
        # a limit of a frame is its own; of joints the one that uses most is told
        key = (str(use.kind), use.of if use.kind.startswith("frame") else "")
        if key not in largest or use.share > largest[key].share:
            largest[key] = use
    return tuple(largest.values())
