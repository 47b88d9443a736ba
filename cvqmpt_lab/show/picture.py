"""Still pictures of a robot, a scene, a problem, a solution or a task, as PNG; films as gif.

The solid part (scene, robot at the start) has outlines and shadows; ghosts of the robot along the
path and at the goal, the hand's trace, the constraint and the hand's axes are blended over it. A
legend or caption stands below.
"""

import io
import math
from base64 import b64encode
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError, require_choice
from cvqmpt_lab.base.files import replacing
from cvqmpt_lab.base.processes import one_thread
from cvqmpt_lab.planning.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.bodies import (
    HIDDEN,
    Body,
    Seen,
    frames,
    ground_height,
    in_view,
    robot_bodies,
    scene_bodies,
    seen_of_problem,
    seen_of_solution,
    seen_of_task,
    shown,
    whole,
)
from cvqmpt_lab.show.meshes import Colour, Mesh, joined, shape_mesh
from cvqmpt_lab.show.raster import Layer, Stage, Viewpoint, clear_viewpoint, framed
from cvqmpt_lab.tasks.solve import TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase, Task
from cvqmpt_lab.tasks.world import World

Label = tuple[str, Colour | None]  # a text, and the colour of its swatch, if it has one
DRAWN = (Robot, Scene, PlanningProblem, Solution, Task, TaskSolution)


