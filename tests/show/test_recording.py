"""Recordings hold what they should."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr
from matplotlib.image import imread
from rerun.chunk import RrdReader

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.planning.result import Counters, Path, PlanResult, PlanStatus
from cvqmpt_lab.scene.scene import SceneObject, pose
from cvqmpt_lab.show.recording import TIMELINE, log_solution, violations
from cvqmpt_lab.show.still import draw_solution
from experiments.suites.place_task import carried_can


def recorded(path):
    """Per entity, its number of rows on the path's timeline."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        on_timeline = chunk.num_rows if TIMELINE in chunk.timeline_names else 0
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + on_timeline
    return rows


def test_solved_recording_holds_everything(solution, tmp_path):
    log_solution(solution, save=tmp_path / "run.rrd")
    rows = recorded(tmp_path / "run.rrd")
    states = len(solution.simplified.path.states)
    assert {f"/world/scene/{name}" for name in solution.problem.scene.names} <= rows.keys()
    assert {"/world/path/raw", "/world/path/simplified", "/world/start/7/panda_hand_0"} <= rows.keys()
    assert {"/world/trees/0/edges", "/world/trees/1/nodes", "/world/goals/0/0/panda_link0_0"} <= rows.keys()
    moving = {f"/world/robot/{link}" for link in range(8)} | {"/plots/violation/rad", "/plots/violation/m"}
    moving |= {f"/plots/joints/{name}" for name in solution.problem.robot.joint_names}
    assert {entity for entity, count in rows.items() if count} == moving
    assert {rows[entity] for entity in moving} == {states}
    assert [path.name for path in tmp_path.iterdir()] == ["run.rrd"]


def test_unsolved_recording_holds_the_problem(unsolved, tmp_path):
    assert not unsolved.solved
    log_solution(unsolved, save=tmp_path / "run.rrd")
    rows = recorded(tmp_path / "run.rrd")
    assert {"/world/start/7", "/world/goals/0/7", "/world/scene/floor"} <= rows.keys()
    assert not any(entity.startswith(("/world/robot", "/world/path", "/plots")) for entity in rows)


def test_problem_without_goals_is_recorded(problem, tmp_path):
    nothing = PlanResult(PlanStatus.NO_GOAL, None, 0.0, Counters(), 0, "none")
    log_solution(
        Solution(problem.with_goals(np.empty((0, 7))), nothing, None, None, 0.0), save=tmp_path / "run.rrd"
    )
    assert not any(entity.startswith("/world/goals") for entity in recorded(tmp_path / "run.rrd"))


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


def test_violations_agree_with_the_certificate(problem):
    states = problem.robot.random_configurations(np.random.default_rng(0), 5)
    found = violations(problem, states)
    for k, q in enumerate(states):
        certificate = certify(problem, Path(np.stack([q, q])), clearance=False)
        assert found["rad"][k] == pytest.approx(certificate.max_violation_rad, abs=1e-9)
        assert found["m"][k] == certificate.max_violation_m == 0.0
    assert not violations(replace(problem, constraint=()), states)["rad"].any()


def test_unwritable_recording_is_refused(unsolved, tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot write recording .*missing.*folder that exists"):
        log_solution(unsolved, save=tmp_path / "missing" / "run.rrd")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for taken in ("folder", "file/run.rrd"):
        with pytest.raises(InvalidInputError, match="cannot write recording"):
            log_solution(unsolved, save=tmp_path / taken)
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "file"}


def test_viewer_needs_something_to_do_and_a_display(unsolved, monkeypatch):
    with pytest.raises(InvalidInputError, match="view=True"):
        log_solution(unsolved)

    def no_viewer(**_):
        raise RuntimeError("Failed to find Rerun Viewer executable\nmore")

    monkeypatch.setattr(rr, "spawn", no_viewer)
    with pytest.raises(
        InvalidInputError, match=r"cannot open the rerun viewer \(Failed to find .* executable\)"
    ):
        log_solution(unsolved, view=True)
