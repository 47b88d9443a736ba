"""Zero-shot over constraints: eight kinds, in scenes of every family, from a posture to a pose of the hand.

Problem k is of kind k modulo 8. Start and goal are drawn on the manifold; the goal is a pose of the hand in any posture
of the arm. An arm without obstacles gets there by a short search; straight along the manifold it does not get there, as
far as a few tries found such a problem.
"""

from dataclasses import replace

import numpy as np

from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.direct_motion import direct_motion
from cvqmpt_lab.planning.proposal import Observation, uniform
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.search import search
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem, shared_checker
from cvqmpt_lab.results.row import phase_problem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.scene.scene import Scene
from experiments.suites.constraint_kinds import KINDS, Kept, held_door
from experiments.suites.door_task import GRIP
from experiments.suites.family_task import blocked_pair
from experiments.suites.place_task import UnsolvableProblem

NAMES = (*KINDS, "door")
PER_KIND = 20
PROBLEMS = range(PER_KIND * len(NAMES))
FIRST_SCENE = 2500  # numbers that no other suite uses
MOVED = 0.25  # [m] from the hand's start to its goal at least
DRAWS = 100  # configurations, of which one is free in any scene
PROJECTED = 600  # configurations, of which start and goal are chosen
WITHOUT_OBSTACLES = 300  # iterations of a search
TRIES = 12  # constraints drawn for one whose goals are within reach, none of them straight ahead


def constraint_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Problem `index`; with its goals. Indices beyond `PROBLEMS` are for tuning."""
    number, kind = divmod(index, len(NAMES))
    name = phase_problem(str(index), kind + 1, NAMES[kind])
    rng = np.random.default_rng([index, 11])
    easy = None
    for _ in range(TRIES):
        posed = _posed(NAMES[kind], number, name, rng)
        if posed is None or not len(posed.goals) or not _within_reach(posed):
            continue
        if not trivial(posed):
            return posed
        easy = easy or posed
    return easy or UnsolvableProblem(name, "no two free states far enough apart that keep the constraint")


def trivial(problem: PlanningProblem) -> bool:
    """Whether some goal is reached straight from the start, on the manifold."""
    space = ConstrainedSpace(problem)
    return any(direct_motion(space, problem.start, goal) is not None for goal in problem.goals)


def _within_reach(problem: PlanningProblem) -> bool:
    """Whether a short search finds a way where there are no obstacles: joint limits may cut goals off."""
    alone = ConstrainedSpace(replace(problem, scene=Scene("empty", ())))
    query = Query.of(alone, Budget(iterations=WITHOUT_OBSTACLES), np.random.default_rng(0))
    return search(BiRRT(), query, uniform(query, Observation())).path is not None


def _posed(kind: str, number: int, name: str, rng: np.random.Generator) -> PlanningProblem | None:
    """A constraint of a kind, a free start on it and goals; None where there is none."""
    scene, robot, kept = _drawn(kind, number, rng)
    middle = 0.5 * (robot.lower + robot.upper)
    problem = PlanningProblem(
        name, robot, scene, middle, middle[None], (kept.region,), attachments=kept.attachments
    )
    if kept.start is not None:
        checker = problem.collision_checker(SAMPLE_MARGIN)
        start = next(iter(sample_region(robot, kept.start, checker, rng, count=1).configurations), None)
        goal = kept.goal
    else:
        start, end = blocked_pair(problem, rng, SAMPLE_MARGIN, MOVED, PROJECTED) or (None, None)
        goal = None if end is None else TaskSpaceRegion(robot.pose(end), np.eye(4), np.zeros((6, 2)))
    if start is None:
        return None
    problem = replace(problem, start=start, goals=np.empty((0, robot.dof)), goal_region=goal)
    return with_sampled_goals(problem)[0]


def _drawn(kind: str, number: int, rng: np.random.Generator) -> tuple[Scene, Robot, Kept]:
    """A scene, the arm, and what a hand keeps there at a pose in which the arm is free."""
    if kind == "door":
        scene, kept = held_door(rng)
        return scene, panda(GRIP), kept
    families, robot = tuple(FAMILIES), panda()
    scene = family_scene(families[number % len(families)], FIRST_SCENE + number)
    checker = shared_checker(robot, scene, (), SAMPLE_MARGIN)
    drawn = robot.random_configurations(rng, DRAWS)
    free = next((q for q in drawn if not checker.in_collision(q)), drawn[0])
    return scene, robot, KINDS[kind](robot.pose(free), rng)
