"""Still pictures of a robot, scene, problem, solution or task (PNG, JPEG, PDF); films as gif.

The solid part (scene, robot at the start) has outlines and shadows. Ghosts of the robot along the
path and at the goal, the hand's trace, the constraint and the hand's axes are blended over it. A
legend or caption is below.
"""

import io
import math
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError, require_choice
from cvqmpt_lab.base.files import picture_format, replacing
from cvqmpt_lab.base.processes import one_thread
from cvqmpt_lab.features.pictures.bodies import (
    HIDDEN_OBJECTS,
    Body,
    Drawing,
    drawing_of_problem,
    drawing_of_solution,
    drawing_of_task,
    frames,
    ground_height,
    ground_under,
    mesh_in_view,
    mesh_of,
    problem_of,
    robot_bodies,
    scene_bodies,
)
from cvqmpt_lab.features.pictures.meshes import Colour, Mesh, joined, shape_mesh
from cvqmpt_lab.features.pictures.raster import Layer, Renderer, Viewpoint, clear_viewpoint, framed
from cvqmpt_lab.features.tasks.solve import TaskSolution
from cvqmpt_lab.features.tasks.task import PlannedPhase, Task
from cvqmpt_lab.features.tasks.world import World
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search.result import JointPath

Label = tuple[str, Colour | None]  # a text, and the colour of its swatch, if it has one
DRAWN_TYPES = (Robot, Scene, PlanningProblem, Solution, Task, TaskSolution)


