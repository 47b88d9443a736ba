"""A still picture of a solution, drawn by a small z-buffer rasteriser: no display or graphics library needed.

Everything drawn is triangles. The solid layer (scene, robot at the start) gets outlines and shadows; ghosts
of the robot along the path and at the goal, and the hand's trace, are blended over it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import replacing
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.show.labels import Label, Strip
from cvqmpt_lab.show.meshes import (
    GHOST_COLOUR,
    GOAL_COLOUR,
    LOAD_COLOUR,
    ROBOT_COLOUR,
    TRACE_COLOUR,
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
from cvqmpt_lab.show.task_frames import moments, shown
from cvqmpt_lab.tasks.solve_task import TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase
from cvqmpt_lab.tasks.world import World

SUPERSAMPLING = 2
HIDDEN = ("walls/right",)  # Scene objects that stand between the usual viewpoint and the robot
PANEL_GAP = 6  # [pixels] between the pictures of a task
NAME_LETTERS = 24  # that fit under a picture of a task
LEGEND_SHARE = 0.2  # of a picture's height; pictures too small for their legend have none


@dataclass(frozen=True, eq=False)
class Layer:
    """A translucent mesh."""

    mesh: Mesh
    opacity: float
    opacity_behind: float = 0.0  # Where something solid is in front of it


def draw_solution(
    solution: Solution,
    path: Path,
    size: tuple[int, int] = (1200, 800),
    ghosts: int = 4,
    viewpoint: Viewpoint | None = None,
    hidden: Sequence[str] = HIDDEN,
    carried: Sequence[Attachment] = (),
) -> None:
    """Write a PNG of scene, robot at the start, ghosts along the path and at the goal, the hand's trace, a legend.

    Parameters
    ----------
    size: width and height [pixels], legend included.
    ghosts: number of poses shown between start and goal.
    viewpoint: None for one from which the motion is seen well.
    hidden: names of scene objects left out because they stand in the way.
    carried: what the hand is shown with where the problem does not model it.

    Raises
    ------
    InvalidInputError: a size without pixels, or a path that cannot be written.
    """
    if min(size) < 1:
        raise InvalidInputError(f"picture size {size} must be at least 1 x 1 pixels")
    problem = with_load(solution.problem, carried)
    states = None if solution.simplified is None else solution.simplified.path.states
    strip = Strip(_legend(problem, states is not None, ghosts), size[0])
    legend = [strip.image()] if strip.height < LEGEND_SHARE * size[1] else []
    height = size[1] - sum(len(part) for part in legend)
    layers = list(_translucent(problem, states, ghosts))
    if viewpoint is None:
        start = joined(robot_meshes(problem, problem.start, ROBOT_COLOUR))
        seen = [start, *(layer.mesh for layer in layers[-2:])]
        viewpoint = clear_viewpoint(seen, scene_meshes(problem, hidden), (size[0], height))
    stage = stage_of(problem, viewpoint, (size[0], height), hidden)
    picture = stage.picture(robot_meshes(problem, problem.start, ROBOT_COLOUR))
    for layer in layers:
        blend(picture, layer, rasterise(layer.mesh, viewpoint, stage.shape), viewpoint)
    write_png(Path(path), np.concatenate([eight_bit(picture.image), *legend]))


def still_image(
    problem: PlanningProblem,
    q: np.ndarray,
    size: tuple[int, int] = (900, 600),
    viewpoint: Viewpoint | None = None,
    hidden: Sequence[str] = HIDDEN,
) -> np.ndarray:
    """Colours (height, width, 3), 8 bit, of the scene and the robot at q (n,); what figures are drawn over.

    `Viewpoint.screen` says where in it a point is.
    """
    stage = stage_of(problem, viewpoint or Viewpoint(), size, hidden)
    return eight_bit(stage.picture(robot_meshes(problem, q, ROBOT_COLOUR)).image)


def draw_world(problem: PlanningProblem, path: Path, size: tuple[int, int] = (1200, 800)) -> None:
    """Write a PNG of the whole scene and the robot at the start."""
    robot = joined(robot_meshes(problem, problem.start, ROBOT_COLOUR))
    corners = np.concatenate([mesh.corners for mesh in (robot, *scene_meshes(problem, ()))])
    viewpoint = framed(corners.reshape(-1, 3), AZIMUTHS[0], size)
    write_png(Path(path), still_image(problem, problem.start, size, viewpoint, hidden=()))


def with_load(problem: PlanningProblem, carried: Sequence[Attachment]) -> PlanningProblem:
    """The problem with something in the hand, where it has nothing there itself."""
    return problem if problem.attachments else replace(problem, attachments=tuple(carried))


def stage_of(
    problem: PlanningProblem, viewpoint: Viewpoint, size: tuple[int, int], hidden: Sequence[str] = HIDDEN
) -> Stage:
    """The problem's scene, for pictures of (width, height) pixels that `eight_bit` makes."""
    shape = (SUPERSAMPLING * size[1], SUPERSAMPLING * size[0])
    return Stage(scene_meshes(problem, hidden), ground_height(problem), viewpoint, shape)


