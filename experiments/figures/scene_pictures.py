"""Pictures of a scene with hands at drawn configurations over it or its cloud beside it, and the
concept figure.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.show.meshes import Viewpoint, poses_along
from cvqmpt_lab.show.picture import still_image
from experiments.figures.code_update import COLOURS, CodeUpdate, draw_norms, squared_residual
from experiments.figures.drawing import write_csv

PICTURE = (900, 690)  # [pixels] width and height of the scene behind hands and beside clouds
STICK = 0.09  # [m] length of the stick that shows which way a hand points up
CLOSE = Viewpoint(eye=(-1.5, -1.75, 1.6), target=(0.3, -0.1, 0.45), height_angle=0.62)
HANDS = 24  # drawn of each Gaussian
START_COLOUR, GOAL_COLOUR = "#1a9850", "#3f3f46"
NUMBERS = ("x", "y", "z", "up_x", "up_y", "up_z", "tilt_rad", "g")


class HandPoses(NamedTuple):
    """Hands at s configurations."""

    q: np.ndarray  # (s, n) [rad]
    positions: np.ndarray  # (s, 3) [m]
    # (s, 3), directions of the hand's x axis, which points up when a can is carried upright
    up: np.ndarray
    tilt: np.ndarray  # (s,), angle between that axis and the vertical [rad]

    @classmethod
    def of(cls, robot: Robot, q: np.ndarray) -> "HandPoses":
        """Hands of a robot at configurations q (s, n)."""
        T_world_hand = poses_along(robot, q)[1]
        up = T_world_hand[:, :3, 0]
        tilt = np.arctan2(np.linalg.norm(up[:, :2], axis=1), up[:, 2])
        return cls(q, T_world_hand[:, :3, 3], up, tilt)


def write_hands(update: CodeUpdate, path: Path) -> Path:
    """Write a row for every hand that the concept figure shows."""
    rows = []
    for when in COLOURS:
        for i in range(len(update.before.means)):
            hands = HandPoses.of(update.problem.robot, update.draws(when, i)[:HANDS])
            g = squared_residual(update.problem.manifold, hands.q)
            code = int(update.codes[i]) if i < len(update.codes) else "goal"
            rows += [
                {
                    "code": code,
                    "when": when,
                    "draw": k,
                    **dict(zip(NUMBERS, map(float, numbers), strict=True)),
                }
                for k, numbers in enumerate(
                    np.column_stack([hands.positions, hands.up, hands.tilt, g])
                )
            ]
    return write_csv(path, rows)


def concept_figure(update: CodeUpdate, viewpoint: Viewpoint = CLOSE) -> Figure:
    """The paper's concept figure: what the model saw, what is sampled before and after, Gaussians
    near the manifold.

    Above: scene, cloud, start and goals; hands at samples before and after. Below: histogram of
    |F|, and the Gaussians as ellipses of one standard deviation in the plane of (way of the hand
    from start to goal, its lean); the line of no lean is where F(q) = 0.
    """
    problem, every = update.problem, range(len(update.before.means))
    start, *goals = (
        poses_along(problem.robot, q[None])[1][0, :3, 3] for q in (problem.start, *_goals(update))
    )
    figure = Figure(figsize=(14.4, 7.6), layout="constrained")
    (scene, *pictures), (histogram, *planes) = figure.subplots(2, 3, height_ratios=(1.25, 1.0))
    image = still_image(problem, problem.start, PICTURE, viewpoint)
    both = 0.55 * image + 0.45 * still_image(problem, _goals(update)[0], PICTURE, viewpoint)
    scene.imshow(both / 255.0)
    x, y, _ = viewpoint.screen(update.cloud, image.shape[:2]).T
    scene.scatter(x, y, s=0.8, color="#2166ac", alpha=0.6)
    for points, colour, label in (([start], START_COLOUR, "start"), (goals, GOAL_COLOUR, "goals")):
        x, y, _ = viewpoint.screen(np.array(points), image.shape[:2]).T
        scene.scatter(x, y, s=45.0, color=colour, edgecolors="white", label=label, zorder=4)
    scene.set(
        title=f"cloud of {len(update.cloud)} points",
        xlim=(0, image.shape[1]),
        ylim=(image.shape[0], 0),
    )
    scene.legend(loc="lower right", fontsize="small")
    norm = Normalize(0.0, 90.0)
    titles = (
        f"{len(update.codes)} codes and {len(goals)} goals, as predicted",
        "after Algorithm 2",
    )
    for axes, when, title in zip(pictures, COLOURS, titles, strict=True):
        q = np.concatenate([update.draws(when, i)[:HANDS] for i in every])
        axes.imshow(0.45 * image / 255.0 + 0.55)
        _draw_hands(axes, HandPoses.of(problem.robot, q), viewpoint, image.shape[:2], norm)
        axes.set(title=title)
    for axes in (scene, *pictures):
        axes.axis("off")
    colours = ScalarMappable(norm, "viridis_r")
    figure.colorbar(
        colours, ax=pictures, label="tilt of the hand [deg]", extend="max", shrink=0.95, pad=0.01
    )
    draw_norms(histogram, [update])
    for axes, when in zip(planes, COLOURS, strict=True):
        for i in every:
            hands = HandPoses.of(problem.robot, update.draws(when, i))
            _draw_ellipse(
                axes,
                hands,
                start,
                goals[0],
                COLOURS[when] if i < len(update.codes) else GOAL_COLOUR,
            )
        axes.axhline(0.0, color="black", linewidth=1.2)
        axes.set(
            title=f"Gaussians {when}, goals dashed", xlim=(-0.7, 2.0), ylim=(-120.0, 120.0),
            xlabel="way of the hand: 0 start, 1 goal", ylabel="lean of the hand [deg]; $F(q)=0$ "
                                                              "on the line",
        )  # fmt: skip
    return figure


def _goals(update: CodeUpdate) -> np.ndarray:
    """The goals (k, n) that have Gaussians, the first choice first [rad]."""
    return update.before.means[len(update.codes) :]


def _draw_ellipse(
    axes: Axes, hands: HandPoses, start: np.ndarray, goal: np.ndarray, colour: str
) -> None:
    """One standard deviation of hands in (share of the way from start to goal, lean towards the
    robot's x axis).
    """
    way = (hands.positions - start) @ (goal - start) / np.square(goal - start).sum()
    points = np.column_stack([way, np.degrees(np.arctan2(hands.up[:, 0], hands.up[:, 2]))])
    values, vectors = np.linalg.eigh(np.cov(points.T))
    width, height = 2.0 * np.sqrt(values)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    middle, is_goal = points.mean(axis=0), colour == GOAL_COLOUR
    shared: dict[str, Any] = {
        "angle": angle,
        "color": colour,
        "linestyle": "--" if is_goal else "-",
    }
    axes.add_patch(Ellipse(tuple(middle), width, height, fill=False, linewidth=1.2, **shared))
    axes.add_patch(Ellipse(tuple(middle), width, height, alpha=0.0 if is_goal else 0.14, **shared))
    axes.plot(*middle, "o", color=colour, markersize=4.0)


def hand_figure(
    problem: PlanningProblem, panels: Sequence[tuple[str, HandPoses]], viewpoint: Viewpoint = CLOSE
) -> Figure:
    """Titled panels of hands over a picture of the scene:
    a stick each, upwards, coloured by its tilt.
    """
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
    axes.scatter(
        segments[:, 1, 0], segments[:, 1, 1], c=tilt, cmap="viridis_r", norm=norm, s=9.0, zorder=3
    )
    axes.set(xlim=(0, columns), ylim=(rows, 0))


def cloud_figure(
    problem: PlanningProblem, cloud: np.ndarray, viewpoint: Viewpoint = CLOSE
) -> Figure:
    """A problem's scene, and beside it its cloud (m, 3) [m] from the same place, coloured by
    height.
    """
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
    points.set(
        title=f"cloud of {len(cloud)} points", xlim=(0, columns), ylim=(rows, 0), aspect="equal"
    )
    for axes in axes_of:
        axes.axis("off")
    figure.colorbar(
        drawn, ax=axes_of, label="height above the robot's base [m]", shrink=0.95, pad=0.01
    )
    return figure
