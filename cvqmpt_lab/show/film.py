"""Films of a solution or of a whole task: a gif, or an mp4 where ffmpeg is installed."""

import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import replacing
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.show.labels import Label, Strip
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
    scene_meshes,
    shape_mesh,
)
from cvqmpt_lab.show.picture import HIDDEN, NAME_LETTERS, Layer, blend, eight_bit, stage_of, with_load
from cvqmpt_lab.show.stage import clear_viewpoint
from cvqmpt_lab.show.task_frames import Frame, frames, moving_poses, shown
from cvqmpt_lab.tasks.solve_task import TaskSolution

FRAMES = 48  # of one path
VIEWS = 6  # of its states that must be seen well
TASK_FRAMES = 110  # of a whole task, however long it takes
TASK_VIEWS = 8  # of them that must be seen well
RATE = 14  # frames a second
REST = 10  # frames that the last one is shown for
COLOURS, PALETTE_FRAMES = 128, 6  # of a gif, and the frames that they are chosen for


def film_solution(
    solution: Solution, path: Path, size: tuple[int, int] = (600, 400), carried: Sequence[Attachment] = ()
) -> None:
    """Write a film of the robot on its path; where none was found, of the start alone.

    Parameters
    ----------
    path: its suffix chooses between gif and mp4.
    size: width and height [pixels], without the legend.
    carried: what the hand is shown with where the problem does not model it.

    Raises
    ------
    InvalidInputError, UnknownChoiceError: see `check_film`; or a path that cannot be written.
    """
    save_film(list(_frames(solution, size, carried)), path)


def _frames(solution: Solution, size: tuple[int, int], carried: Sequence[Attachment]) -> Iterator[np.ndarray]:
    """Pictures (height, width, 3) from the start to the goal."""
    problem = with_load(solution.problem, carried)
    path = None if solution.simplified is None else solution.simplified.path
    states = problem.start[None] if path is None else path.spaced(path.length / FRAMES)
    arms = [joined(robot_meshes(problem, q, ROBOT_COLOUR)) for q in states[:: max(1, len(states) // VIEWS)]]
    viewpoint = clear_viewpoint([joined(arms)], scene_meshes(problem, HIDDEN), size)
    stage = stage_of(problem, viewpoint, size)
    layers = [
        Layer(joined(robot_meshes(problem, states[-1], GOAL_COLOUR)), 0.35),
        Layer(beads(poses_along(problem.robot, states)[1][:, :3, 3], TRACE_COLOUR), 1.0, 0.4),
    ]
    views = [rasterise(layer.mesh, viewpoint, stage.shape) for layer in layers]
    labels = [
        Label("robot", ROBOT_COLOUR),
        Label("goal", GOAL_COLOUR),
        Label("path of the hand", TRACE_COLOUR),
    ]
    loads = [Label(item.name.replace("_", " "), LOAD_COLOUR) for item in problem.attachments]
    legend = Strip([*labels, *loads], size[0], letters_across=42).image()
    for q in states:
        picture = stage.picture(robot_meshes(problem, q, ROBOT_COLOUR))
        for layer, view in zip(layers, views, strict=True):
            blend(picture, layer, view, viewpoint)
        yield np.concatenate([eight_bit(picture.image), legend])


def check_film(path: Path) -> None:
    """Refuse a film that could not be written, before anything is planned for it.

    Raises
    ------
    UnknownChoiceError: a suffix other than those of `WRITERS`.
    InvalidInputError: an mp4 where ffmpeg is not installed.
    """
    if path.suffix not in WRITERS:
        raise UnknownChoiceError(f"kind of film {path.name}: suffix", path.suffix, WRITERS)
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InvalidInputError(f"cannot write {path}: no ffmpeg is installed; save a .gif instead")


def save_film(frames: Sequence[np.ndarray], path: Path) -> None:
    """Write pictures (height, width, 3), 8 bit, one after another; see `check_film`."""
    check_film(path)
    WRITERS[path.suffix]([*frames, *[frames[-1]] * REST], path)


def _write_gif(frames: Sequence[np.ndarray], path: Path) -> None:
    some = frames[:: max(1, len(frames) // PALETTE_FRAMES)]
    palette = Image.fromarray(np.concatenate(some)).quantize(COLOURS)
    first, *rest = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames
    )
    with replacing(path) as temporary:
        first.save(temporary, "GIF", save_all=True, append_images=rest, duration=1000 // RATE, loop=0)


def _write_mp4(frames: Sequence[np.ndarray], path: Path) -> None:
    height, width = (side - side % 2 for side in frames[0].shape[:2])  # the codec wants even numbers
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(RATE), "-i", "-"]
    coded = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-f", "mp4"]
    data = b"".join(frame[:height, :width].tobytes() for frame in frames)
    with replacing(path) as temporary:
        done = subprocess.run(
            ["ffmpeg", "-y", "-loglevel", "error", *raw, *coded, str(temporary)],
            input=data,
            capture_output=True,
        )
        if done.returncode != 0:
            reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no reason given"]
            raise InvalidInputError(f"cannot write {path}: ffmpeg says {reason[0]!r}; save a .gif instead")


WRITERS: Mapping[str, Callable[[Sequence[np.ndarray], Path], None]] = {".gif": _write_gif, ".mp4": _write_mp4}
"""How a film is written, by the suffix of its file."""


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
    chosen = [every[k] for k in np.linspace(0, len(every) - 1, min(TASK_FRAMES, len(every))).astype(int)]
    scene = solution.task.scene
    moving = moving_poses(scene.names, chosen)
    first = shown(chosen[0].world)
    arms = [joined(_arm(frame)) for frame in chosen[:: max(1, len(chosen) // TASK_VIEWS)]]
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
