"""Random scenes of several kinds for training, so that samplers do not depend on one kitchen.

A scene is its family and a number, which seeds numpy's `default_rng`. Evaluation scenes are made
elsewhere; the kitchen of the tasks, with its published dimensions, is never among these.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_choice, whole_number
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.benchmarks.kitchen import PUBLISHED, kitchen
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere


def random_scene(seed: int, n_cubes: int = 8, n_spheres: int = 8) -> Scene:
    """Return environment `seed` of the published training data: cubes with random yaw, and spheres.

    The seed, 0 to 2**32 - 1, seeds numpy's legacy generator, whose stream is frozen, so environment
    n is the same everywhere. Order of the draws: cube distances, elevations, azimuths, yaws; sphere
    distances, elevations, azimuths. The older 6-joint data used 6 cubes and 6 spheres.
    """
    for what, value in (("seed", seed), ("n_cubes", n_cubes), ("n_spheres", n_spheres)):
        whole_number(what, value, 0, 2**32 - 1)
    rng = np.random.RandomState(seed)
    cube_centres = _scattered(rng, n_cubes, lift=0.5)
    yaws = rng.uniform(0.0, 2.0 * math.pi, n_cubes)
    sphere_centres = _scattered(rng, n_spheres, lift=0.33)
    cube, ball = Box((0.2, 0.2, 0.2)), Sphere(0.15)
    cube_poses = map(pose, cube_centres, yaws)
    cubes = [SceneObject(f"cube_{i}", cube, T) for i, T in enumerate(cube_poses)]
    spheres = [SceneObject(f"sphere_{i}", ball, T) for i, T in enumerate(map(pose, sphere_centres))]
    return Scene(f"random_{seed:06d}", (*cubes, *spheres))


def _scattered(rng: np.random.RandomState, count: int, lift: float) -> FloatArray:
    """Points (count, 3) [m] on a spherical shell around a point `lift` [m] above the base."""
    distance = rng.uniform(0.4, 1.2, count)
    elevation = rng.uniform(-0.25 * math.pi, 0.5 * math.pi, count)
    azimuth = rng.uniform(0.0, 2.0 * math.pi, count)
    across, up = distance * np.cos(elevation), distance * np.sin(elevation)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up + lift], axis=1)


class Family(NamedTuple):
    """A kind of random scenes."""

    name: str  # of its scenes, before their number
    seed: int  # seeds the generator together with the number of the scene
    objects: Callable[[np.random.Generator], Iterable[SceneObject]]


def family_scene(family: str, number: int) -> Scene:
    """Return scene `number` of a family; UnknownChoiceError lists the families."""
    require_choice("scene family", family, FAMILIES)
    whole_number("number of the scene", number)
    made = FAMILIES[family]
    if made is None:
        return random_scene(number)
    rng = np.random.default_rng([made.seed, number])
    return Scene(f"{made.name}_{number}", tuple(made.objects(rng)))


def another_scene() -> Scene:
    """The scene that controls are given in place of a problem's own."""
    return family_scene("shelves", 77)


def _tables(
    spans: Sequence[tuple[float, float]],
    counts: tuple[int, int],
    thing: Callable[[np.random.Generator], tuple[Box | Cylinder | Sphere, float]],
    board: float = 0.02,
) -> Callable[[np.random.Generator], Iterator[SceneObject]]:
    """A table with items on it.

    Args:
        spans: ranges of its depth, width, height and distance [m], and of its angle [rad].
        counts: range of the number of items, the last excluded.
        thing: draws one of them.
        board: thickness of its top [m].
    """

    def objects(rng: np.random.Generator) -> Iterator[SceneObject]:
        depth, width, top, near, yaw = (rng.uniform(*span) for span in spans)
        x, T = near + depth / 2, pose((0.0, 0.0, 0.0), yaw)
        yield SceneObject("top", Box((depth, width, board)), T @ pose((x, 0.0, top - board / 2)))
        for i in range(rng.integers(*counts)):
            place = (x + rng.uniform(-0.45, 0.45) * depth, rng.uniform(-0.45, 0.45) * width)
            shape, height = thing(rng)
            stands = pose((*place, top + height / 2), rng.uniform(-np.pi, np.pi))
            yield SceneObject(f"item_{i}", shape, T @ stands)

    return objects


def _clutter(rng: np.random.Generator) -> tuple[Box | Cylinder | Sphere, float]:
    """An item that stands on a table, and its height [m]."""
    kind, height = rng.integers(3), rng.uniform(0.1, 0.4)
    if kind == 0:
        return Box((rng.uniform(0.05, 0.25), rng.uniform(0.05, 0.25), height)), height
    if kind == 1:
        return Cylinder(rng.uniform(0.03, 0.1), height), height
    radius = rng.uniform(0.05, 0.12)
    return Sphere(radius), 2.0 * radius


def _slim(rng: np.random.Generator) -> tuple[Box | Cylinder, float]:
    """A slim item, and its height [m]."""
    radius, height = rng.uniform(0.02, 0.06), rng.uniform(0.15, 0.5)
    return Cylinder(radius, height) if rng.random() < 0.5 else Box(
        (2 * radius, 2 * radius, height)
    ), height


