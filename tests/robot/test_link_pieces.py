"""Concave links of robots from files: convex pieces; hulls that coal refuses are rounded."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from small_arms import joint, problem_of

from cvqmpt_lab.certificate.certificate import FaultKind, certify
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.features.motion.motion_check import DryRun
from cvqmpt_lab.features.motion.record import record, report_of
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.features.pictures.bodies import drawing_of_solution
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.robot.hulls import hull_vertices, triangles_of_file
from cvqmpt_lab.robot.link_pieces import hull_gaps
from cvqmpt_lab.robot.load import load_robot, robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.planner_interface import Budget
from cvqmpt_lab.search.result import JointPath

# floor, wall and a column beside the arm, as size and place [m]
ROOM = (
    ((3.0, 3.0, 0.02), (0.0, 0.0, -0.01)),
    ((0.02, 3.0, 2.0), (1.5, 0.0, 1.0)),
    ((0.1, 0.1, 1.0), (0.55, 0.0, 0.5)),
)
FORK = (
    ((0.3, 0.04, 0.04), (0.15, 0.12, 0.0)),
    ((0.3, 0.04, 0.04), (0.15, -0.12, 0.0)),
    ((0.04, 0.28, 0.04), (0.02, 0.0, 0.0)),
)
ACROSS = np.linspace((-0.6, -0.4, 1.0), (0.6, -0.4, 1.0), 17)  # through the column


def mesh_of(boxes):
    placed = trimesh.transformations.translation_matrix
    made = [trimesh.creation.box(size, transform=placed(at)) for size, at in boxes]
    return trimesh.util.concatenate(made)


def body(size, at):
    size, at = (" ".join(map(str, values)) for values in (size, at))
    return f'<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision>'


def link(name, *boxes):
    return f'<link name="{name}">{"".join(body(*one) for one in boxes)}</link>'


def from_file(name, file):
    mesh = f'<geometry><mesh filename="{file}"/></geometry>'
    return f'<link name="{name}"><collision>{mesh}</collision></link>'


def arm(room, tool='<link name="tool"/>', mount="fixed"):
    """An arm of three hinges on the floor of a room, which is mounted beside it."""
    return (
        f'<robot name="arm"><link name="base"/>{room}{tool}'
        + link("column", ((0.08, 0.08, 0.3), (0.0, 0.0, 0.15)))
        + link("upper", ((0.4, 0.06, 0.06), (0.2, 0.0, 0.0)))
        + link("fore", ((0.3, 0.05, 0.05), (0.15, 0.0, 0.0)))
        + joint("room_mount", "base", "room", mount, (0, 0, 1))
        + joint("turn", "base", "column", "revolute", (0, 0, 1))
        + joint("lift", "column", "upper", "revolute", (0, 1, 0), (0.0, 0.0, 0.3), 1.5)
        + joint("bend", "upper", "fore", "revolute", (0, 1, 0), (0.4, 0.0, 0.0), 2.5)
        + joint("hold", "fore", "tool", "fixed", (0, 1, 0), (0.3, 0.0, 0.0))
        + "</robot>"
    )


def written(folder, text, name):
    (folder / name).write_text(text)
    return folder / name


@pytest.fixture
def room_urdf(tmp_path):
    mesh_of(ROOM).export(tmp_path / "room.stl")
    return arm(from_file("room", "room.stl"))


@pytest.mark.parametrize("mount", ["fixed", "prismatic"])
def test_a_standing_room_is_compared_like_its_boxes(tmp_path, room_urdf, mount):
    """It was one hull, whose pairs were left out: they overlapped in every state."""
    text = room_urdf.replace('name="room_mount" type="fixed"', f'name="room_mount" type="{mount}"')
    meshed = load_robot(written(tmp_path, text, "meshed.urdf"), "tool")
    boxes = load_robot(written(tmp_path, arm(link("room", *ROOM)), "boxes.urdf"), "tool")
    states = boxes.random_configurations(np.random.default_rng(0), 300)
    nothing = Scene("nothing", ())
    checks = (CollisionChecker(robot, nothing) for robot in (meshed, boxes))
    ours, truth = (check.in_collision_batch(states) for check in checks)
    assert 0.1 < truth.mean() < 0.9
    # pieces contain the boxes, and add little
    assert (ours >= truth).all() and (ours != truth).mean() < 0.03
    assert "concave meshes in convex pieces: room_0 (" in " ".join(meshed.notes)


def test_a_path_through_a_column_of_a_standing_link_is_refused(tmp_path, room_urdf):
    problem = problem_of(tmp_path, room_urdf, ACROSS, ["tool"])
    refused = certify(problem, JointPath(ACROSS))
    assert refused.faults[0].kind is FaultKind.COLLISION and "room_0." in refused.faults[0].text
    solution = solve(problem, "birrt", Budget(iterations=4000), seed=0)
    assert solution.solved


@pytest.mark.parametrize("room", ["boxes", "mesh"])
def test_only_the_floor_under_the_arm_is_left_out_and_all_reports_say_so(tmp_path, room_urdf, room):
    """The first link stands on the floor; the pair of links was left out as a whole."""
    text = room_urdf if room == "mesh" else arm(link("room", *ROOM))
    problem = problem_of(tmp_path, text, ACROSS, ["tool"])
    robot = problem.robot
    column = {pair[0] if pair[1] == "column_0" else pair[1] for pair in robot.left_out_pairs}
    pieces = {piece.name for piece in robot.links if "room" in piece.name}
    assert column & pieces and pieces - column
    note = next(note for note in robot.notes if "compared by nobody" in note)
    assert "room_0" in note and "column_0" in note
    path = JointPath(ACROSS[:2])
    certificate = certify(problem, path)
    contents = record(problem, Motion(robot.joint_names, path.states), DryRun(certificate, ACROSS))
    lines = "\n".join(report_of(DryRun(certificate, path.states), contents).lines)
    solution = solve(problem, "birrt", Budget(iterations=1), seed=0)
    assert "column_0" in lines and "column_0" in str(solution.report())
    assert "column_0" in "\n".join(drawing_of_solution(solution).lines)
    out = [list(pair) for pair in robot.left_out_pairs]
    assert solution.report().data["pairs_left_out"] == out


def test_a_moving_fork_is_compared_in_pieces(tmp_path):
    """Its hull fills the space between the tines."""
    mesh_of(FORK).export(tmp_path / "fork.stl")
    text = arm('<link name="room"/>', from_file("tool", "fork.stl"))
    robot = load_robot(written(tmp_path, text, "fork.urdf"), "tool")
    tool = [piece for piece in robot.links if piece.name.startswith("tool_0.")]
    assert 3 <= len(tool) <= 12
    between = np.array([0.25, 0.0, 0.0])
    assert not any(
        (piece.vertices.min(axis=0) < between).all()
        and (piece.vertices.max(axis=0) > between).all()
        for piece in tool
    )
    whole = robot_from_source({**robot.source, "one_hull_a_mesh": True})
    assert len(whole.links) == 4 and hull_gaps(whole)["tool_0"] > 0.08


def test_arms_by_name_keep_their_hulls():
    robot = robot_from_source({"name": "ur5"})
    assert len(robot.links) == 8 and robot.notes == []
    gaps = hull_gaps(robot)
    assert max(gaps, key=gaps.get) == "forearm_link_0" and 0.02 < gaps["forearm_link_0"] < 0.05


@pytest.mark.parametrize("sides", [200, 300])
def test_a_hull_with_too_many_neighbours_at_a_corner_is_rounded_outwards(tmp_path, sides):
    """Coal stores at most 255 neighbours of a corner."""
    cone = trimesh.creation.cone(0.1, 0.2, sections=sides)
    cone.export(tmp_path / "cone.stl")
    text = arm('<link name="room"/>', from_file("tool", "cone.stl"))
    robot = load_robot(written(tmp_path, text, "cone.urdf"), "tool")
    (piece,) = (piece for piece in robot.links if piece.name == "tool_0")
    shape = next(
        item.geometry for item in robot.collision_model.geometryObjects if item.name == "tool_0"
    )
    for corners in (hull_vertices(shape), piece.vertices):
        planes = ConvexHull(corners).equations
        away = np.asarray(cone.vertices) @ planes[:, :3].T + planes[:, 3]
        assert away.max() < 1e-7 and np.linalg.norm(corners, axis=1).max() < 0.2 + 1e-3
    rounded = [note for note in robot.notes if "hulls of meshes with too many corners" in note]
    assert len(rounded) == (sides > 255)


@pytest.mark.parametrize("thickness", [1e-9, 1e-6])
def test_a_flat_disc_with_many_corners_is_thickened_and_rounded(tmp_path, thickness):
    """Coal stores at most 255 neighbours of a corner: such a disc ended in a traceback."""
    disc = trimesh.creation.cylinder(0.1, thickness, sections=400)
    disc.export(tmp_path / "disc.stl")
    text = arm('<link name="room"/>', from_file("tool", "disc.stl"))
    robot = load_robot(written(tmp_path, text, "disc.urdf"), "tool")
    (piece,) = (piece for piece in robot.links if piece.name == "tool_0")
    planes = ConvexHull(piece.vertices).equations
    assert (np.asarray(disc.vertices) @ planes[:, :3].T + planes[:, 3]).max() < 1e-7
    assert np.abs(piece.vertices[:, 2]).max() < 1e-3
    (note,) = (note for note in robot.notes if "without thickness are larger" in note)
    assert "tool_0" in note


def test_parts_of_several_materials_keep_their_triangles(tmp_path):
    boxes = [trimesh.creation.box((0.1, 0.1, 0.1), placed) for placed in (np.eye(4), np.eye(4))]
    boxes[1].apply_translation((0.5, 0.0, 0.0))
    (tmp_path / "two.mtl").write_text("newmtl m0\nKd 1 0 0\nnewmtl m1\nKd 0 1 0\n")
    lines = ["mtllib two.mtl", "o both"]
    lines += [f"v {x} {y} {z}" for box in boxes for x, y, z in box.vertices]
    for k, box in enumerate(boxes):
        lines += [f"usemtl m{k}", *(f"f {a} {b} {c}" for a, b, c in box.faces + 8 * k + 1)]
    (tmp_path / "two.obj").write_text("\n".join(lines) + "\n")
    points, faces = triangles_of_file(str(tmp_path / "two.obj"), (2.0, 2.0, 2.0))
    assert len(faces) == 24
    triangles = points[faces]
    assert np.ptp(triangles, axis=1).max() < 0.21, "no triangle joins the two boxes"
    assert sum(triangles[:, 0, 0] > 0.5) == 12, "each box has its own triangles"
