"""Films of a solution or a task: gif files."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.files import replacing
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.processes import one_thread
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.show.meshes import (
    GOAL_COLOUR,
    LOAD_COLOUR,
    ROBOT_COLOUR,
    TRACE_COLOUR,
    Mesh,
    beads,
    colour_of,
    joined,
    poses_along,
    rasterise,
    robot_meshes,
    shape_mesh,
)
from cvqmpt_lab.show.picture import (
    NAME_LETTERS,
    Label,
    Layer,
    blend,
    clear_stage,
    eight_bit,
    strip,
    with_load,
)
from cvqmpt_lab.show.task_frames import Frame, moving_poses, shown, solved_frames
from cvqmpt_lab.tasks.solve import TaskSolution

FRAMES = 48  # of one path
VIEWS = 6  # of its states that the viewpoint is chosen for
TASK_FRAMES = 110  # of a task, however long it takes
TASK_VIEWS = 8  # of them that the viewpoint is chosen for
RATE = 14  # frames a second
REST = 10  # frames that the last one is shown for
LEGEND_LETTERS = 42  # that fit side by side below a film
COLOURS, PALETTE_FRAMES = 128, 6  # of a gif, and the frames that they are chosen for


Progress = Callable[[int, int], None]  # told how many pictures of how many are drawn


@one_thread()
def film_solution(
    solution: Solution,
    path: Path,
    size: tuple[int, int] = (600, 400),
    carried: Sequence[Attachment] = (),
    progress: Progress = lambda done, total: None,
) -> None:
    """Write a film of the robot on its path, or of the start alone without one, as a gif.

    size: width and height [pixels], without the legend. carried: as for `draw_solution`.
    """
    problem = with_load(solution.problem, carried)
    states = problem.start[None]
    if solution.simplified is not None:
        planned = solution.simplified.path
        states = planned.spaced(planned.length / FRAMES)
    arms = [
        joined(robot_meshes(problem, q, ROBOT_COLOUR))
        for q in states[:: max(1, len(states) // VIEWS)]
    ]
    stage = clear_stage(problem, [joined(arms)], size)
    layers = [
        Layer(joined(robot_meshes(problem, states[-1], GOAL_COLOUR)), 0.35),
        Layer(beads(poses_along(problem.robot, states)[1][:, :3, 3], TRACE_COLOUR), 1.0, 0.4),
    ]
    views = [rasterise(layer.mesh, stage.viewpoint, stage.shape) for layer in layers]
    names = {"robot": ROBOT_COLOUR, "goal": GOAL_COLOUR, "path of the hand": TRACE_COLOUR}
    names |= {item.name.replace("_", " "): LOAD_COLOUR for item in problem.attachments}
    legend = strip([Label(*item) for item in names.items()], size[0], LEGEND_LETTERS)
    pictures = []
    for q in states:
        picture = stage.picture(robot_meshes(problem, q, ROBOT_COLOUR))
        for layer, view in zip(layers, views, strict=True):
            blend(picture, layer, view, stage.viewpoint)
        pictures.append(np.concatenate([eight_bit(picture.image), legend]))
        progress(len(pictures), len(states))
    save_film(pictures, path)


def check_film(path: Path) -> None:
    """Refuse a film that could not be written, before anything is planned for it."""
    if path.suffix != ".gif":
        raise UnknownChoiceError(f"kind of film {path.name}: suffix", path.suffix, (".gif",))


def save_film(frames: Sequence[np.ndarray], path: Path) -> None:
    """Write pictures (height, width, 3), 8 bit, one after another, as a gif."""
    check_film(path)
    frames = [*frames, *[frames[-1]] * REST]
    some = frames[:: max(1, len(frames) // PALETTE_FRAMES)]
    palette = Image.fromarray(np.concatenate(some)).quantize(COLOURS)
    first, *rest = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    )
    with replacing(path) as temporary:
        first.save(
            temporary, "GIF", save_all=True, append_images=rest, duration=1000 // RATE, loop=0
        )


@one_thread()
def film_task(
    solution: TaskSolution,
    path: Path,
    size: tuple[int, int] = (600, 450),
    progress: Progress = lambda done, total: None,
) -> None:
    """Write a film of a task, the name of the phase below, as a gif.

    size: width and height [pixels], without the name.
    """
    every = solved_frames(solution)
    chosen = [
        every[k] for k in np.linspace(0, len(every) - 1, min(TASK_FRAMES, len(every))).astype(int)
    ]
    scene = solution.task.scene
    moving = moving_poses(scene.names, chosen)
    first = shown(chosen[0].world)
    arms = [joined(_arm(frame)) for frame in chosen[:: max(1, len(chosen) // TASK_VIEWS)]]
    stage = clear_stage(first, [joined(arms)], size, moving)
    pictures = []
    for k, frame in enumerate(chosen):
        items = [
            shape_mesh(scene[name].shape).placed(poses[k], colour_of(name))
            for name, poses in moving.items()
        ]
        picture = eight_bit(stage.picture([*_arm(frame), *items]).image)
        pictures.append(
            np.concatenate([picture, strip([Label(frame.phase)], size[0], NAME_LETTERS)])
        )
        progress(len(pictures), len(chosen))
    save_film(pictures, path)


def _arm(frame: Frame) -> list[Mesh]:
    """The arm without what it carries."""
    problem = shown(frame.world)
    return robot_meshes(problem, frame.world.q, ROBOT_COLOUR)[: len(problem.robot.links)]