@one_thread()  # BLAS threads wait for each other on small products
def draw(
    what: object, path: Path | str | None = None, size: tuple[int, int] = (900, 600)
) -> Image.Image:
    """Draw a robot, scene, problem, solution, task or solved task; notebooks show the image.

    Args:
        what: one of these.
        path: of a PNG that is written, too.
        size: width and height [pixels]; a picture of a phase of a solved task has half of both.

    Raises UnknownChoiceError for anything else, InvalidInputError for a scene without objects.
    """
    match what:
        case Robot():
            # its joints as near to 0 as their limits let them
            rest = np.clip(0.0, what.lower, what.upper)
            alone = PlanningProblem(what.name, what, Scene("nothing", ()), rest, rest[None])
            bodies = robot_bodies(alone, rest[None])
            torso = whole(body for body in bodies if body.aside)
            viewpoint = clear_viewpoint([in_view(bodies)], whole(()), size, [torso], torso)
            image = still_image(alone, rest, size, viewpoint)
        case Scene():
            scene = whole(scene_bodies(what))
            if not len(scene.corners):
                raise InvalidInputError(f"scene {what.name!r} has no object to draw")
            viewpoint = framed(scene.corners.reshape(-1, 3), size)
            image = Stage(whole(()), ground_height(what), viewpoint, size).image(scene)
        case PlanningProblem():
            image = problem_image(what, None, size)
        case Solution():
            image = problem_image(what.problem, what.path, size)
        case Task():
            image = problem_image(shown(World.before(what)), None, size)
        case TaskSolution():
            image = task_image(what, (size[0] // 2, size[1] // 2))[0]
        case _:
            names = [kind.__name__ for kind in DRAWN]
            raise UnknownChoiceError("draw:", type(what).__name__, names)
    if path is not None:
        write_png(Path(path), image)
    return Image.fromarray(image)


def png_of(what: object) -> bytes | None:
    """The PNG of something in a notebook, or None if there is nothing to see."""
    if isinstance(what, Scene) and not what.objects:
        return None
    written = io.BytesIO()
    draw(what, size=(600, 400)).save(written, format="PNG")
    return written.getvalue()


def html_of(what: object) -> str:
    """The text of something above its picture, as html."""
    png = png_of(what)
    picture = f'<img src="data:image/png;base64,{b64encode(png).decode()}">' if png else ""
    return f"<pre>{escape(repr(what))}</pre>{picture}"


def draw_solution(
    solution: Solution,
    path: Path,
    size: tuple[int, int] = (1200, 800),
    ghosts: int = 4,
    carried: Sequence[Attachment] = (),
) -> None:
    """Write a PNG of the scene, the robot along the path, and the constraint, with a legend.

    The robot is drawn at the start, as ghosts along the path and at the goal; lines show the hand's
    trace, and its axes at start and goal.

    Args:
        solution: solved or not.
        path: of the file.
        size: width and height, legend included [pixels].
        ghosts: number of poses shown between start and goal.
        carried: the load in the hand if the problem does not model it.
    """
    image = problem_image(solution.problem, solution.path, size, ghosts, carried)
    write_png(Path(path), image)


@one_thread()
def problem_image(
    problem: PlanningProblem,
    path: JointPath | None,
    size: tuple[int, int],
    ghosts: int = 4,
    carried: Sequence[Attachment] = (),
) -> np.ndarray:
    """What `draw_solution` writes, (height, width, 3), 8 bit."""
    if min(size) < 1:
        raise InvalidInputError(f"picture size {size} must be at least 1 x 1 pixels")
    seen = seen_of_problem(problem, path, carried, ghosts=ghosts)
    start, *over = seen.layers("start", "goals", "way", "path", "constraint", "axes").values()
    named = (body for bodies in (start, *over) for body in bodies if body.group != "axes")
    legend = strip(legend_of(named, () if path is not None else ("no path found",)), size[0])
    # pictures too small for their legend have none
    if len(legend) >= 0.2 * size[1]:
        legend = legend[:0]
    size = (size[0], size[1] - len(legend))
    moving = list(seen.layers("goals", "way", "path").values())
    parts = [in_view(bodies) for bodies in (start, *moving[:1], *moving[-1:])]
    stage = clear_stage(seen, parts, size, map(in_view, over))
    return np.concatenate([stage.image(whole(start), layers_on(stage, over)), legend])


def layers_on(stage: Stage, layers: Sequence[Sequence[Body]]) -> list[Layer]:
    """Translucent bodies as they are seen from the stage's viewpoint."""
    return [stage.layer(whole(bodies), bodies[0].opacity, bodies[0].behind) for bodies in layers]


def clear_stage(
    seen: Seen, parts: Sequence[Mesh], size: tuple[int, int], inside: Iterable[Mesh] = ()
) -> Stage:
    """The scene, from a viewpoint that shows most of a motion's parts; see `clear_viewpoint`."""
    still, torso = whole(seen.scene), whole(body for body in seen.moving if body.aside)
    viewpoint = clear_viewpoint(parts, still, size, [*inside], torso)
    return Stage(still, seen.ground, viewpoint, size)


def still_image(
    problem: PlanningProblem,
    q: np.ndarray,
    size: tuple[int, int],
    viewpoint: Viewpoint,
    hidden: Sequence[str] = HIDDEN,
) -> np.ndarray:
    """Colours (height, width, 3), 8 bit, of the scene without `hidden` and the robot at q (n,).

    `Viewpoint.screen` gives the pixel of a point.
    """
    scene = whole(scene_bodies(problem.scene, hidden))
    stage = Stage(scene, ground_height(problem.scene), viewpoint, size)
    return stage.image(whole(robot_bodies(problem, q[None])))


@one_thread()
def task_image(
    solution: TaskSolution, size: tuple[int, int], columns: int = 3, gap: int = 6
) -> tuple[np.ndarray, list[str]]:
    """8-bit pictures of the start and the end of each planned phase in a grid, and their names.

    Args:
        solution: of the task.
        size: width and height of one picture, without the name below it [pixels].
        columns: of pictures.
        gap: between pictures [pixels].
    """
    phases = (phase for phase in solution.task.phases if isinstance(phase, PlannedPhase))
    planned = {"start", *(phase.name for phase in phases)}
    worlds = {"start": World.before(solution.task)}
    worlds |= {moment.phase: moment.world for moment in frames(solution)}
    chosen = {name: shown(world) for name, world in worlds.items() if name in planned}
    arms = [whole(robot_bodies(problem, problem.start[None])) for problem in chosen.values()]
    scene = whole(scene_bodies(list(chosen.values())[-1].scene))
    before = {item.name: item.T_world_object for item in solution.task.scene}
    moved = [
        shape_mesh(item.shape).placed(item.T_world_object)
        for problem in chosen.values()
        for item in problem.scene
        if not np.array_equal(item.T_world_object, before[item.name])
    ]
    viewpoint = clear_viewpoint([joined(arms)], scene, size, moved)
    panels = []
    for k, (name, problem) in enumerate(chosen.items(), start=1):
        image = still_image(problem, problem.start, size, viewpoint)
        panels.append(np.concatenate([image, strip([(f"{k}  {name}", None)], size[0], 24)]))
    height, width = (side + gap for side in panels[0].shape[:2])
    rows = -(-len(panels) // columns)
    sheet = np.full((rows * height - gap, columns * width - gap, 3), 255, np.uint8)
    for k, panel in enumerate(panels):
        top, left = (k // columns) * height, (k % columns) * width
        sheet[top : top + len(panel), left : left + size[0]] = panel
    return sheet, list(chosen)


def legend_of(bodies: Iterable[Body], texts: Sequence[str] = ()) -> list[Label]:
    """A label for each group of bodies and for texts without a colour; what is carried last."""
    colours: dict[str, Colour | None] = dict.fromkeys(texts)
    for body in bodies:
        colours.setdefault(body.group, body.colour)
    order = ("start", "robot", "on the way", "goal", "path of the hand", *texts, "constraint")
    labels = [(word, colours.pop(word)) for word in order if word in colours]
    return [*labels, *colours.items()]


def strip(labels: Sequence[Label], width: int, letters_across: int = 62) -> np.ndarray:
    """Image (height, width, 3), 8 bit, of labels in lines, as high as they need.

    letters_across: letters per line; the font has at least 11 pixels.
    """
    ink, size = (40, 40, 44), max(11, width // letters_across)
    font = ImageFont.load_default(size)
    gap, swatch, line_height = 1.3 * size, 1.3 * size, 1.9 * size
    # one line for each label is enough
    image = Image.new("RGB", (width, math.ceil(len(labels) * line_height)), (255, 255, 255))
    canvas = ImageDraw.Draw(image)
    left, line = gap / 2, 0
    for text, colour in labels:
        needed = font.getlength(text) + (0 if colour is None else swatch)
        if left + needed > width and left > gap:
            left, line = gap / 2, line + 1
        middle = (line + 0.5) * line_height
        if colour is not None:
            fill, half = tuple(round(255 * part) for part in colour), 0.42 * size
            box = (left, middle - half, left + 2 * half, middle + half)
            canvas.rounded_rectangle(box, radius=0.2 * size, fill=fill, outline=ink)
            left, needed = left + swatch, needed - swatch
        canvas.text((left, middle), text, fill=ink, font=font, anchor="lm")
        left += needed + gap
    return np.array(image)[: round((1 + line) * line_height)]


def write_png(path: Path, image: np.ndarray) -> None:
    """Write 8-bit colours (rows, columns, 3)."""
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG", optimize=True)


@one_thread()
def film_solution(
    solution: Solution | TaskSolution | Seen,
    path: Path,
    size: tuple[int, int] = (600, 400),
    carried: Sequence[Attachment] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    pictures: int | None = None,
) -> None:
    """Write a film of the robot on its path (without a path, of the start), or of a task.

    Args:
        solution: what is shown; of something else that takes time, what `seen_of_frames` returns.
        path: of the gif.
        size: width and height, without the legend or the name of the phase below [pixels].
        carried: load in the hand if the problem does not model it.
        progress: called with the numbers of pictures drawn and of all.
        pictures: of the film, about; default: 49 of a path, 110 at most of a task.
    """
    if isinstance(solution, TaskSolution):
        solution = seen_of_task(solution, pictures or 110)
    if isinstance(solution, Seen):
        seen = solution
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
    some = range(0, count, max(1, count // 8))
    views, over = [in_view(arm, k) for k in some], list(seen.layers("goals", "path").values())
    inside = [*(in_view(seen.moving, k) for k in some), *map(in_view, over)]
    stage = clear_stage(seen, [joined(views)], size, inside)
    layers = layers_on(stage, over)
    images = []
    for k, label in enumerate(seen.labels):
        image = stage.image(whole(seen.moving, k), layers)
        images.append(np.concatenate([image, captions[label]]))
        progress(len(images), count)
    save_film(images, path)


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
    require_choice(f"kind of film {path.name}: suffix", path.suffix, (".gif",))
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
