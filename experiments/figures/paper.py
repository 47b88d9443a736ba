"""The paper's figures (histogram of the update, concept figure); pictures of hands and clouds."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import LogLocator, NullFormatter

from cvqmpt_lab.base.errors import RunStoreError
from cvqmpt_lab.base.files import csv_table, make_folder, write_bytes
from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE, ProvenanceFile, provenance
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.experiments.figures.code_update import (
    WHEN,
    CodeUpdate,
    UpdateSettings,
    exceedance_rows,
    histogram_rows,
    pooled_g,
    squared_residual,
    update_codes,
)
from cvqmpt_lab.features.pictures.picture import still_image
from cvqmpt_lab.features.pictures.raster import Viewpoint
from cvqmpt_lab.paper_tables.plots import figure_bytes
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.weights import VQ_MPT, resolve_model, weights_digest

FIGURES = ("histogram", "concept")
PICTURE = (900, 690)  # [pixels] width and height of pictures of the scene
CLOSE = Viewpoint(eye=(-1.5, -1.75, 1.6), target=(0.3, -0.1, 0.45), height_angle=0.62)
HANDS = 24  # number of hands drawn for each Gaussian
COLOURS = {"before": "#8c96a3", "after": "#c8452d"}
START_COLOUR, GOAL_COLOUR = "#1a9850", "#3f3f46"
TILT = "tilt of the hand [deg]"


def reproduce_figure(
    figure: str,
    out: Path,
    command: Sequence[str],
    problems: Sequence[int] = (0,),
    model: str | None = None,
    settings: UpdateSettings | None = None,
) -> tuple[list[CodeUpdate], list[Path]]:
    """Predict and update codes on place-task problems; write figure, tables and provenance.

    Args:
        figure: one of FIGURES; "concept" shows the first problem only.
        out: output folder; a new or empty folder, or one with results of the same settings.
        command: words of the command line, which are stored in the provenance.
        problems: indices of problems of the place task.
        model: name or folder of the weights (None: the shipped ones).
        settings: seed and number of samples (None: the defaults).

    Returns:
        The updates of the problems, and the paths of the written files.

    Raises:
        RunStoreError: the folder has other results or files.
    """
    suite = suite_named("place-task")
    items = [suite.solvable(index) for index in problems]
    settings, folder = settings or UpdateSettings(), resolve_model(model or "vq_mpt", VQ_MPT)
    configuration: dict[str, Any] = {
        "figure": figure,
        "suite": "place-task",
        "problems": list(problems),
        "update": asdict(settings),
    }
    session = provenance(command, [settings.seed], {"vq_mpt": weights_digest(folder)})
    record = ProvenanceFile(make_folder(out))
    if record.path.is_file():
        record.require_same(configuration, session)
    elif any(out.iterdir()):
        raise RunStoreError(
            f"{out} has files but no {PROVENANCE_FILE}; use an empty folder as --out"
        )
    updates = [
        update_codes(item, str(folder), settings)
        for item in items
        if isinstance(item, PlanningProblem)
    ]
    record.create(configuration, session)
    if figure == "histogram":
        drawn = histogram_figure(updates)
        values = [row for update in updates for row in update.rows()]
        tables = {"histogram.csv": histogram_rows(updates), "values.csv": values}
        tables["exceedance.csv"] = exceedance_rows(updates)
    else:
        drawn = concept_figure(updates[0])
        tables = {"concept.csv": hand_rows(updates[0])}
    contents = {f"{figure}.{kind}": figure_bytes(drawn, kind) for kind in ("png", "svg")}
    for name, rows in tables.items():
        cells = [[f"{x:.6g}" if isinstance(x, float) else x for x in row.values()] for row in rows]
        contents[name] = csv_table([rows[0], *cells]).encode()
    for name, content in contents.items():
        write_bytes(out / name, content)
    return updates, [*(out / name for name in contents), record.path]


def summary(updates: Sequence[CodeUpdate]) -> list[str]:
    """Return lines of text about updates; values are medians over problems."""
    codes = [len(update.codes) for update in updates]
    lines = [
        f"{len(updates)} problems, {sum(codes)} codes, {min(codes)} to {max(codes)} per problem"
    ]
    for what, goals in (("codes", False), ("codes and goals", True)):
        means, norms = [], []
        for when in WHEN:
            g = [u.g(when)[: None if goals else len(u.codes)] for u in updates]
            means.append(np.median([values.mean() for values in g]))
            norms.append(np.median([np.median(np.sqrt(values)) for values in g]))
        lines.append(
            f"{what}: mean F^T F {means[0]:.3g} before, {means[1]:.3g} after; median |F| "
            f"{norms[0]:.3g} before, {norms[1]:.3g} after"
        )
    return lines + [
        f"{row['of']}: P(F^T F > {row['delta']:g}) {row['before']:.3f} before, "
        f"{row['after']:.3f} after"
        for row in exceedance_rows(updates)
    ]


def histogram_figure(updates: Sequence[CodeUpdate]) -> Figure:
    """Draw three plots of F before and after the update.

    Left: histogram of |F| at samples of the codes. Middle: G, the mean of F^T F over the samples of
    a code, with one point per code. Right: G over all samples, also of goals, with one row per
    problem.
    """
    figure = Figure(figsize=(13.0, max(4.2, 0.6 + 0.16 * len(updates))), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    draw_norms(left, updates)
    rows = [row for update in updates for row in update.rows()]
    codes = np.array(
        [(row["g_before"], row["g_after"]) for row in rows if row["code"] != "goal"], dtype=float
    )
    limits = (0.7 * max(codes.min(), 1e-6), 1.4 * codes.max())
    middle.plot(limits, limits, ":", color="0.5", label="not moved")
    middle.scatter(*codes.T, s=14.0, color=COLOURS["after"], alpha=0.7)
    middle.set(
        xscale="log",
        yscale="log",
        xlim=limits,
        ylim=limits,
        title=f"$G$ of {len(codes)} codes",
        xlabel="before [rad$^2$]",
        ylabel="after [rad$^2$]",
    )
    for axis in (middle.xaxis, middle.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    middle.legend(frameon=False)
    means = np.array([[update.g(when).mean() for when in COLOURS] for update in updates])
    y = np.arange(len(updates))
    right.hlines(y, means[:, 1], means[:, 0], color="0.8", linewidth=2.0)
    for column, (when, colour) in enumerate(COLOURS.items()):
        right.scatter(means[:, column], y, color=colour, s=30.0, label=when, zorder=3)
    right.set(
        yticks=y,
        yticklabels=[update.problem.name for update in updates],
        xlim=(0.0, None),
        title="$G$ of all that is sampled, goals included",
        xlabel="mean $F(q)^T F(q)$ [rad$^2$]",
        ylabel="problem",
    )
    right.invert_yaxis()
    right.legend(frameon=False)
    return figure


def draw_norms(axes: Axes, updates: Sequence[CodeUpdate]) -> None:
    """Draw the histograms of |F| [rad] at samples of the codes, before and after the update.

    The last bin, which has no upper edge, is left out.
    """
    rows = [row for row in histogram_rows(updates) if row["of"] == "codes"]
    edges = [float(str(row["from"])) for row in rows]
    for when, colour in COLOURS.items():
        counts = np.array([row[when] for row in rows], dtype=float)
        share = counts[:-1] / counts.sum()
        norms = np.sqrt(pooled_g(updates, "codes", when))
        axes.stairs(share, edges, fill=True, color=colour, alpha=0.4)
        axes.stairs(share, edges, color=colour, label=f"{when}: median {np.median(norms):.2f}")
    axes.set(
        title="raw samples of the codes", xlabel="$\\|F(q)\\|$ [rad]", ylabel="share of samples"
    )
    axes.set_xlim(0.0, edges[-1])
    axes.legend(frameon=False)


class HandPoses(NamedTuple):
    """Poses of the hand at s configurations."""

    q: np.ndarray  # (s, n) [rad]
    positions: np.ndarray  # (s, 3) [m]
    # (s, 3), directions of the hand's x axis, which is vertical when a can is carried upright
    up: np.ndarray
    tilt: np.ndarray  # (s,), angle between this axis and the vertical [rad]

    @classmethod
    def of(cls, robot: Robot, q: np.ndarray) -> "HandPoses":
        """Return the hand poses of a robot at configurations q (s, n) [rad]."""
        T_world_hand = robot.poses(q)
        up = T_world_hand[:, :3, 0]
        tilt = np.arctan2(np.linalg.norm(up[:, :2], axis=1), up[:, 2])
        return cls(q, T_world_hand[:, :3, 3], up, tilt)


def hand_rows(update: CodeUpdate) -> list[dict[str, object]]:
    """Table row for each hand in the concept figure: position [m], x axis, tilt and F^T F."""
    names = ("x", "y", "z", "up_x", "up_y", "up_z", "tilt_rad", "g")
    rows: list[dict[str, object]] = []
    for when in WHEN:
        for i in range(len(update.before.means)):
            hands = HandPoses.of(update.problem.robot, update.draws(when, i)[:HANDS])
            g = squared_residual(update.problem.manifold, hands.q)
            code = int(update.codes[i]) if i < len(update.codes) else "goal"
            table = np.column_stack([hands.positions, hands.up, hands.tilt, g])
            for k, numbers in enumerate(table.tolist()):
                named = dict(zip(names, numbers, strict=True))
                rows.append({"code": code, "when": when, "draw": k, **named})
    return rows


def concept_figure(update: CodeUpdate, viewpoint: Viewpoint = CLOSE) -> Figure:
    """Draw the paper's concept figure: model input, and samples before and after the update.

    First row: the scene with cloud, start and goals; the hand at samples before the update; the
    same after the update. Second row: histograms of |F|; the Gaussians before the update, each as
    the ellipse of one standard deviation of (way, lean), see `_draw_ellipse`; the same after the
    update. F(q) = 0 holds on the line lean = 0.
    """
    problem, every, count = update.problem, range(len(update.before.means)), len(update.codes)
    goal_states = update.before.means[count:]  # in order of preference
    T_world_hand = problem.robot.poses(np.vstack([problem.start, goal_states]))
    start, *goals = T_world_hand[:, :3, 3]
    figure = Figure(figsize=(14.4, 7.6), layout="constrained")
    (scene, *pictures), (histogram, *planes) = figure.subplots(2, 3, height_ratios=(1.25, 1.0))
    image = still_image(problem, problem.start, PICTURE, viewpoint)
    size = image.shape[:2]
    # blend pictures of the robot at the start and at the first goal
    blended = 0.55 * image + 0.45 * still_image(problem, goal_states[0], PICTURE, viewpoint)
    scene.imshow(blended / 255.0)
    x, y, _ = viewpoint.screen(update.cloud, size).T
    scene.scatter(x, y, s=0.8, color="#2166ac", alpha=0.6)
    for points, colour, label in (([start], START_COLOUR, "start"), (goals, GOAL_COLOUR, "goals")):
        x, y, _ = viewpoint.screen(np.array(points), size).T
        scene.scatter(x, y, s=45.0, color=colour, edgecolors="white", label=label, zorder=4)
    title = f"cloud of {len(update.cloud)} points"
    scene.set(title=title, xlim=(0, size[1]), ylim=(size[0], 0))
    scene.legend(loc="lower right", fontsize="small")
    scene.axis("off")
    titles = f"{count} codes and {len(goals)} goals, as predicted", "after Algorithm 2"
    panels = []
    for when, title in zip(WHEN, titles, strict=True):
        q = np.concatenate([update.draws(when, i)[:HANDS] for i in every])
        panels.append((title, HandPoses.of(problem.robot, q)))
    _draw_hands(figure, pictures, panels, image, viewpoint, Normalize(0.0, 90.0))
    draw_norms(histogram, [update])
    for axes, when in zip(planes, WHEN, strict=True):
        for i in every:
            colour = COLOURS[when] if i < count else GOAL_COLOUR
            drawn = HandPoses.of(problem.robot, update.draws(when, i))
            _draw_ellipse(axes, drawn, start, goals[0], colour)
        axes.axhline(0.0, color="black", linewidth=1.2)
        axes.set(
            title=f"Gaussians {when}, goals dashed",
            xlim=(-0.7, 2.0),
            ylim=(-120.0, 120.0),
            xlabel="way of the hand: 0 start, 1 goal",
            ylabel="lean of the hand [deg]; $F(q)=0$ on the line",
        )
    return figure


def _draw_ellipse(
    axes: Axes, hands: HandPoses, start: np.ndarray, goal: np.ndarray, colour: str
) -> None:
    """Draw the ellipse of one standard deviation of (way, lean) of hands, and their mean.

    With p the position of a hand and u its x axis:

        way = (p - p_start) . (p_goal - p_start) / |p_goal - p_start|^2
        lean = atan2(u_x, u_z) [deg]

    Args:
        axes: axes to draw in, with way to the right and lean upwards.
        hands: hand poses at samples of one Gaussian.
        start: position p_start of the hand at the start (3,) [m].
        goal: position p_goal of the hand at the goal (3,) [m].
        colour: colour of the ellipse, which is dashed for `GOAL_COLOUR`.
    """
    way = (hands.positions - start) @ (goal - start) / np.square(goal - start).sum()
    points = np.column_stack([way, np.degrees(np.arctan2(hands.up[:, 0], hands.up[:, 2]))])
    values, vectors = np.linalg.eigh(np.cov(points.T))
    # full axis lengths: one standard deviation to each side
    width, height = 2.0 * np.sqrt(values)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    middle, is_goal = points.mean(axis=0), colour == GOAL_COLOUR
    style: Any = {"angle": angle, "color": colour, "linestyle": "--" if is_goal else "-"}
    axes.add_patch(Ellipse(tuple(middle), width, height, fill=False, linewidth=1.2, **style))
    axes.add_patch(Ellipse(tuple(middle), width, height, alpha=0.0 if is_goal else 0.14, **style))
    axes.plot(*middle, "o", color=colour, markersize=4.0)


def hand_figure(
    problem: PlanningProblem, panels: Sequence[tuple[str, HandPoses]], viewpoint: Viewpoint = CLOSE
) -> Figure:
    """Draw hands over a picture of the scene; panels: title and hands of each panel."""
    image = still_image(problem, problem.start, PICTURE, viewpoint)
    figure = Figure(figsize=(1.2 + 4.6 * len(panels), 4.05), layout="constrained")
    tilts = np.concatenate([hands.tilt for _, hands in panels])
    norm = Normalize(0.0, np.degrees(max(0.5, np.quantile(tilts, 0.9))))
    axes_of = figure.subplots(1, len(panels), squeeze=False)[0]
    _draw_hands(figure, axes_of, panels, image, viewpoint, norm)
    return figure


def _draw_hands(
    figure: Figure,
    axes_of: Sequence[Axes],
    panels: Sequence[tuple[str, HandPoses]],
    image: np.ndarray,
    viewpoint: Viewpoint,
    norm: Normalize,
) -> None:
    """Draw the x axis of each hand, 9 cm long and coloured by tilt, over a picture of the scene.

    Args:
        figure: figure, to which a colour bar is added.
        axes_of: axes of each panel.
        panels: title and hands of each panel.
        image: (rows, columns, 3), picture of the scene, 0 to 255.
        viewpoint: viewpoint of the picture.
        norm: range of tilts [deg] that the colours cover.
    """
    rows, columns = image.shape[:2]
    style: Any = {"cmap": "viridis_r", "norm": norm}
    for axes, (title, hands) in zip(axes_of, panels, strict=True):
        axes.imshow(0.45 * image / 255.0 + 0.55)
        ends = np.stack((hands.positions, hands.positions + 0.09 * hands.up), axis=1)
        screen = viewpoint.screen(ends, (rows, columns))
        order = np.argsort(-screen[:, 0, 2], kind="stable")  # the farthest hand first
        segments, tilt = screen[order, :, :2], np.degrees(hands.tilt[order])
        lines = LineCollection(list(segments), linewidths=1.4, alpha=0.9, **style)
        lines.set_array(tilt)
        axes.add_collection(lines)
        x, y = segments[:, 1].T
        axes.scatter(x, y, c=tilt, s=9.0, zorder=3, **style)
        axes.set(xlim=(0, columns), ylim=(rows, 0), title=title)
        axes.axis("off")
    colours = ScalarMappable(norm, "viridis_r")
    figure.colorbar(colours, ax=axes_of, label=TILT, extend="max", shrink=0.95, pad=0.01)


def cloud_figure(
    problem: PlanningProblem, cloud: np.ndarray, viewpoint: Viewpoint = CLOSE
) -> Figure:
    """Draw a problem's scene, and its cloud (m, 3) [m] from the same viewpoint."""
    image = still_image(problem, problem.start, PICTURE, viewpoint)
    rows, columns = image.shape[:2]
    figure = Figure(figsize=(10.4, 4.05), layout="constrained")
    scene, points = axes_of = figure.subplots(1, 2)
    scene.imshow(image)
    scene.set(title="scene")
    screen = viewpoint.screen(cloud, (rows, columns))
    order = np.argsort(-screen[:, 2], kind="stable")  # the farthest point first
    x, y, _ = screen[order].T
    drawn = points.scatter(x, y, c=cloud[order, 2], cmap="viridis", s=7.0)
    title = f"cloud of {len(cloud)} points"
    points.set(title=title, xlim=(0, columns), ylim=(rows, 0), aspect="equal")
    for axes in axes_of:
        axes.axis("off")
    label = "height above the robot's base [m]"
    figure.colorbar(drawn, ax=axes_of, label=label, shrink=0.95, pad=0.01)
    return figure
