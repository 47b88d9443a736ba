"""The moments of a solved task, for pictures, films and recordings."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.show.meshes import poses_along
from cvqmpt_lab.tasks.solve_task import TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase
from cvqmpt_lab.tasks.world import HeldDoor, Load, World

PERIOD = 0.1  # [s] between shown states
PAUSE = 0.5  # [s] shown of fingers that open or close


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
            yield Frame(time + float(t), phase.name, world_along(world, q))
        world = world.moved(outcome.solution.simplified.path.states[-1])
        time += motion.duration


def moments(solution: TaskSolution) -> list[tuple[str, World]]:
    """(name, world) at the start and after every phase that was solved, in order."""
    outcomes = {outcome.phase.name: outcome for outcome in solution.outcomes if outcome.solved}
    world = World.before(solution.task)
    found = [("start", world)]
    for phase in solution.task.phases:
        if not isinstance(phase, PlannedPhase):
            world = world.after(phase)
        elif phase.name in outcomes:
            world = world.moved(outcomes[phase.name].solution.simplified.path.states[-1])  # type: ignore[union-attr]
        else:
            break
        found.append((phase.name, world))
    return found


def shown(world: World) -> PlanningProblem:
    """A world as something that can be drawn: the arm alone, and a door it holds in the scene."""
    attachments: tuple[Attachment, ...] = ()
    if isinstance(world.held, Load):  # the object itself, not the little less of it that is checked
        attachments = (
            replace(
                world.held.attachment, shape=world.held.item.shape, T_hand_object=world.held.T_hand_object
            ),
        )
    return PlanningProblem(
        name="shown",
        robot=world.arm,
        scene=world.scene,
        start=world.q,
        goals=world.q[None],
        attachments=attachments,
    )


def world_along(world: World, q: np.ndarray) -> World:
    """The world at a state (n,) of a planned phase's path, or (n + 1,) with a door in the hand."""
    return world.moved(q) if isinstance(world.held, HeldDoor) else replace(world, q=q)


def moving_poses(names: tuple[str, ...], shown: list[Frame]) -> dict[str, np.ndarray]:
    """Poses (k, 4, 4) of the objects that do not stay where they are."""
    standing = {name: [] for name in names}  # type: dict[str, list[np.ndarray]]
    for frame in shown:
        world, held = frame.world, frame.world.held
        placed = {item.name: item.T_world_object for item in world.scene}
        if isinstance(held, Load):
            placed[held.item.name] = world.arm.pose(world.q) @ held.T_hand_object
        for name in names:
            standing[name].append(placed[name])
    return {
        name: np.array(poses)
        for name, poses in standing.items()
        if any(not np.array_equal(pose, poses[0]) for pose in poses)
    }


def piece_poses(shown: list[Frame]) -> dict[str, np.ndarray]:
    """Poses (k, 4, 4) in the world of the arm's pieces."""
    found: dict[str, list[np.ndarray]] = {}
    for frame in shown:
        robot = frame.world.arm
        T_world_link = poses_along(robot, frame.world.q[None])[0][0]
        for part in robot.links:
            found.setdefault(part.name, []).append(T_world_link[part.link] @ part.T_link_geometry)
    return {name: np.array(poses) for name, poses in found.items()}
