"""One call that draws whatever can be seen:
a robot, a scene, a problem, a task, or what came of them.
"""

import io
from base64 import b64encode
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.show.picture import (
    robot_image,
    scene_image,
    solution_image,
    task_image,
    write_png,
)
from cvqmpt_lab.show.task_frames import shown
from cvqmpt_lab.tasks.solve import TaskSolution
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.tasks.world import World

DRAWN = (Robot, Scene, PlanningProblem, Solution, Task, TaskSolution)
# [pixels] of pictures, and of those that notebooks show by themselves
SIZE, SMALL = (900, 600), (600, 400)


def draw(what: object, path: Path | str | None = None, size: tuple[int, int] = SIZE) -> Image.Image:
    """Draw a robot, scene, problem, solution, task or solved task; notebooks show the image.

    path: of a PNG that is written, too. size: width and height [pixels], of a solved task those of
        one phase.
    UnknownChoiceError for anything else; InvalidInputError for a scene without objects.
    """
    image = Image.fromarray(_image(what, size))
    if path is not None:
        write_png(Path(path), np.array(image))
    return image


def png_of(what: object) -> bytes | None:
    """The PNG of something, or None if there is nothing to see."""
    if isinstance(what, Scene) and not what.objects:
        return None
    written = io.BytesIO()
    draw(what, size=SMALL).save(written, format="PNG")
    return written.getvalue()


def html_of(what: object) -> str:
    """The text of something above its picture, as html."""
    png = png_of(what)
    picture = f'<img src="data:image/png;base64,{b64encode(png).decode()}">' if png else ""
    return f"<pre>{escape(repr(what))}</pre>{picture}"


def register_pictures(shell: Any) -> None:
    """Let an IPython shell show all that `draw` draws: its text above its picture."""
    for kind in DRAWN:
        shell.display_formatter.formatters["image/png"].for_type(kind, png_of)
        shell.display_formatter.formatters["text/html"].for_type(kind, html_of)


def _image(what: object, size: tuple[int, int]) -> np.ndarray:
    match what:
        case Robot():
            return robot_image(what, size)
        case Scene():
            return scene_image(what, size)
        case PlanningProblem():
            return solution_image(what, None, size)
        case Solution():
            states = None if what.simplified is None else what.simplified.path.states
            return solution_image(what.problem, states, size)
        case Task():
            return solution_image(shown(World.before(what)), None, size)
        case TaskSolution():
            return task_image(what, (size[0] // 2, size[1] // 2))[0]
    raise UnknownChoiceError("draw:", type(what).__name__, [kind.__name__ for kind in DRAWN])