def blend(picture: Picture, layer: Layer, view: View, viewpoint: Viewpoint) -> None:
    """Lay a translucent mesh, of which `rasterise` gave a view, over a picture."""
    at = view.rows, view.columns
    share = np.where(view.depth < picture.depth[at] - 1e-3, layer.opacity, layer.opacity_behind)[:, None]
    sky, sunlight = light(view.normals, viewpoint)
    colours = layer.mesh.colours[view.face] * (sky + sunlight)[:, None]
    picture.image[at] += share * (colours - picture.image[at])


def eight_bit(image: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] at SUPERSAMPLING times the size as 8-bit colours of the picture."""
    rows, columns = (side // SUPERSAMPLING for side in image.shape[:2])
    smaller = image.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return (255.0 * np.clip(smaller, 0.0, 1.0) + 0.5).astype(np.uint8)


def _translucent(problem: PlanningProblem, states: np.ndarray | None, ghosts: int) -> Iterator[Layer]:
    """What is blended over the solid layer; states (m, n) of the path, or None."""
    if states is None:
        for goal in problem.goals[:1]:
            yield Layer(joined(robot_meshes(problem, goal, GOAL_COLOUR)), 0.5)
        return
    travelled = travelled_along(states)
    for k in range(1, ghosts + 1):
        between = states[np.searchsorted(travelled, travelled[-1] * k / (ghosts + 1))]
        yield Layer(joined(robot_meshes(problem, between, GHOST_COLOUR)), 0.25)
    yield Layer(joined(robot_meshes(problem, states[-1], GOAL_COLOUR)), 0.55)
    yield Layer(beads(poses_along(problem.robot, states)[1][:, :3, 3], TRACE_COLOUR), 1.0, 0.45)


def _legend(problem: PlanningProblem, solved: bool, ghosts: int) -> list[Label]:
    """What the colours mean."""
    labels = [Label("start", ROBOT_COLOUR)]
    if solved and ghosts:
        labels.append(Label("on the way", GHOST_COLOUR))
    if solved or len(problem.goals):
        labels.append(Label("goal", GOAL_COLOUR))
    labels.append(Label("path of the hand", TRACE_COLOUR) if solved else Label("no path found"))
    labels += [Label(item.name.replace("_", " "), LOAD_COLOUR) for item in problem.attachments]
    return labels


def write_png(path: Path, image: np.ndarray) -> None:
    """Write 8-bit colours (rows, columns, 3)."""
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG", optimize=True)


def draw_task(
    solution: TaskSolution,
    path: Path,
    size: tuple[int, int] = (600, 450),
    columns: int = 3,
    viewpoint: Viewpoint | None = None,
) -> list[str]:
    """Write a PNG with a named picture of the start and of the end of each planned phase, row by row; their names.

    Parameters
    ----------
    size: width and height of one picture [pixels], without the name below it.
    viewpoint: of all pictures; None for one from which all of them are seen well.

    Raises
    ------
    InvalidInputError: a path that cannot be written.
    """
    planned = {phase.name for phase in solution.task.phases if isinstance(phase, PlannedPhase)}
    chosen = [(name, world) for name, world in moments(solution) if name in planned or name == "start"]
    viewpoint = viewpoint or _task_viewpoint([world for _, world in chosen], size)
    panels = []
    for k, (name, world) in enumerate(chosen):
        picture = still_image(shown(world), world.q, size, viewpoint)
        panels.append(
            np.concatenate([picture, Strip([Label(f"{k + 1}  {name}")], size[0], NAME_LETTERS).image()])
        )
    height, width = panels[0].shape[:2]
    rows = -(-len(panels) // columns)
    sheet = np.full(
        (rows * (height + PANEL_GAP) - PANEL_GAP, columns * (width + PANEL_GAP) - PANEL_GAP, 3), 255, np.uint8
    )
    for k, panel in enumerate(panels):
        top, left = (k // columns) * (height + PANEL_GAP), (k % columns) * (width + PANEL_GAP)
        sheet[top : top + height, left : left + width] = panel
    write_png(Path(path), sheet)
    return [name for name, _ in chosen]


def _task_viewpoint(worlds: list[World], size: tuple[int, int]) -> Viewpoint:
    """One from which the arm is seen well in each of the worlds."""
    arms = [joined(robot_meshes(shown(world), world.q, ROBOT_COLOUR)) for world in worlds]
    return clear_viewpoint([joined(arms)], scene_meshes(shown(worlds[-1]), HIDDEN), size)
