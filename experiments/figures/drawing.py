"""Figures by matplotlib, without a display; numbers come from elsewhere."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from cvqmpt_lab.files import write_bytes
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.show.meshes import Viewpoint
from cvqmpt_lab.show.picture import still_image
from experiments.figures.code_update import FAR, NEAR
from experiments.figures.hand_poses import HandPoses
from experiments.figures.histogram import CodeChange

BEFORE, AFTER = "#8c96a3", "#1f6fb4"
FORMATS = ("png", "svg")
DPI = 160
PICTURE = (900, 690)  # [pixels] width and height of the scene behind hands and beside clouds
STICK = 0.09  # [m] length of the stick that shows which way a hand points up
CLOSE = Viewpoint(eye=(-1.5, -1.75, 1.6), target=(0.3, -0.1, 0.45), height_angle=0.62)


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as png or svg; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "cvqmpt"}):
        figure.savefig(buffer, format=kind, dpi=DPI, metadata={"Date": None} if kind == "svg" else None)
    return buffer.getvalue()


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write name.png and name.svg, each at once or not at all."""
    paths = [folder / f"{name}.{kind}" for kind in FORMATS]
    for path, kind in zip(paths, FORMATS, strict=True):
        write_bytes(path, figure_bytes(figure, kind))
    return paths


def histogram_figure(changes: Sequence[CodeChange]) -> Figure:
    """A row for each code: histogram of F^T F, and its tail below the Markov bound."""
    figure = Figure(figsize=(9.0, 3.1 * len(changes)), layout="constrained")
    rows = figure.subplots(len(changes), 2, squeeze=False)
    for (left, right), change in zip(rows, changes, strict=True):
        _draw_histogram(left, change)
        _draw_tail(right, change)
    return figure


def _draw_histogram(axes: Axes, change: CodeChange) -> None:
    edges = change.histogram.edges
    shown = len(edges) - 1 - change.histogram.beyond
    for counts, colour, when, mean in (
        (change.histogram.before, BEFORE, "before", change.g_before),
        (change.histogram.after, AFTER, "after", change.g_after),
    ):
        share = counts / counts.sum()
        axes.stairs(share[:shown], edges[: shown + 1], fill=True, color=colour, alpha=0.45)
        axes.stairs(
            share[:shown], edges[: shown + 1], color=colour, linewidth=1.4, label=f"{when}: mean {mean:#.3g}"
        )
        axes.axvline(mean, color=colour, linestyle=":", linewidth=1.4)
    place = {FAR: "far from the constraint", NEAR: "near the constraint"}[change.role]
    axes.set(
        title=f"{place}: code {change.code}",
        xlabel="$F(q)^T F(q)$ [rad$^2$]",
        ylabel="share of draws",
        xlim=(0.0, edges[shown]),
    )
    axes.legend(frameon=False)


def _draw_tail(axes: Axes, change: CodeChange) -> None:
    for markov, mean, colour, when in (
        (change.before, change.g_before, BEFORE, "before"),
        (change.after, change.g_after, AFTER, "after"),
    ):
        k = np.geomspace(markov.k[0], markov.k[-1], 400)
        axes.plot(k, np.minimum(mean / k, 1.0), "--", color=colour, label=f"{when}: bound $G/k$")
        axes.plot(markov.k, markov.tail, ".-", color=colour, label=f"{when}: measured")
    axes.set(
        xscale="log",
        title="tail and its Markov bound",
        xlabel="$k$ [rad$^2$]",
        ylabel="$P(F^T F \\geq k)$",
        ylim=(0.0, 1.05),
    )
    axes.legend(frameon=False, fontsize="small", loc="lower left")


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
    colours = ScalarMappable(norm, "viridis_r")
    label = "tilt of the hand [deg]"
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
