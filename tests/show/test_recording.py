"""Recordings hold what they should."""

from dataclasses import replace

import pytest
from matplotlib.image import imread
from rerun.chunk import RrdReader

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.show.picture import draw_solution
from cvqmpt_lab.show.recording import TIMELINE, log_solution
from experiments.suites.place_task import carried_can


def recorded(path, timeline=TIMELINE):
    """Per entity, its number of rows on a timeline."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        on_timeline = chunk.num_rows if timeline in chunk.timeline_names else 0
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + on_timeline
    return rows


def test_solved_recording_holds_everything(solution, tmp_path):
    log_solution(solution, save=tmp_path / "run.rrd", carried=[carried_can()])
    rows = recorded(tmp_path / "run.rrd")
    states = len(solution.simplified.path.states)
    assert {f"/world/scene/{name}" for name in solution.problem.scene.names} <= rows.keys()
    assert {"/world/path/raw", "/world/path/simplified", "/world/start/7/panda_hand_0"} <= rows.keys()
    assert {"/world/goals/0/0/panda_link0_0", "/world/robot/7/carried_can"} <= rows.keys()
    moving = {f"/world/robot/{link}" for link in range(8)}
    moving |= {f"/plots/joints/{name}" for name in solution.problem.robot.joint_names}
    moving |= {"/plots/clearance/clearance", "/plots/clearance/contact"}
    for row in ("rotation_about_y", "rotation_about_z"):
        moving |= {f"/plots/bounds/0_{row}/{curve}" for curve in (row, "lower_bound", "upper_bound")}
    assert {entity for entity, count in rows.items() if count} == moving
    assert {rows[entity] for entity in moving} == {states}
    assert [path.name for path in tmp_path.iterdir()] == ["run.rrd"]


def test_unsolved_recording_holds_the_problem(unsolved, tmp_path):
    assert not unsolved.solved
    log_solution(unsolved, save=tmp_path / "run.rrd")
    rows = recorded(tmp_path / "run.rrd")
    assert {"/world/start/7", "/world/goals/0/7", "/world/scene/floor"} <= rows.keys()
    assert not any(entity.startswith(("/world/robot", "/world/path", "/plots")) for entity in rows)


def test_every_shape_and_attachment_is_shown(unsolved, every_shape, tmp_path):
    items = [SceneObject(type(shape).__name__, shape, pose((0.5, 0.0, 0.5))) for shape in every_shape]
    problem = unsolved.problem
    crowded = replace(problem, scene=problem.scene.with_objects(*items), attachments=(carried_can(),))
    solution = replace(unsolved, problem=crowded)
    log_solution(solution, save=tmp_path / "run.rrd")
    shown = recorded(tmp_path / "run.rrd").keys()
    assert {f"/world/scene/{item.name}" for item in items} | {"/world/start/7/carried_can"} <= shown
    draw_solution(solution, tmp_path / "shapes.png", (90, 60))
    assert imread(tmp_path / "shapes.png").shape[:2] == (60, 90)


def test_unwritable_recording_is_refused(unsolved, tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot write .*missing"):
        log_solution(unsolved, save=tmp_path / "missing" / "run.rrd")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for taken in ("folder", "file/run.rrd"):
        with pytest.raises(InvalidInputError, match="cannot write"):
            log_solution(unsolved, save=tmp_path / taken)
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "file"}
