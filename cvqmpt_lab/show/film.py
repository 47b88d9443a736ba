"""Films of a solution or a task, as gif files."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.files import replacing
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.processes import one_thread
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.show.bodies import meshes_of, seen_of_solution, seen_of_task, whole
from cvqmpt_lab.show.meshes import joined
from cvqmpt_lab.show.picture import clear_stage, layers_on, legend_of, strip
from cvqmpt_lab.tasks.solve import TaskSolution


@one_thread()
def film_solution(
    solution: Solution | TaskSolution,
    path: Path,
    size: tuple[int, int] = (600, 400),
    carried: Sequence[Attachment] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    pictures: int | None = None,
) -> None:
    """Write a film of the robot on its path (without a path, of the start), or of a task.

    Args:
        solution: what is shown.
        path: of the gif.
        size: width and height, without the legend or the name of the phase below [pixels].
        carried: load in the hand if the problem does not model it.
        progress: called with the numbers of pictures drawn and of all.
        pictures: of the film, about; default: 49 of a path, 110 at most of a task.
    """
    if isinstance(solution, TaskSolution):
        seen = seen_of_task(solution, pictures or 110)
        arm = [body for body in seen.moving if body.group == "robot"]
        captions = {name: strip([(name, None)], size[0], 24) for name in set(seen.labels)}
    else:
        seen = seen_of_solution(solution, carried, pictures or 49)
        arm = list(seen.moving)
        shown = seen.layers("goals", "path").values()
        bodies = [*arm, *(layer[0] for layer in shown)]
        captions = dict.fromkeys(seen.labels, strip(legend_of(bodies), size[0], 42))
    count = len(seen.labels)
    # the viewpoint is chosen for some eight of its states
    views = [whole(arm, k) for k in range(0, count, max(1, count // 8))]
    stage = clear_stage(seen, [joined(views)], size)
    layers = layers_on(stage, list(seen.layers("goals", "path").values()))
    frames = []
    for k, label in enumerate(seen.labels):
        image = stage.image(meshes_of(seen.moving, k), layers)
        frames.append(np.concatenate([image, captions[label]]))
        progress(len(frames), count)
    save_film(frames, path)


def save_film(
    frames: Sequence[np.ndarray],
    path: Path,
    rate: int = 14,
    rest: int = 10,
    colours: int = 128,
    chosen: int = 6,
) -> None:
    """Write pictures one after another as a gif.

    Args:
        frames: (height, width, 3) each, 8 bit.
        path: of the file.
        rate: of pictures [1/s].
        rest: pictures for which the last one is shown.
        colours: number of colours of the gif.
        chosen: about how many pictures the colours are chosen from.
    """
    if path.suffix != ".gif":
        raise UnknownChoiceError(f"kind of film {path.name}: suffix", path.suffix, (".gif",))
    frames = [*frames, *[frames[-1]] * rest]
    some = frames[:: max(1, len(frames) // chosen)]
    palette = Image.fromarray(np.concatenate(some)).quantize(colours)
    first, *others = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    )
    with replacing(path) as temporary:
        first.save(
            temporary, "GIF", save_all=True, append_images=others, duration=1000 // rate, loop=0
        )
