"""Pictures, films, recordings and plots: complete, and in agreement with the certificate."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image
from refusals import refused

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.place_task import SHELF_DOOR, carried_can
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.task_space_region import upright, upright_box
from cvqmpt_lab.features.pictures import picture
from cvqmpt_lab.features.pictures.bodies import (
    BODY_COLOURS,
    drawing_of_problem,
    drawing_of_task,
    frames,
    ground_height,
    mesh_of,
    robot_bodies,
    scene_bodies,
)
from cvqmpt_lab.features.pictures.curves import plots_along
from cvqmpt_lab.features.pictures.meshes import constraint_marks, hull_mesh, shape_mesh
from cvqmpt_lab.features.pictures.picture import (
    draw_solution,
    film_solution,
    legend_of,
    save_film,
    strip,
    task_image,
)
from cvqmpt_lab.features.pictures.raster import Renderer, Viewpoint
from cvqmpt_lab.features.pictures.recording import log_solution
from cvqmpt_lab.features.pictures.visuals import drawn_pieces, shaded, simplified
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, OccupancyMap, PointCloud, Sphere
from cvqmpt_lab.search.result import JointPath


def test_picture_has_the_size_and_shows_the_trace(solution, tmp_path):
    draw_solution(solution, tmp_path / "a.png", (180, 120), ghosts=1)
    image = imread(tmp_path / "a.png")
    assert image.shape[:2] == (120, 180)
    orange = image[..., 0] - image[..., 2] > 0.5  # nothing but the trace is that colourful
    assert orange.sum() > 20
    draw_solution(replace(solution, simplified=None), tmp_path / "b.png", (180, 120))
    assert not (np.subtract(*imread(tmp_path / "b.png").T[[0, 2]]) > 0.5).any()


def test_fine_hulls_are_drawn_by_few_corners_close_to_the_whole():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20_000, 3))
    plate = points / np.linalg.norm(points, axis=1)[:, None] * (0.3, 0.2, 0.01)
    mesh = hull_mesh(plate)
    assert mesh is hull_mesh(plate.copy()) and len(mesh.corners) < 600
    directions = rng.normal(size=(200, 3))
    drawn, whole = (
        np.max(corners @ directions.T, axis=0) for corners in (mesh.corners.reshape(-1, 3), plate)
    )
    assert (drawn <= whole + 1e-12).all() and (drawn > 0.98 * whole).all()


def test_visual_meshes_are_simplified_and_hulls_are_drawn_where_they_are_missing(
    panda, slider_arm_urdf, tmp_path
):
    round_mesh = shape_mesh(Sphere(1.0)).corners.reshape(-1, 3)
    points, faces = simplified(round_mesh, np.arange(len(round_mesh)).reshape(-1, 3), most=150)
    assert 50 < len(faces) <= 150
    assert np.linalg.norm(points[faces], axis=-1) == pytest.approx(1.0, abs=0.08)
    assert (np.einsum("fij,fij->fi", shaded(points, faces).normals, points[faces]) > 0.9).all()
    pieces = drawn_pieces(panda)
    assert {piece.name for piece in pieces} >= {"panda_link5_0", "panda_hand_0"}
    assert 2500 < max(len(piece.mesh.corners) for piece in pieces) <= 3000
    hulls = robot_from_source({**panda.source, "bodies": "hulls"})
    assert len(drawn_pieces(hulls)) == len(panda.links)
    text = slider_arm_urdf.read_text()
    lost = '<visual><geometry><mesh filename="lost.stl"/></geometry></visual></link>'
    (tmp_path / "arm.urdf").write_text(text.replace("</link>", lost, 2))
    arm = load_robot(tmp_path / "arm.urdf", "tool")
    with pytest.warns(UserWarning, match=r"drawn by collision hulls: .*lost\.stl"):
        assert len(drawn_pieces(arm)) == len(arm.links)


def test_a_robot_has_the_colours_of_its_urdf_and_legends_the_most_frequent(
    slider_arm_urdf, tmp_path
):
    text, body = slider_arm_urdf.read_text(), '<visual><geometry><sphere radius="0.05"/></geometry>'
    named = f'{body}<material name="red"/></visual>'
    blue = f'{body}<material name="own"><color rgba="0 0 1 0.5"/></material></visual>'
    bare = f'{body}<material name="unknown"/></visual>'
    text = text.replace("</link>", f"{named}</link>", 2).replace("</link>", f"{blue}</link>", 1)
    text = text.replace(
        "</robot>", '<material name="red"><color rgba="1 0 0 1"/></material></robot>'
    )
    at = text.index('name="wrist"')
    (tmp_path / "arm.urdf").write_text(
        text[:at] + text[at:].replace("</link>", f"{bare}</link>", 1)
    )
    arm = load_robot(tmp_path / "arm.urdf", "tool")
    problem = PlanningProblem("alone", arm, Scene("none", ()), np.zeros(4), np.zeros((1, 4)))
    bodies = robot_bodies(problem, problem.start[None])
    colours = {body.name: body.colour for body in bodies}
    assert colours["base_0"] == colours["carriage_0"] == (1.0, 0.0, 0.0)
    assert colours["base_1"] == (0.0, 0.0, 1.0)
    assert colours["wrist_0"] == colours["elbow_0"] == BODY_COLOURS["robot"]
    assert legend_of(bodies[:3]) == [("robot", (1.0, 0.0, 0.0))]
    assert {
        body.colour for body in robot_bodies(problem, problem.start[None], (0.0, 1.0, 0.0))
    } == {(0.0, 1.0, 0.0)}


def test_a_ghost_that_stands_where_the_robot_stands_is_not_seen(problem):
    still = mesh_of(scene_bodies(problem.scene))
    renderer = Renderer(still, ground_height(problem.scene), Viewpoint(), (60, 40))
    robot = mesh_of(robot_bodies(problem, problem.start[None]))
    ghost = renderer.layer(robot, 0.5)
    assert np.array_equal(renderer.image(robot, [ghost]), renderer.image(robot))


@pytest.mark.parametrize(
    ("region", "thin"),
    [
        ({"plane": {"normal": [0, 1, 0], "point": [0.4, 0.1, 0.5]}}, [1]),
        ({"line": {"direction": [1, 0, 0], "point": [0.4, 0.1, 0.5]}}, [1, 2]),
    ],
)
def test_planes_and_lines_are_drawn_where_the_hand_may_be(problem, region, thin):
    bounded = replace(problem, constraint=(from_plain(Region, region, "region"),))
    (mark,) = constraint_marks(bounded, problem.start[None])
    low, high = mark.corners.min(axis=(0, 1)), mark.corners.max(axis=(0, 1))
    assert np.flatnonzero(high - low < 0.01).tolist() == thin
    assert (0.5 * (low + high))[thin] == pytest.approx(np.array([0.4, 0.1, 0.5])[thin])


@pytest.mark.parametrize("region", [upright(0.2), upright_box(0.1)])
def test_the_cone_of_a_tilt_is_as_wide_as_its_bound(problem, region):
    bounded = replace(problem, constraint=(region,))
    cone, *_ = constraint_marks(bounded, problem.start[None])
    apex = problem.robot.pose(problem.start)[:3, 3]
    rays = cone.corners.reshape(-1, 3) - apex
    rays = rays[np.linalg.norm(rays, axis=1) > 1e-6]
    angles = np.arccos(rays[:, 2] / np.linalg.norm(rays, axis=1))
    assert angles == pytest.approx(region.bounds[region.bounded_rows[-1], 1], abs=1e-6)


def test_all_of_a_motion_is_inside_of_the_picture(problem, monkeypatch):
    """Start and goal are equal; between them the arm swings a long stick far to the side."""
    stick = Attachment("stick", Box((0.05, 0.05, 2.0)), pose((0.0, 0.0, 1.0)))
    carrying, away = replace(problem, attachments=(stick,)), problem.start.copy()
    away[0] += 2.5
    path = JointPath(np.linspace(problem.start, away, 9)[[*range(9), *range(8, -1, -1)]])
    renderers = []
    monkeypatch.setattr(
        picture, "Renderer", lambda *words: renderers.append(words) or Renderer(*words)
    )
    picture.problem_image(carrying, path, (120, 80))
    _, _, viewpoint, (width, height) = renderers[0]
    corners = mesh_of(drawing_of_problem(carrying, path).over).corners
    columns, rows, _ = np.moveaxis(viewpoint.screen(corners, (height, width)), -1, 0)
    assert columns.min() > 0 and columns.max() < width and rows.min() > 0 and rows.max() < height


def test_files_that_cannot_be_written_are_refused(unsolved, tmp_path):
    frames = [np.zeros((21, 31, 3), np.uint8)]
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for place in ("missing/a", "file/a"):
        path, told = tmp_path / place, f"cannot write .*{place}"
        refused(told, draw_solution, unsolved, path.with_suffix(".png"), (3, 2))
        refused(told, save_film, frames, path.with_suffix(".gif"))
        refused(told, log_solution, unsolved, path.with_suffix(".rrd"))
    refused("cannot write", log_solution, unsolved, tmp_path / "folder")
    refused(r"size \(0, 5\)", draw_solution, unsolved, tmp_path / "a.png", (0, 5))
    refused(r"'\.avi'; valid choices: \.gif", save_film, frames, tmp_path / "a.avi")
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "file"}


def test_a_film_shows_the_robot_from_start_to_goal(solution, tmp_path):
    film_solution(solution, tmp_path / "a.gif", (120, 80), pictures=5)
    with Image.open(tmp_path / "a.gif") as shown:
        assert shown.n_frames >= 5
        ends = []
        for k in (0, shown.n_frames - 1):
            shown.seek(k)
            ends.append(np.array(shown.convert("RGB"), dtype=int))
    assert (np.abs(ends[1] - ends[0]).max(axis=2) > 60).sum() > 50


def test_pictures_film_and_recording_of_a_task(task_solution, recorded, tmp_path):
    phases = [outcome.phase.name for outcome in task_solution.outcomes]
    image, names = task_image(task_solution, (60, 40))
    assert names == ["start", *phases]
    height = 40 + len(strip([("1  start", None)], 60, 24))
    assert image.shape[:2] == (2 * height + 6, 3 * 60 + 2 * 6)
    film_solution(task_solution, tmp_path / "task.gif", size=(60, 40), pictures=8)
    with Image.open(tmp_path / "task.gif") as moving:
        assert moving.n_frames > len(phases)
    log_solution(task_solution, tmp_path / "task.rrd")
    rows = recorded(tmp_path / "task.rrd", "task_time")
    moments = {entity: count for entity, count in rows.items() if count}
    assert moments.pop("/phase") == len(task_solution.task.phases)
    assert "/world/moving/can" in moments and f"/world/moving/{SHELF_DOOR}/handle_bar" in moments
    assert "/world/robot/panda_leftfinger_0" in moments
    assert "/world/moving/mustard_bottle" not in moments
    duration = sum(outcome.trajectory.duration for outcome in task_solution.outcomes)
    assert set(moments.values()) == {len(frames(task_solution))}
    assert min(moments.values()) > duration / 0.1
    assert len(drawing_of_task(task_solution, most=8).labels) == 8


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
    robot = [part.name for part in drawn_pieces(solution.problem.robot)]
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
def test_plots_agree_with_the_certificate(problem, solution, rows):
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
        found = certify(problem, JointPath(np.stack([q, q])))
        assert excess == pytest.approx(found.max_violation_rad, abs=1e-9)
    states = solution.path.states[::20]
    *_, clearance, _ = plots_along(solution.problem, states)
    for q, drawn in zip(states, clearance.curves["clearance"], strict=True):
        expected = certify(
            solution.problem, JointPath(np.stack([q, q])), exact_clearance=True
        ).min_clearance_m
        assert drawn == pytest.approx(1e3 * expected)
