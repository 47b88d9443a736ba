"""A still picture of a solution or task, drawn by a small z-buffer rasteriser: no display is
needed.

The solid layer (scene, robot at the start) has outlines and shadows; ghosts of the robot along the
path and at the goal, and the hand's trace, are blended over it. Legends and captions stand below
the picture.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import replacing
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.processes import one_thread
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.show.marks import CONSTRAINT_COLOUR, constraint_marks, hand_axes
from cvqmpt_lab.show.meshes import (
    GHOST_COLOUR,
    GOAL_COLOUR,
    LOAD_COLOUR,
    ROBOT_COLOUR,
    TRACE_COLOUR,
    Colour,
    Mesh,
    View,
    Viewpoint,
    beads,
    ground_height,
    joined,
    poses_along,
    rasterise,
    robot_meshes,
    scene_meshes,
    travelled_along,
)
from cvqmpt_lab.show.stage import AZIMUTHS, Picture, Stage, clear_viewpoint, framed, light
from cvqmpt_lab.show.task_frames import frames, shown
from cvqmpt_lab.tasks.solve import TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase
from cvqmpt_lab.tasks.world import World

SUPERSAMPLING = 2
HIDDEN = ("walls/right",)  # scene objects that stand between the usual viewpoint and the robot
PANEL_GAP = 6  # [pixels] between the pictures of a task
COLUMNS = 3  # of pictures of a task
# [m] a surface this close behind or before one that is drawn already is the same surface
COINCIDE = 0.01
LEGEND_SHARE = 0.2  # of a picture's height; pictures too small for their legend have none
INK, PAPER = (40, 40, 44), (255, 255, 255)
SMALLEST_FONT = 11  # [pixels]; the font is larger under wide pictures
LETTERS_ACROSS, NAME_LETTERS = (
    62,
    24,
)  # letters that fit side by side in a legend, and in the caption of a phase


class Layer(NamedTuple):
    """A translucent mesh."""

    mesh: Mesh
    opacity: float
    opacity_behind: float = 0.0  # where something solid is in front of it


class Label(NamedTuple):
    """A text under a picture, after a swatch of its colour if it has one."""

    text: str
    colour: Colour | None = None


def strip(labels: Sequence[Label], width: int, letters_across: int = LETTERS_ACROSS) -> np.ndarray:
    """An image (height, width, 3), 8 bit, of labels in lines, as high as they need."""
    size = max(SMALLEST_FONT, width // letters_across)
    font = ImageFont.load_default(size)
    gap, swatch, line_height = 1.3 * size, 1.3 * size, 1.9 * size
    x, line, placed = gap / 2, 0, []
    for label in labels:
        needed = font.getlength(label.text) + (0 if label.colour is None else swatch)
        if x + needed > width and x > gap:
            x, line = gap / 2, line + 1
        placed.append((label, x, (line + 0.5) * line_height))
        x += needed + gap
    image = Image.new("RGB", (width, round((1 + line) * line_height)), PAPER)
    draw = ImageDraw.Draw(image)
    for (text, colour), left, middle in placed:
        if colour is not None:
            fill, half = tuple(round(255 * part) for part in colour), 0.42 * size
            box = (left, middle - half, left + 2 * half, middle + half)
            draw.rounded_rectangle(box, radius=0.2 * size, fill=fill, outline=INK)
            left += swatch
        draw.text((left, middle), text, fill=INK, font=font, anchor="lm")
    return np.array(image)


def draw_solution(
    solution: Solution,
    path: Path,
    size: tuple[int, int] = (1200, 800),
    ghosts: int = 4,
    carried: Sequence[Attachment] = (),
) -> None:
    """Write a PNG of scene, robot at the start, ghosts along the path and at the goal, the hand's
    trace, a legend.

    The constraint is drawn as `constraint_marks` says, the hand's axes at start and goal.

    size: width and height [pixels], legend included. ghosts: number of poses shown between start
        and goal.
    carried: what the hand is shown with where the problem does not model it.
    """
    problem = with_load(solution.problem, carried)
    states = None if solution.simplified is None else solution.simplified.path.states
    write_png(Path(path), solution_image(problem, states, size, ghosts))


@one_thread()  # BLAS threads wait for each other on small products
def solution_image(
    problem: PlanningProblem, states: np.ndarray | None, size: tuple[int, int], ghosts: int = 4
) -> np.ndarray:
    """What `draw_solution` writes, (height, width, 3), 8 bit;
    states (m, n) of the path, or None without one.
    """
    if min(size) < 1:
        raise InvalidInputError(f"picture size {size} must be at least 1 x 1 pixels")
    legend = strip(_legend(problem, states is not None, ghosts), size[0])
    if len(legend) >= LEGEND_SHARE * size[1]:
        legend = legend[:0]
    size = (size[0], size[1] - len(legend))
    layers = list(_translucent(problem, states, ghosts))
    start = robot_meshes(problem, problem.start, ROBOT_COLOUR)
    seen = [joined(start), *(layer.mesh for layer in layers[:1] + layers[-1:])]
    stage = clear_stage(problem, seen, size)
    picture = stage.picture(start)
    for layer in [*layers, *_marks(problem, states)]:
        blend(picture, layer, rasterise(layer.mesh, stage.viewpoint, stage.shape), stage.viewpoint)
    return np.concatenate([eight_bit(picture.image), legend])


def still_image(
    problem: PlanningProblem,
    q: np.ndarray,
    size: tuple[int, int],
    viewpoint: Viewpoint,
    hidden: Sequence[str] = HIDDEN,
) -> np.ndarray:
    """Colours (height, width, 3), 8 bit, of the scene without `hidden` and the robot at q (n,).

    `Viewpoint.screen` says where in it a point is.
    """
    stage = stage_of(problem, viewpoint, size, hidden)
    return eight_bit(stage.picture(robot_meshes(problem, q, ROBOT_COLOUR)).image)


def draw_world(problem: PlanningProblem, path: Path, size: tuple[int, int] = (1200, 800)) -> None:
    """Write a PNG of the whole scene and the robot at the start."""
    robot = joined(robot_meshes(problem, problem.start, ROBOT_COLOUR))
    corners = np.concatenate([mesh.corners for mesh in (robot, *scene_meshes(problem.scene, ()))])
    viewpoint = framed(corners.reshape(-1, 3), AZIMUTHS[0], size)
    write_png(Path(path), still_image(problem, problem.start, size, viewpoint, hidden=()))


def alone(robot: Robot) -> PlanningProblem:
    """A robot in an empty scene, its joints as near to 0 as their limits let them."""
    rest = np.clip(0.0, robot.lower, robot.upper)
    return PlanningProblem(robot.name, robot, Scene("nothing", ()), rest, rest[None])


@one_thread()
def robot_image(robot: Robot, size: tuple[int, int]) -> np.ndarray:
    """The collision pieces of a robot, (height, width, 3), 8 bit."""
    problem = alone(robot)
    seen = joined(robot_meshes(problem, problem.start, ROBOT_COLOUR))
    return still_image(problem, problem.start, size, clear_viewpoint([seen], [], size))


@one_thread()
def scene_image(scene: Scene, size: tuple[int, int]) -> np.ndarray:
    """A scene without a robot, (height, width, 3), 8 bit."""
    meshes = scene_meshes(scene, HIDDEN)
    if not meshes:
        raise InvalidInputError(f"scene {scene.name!r} has no object to draw")
    viewpoint = framed(joined(meshes).corners.reshape(-1, 3), AZIMUTHS[0], size)
    shape = (SUPERSAMPLING * size[1], SUPERSAMPLING * size[0])
    return eight_bit(Stage((), ground_height(scene), viewpoint, shape).picture(meshes).image)


def with_load(problem: PlanningProblem, carried: Sequence[Attachment]) -> PlanningProblem:
    """The problem with `carried` in the hand, if it has nothing there itself."""
    return problem if problem.attachments else replace(problem, attachments=tuple(carried))


def stage_of(
    problem: PlanningProblem,
    viewpoint: Viewpoint,
    size: tuple[int, int],
    hidden: Sequence[str] = HIDDEN,
) -> Stage:
    """The problem's scene without `hidden`, for pictures of (width, height) pixels that `eight_bit`
    makes.
    """
    shape = (SUPERSAMPLING * size[1], SUPERSAMPLING * size[0])
    return Stage(
        scene_meshes(problem.scene, hidden), ground_height(problem.scene), viewpoint, shape
    )


def clear_stage(
    problem: PlanningProblem,
    seen: Sequence[Mesh],
    size: tuple[int, int],
    moving: Iterable[str] = (),
) -> Stage:
    """The scene without objects that move, from a viewpoint that shows most of the meshes `seen`."""
    viewpoint = clear_viewpoint(seen, scene_meshes(problem.scene, HIDDEN), size)
    return stage_of(problem, viewpoint, size, (*HIDDEN, *moving))


def blend(picture: Picture, layer: Layer, view: View, viewpoint: Viewpoint) -> None:
    """Blend a translucent mesh, of which `rasterise` gave the view, over a picture.

    Where a body stands as another one that is drawn already, the first one alone is seen.
    """
    at = view.rows, view.columns
    share = np.where(view.depth < picture.depth[at] - 1e-3, layer.opacity, layer.opacity_behind)[
        :, None
    ]
    if layer.opacity < 1.0:
        for depth in (picture.depth, *picture.ghosts):
            share[np.abs(view.depth - depth[at]) < COINCIDE] = 0.0
        picture.ghosts.append(np.full(picture.depth.shape, np.inf, np.float32))
        picture.ghosts[-1][at] = view.depth
    sky, sunlight = light(view.normals, viewpoint)
    colours = layer.mesh.colours[view.face] * (sky + sunlight)[:, None]
    picture.image[at] += share * (colours - picture.image[at])


def eight_bit(image: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] at SUPERSAMPLING times the size as 8-bit colours of the picture."""
    rows, columns = (side // SUPERSAMPLING for side in image.shape[:2])
    smaller = image.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return (255.0 * np.clip(smaller, 0.0, 1.0) + 0.5).astype(np.uint8)


def _translucent(
    problem: PlanningProblem, states: np.ndarray | None, ghosts: int
) -> Iterator[Layer]:
    """The layers over the solid one; states (m, n) of the path, or None."""
    if states is None:
        for goal in problem.goals[:1]:
            yield Layer(joined(robot_meshes(problem, goal, GOAL_COLOUR)), 0.5)
        return
    yield Layer(joined(robot_meshes(problem, states[-1], GOAL_COLOUR)), 0.55)
    travelled = travelled_along(states)
    for k in range(1, ghosts + 1):
        between = states[np.searchsorted(travelled, travelled[-1] * k / (ghosts + 1))]
        yield Layer(joined(robot_meshes(problem, between, GHOST_COLOUR)), 0.25)
    yield Layer(beads(poses_along(problem.robot, states)[1][:, :3, 3], TRACE_COLOUR), 1.0, 0.45)


def _marks(problem: PlanningProblem, states: np.ndarray | None) -> Iterator[Layer]:
    """The constraint and the hand's axes."""
    states = problem.start[None] if states is None else states
    for mark in constraint_marks(problem, states):
        yield Layer(mark, 0.3, 0.12)
    yield Layer(joined(hand_axes(problem, q) for q in states[[0, -1]]), 1.0, 0.5)


def _legend(problem: PlanningProblem, solved: bool, ghosts: int) -> list[Label]:
    labels = [Label("start", ROBOT_COLOUR)]
    if solved and ghosts:
        labels.append(Label("on the way", GHOST_COLOUR))
    if solved or len(problem.goals):
        labels.append(Label("goal", GOAL_COLOUR))
    labels.append(Label("path of the hand", TRACE_COLOUR) if solved else Label("no path found"))
    labels += [Label("constraint", CONSTRAINT_COLOUR)] if problem.constraint else []
    labels += [Label(item.name.replace("_", " "), LOAD_COLOUR) for item in problem.attachments]
    return labels


def write_png(path: Path, image: np.ndarray) -> None:
    """Write 8-bit colours (rows, columns, 3)."""
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG", optimize=True)


def draw_task(solution: TaskSolution, path: Path, size: tuple[int, int] = (600, 450)) -> list[str]:
    """Write `task_image` as a PNG; the names in it."""
    image, names = task_image(solution, size)
    write_png(Path(path), image)
    return names


@one_thread()
def task_image(solution: TaskSolution, size: tuple[int, int]) -> tuple[np.ndarray, list[str]]:
    """Named pictures of the start and of the end of each planned phase, row by row, 8 bit; their
    names.

    size: width and height of one picture [pixels], without the name below it.
    """
    planned = {
        "start",
        *(phase.name for phase in solution.task.phases if isinstance(phase, PlannedPhase)),
    }
    worlds = {"start": World.before(solution.task)} | {
        frame.phase: frame.world for frame in frames(solution)
    }
    chosen = {name: shown(world) for name, world in worlds.items() if name in planned}
    arms = [
        joined(robot_meshes(problem, problem.start, ROBOT_COLOUR)) for problem in chosen.values()
    ]
    last = list(chosen.values())[-1]
    viewpoint = clear_viewpoint([joined(arms)], scene_meshes(last.scene, HIDDEN), size)
    panels = []
    for k, (name, problem) in enumerate(chosen.items(), start=1):
        caption = strip([Label(f"{k}  {name}")], size[0], NAME_LETTERS)
        panels.append(
            np.concatenate([still_image(problem, problem.start, size, viewpoint), caption])
        )
    height, width = (side + PANEL_GAP for side in panels[0].shape[:2])
    rows = -(-len(panels) // COLUMNS)
    sheet = np.full((rows * height - PANEL_GAP, COLUMNS * width - PANEL_GAP, 3), 255, np.uint8)
    for k, panel in enumerate(panels):
        top, left = (k // COLUMNS) * height, (k % COLUMNS) * width
        sheet[top : top + len(panel), left : left + size[0]] = panel
    return sheet, list(chosen)
