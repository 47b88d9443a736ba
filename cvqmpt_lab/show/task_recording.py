"""A whole task in rerun: the robot moving through all phases in time, the door turning, the can carried.

Entities: ``world/scene`` (what stands still), ``world/moving`` (parts of doors, carried objects), ``world/robot``
(the arm's pieces) and ``phase``, a log of what happens. The timeline "task_time" is execution time.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.show.meshes import ROBOT_COLOUR, hull_mesh, poses_along
from cvqmpt_lab.show.recording import log_scene, mesh_archetype, object_archetype, save_recording
from cvqmpt_lab.show.task_still import world_along
from cvqmpt_lab.tasks.phases import PlannedPhase
from cvqmpt_lab.tasks.solve_task import TaskSolution
from cvqmpt_lab.tasks.world import Load, World

TIMELINE = "task_time"
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


def log_task(solution: TaskSolution, save: Path) -> None:
    """Write a task to a .rrd file; works without a display.

    Raises
    ------
    InvalidInputError: nothing was solved, or the file cannot be written.
    """
    shown = list(frames(solution))
    if not shown:
        raise InvalidInputError(f"nothing to show of task {solution.task.name}: {solution.failure}")
    eye = rrb.EyeControls3D(position=(-1.35, -1.75, 1.55), look_target=(0.3, -0.2, 0.5), eye_up=(0, 0, 1))
    blueprint = rrb.Blueprint(
        rrb.Spatial3DView(origin="world", name="world", eye_controls=eye),
        rrb.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )
    save_recording(Path(save), blueprint, lambda recording: _log(recording, solution, shown))


def _log(recording: rr.RecordingStream, solution: TaskSolution, shown: list[Frame]) -> None:
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    first = solution.task.scene
    moving = moving_poses(first.names, shown)
    log_scene(recording, first.without(*moving))
    times = np.array([frame.time for frame in shown])
    for name, poses in moving.items():
        entity = rr.new_entity_path(["world", "moving", *name.split("/")])
        recording.log(entity, object_archetype(first[name]), static=True)
        _send(recording, entity, times, poses)
    for piece, poses in _piece_poses(shown).items():
        entity = rr.new_entity_path(["world", "robot", piece])
        vertices = next(part.vertices for part in shown[0].world.arm.links if part.name == piece)
        recording.log(entity, mesh_archetype(hull_mesh(vertices), ROBOT_COLOUR), static=True)
        _send(recording, entity, times, poses)
    names = [frame.phase for frame in shown]
    for k, name in enumerate(names):
        if k == 0 or name != names[k - 1]:
            recording.set_time(TIMELINE, duration=times[k])
            recording.log("phase", rr.TextLog(name))


def _send(recording: rr.RecordingStream, entity: str, times: np.ndarray, poses: np.ndarray) -> None:
    """Poses (k, 4, 4) of an entity at times (k,) [s]."""
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], mat3x3=poses[:, :3, :3])
    recording.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=times)], columns)


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


def _piece_poses(shown: list[Frame]) -> dict[str, np.ndarray]:
    """Poses (k, 4, 4) in the world of the arm's pieces."""
    found: dict[str, list[np.ndarray]] = {}
    for frame in shown:
        robot = frame.world.arm
        T_world_link = poses_along(robot, frame.world.q[None])[0][0]
        for part in robot.links:
            found.setdefault(part.name, []).append(T_world_link[part.link] @ part.T_link_geometry)
    return {name: np.array(poses) for name, poses in found.items()}
