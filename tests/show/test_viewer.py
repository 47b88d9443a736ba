"""Recordings hold what they should, pictures have the right size and show the right things."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr
from matplotlib.image import imread
from rerun.chunk import RrdReader

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import Solution, solve
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, Counters, Path, PlanResult, PlanStatus
from cvqmpt_lab.scene.scene import SceneObject, pose
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Sphere, bounding_radius
from cvqmpt_lab.show import recording as viewer
from cvqmpt_lab.show import still as picture
from cvqmpt_lab.show.recording import log_solution, violations
from cvqmpt_lab.show.still import Camera, draw_solution, hull_mesh, poses_along, rasterise, shape_mesh
from experiments.suites.place_task import carried_can

SIZE = (90, 60)
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
SHAPES = (
    Box((0.1, 0.2, 0.3)),
    Cylinder(0.1, 0.3),
    Sphere(0.2),
    ConvexMesh(CORNERS),
    PointCloud(CORNERS, 0.05),
)


@pytest.fixture(scope="module")
def unsolved(problem):
    return solve(problem, BiRRT(), Budget(iterations=1), seed=0)


def recorded(path):
    """Per entity, its number of rows on the path's timeline."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        on_timeline = chunk.num_rows if viewer.TIMELINE in chunk.timeline_names else 0
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


def test_every_shape_and_attachment_is_shown(unsolved, tmp_path):
    items = [SceneObject(type(shape).__name__, shape, pose((0.5, 0.0, 0.5))) for shape in SHAPES]
    problem = unsolved.problem
    crowded = replace(problem, scene=problem.scene.with_objects(*items), attachments=(carried_can(),))
    solution = replace(unsolved, problem=crowded)
    log_solution(solution, save=tmp_path / "run.rrd")
    shown = recorded(tmp_path / "run.rrd").keys()
    assert {f"/world/scene/{item.name}" for item in items} | {"/world/start/7/carried_can"} <= shown
    draw_solution(solution, tmp_path / "shapes.png", SIZE)
    assert imread(tmp_path / "shapes.png").shape[:2] == SIZE[::-1]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_meshes_are_as_large_as_their_shapes(shape):
    farthest = np.linalg.norm(shape_mesh(shape).corners, axis=-1).max()
    assert farthest == pytest.approx(bounding_radius(shape), rel=0.01)


def test_violations_agree_with_the_certificate(problem):
    states = problem.robot.random_configurations(np.random.default_rng(0), 5)
    found = violations(problem, states)
    for k, q in enumerate(states):
        certificate = certify(problem, Path(np.stack([q, q])), clearance=False)
        assert found["rad"][k] == pytest.approx(certificate.max_violation_rad, abs=1e-9)
        assert found["m"][k] == certificate.max_violation_m == 0.0
    assert not violations(replace(problem, constraint=()), states)["rad"].any()


def test_unwritable_recording_and_picture_are_refused(unsolved, tmp_path):
    with pytest.raises(InvalidInputError, match=r"cannot write recording .*missing.*folder that exists"):
        log_solution(unsolved, save=tmp_path / "missing" / "run.rrd")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for taken in ("folder", "file/run.rrd"):
        with pytest.raises(InvalidInputError, match="cannot write recording"):
            log_solution(unsolved, save=tmp_path / taken)
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "file"}
    with pytest.raises(InvalidInputError, match="cannot write picture"):
        draw_solution(unsolved, tmp_path / "missing" / "a.png", (3, 2))
    with pytest.raises(InvalidInputError, match=r"size \(0, 5\)"):
        draw_solution(unsolved, tmp_path / "a.png", (0, 5))


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


def test_picture_has_the_size_and_shows_the_trace(solution, tmp_path):
    draw_solution(solution, tmp_path / "a.png", (180, 120), ghosts=1)
    image = imread(tmp_path / "a.png")
    assert image.shape[:2] == (120, 180)
    orange = image[..., 0] - image[..., 2] > 0.35  # nothing but the trace is that colourful
    assert orange.sum() > 20
    draw_solution(replace(solution, simplified=None), tmp_path / "b.png", (180, 120))
    assert not (np.subtract(*imread(tmp_path / "b.png").T[[0, 2]]) > 0.35).any()


def test_poses_along_are_the_robots(panda):
    states = panda.random_configurations(np.random.default_rng(1), 4)
    for q, T_world_hand in zip(states, poses_along(panda, states)[1], strict=True):
        np.testing.assert_allclose(T_world_hand, panda.pose(q), atol=1e-9)


def test_hull_mesh_is_closed_and_faces_outwards():
    points = np.random.default_rng(2).normal(size=(60, 3))
    corners = hull_mesh(points).corners
    volume = np.linalg.det(corners).sum() / 6.0
    assert volume == pytest.approx(picture.ConvexHull(points).volume)
    box = hull_mesh(picture.shape_vertices(Box((1.0, 2.0, 3.0))))
    assert np.linalg.det(box.corners).sum() / 6.0 == pytest.approx(6.0)
    np.testing.assert_allclose(np.abs(box.normals).max(axis=-1), 1.0)


def test_rasterised_ball_has_the_right_place_size_and_depth():
    camera, shape = Camera((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0), height_angle=0.6), (240, 320)
    ball = shape_mesh(Sphere(0.3)).placed(pose((0.0, 0.2, 0.1)), (1.0, 1.0, 1.0))
    view = rasterise(ball, camera, shape)
    column, row, depth = camera.screen(np.array([0.0, 0.2, 0.1]), shape)
    assert column < 160 and row < 120  # +y is left, +z is up
    assert [view.columns.mean(), view.rows.mean()] == pytest.approx([column, row], abs=2.0)
    radius = 120 / np.tan(0.3) * 0.3 / np.sqrt(depth**2 - 0.3**2)
    assert len(view.face) == pytest.approx(np.pi * radius**2, rel=0.05)
    assert view.depth.min() == pytest.approx(2.0 - 0.3, abs=0.01)
    ray = camera.rays(view.rows, view.columns, shape)
    points = camera.eye + view.depth[:, None] * ray
    np.testing.assert_allclose(np.linalg.norm(points - [0.0, 0.2, 0.1], axis=1), 0.3, atol=0.01)


def test_nearer_triangle_hides_the_farther_one():
    near, far = (
        shape_mesh(Box((0.1, size, size))).placed(pose((x, 0, 0)), (1.0, 1.0, 1.0))
        for x, size in ((0, 0.5), (1, 4))
    )
    view = rasterise(picture.joined([far, near]), Camera((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (41, 41))
    centre = (view.rows == 20) & (view.columns == 20)
    assert view.depth[centre] == pytest.approx(1.95)
    assert view.depth[(view.rows == 1) & (view.columns == 1)] == pytest.approx(2.95)
