"""Where the hand is at draws of one predicted Gaussian, and how far it tilts, before and after the update."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.show.meshes import poses_along
from experiments.figures.code_update import CodeUpdate
from experiments.figures.histogram import write_csv

NUMBERS = ("x", "y", "z", "up_x", "up_y", "up_z", "tilt_rad", "g")


@dataclass(frozen=True, eq=False)
class HandPoses:
    """Hands at s configurations."""

    q: np.ndarray
    """(s, n) [rad]."""
    positions: np.ndarray
    """(s, 3) [m]."""
    up: np.ndarray
    """(s, 3), directions of the hand's x axis, which points up when a can is carried upright."""
    tilt: np.ndarray
    """(s,), angle between that axis and the vertical [rad]."""

    @classmethod
    def of(cls, robot: Robot, q: np.ndarray) -> "HandPoses":
        """Hands of a robot at configurations q (s, n)."""
        T_world_hand = poses_along(robot, q)[1]
        up = T_world_hand[:, :3, 0]
        tilt = np.arctan2(np.linalg.norm(up[:, :2], axis=1), up[:, 2])
        return cls(q, T_world_hand[:, :3, 3], up, tilt)


@dataclass(frozen=True, eq=False)
class HandChange:
    """Hands at the same draws of a code's Gaussian before and after."""

    code: int
    before: HandPoses
    after: HandPoses
    g_before: np.ndarray
    """F^T F there (s,)."""
    g_after: np.ndarray

    @property
    def panels(self) -> list[tuple[str, HandPoses]]:
        """Titled hands for `figures.hand_figure`."""
        return [
            (
                f"{when}: median tilt {np.degrees(np.median(hands.tilt)):.0f}°, mean $F^TF$ {g.mean():.2f} rad$^2$",
                hands,
            )
            for when, hands, g in (
                ("before", self.before, self.g_before),
                ("after", self.after, self.g_after),
            )
        ]


def hand_change(update: CodeUpdate, index: int, count: int = 120) -> HandChange:
    """The first draws of a code, which is counted among the predicted."""
    noise = update.noise[:count]
    before, after = (
        HandPoses.of(update.problem.robot, gaussians.draws(index, noise))
        for gaussians in (update.before, update.after)
    )
    return HandChange(
        code=int(update.codes[index]),
        before=before,
        after=after,
        g_before=update.g_before[index, :count],
        g_after=update.g_after[index, :count],
    )


def write_hands(change: HandChange, path: Path) -> Path:
    """Write a row for every hand."""
    sides = (("before", change.before, change.g_before), ("after", change.after, change.g_after))
    rows = []
    for when, hands, g in sides:
        for i in range(len(g)):
            numbers = map(float, (*hands.positions[i], *hands.up[i], hands.tilt[i], g[i]))
            rows.append(
                {"code": change.code, "when": when, "draw": i} | dict(zip(NUMBERS, numbers, strict=True))
            )
    return write_csv(path, rows)