@one_thread()  # small matrix products are faster with one BLAS thread
def draw(
    what: object, path: Path | str | None = None, size: tuple[int, int] = (900, 600)
) -> Image.Image:
    """Draw a robot, scene, problem, solution, task or task solution; notebooks show the image.

    Args:
        what: the value to draw.
        path: file to write (.png, .jpg or .pdf); None: no file is written.
        size: width and height [pixels]; for a task solution, twice as large as for one phase.

    Raises UnknownChoiceError for a value of another type, InvalidInputError for a scene without
    objects.
    """
    match what:
        case Robot():
            rest = np.clip(0.0, what.lower, what.upper)  # all joints as close to 0 as possible
            alone = PlanningProblem(what.name, what, Scene("nothing", ()), rest, rest[None])
            bodies = robot_bodies(alone, rest[None])
            torso = mesh_of(body for body in bodies if body.torso)
            viewpoint = clear_viewpoint([mesh_in_view(bodies)], mesh_of(()), size, [torso], torso)
            image = still_image(alone, rest, size, viewpoint)
        case Scene():
            scene = mesh_of(scene_bodies(what))
            if not len(scene.corners):
                raise InvalidInputError(f"scene {what.name!r} has no object to draw")
            viewpoint = framed(scene.corners.reshape(-1, 3), size)
            ground = ground_under(ground_height(what), scene)
            image = Renderer(mesh_of(()), ground, viewpoint, size).image(scene)
        case PlanningProblem():
            image = problem_image(what, None, size)
        case Solution():
            image = problem_image(what.problem, what.path, size)
        case Task():
            image = problem_image(problem_of(World.before(what)), None, size)
        case TaskSolution():
            image = task_image(what, (size[0] // 2, size[1] // 2))[0]
        case _:
            names = [kind.__name__ for kind in DRAWN_TYPES]
            raise UnknownChoiceError("draw:", type(what).__name__, names)
    if path is not None:
        write_picture(Path(path), image)
    return Image.fromarray(image)


def png_of(what: object) -> bytes | None:
    """PNG of a value in a notebook; None for an empty scene."""
    if isinstance(what, Scene) and not what.objects:
        return None
    written = io.BytesIO()
    draw(what, size=(600, 400)).save(written, format="PNG")
    return written.getvalue()


def html_of(what: object) -> str:
    """Html of a value in a notebook: its text above its picture."""
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
    """Write a picture of the scene, the robot along the path, and the constraint, with a legend.

    The robot is drawn at the start, as ghosts along the path and at the goal; lines show the hand's
    trace, and its axes at start and goal.

    Args:
        solution: solved or not.
        path: the file to write.
        size: width and height, legend included [pixels].
        ghosts: number of ghosts between start and goal.
        carried: objects drawn in the hand if the problem has no attachments.
    """
    image = problem_image(solution.problem, solution.path, size, ghosts, carried)
    write_picture(Path(path), image)


@one_thread()
def problem_image(
    problem: PlanningProblem,
    path: JointPath | None,
    size: tuple[int, int],
    ghosts: int = 4,
    carried: Sequence[Attachment] = (),
) -> np.ndarray:
    """Image (height, width, 3), 8 bit, of a problem and its path, with a legend.

    Args:
        problem: the problem.
        path: a path of the problem, or None.
        size: width and height, legend included [pixels].
        ghosts: number of ghosts between start and goal.
        carried: objects drawn in the hand if the problem has no attachments.
    """
    if min(size) < 1:
        raise InvalidInputError(f"picture size {size} must be at least 1 x 1 pixels")
    drawing = drawing_of_problem(problem, path, carried, ghosts=ghosts)
    start, *over = drawing.layers("start", "goals", "way", "path", "constraint", "axes").values()
    named = (body for bodies in (start, *over) for body in bodies if body.group != "axes")
    legend = strip(legend_of(named, () if path is not None else ("no path found",)), size[0])
    # small pictures have no legend
    if len(legend) >= 0.2 * size[1]:
        legend = legend[:0]
    size = (size[0], size[1] - len(legend))
    moving = list(drawing.layers("goals", "way", "path").values())
    parts = [mesh_in_view(bodies) for bodies in (start, *moving[:1], *moving[-1:])]
    renderer = renderer_of(drawing, parts, size, map(mesh_in_view, over))
    return np.concatenate([renderer.image(mesh_of(start), layers_of(renderer, over)), legend])


def layers_of(renderer: Renderer, layers: Sequence[Sequence[Body]]) -> list[Layer]:
    """Render layers of translucent bodies from the viewpoint of the renderer."""
    return [
        renderer.layer(mesh_of(bodies), bodies[0].opacity, bodies[0].behind) for bodies in layers
    ]


def renderer_of(
    drawing: Drawing, parts: Sequence[Mesh], size: tuple[int, int], inside: Iterable[Mesh] = ()
) -> Renderer:
    """Renderer with the scene of a drawing, and a viewpoint from which the motion is well visible.

    Args:
        drawing: the drawing.
        parts: parts of the motion that should be visible.
        size: width and height [pixels].
        inside: meshes that must be within the picture, even where the scene hides them.
    """
    still, torso = mesh_of(drawing.scene), mesh_of(body for body in drawing.moving if body.torso)
    viewpoint = clear_viewpoint(parts, still, size, [*inside], torso)
    return Renderer(still, drawing.under, viewpoint, size)


def still_image(
    problem: PlanningProblem,
    q: np.ndarray,
    size: tuple[int, int],
    viewpoint: Viewpoint,
    hidden: Sequence[str] = HIDDEN_OBJECTS,
) -> np.ndarray:
    """Image (height, width, 3), 8 bit, of the scene and the robot at q.

    `Viewpoint.screen` computes the pixel of a point.

    Args:
        problem: the problem with scene and robot.
        q: configuration (n,) [rad or m].
        size: width and height [pixels].
        viewpoint: the camera.
        hidden: names of scene objects that are not drawn.
    """
    scene = mesh_of(scene_bodies(problem.scene, hidden))
    robot = mesh_of(robot_bodies(problem, q[None]))
    ground = ground_under(ground_height(problem.scene), scene, robot)
    return Renderer(scene, ground, viewpoint, size).image(robot)


@one_thread()
def task_image(
    solution: TaskSolution, size: tuple[int, int], columns: int = 3, gap: int = 6
) -> tuple[np.ndarray, list[str]]:
    """Pictures of the start and of the end of each planned phase, in a grid.

    Args:
        solution: the task's solution.
        size: width and height of one picture, without the name below it [pixels].
        columns: number of pictures in a row.
        gap: distance between pictures [pixels].

    Returns:
        Image (height, width, 3), 8 bit, and the names of the pictures.
    """
    phases = (phase for phase in solution.task.phases if isinstance(phase, PlannedPhase))
    planned = {"start", *(phase.name for phase in phases)}
    worlds = {"start": World.before(solution.task)}
    worlds |= {moment.phase: moment.world for moment in frames(solution)}
    chosen = {name: problem_of(world) for name, world in worlds.items() if name in planned}
    arms = [mesh_of(robot_bodies(problem, problem.start[None])) for problem in chosen.values()]
    scene = mesh_of(scene_bodies(list(chosen.values())[-1].scene))
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
    """Labels for the groups of bodies and for texts without a colour; carried objects are last."""
    found: dict[str, Counter[Colour]] = {}
    for body in bodies:
        found.setdefault(body.group, Counter())[body.colour] += len(body.mesh.corners)
    colours: dict[str, Colour | None] = dict.fromkeys(texts)
    colours |= {group: counts.most_common(1)[0][0] for group, counts in found.items()}
    order = ("start", "robot", "on the way", "goal", "path of the hand", *texts, "constraint")
    labels = [(word, colours.pop(word)) for word in order if word in colours]
    return [*labels, *colours.items()]


def strip(labels: Sequence[Label], width: int, letters_across: int = 62) -> np.ndarray:
    """Image (height, width, 3), 8 bit, of labels in as many lines as they need.

    letters_across: letters per line, which sets the font size; that is at least 11 pixels.
    """
    ink, size = (40, 40, 44), max(11, width // letters_across)
    font = ImageFont.load_default(size)
    gap = swatch = 1.3 * size
    line_height = 1.9 * size
    # one line per label is always enough
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


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write an 8-bit image (height, width, 3) as PNG, JPEG or PDF, by the suffix of the file."""
    kind = picture_format(path)
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format=kind, optimize=True, quality=92)


@one_thread()
def film_solution(
    solution: Solution | TaskSolution | Drawing,
    path: Path,
    size: tuple[int, int] = (600, 400),
    carried: Sequence[Attachment] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    pictures: int | None = None,
) -> None:
    """Write a film of a path, of the start if there is no path, or of a task.

    Args:
        solution: a solution of a problem or task, or the drawing of an execution.
        path: the gif file to write.
        size: width and height, without the legend or the name of the phase below [pixels].
        carried: objects drawn in the hand if the problem has no attachments.
        progress: called with the number of finished pictures and the number of all.
        pictures: approximate number of pictures; None: 49 for a path, at most 110 for a task.
    """
    if isinstance(solution, TaskSolution):
        solution = drawing_of_task(solution, pictures or 110)
    if isinstance(solution, Drawing):
        drawing = solution
        arm = [body for body in drawing.moving if body.group == "robot"]
        captions = {name: strip([(name, None)], size[0], 24) for name in set(drawing.labels)}
    else:
        drawing = drawing_of_solution(solution, carried, pictures or 49)
        arm = list(drawing.moving)
        layers = drawing.layers("goals", "path").values()
        bodies = [*arm, *(layer[0] for layer in layers)]
        captions = dict.fromkeys(drawing.labels, strip(legend_of(bodies), size[0], 42))
    count = len(drawing.labels)
    # the viewpoint is chosen for about eight of the states
    some = range(0, count, max(1, count // 8))
    views = [mesh_in_view(arm, k) for k in some]
    over = list(drawing.layers("goals", "path").values())
    inside = [*(mesh_in_view(drawing.moving, k) for k in some), *map(mesh_in_view, over)]
    renderer = renderer_of(drawing, [joined(views)], size, inside)
    rendered = layers_of(renderer, over)
    images = []
    for k, label in enumerate(drawing.labels):
        image = renderer.image(mesh_of(drawing.moving, k), rendered)
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
    """Write pictures as a gif.

    Args:
        frames: images (height, width, 3), 8 bit.
        path: the file to write.
        rate: pictures per second.
        rest: number of times that the last picture is repeated.
        colours: number of colours of the gif.
        chosen: colours are chosen from about this many pictures.
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
