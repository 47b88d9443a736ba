"""What is scanned: ten true scenes, a start and a goal in each, and where cameras stand.

Five are the kitchen, its shelf open, with things on the counter, five are cluttered tables. As on the paper's robot,
start and goal are random configurations with an upright hand; here they are `ROOM` away from everything, so that
noise and padding do not lie on them, and the straight motion between them is blocked.
"""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.objects import CAN, CRACKER_BOX, MUSTARD_BOTTLE
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.sensing.camera import KINECT, Camera, look_at
from experiments.suites.family_task import PANDA, blocked_pair
from experiments.suites.place_task import DOOR, DOOR_ANGLE, UnsolvableProblem

SCENES = range(10)
FIRST_TABLE = 3000  # scene numbers that no other suite uses
ROOM = 0.06  # [m] that start and goal keep from obstacles
THINGS = {"cracker_box": (CRACKER_BOX, 0.287), "mustard": (MUSTARD_BOTTLE, 0.262), "can": (CAN, 0.271)}
"""On the counter: what, and the height of its centre of mass [m]."""
COUNTER = ((0.32, -0.85), (0.70, -0.20))  # [m] corners x, y of where they stand
APART = 0.17  # [m] between their centres
STANDS = (((130, 160), (20, 45)), ((185, 205), (20, 45)), ((165, 195), (50, 65)), ((100, 120), (15, 35)))
"""Azimuths and elevations [deg] of the first, second, ... camera as seen from `TARGET`: behind the robot."""
TARGET, TARGET_SPREAD, DISTANCE = (0.45, -0.15, 0.35), 0.1, (1.2, 1.7)  # [m]


@dataclass(frozen=True)
class ScannedScene:
    """One true scene."""

    truth: PlanningProblem
    """With its start and its only goal."""
    cameras: tuple[Camera, ...]
    """As many as there are `STANDS`; the first ones are used."""


def scanned_scene(number: int) -> ScannedScene | UnsolvableProblem:
    """Scene `number`: even ones are kitchens, odd ones tables."""
    rng = np.random.default_rng([number, 12])
    scene = _table(number) if number % 2 else _cluttered_kitchen(number, rng)
    robot = robot_from_source(PANDA)
    middle = 0.5 * (robot.lower + robot.upper)
    empty = PlanningProblem(str(number), robot, scene, middle, middle[None], (upright(),))
    pair = blocked_pair(empty, rng, ROOM)
    if pair is None:
        return UnsolvableProblem(
            str(number), f"no two upright states {ROOM} m from everything in {scene.name}"
        )
    truth = PlanningProblem(str(number), robot, scene, pair[0], pair[1][None], (upright(),))
    return ScannedScene(truth, tuple(_camera(stand, rng) for stand in STANDS))


def _table(number: int) -> Scene:
    return family_scene("table", FIRST_TABLE + number)


def _cluttered_kitchen(number: int, rng: np.random.Generator) -> Scene:
    """The kitchen of the place task with three things on the right counter, none touching another."""
    while True:
        places = rng.uniform(*COUNTER, (len(THINGS), 2))
        gaps = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(len(THINGS), 1)]
        if gaps.min() > APART:
            break
    things = [
        thing.at_com(name, (float(x), float(y), height), float(rng.uniform(-np.pi, np.pi)))
        for (name, (thing, height)), (x, y) in zip(THINGS.items(), places, strict=True)
    ]
    scene = kitchen(door_angles={DOOR: DOOR_ANGLE}).with_objects(*things)
    return Scene(f"kitchen_clutter_{number}", scene.objects)


def _camera(stand: tuple[tuple[int, int], tuple[int, int]], rng: np.random.Generator) -> Camera:
    azimuth, elevation = (np.radians(rng.uniform(*span)) for span in stand)
    target = np.add(TARGET, rng.uniform(-TARGET_SPREAD, TARGET_SPREAD, 3))
    flat = np.cos(elevation)
    away = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
    return Camera(KINECT, look_at(target + rng.uniform(*DISTANCE) * away, target))
