"""The moments of a solved task, for pictures, films and recordings."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.show.meshes import poses_along
from cvqmpt_lab.tasks.solve import TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase
from cvqmpt_lab.tasks.world import Load, World

PERIOD = 0.1  # [s] between states
PAUSE = 0.5  # [s] for fingers that open or close


class Frame(NamedTuple):
    """A moment: time [s], the phase it belongs to, the world."""

    time: float
    phase: str
    world: World


def frames(solution: TaskSolution) -> Iterator[Frame]:
    """The task's moments in order, `PERIOD` apart, up to its end or the phase that failed."""
    outcomes = {outcome.phase.name: outcome for outcome in solution.outcomes if outcome.solved}
    world, time = World.before(solution.task), 0.0
    for phase in solution.task.phases:
        if not isinstance(phase, PlannedPhase):
            world = world.after(phase)
            yield Frame(time, phase.name, world)
            time += PAUSE
            continue
        if phase.name not in outcomes:
            return
        outcome = outcomes[phase.name]
        assert outcome.trajectory is not None and outcome.solution.simplified is not None
        motion = outcome.trajectory.sampled(PERIOD)
        for t, q in zip(motion.times, motion.positions, strict=True):
            yield Frame(time + float(t), phase.name, world.moved(q))
        world = world.moved(outcome.solution.simplified.path.states[-1])
        time += motion.duration


def solved_frames(solution: TaskSolution) -> list[Frame]:
    """All `frames`; InvalidInputError if there are none."""
    every = list(frames(solution))
    if not every:
        raise InvalidInputError(f"nothing to show of task {solution.task.name}: {solution.failure}")
    return every


def shown(world: World) -> PlanningProblem:
    """A problem to draw a world by: the arm alone, and a door it holds in the scene."""
    carried = (world.held.attachment,) if isinstance(world.held, Load) else ()
    return PlanningProblem(
        "shown", world.arm, world.scene, world.q, world.q[None], attachments=carried
    )


def moving_poses(names: tuple[str, ...], shown: list[Frame]) -> dict[str, np.ndarray]:
    """Poses (k, 4, 4) of the objects that move."""
    standing: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for frame in shown:
        world, held = frame.world, frame.world.held
        placed = {item.name: item.T_world_object for item in world.scene}
        if isinstance(held, Load):
            placed[held.item.name] = world.arm.pose(world.q) @ held.attachment.T_hand_object
        for name in names:
            standing[name].append(placed[name])
    return {
        name: np.array(poses)
        for name, poses in standing.items()
        if any(not np.array_equal(pose, poses[0]) for pose in poses)
    }


def piece_poses(shown: list[Frame]) -> dict[str, np.ndarray]:
    """Poses (k, 4, 4) of the arm's pieces in the world."""
    found: dict[str, list[np.ndarray]] = {}
    for frame in shown:
        robot = frame.world.arm
        T_world_link = poses_along(robot, frame.world.q[None])[0][0]
        for part in robot.links:
            found.setdefault(part.name, []).append(T_world_link[part.link] @ part.T_link_geometry)
    return {name: np.array(poses) for name, poses in found.items()}
