"""A whole task as a film: the arm through all phases, the door turning, the can carried."""

from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.show.film import save_film
from cvqmpt_lab.show.framing import clear_viewpoint
from cvqmpt_lab.show.labels import Label, Strip
from cvqmpt_lab.show.meshes import (
    ROBOT_COLOUR,
    Mesh,
    colour_of,
    joined,
    robot_meshes,
    scene_meshes,
    shape_mesh,
)
from cvqmpt_lab.show.still import HIDDEN, eight_bit, stage_of
from cvqmpt_lab.show.task_recording import Frame, frames, moving_poses
from cvqmpt_lab.show.task_still import NAME_LETTERS, shown
from cvqmpt_lab.tasks.solve_task import TaskSolution

FRAMES = 110  # of a whole task, however long it takes
LOOKS = 8  # of them that must be seen well


def film_task(solution: TaskSolution, path: Path, size: tuple[int, int] = (600, 450)) -> None:
    """Write a film of a task, the name of the phase below; its suffix chooses between gif and mp4.

    size: width and height [pixels], without the name.

    Raises
    ------
    InvalidInputError: nothing was solved, or see `check_film`.
    """
    every = list(frames(solution))
    if not every:
        raise InvalidInputError(f"nothing to show of task {solution.task.name}: {solution.failure}")
    chosen = [every[k] for k in np.linspace(0, len(every) - 1, min(FRAMES, len(every))).astype(int)]
    scene = solution.task.scene
    moving = moving_poses(scene.names, chosen)
    first = shown(chosen[0].world)
    arms = [joined(_arm(frame)) for frame in chosen[:: max(1, len(chosen) // LOOKS)]]
    viewpoint = clear_viewpoint([joined(arms)], scene_meshes(first, HIDDEN), size)
    stage = stage_of(first, viewpoint, size, (*HIDDEN, *moving))
    pictures = []
    for k, frame in enumerate(chosen):
        items = [
            shape_mesh(scene[name].shape).placed(poses[k], colour_of(name)) for name, poses in moving.items()
        ]
        picture = eight_bit(stage.picture([*_arm(frame), *items]).image)
        caption = Strip([Label(frame.phase)], size[0], NAME_LETTERS).image()
        pictures.append(np.concatenate([picture, caption]))
    save_film(pictures, path)


def _arm(frame: Frame) -> list[Mesh]:
    """The arm without what it carries."""
    problem = shown(frame.world)
    return robot_meshes(problem, frame.world.q, ROBOT_COLOUR)[: len(problem.robot.links)]
