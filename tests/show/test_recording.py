"""Recordings are complete, plots agree with the certificate."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from cvqmpt_lab.benchmarks.place_task import carried_can
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, OccupancyMap, PointCloud, Sphere
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.curves import plots_along
from cvqmpt_lab.show.picture import draw_solution
from cvqmpt_lab.show.recording import log_solution

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
SHAPES = (
    Box((0.1, 0.2, 0.3)),
    Cylinder(0.1, 0.3),
    Sphere(0.2),
    ConvexMesh(CORNERS),
    PointCloud(CORNERS, 0.05),
    OccupancyMap(CORNERS, 0.1),
)


def test_solved_recording_holds_everything(solution, recorded, tmp_path):
    log_solution(solution, tmp_path / "run.rrd", carried=[carried_can()])
    rows = recorded(tmp_path / "run.rrd")
    states = len(solution.path.states)
    assert {f"/world/scene/{name}" for name in solution.problem.scene.names} <= rows.keys()
    assert {"/world/path/raw", "/world/path/hand", "/world/start/panda_hand_0"} <= rows.keys()
    assert {"/world/goals/0/panda_link0_0", "/world/constraint/0/mark"} <= rows.keys()
    robot = [part.name for part in solution.problem.robot.links]
    moving = {f"/world/robot/{name}" for name in (*robot, "carried_can")}
    moving |= {f"/world/hand/{axis}" for axis in "xyz"}
    moving |= {"/plots/tilt/0/tilt", "/plots/tilt/0/largest_by_the_bounds"}
    moving |= {f"/plots/joints/{name}" for name in solution.problem.robot.joint_names}
    moving |= {"/plots/clearance/clearance", "/plots/clearance/contact"}
    for row in ("rotation_about_y", "rotation_about_z"):
        curves = (row, "lower_bound", "upper_bound")
        moving |= {f"/plots/bounds/0_{row}/{curve}" for curve in curves}
    assert {entity for entity, count in rows.items() if count} == moving
    assert {rows[entity] for entity in moving} == {states}
    assert [path.name for path in tmp_path.iterdir()] == ["run.rrd"]


def test_every_shape_and_attachment_is_shown(unsolved, recorded, tmp_path):
    T = pose((0.5, 0.0, 0.5))
    items = [SceneObject(type(shape).__name__, shape, T) for shape in SHAPES]
    scene = unsolved.problem.scene.with_objects(*items)
    crowded = replace(unsolved.problem, scene=scene, attachments=(carried_can(),))
    solution = replace(unsolved, problem=crowded)
    log_solution(solution, tmp_path / "run.rrd")
    shown = recorded(tmp_path / "run.rrd").keys()
    assert {f"/world/scene/{item.name}" for item in items} | {"/world/start/carried_can"} <= shown
    draw_solution(solution, tmp_path / "shapes.png", (90, 60))
    assert imread(tmp_path / "shapes.png").shape[:2] == (60, 90)


@pytest.mark.parametrize("rows", [("rotation about y", "rotation about z"), ("tilt",)])
def test_plots_say_what_the_certificate_says(problem, solution, rows):
    if rows == ("tilt",):
        problem = replace(problem, constraint=(upright(),))
    states = problem.robot.random_configurations(np.random.default_rng(0), 5)
    plots = {plot.title: plot for plot in plots_along(problem, states)}
    outside = np.zeros(len(states))
    leans = np.degrees(np.arccos(problem.robot.poses(states)[:, 2, 0]))
    assert plots["tilt of the hand [deg]"].curves["tilt"] == pytest.approx(leans)
    for row in rows:
        if row == "tilt":
            tilt, high = np.radians([*plots["tilt of the hand [deg]"].lines.values()])
            outside = np.maximum(outside, tilt - high)
            continue
        tilt, low, high = plots[f"{row} against its bounds [rad]"].lines.values()
        outside = np.maximum(outside, np.maximum(low - tilt, tilt - high))
    for q, excess in zip(states, outside, strict=True):
        found = certify(problem, JointPath(np.stack([q, q])), clearance=False)
        assert excess == pytest.approx(found.max_violation_rad, abs=1e-9)
    states = solution.path.states[::20]
    *_, clearance, _ = plots_along(solution.problem, states)
    for q, drawn in zip(states, clearance.curves["clearance"], strict=True):
        expected = certify(solution.problem, JointPath(np.stack([q, q]))).min_clearance_m
        assert drawn == pytest.approx(1e3 * expected)
