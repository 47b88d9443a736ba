"""A task as a row of still pictures: where it starts, and each moment at which a phase ends."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.show.framing import clear_viewpoint
from cvqmpt_lab.show.labels import Label, Strip
from cvqmpt_lab.show.meshes import ROBOT_COLOUR, joined, robot_meshes, scene_meshes
from cvqmpt_lab.show.rasteriser import Viewpoint
from cvqmpt_lab.show.still import HIDDEN, still_image, write_png
from cvqmpt_lab.tasks.phases import PlannedPhase
from cvqmpt_lab.tasks.solve_task import TaskSolution
from cvqmpt_lab.tasks.world import HeldDoor, Load, World

GAP = 6  # [pixels] between pictures
NAME_LETTERS = 24  # that fit under a picture


def moments(solution: TaskSolution) -> list[tuple[str, World]]:
    """(name, world) at the start and after every phase that was solved, in order."""
    outcomes = {outcome.phase.name: outcome for outcome in solution.outcomes if outcome.solved}
    world = World.before(solution.task)
    found = [("start", world)]
    for phase in solution.task.phases:
        if not isinstance(phase, PlannedPhase):
            world = world.after(phase)
        elif phase.name in outcomes:
            world = world.moved(outcomes[phase.name].solution.simplified.path.states[-1])  # type: ignore[union-attr]
        else:
            break
        found.append((phase.name, world))
    return found


def shown(world: World) -> PlanningProblem:
    """A world as something that can be drawn: the arm alone, and a door it holds in the scene."""
    attachments: tuple[Attachment, ...] = ()
    if isinstance(world.held, Load):  # the object itself, not the little less of it that is checked
        attachments = (
            replace(
                world.held.attachment, shape=world.held.item.shape, T_hand_object=world.held.T_hand_object
            ),
        )
    return PlanningProblem(
        name="shown",
        robot=world.arm,
        scene=world.scene,
        start=world.q,
        goals=world.q[None],
        attachments=attachments,
    )


def world_along(world: World, q: np.ndarray) -> World:
    """The world at a state (n,) of a planned phase's path, or (n + 1,) with a door in the hand."""
    return world.moved(q) if isinstance(world.held, HeldDoor) else replace(world, q=q)


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
    viewpoint = viewpoint or _viewpoint([world for _, world in chosen], size)
    panels = []
    for k, (name, world) in enumerate(chosen):
        picture = still_image(shown(world), world.q, size, viewpoint)
        panels.append(
            np.concatenate([picture, Strip([Label(f"{k + 1}  {name}")], size[0], NAME_LETTERS).image()])
        )
    height, width = panels[0].shape[:2]
    rows = -(-len(panels) // columns)
    sheet = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for k, panel in enumerate(panels):
        top, left = (k // columns) * (height + GAP), (k % columns) * (width + GAP)
        sheet[top : top + height, left : left + width] = panel
    write_png(Path(path), sheet)
    return [name for name, _ in chosen]


def _viewpoint(worlds: list[World], size: tuple[int, int]) -> Viewpoint:
    """One from which the arm is seen well in each of the worlds."""
    arms = [joined(robot_meshes(shown(world), world.q, ROBOT_COLOUR)) for world in worlds]
    return clear_viewpoint([joined(arms)], scene_meshes(shown(worlds[-1]), HIDDEN), size)
