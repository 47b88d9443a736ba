"""Pictures of a scene with hands at drawn configurations over it, or with its cloud beside it."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.show.meshes import Viewpoint, poses_along
from cvqmpt_lab.show.picture import still_image
from experiments.figures.code_update import CodeUpdate
from experiments.figures.drawing import write_csv

PICTURE = (900, 690)  # [pixels] width and height of the scene behind hands and beside clouds
STICK = 0.09  # [m] length of the stick that shows which way a hand points up
CLOSE = Viewpoint(eye=(-1.5, -1.75, 1.6), target=(0.3, -0.1, 0.45), height_angle=0.62)
NUMBERS = ("x", "y", "z", "up_x", "up_y", "up_z", "tilt_rad", "g")


class HandPoses(NamedTuple):
    """Hands at s configurations."""

    q: np.ndarray  # (s, n) [rad]
    positions: np.ndarray  # (s, 3) [m]
    up: np.ndarray  # (s, 3), directions of the hand's x axis, which points up when a can is carried upright
    tilt: np.ndarray  # (s,), angle between that axis and the vertical [rad]

    @classmethod
    def of(cls, robot: Robot, q: np.ndarray) -> "HandPoses":
        """Hands of a robot at configurations q (s, n)."""
        T_world_hand = poses_along(robot, q)[1]
        up = T_world_hand[:, :3, 0]
        tilt = np.arctan2(np.linalg.norm(up[:, :2], axis=1), up[:, 2])
        return cls(q, T_world_hand[:, :3, 3], up, tilt)


class HandsOfCode(NamedTuple):
    """Hands at draws of a code's Gaussian, before or after the update."""

    when: str
    hands: HandPoses
    g: np.ndarray  # F^T F there (s,)

    @property
    def panel(self) -> tuple[str, HandPoses]:
        """Titled hands for `hand_figure`."""
        tilt, g = np.degrees(np.median(self.hands.tilt)), self.g.mean()
        return f"{self.when}: median tilt {tilt:.0f}°, mean $F^TF$ {g:.2f} rad$^2$", self.hands


def hands_of_code(update: CodeUpdate, index: int, count: int = 120) -> list[HandsOfCode]:
    """Hands at the first draws of a code, which is counted among the predicted, before and after the update."""
    return [
        HandsOfCode(
            when, HandPoses.of(update.problem.robot, gaussians.draws(index, update.noise[:count])), g[:count]
        )
        for when, gaussians, g in (
            ("before", update.before, update.g_before[index]),
            ("after", update.after, update.g_after[index]),
        )
    ]


def write_hands(code: int, sides: Sequence[HandsOfCode], path: Path) -> Path:
    """Write a row for every hand."""
    return write_csv(
        path,
        [
            {"code": code, "when": when, "draw": i, **dict(zip(NUMBERS, map(float, numbers), strict=True))}
            for when, hands, g in sides
            for i, numbers in enumerate(np.column_stack([hands.positions, hands.up, hands.tilt, g]))
        ],
    )


def hand_figure(
    problem: PlanningProblem, panels: Sequence[tuple[str, HandPoses]], viewpoint: Viewpoint = CLOSE
) -> Figure:
    """Titled panels of hands over a picture of the scene: a stick each, upwards, coloured by its tilt."""
    image = still_image(problem, problem.start, PICTURE, viewpoint)
    figure = Figure(figsize=(1.2 + 4.6 * len(panels), 4.05), layout="constrained")
    tilts = np.concatenate([hands.tilt for _, hands in panels])
    norm = Normalize(0.0, np.degrees(max(0.5, np.quantile(tilts, 0.9))))
    axes_of = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, hands) in zip(axes_of, panels, strict=True):
        axes.imshow(0.45 * image / 255.0 + 0.55)
        _draw_hands(axes, hands, viewpoint, image.shape[:2], norm)
        axes.set(title=title)
        axes.axis("off")
    colours, label = ScalarMappable(norm, "viridis_r"), "tilt of the hand [deg]"
    figure.colorbar(colours, ax=axes_of, label=label, extend="max", shrink=0.95, pad=0.01)
    return figure


def _draw_hands(
    axes: Axes, hands: HandPoses, viewpoint: Viewpoint, shape: tuple[int, ...], norm: Normalize
) -> None:
    """Sticks from each hand along its up direction, the head a dot; farther ones first."""
    rows, columns = shape
    ends = np.stack((hands.positions, hands.positions + STICK * hands.up), axis=1)
    screen = viewpoint.screen(ends, (rows, columns))
    order = np.argsort(-screen[:, 0, 2], kind="stable")
    segments, tilt = screen[order, :, :2], np.degrees(hands.tilt[order])
    sticks = LineCollection(list(segments), cmap="viridis_r", norm=norm, linewidths=1.4, alpha=0.9)
    sticks.set_array(tilt)
    axes.add_collection(sticks)
    axes.scatter(segments[:, 1, 0], segments[:, 1, 1], c=tilt, cmap="viridis_r", norm=norm, s=9.0, zorder=3)
    axes.set(xlim=(0, columns), ylim=(rows, 0))


def cloud_figure(problem: PlanningProblem, cloud: np.ndarray, viewpoint: Viewpoint = CLOSE) -> Figure:
    """A problem's scene, and beside it its cloud (m, 3) [m] from the same place, coloured by height."""
    image = still_image(problem, problem.start, PICTURE, viewpoint)
    figure = Figure(figsize=(10.4, 4.05), layout="constrained")
    scene, points = axes_of = figure.subplots(1, 2)
    scene.imshow(image)
    scene.set(title="scene")
    rows, columns = image.shape[:2]
    screen = viewpoint.screen(cloud, (rows, columns))
    order = np.argsort(-screen[:, 2], kind="stable")  # farther ones first
    x, y, _ = screen[order].T
    drawn = points.scatter(x, y, c=cloud[order, 2], cmap="viridis", s=7.0)
    points.set(title=f"cloud of {len(cloud)} points", xlim=(0, columns), ylim=(rows, 0), aspect="equal")
    for axes in axes_of:
        axes.axis("off")
    figure.colorbar(drawn, ax=axes_of, label="height above the robot's base [m]", shrink=0.95, pad=0.01)
    return figure