def _cage(rng: np.random.Generator) -> Iterator[SceneObject]:
    """Upright bars in a ring around the robot, with gaps wide enough for an arm, and hoops."""
    ring, radius = rng.uniform(0.4, 0.65), rng.uniform(0.01, 0.03)
    low, high = rng.uniform(-0.4, 0.0), rng.uniform(0.7, 1.2)
    count = int(2.0 * np.pi * ring / rng.uniform(0.22, 0.4))
    angles = rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    angles += rng.uniform(-0.3, 0.3, count) * 2.0 * np.pi / count
    for i, angle in enumerate(angles):
        T = pose((ring * np.cos(angle), ring * np.sin(angle), (low + high) / 2))
        yield SceneObject(f"bar_{i}", Cylinder(radius, high - low), T)
    side = 2.0 * np.pi * ring / 12
    for hoop, level in enumerate(rng.uniform(low, high, rng.integers(1, 3))):
        for part in range(12):
            T = pose((0.0, 0.0, 0.0), part * np.pi / 6) @ pose((ring, 0.0, float(level)))
            yield SceneObject(f"hoop_{hoop}/{part}", Box((2 * radius, side, 2 * radius)), T)


def _cabinets(
    widths: tuple[float, float], gaps: tuple[float, float], boards: tuple[int, int]
) -> Callable[[np.random.Generator], Iterator[SceneObject]]:
    """One to three open cabinets around the robot, each with boards and things on them.

    Args:
        widths: range of a cabinet's width [m].
        gaps: range of the height between two of its boards [m].
        boards: range of their number, the last excluded.
    """

    def objects(rng: np.random.Generator) -> Iterator[SceneObject]:
        heading = rng.uniform(-np.pi, np.pi)
        for k in range(rng.integers(1, 4)):
            T = pose((0.0, 0.0, 0.0), heading + k * rng.uniform(0.9, 1.6))
            near, depth = rng.uniform(0.35, 0.65), rng.uniform(0.25, 0.4)
            width, count = rng.uniform(*widths), rng.integers(*boards)
            levels = rng.uniform(-0.3, 0.3) + np.cumsum(
                np.concatenate([[0.0], rng.uniform(*gaps, count - 1)])
            )
            yield from _cabinet(f"cabinet_{k}", T, rng, (near, depth, width), levels)

    return objects


def _cabinet(
    name: str,
    T: np.ndarray,
    rng: np.random.Generator,
    size: tuple[float, float, float],
    levels: FloatArray,
    board: float = 0.02,
) -> Iterator[SceneObject]:
    """A cabinet open towards the robot: back, two sides, boards, a few things inside.

    Args:
        name: before the names of its pieces.
        T: (4, 4), turns it about the robot.
        rng: draws the things.
        size: distance from the robot, depth, width [m].
        levels: heights of its boards [m].
        board: thickness of boards and walls [m].
    """
    near, depth, width = size
    x, low, high = near + depth / 2, levels[0], levels[-1]
    parts = [
        ("back", (board, width, high - low), (near + depth, 0.0, (low + high) / 2)),
        ("left", (depth, board, high - low), (x, width / 2, (low + high) / 2)),
        ("right", (depth, board, high - low), (x, -width / 2, (low + high) / 2)),
        *(
            (f"board_{i}", (depth, width, board), (x, 0.0, float(level)))
            for i, level in enumerate(levels)
        ),
    ]
    for part, edges, place in parts:
        yield SceneObject(f"{name}/{part}", Box(edges), T @ pose(place))
    for i in range(rng.integers(0, 4)):
        radius, height = rng.uniform(0.03, 0.05), rng.uniform(0.08, 0.2)
        level = float(levels[rng.integers(0, len(levels) - 1)])
        place = (x, rng.uniform(-0.4, 0.4) * width, level + board / 2 + height / 2)
        yield SceneObject(f"{name}/item_{i}", Cylinder(radius, height), T @ pose(place))


def _random_kitchen(rng: np.random.Generator, spread: float = 0.2) -> tuple[SceneObject, ...]:
    """The kitchen with other dimensions, and doors and drawers moved at random.

    spread: share by which its dimensions may differ from the published ones.
    """
    fixed = ("floor", "pedestal", "wall", "handle", "knob", "plate")
    names = [name for name in PUBLISHED if not name.startswith(fixed)]
    while True:
        changed = rng.choice(names, size=len(names) // 2, replace=False)
        factors = {str(name): 1.0 + rng.uniform(-spread, spread) for name in changed}
        try:
            scene = kitchen({name: PUBLISHED[name] * factors[name] for name in factors})
        except InvalidInputError:  # pieces do not fit each other
            continue
        for joint in scene.articulations:
            if rng.random() < 0.4:
                scene = scene.with_joint(joint.name, rng.uniform(joint.lower, joint.upper))
        return scene.objects


FAMILIES: Mapping[str, Family | None] = {
    "cubes-spheres": None,  # the published training family, see `random_scene`
    # in front of the robot
    "table": Family(
        "table",
        1,
        _tables(((0.4, 0.8), (0.8, 1.6), (-0.1, 0.45), (0.3, 0.5), (-0.6, 0.6)), (3, 10), _clutter),
    ),
    "shelves": Family("shelves", 2, _cabinets((0.35, 0.9), (0.25, 0.5), (2, 5))),
    "kitchen-like": Family("kitchen", 3, _random_kitchen),
    # reached from its side, at elbow height, full of slim items as tall as a forearm
    "cluttered-table": Family(
        "cluttered_table",
        4,
        _tables(
            ((0.5, 0.8), (0.6, 1.2), (0.05, 0.45), (0.25, 0.4), (-np.pi, np.pi)), (8, 19), _slim
        ),
    ),
    # compartments that a hand just fits into
    "narrow-shelves": Family("narrow_shelves", 6, _cabinets((0.25, 0.45), (0.17, 0.3), (3, 7))),
    "cage": Family("cage", 5, _cage),
}
