"""`cvqmpt scan` and `cvqmpt plan --cloud`:
a file becomes a clean cloud, a scene, a certified path, or one line.
"""

import numpy as np
import pytest
from command_line import refused
from scipy.spatial import cKDTree

from cli.main import main
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.cloud_files import read_cloud, write_cloud
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.scene_files import read_scene
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.sensing.camera import Camera, Intrinsics, look_at
from cvqmpt_lab.sensing.depth import write_view
from cvqmpt_lab.sensing.filters import near_robot
from cvqmpt_lab.sensing.render import view_of
from cvqmpt_lab.sensing.virtual import arm_objects, solids_of

START, GOAL = "-0.9,0.3,0,-2.0,0,2.3,0.8", "0.9,0.3,0,-2.0,0,2.3,0.8"
LENS = Intrinsics.from_fov(width=160, height=120, vertical_fov=60.0, near=0.2)
CAMERA = Camera(LENS, look_at((-0.4, 0.3, 1.2), (0.6, 0.0, 0.0)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, panda):
    """A depth image of a table, a post and the arm at the start, with its camera;
    the same as a cloud.
    """
    folder = tmp_path_factory.mktemp("scan")
    objects = (
        SceneObject("table", Box((0.8, 1.4, 0.04)), pose((0.7, 0.0, -0.02))),
        SceneObject("post", Box((0.08, 0.08, 0.5)), pose((0.62, 0.0, 0.25))),
    )
    view = view_of(
        solids_of((*objects, *arm_objects(panda, np.fromstring(START, sep=",")))), CAMERA
    )
    write_view(view, folder, "depth")
    T = CAMERA.T_world_camera
    write_cloud(folder / "cloud.ply", (view.points - T[:3, 3]) @ T[:3, :3])
    return folder


@pytest.fixture
def camera(folder):
    intrinsics, extrinsics = (
        folder / f"depth.{part}.json" for part in ("intrinsics", "extrinsics")
    )
    return ["--intrinsics", intrinsics, "--extrinsics", extrinsics]


def run(*words):
    return main([str(word) for word in words])


def test_a_depth_image_becomes_a_clean_cloud_and_a_scene(folder, camera, tmp_path, capsys, panda):
    out = [tmp_path / name for name in ("clean.pcd", "scene.json")]
    words = ["--arm-at", START, "--plane", "box", "--out", out[0], "--out", out[1]]
    assert run("scan", folder / "depth.png", *camera, *words) == 0
    lines = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert lines[:6] == ["scan", "voxels", "robot", "outliers", "supporting", "plane"]
    points = read_cloud(out[0]).points
    assert not near_robot(points, panda, np.fromstring(START, sep=","), 0.049).any()
    scene = read_scene(out[1])
    assert set(scene.names) == {"scan", "table"} and scene["scan"].shape.resolution == 0.02
    off, _ = cKDTree(scene["scan"].shape.centres).query(points, p=np.inf)
    assert off.max() < 0.01 + 1e-6, "every point lies in a cell"


@pytest.mark.parametrize("file", ["depth.png", "cloud.ply"])
def test_an_unknown_file_becomes_a_certified_path_in_one_command(folder, camera, file, capsys):
    words = camera if file == "depth.png" else camera[2:]
    ends = ["--start", START, "--goal", GOAL, "--constraint", "upright"]
    assert run("plan", "--cloud", folder / file, *words, *ends, "--iterations", 5000) == 0
    said = capsys.readouterr()
    assert "rotation about y" in said.out and "certificate valid" in said.out
    assert "robot " in said.err


def test_a_network_may_be_shown_the_scan_beside_a_suite(folder, camera, capsys):
    words = ["--cloud", folder / "depth.png", *camera, "--iterations", 1]
    assert run("plan", "place-task", *words) == 2
    assert "roadmap uses no cloud" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--level", "table"], "--level and --extrinsics: give one of the two"),
        (["--crop", "0,0,0,1,1"], "write 6 numbers, X0, Y0, Z0"),
        (["--crop", "5,5,5,6,6,6"], "nothing of the scan is left"),
        (["--front", "0.3,0,0"], "is that of --level table"),
        (["--extrinsics", "a.json"], "2 times for 1 files"),
        (["--arm-at", "0,0,0,0,0,0"], "write 7 numbers, panda_joint1,"),
        (
            ["--arm-at", START, "--robot-margin", "0", "--neighbours", "0"],
            "the arm stands inside the scan",
        ),
        (["--out", "x.obj"], "'.obj'; valid choices: .json, .pcd"),
        (["--voxel", "-1"], "-1"),
    ],
)
def test_what_cannot_be_meant_is_refused(folder, camera, words, message, capsys):
    assert message in refused(capsys, "scan", folder / "depth.png", *camera, *words)


ENDS = ["--start", START, "--goal", GOAL]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (ENDS, "give --cloud or --scene"),
        (
            ["--cloud", "a.pcd", "--start", START],
            "a motion needs --start Q, and --goal Q or --goal-pose",
        ),
        (["--cloud", "CLOUD", *ENDS, "--constraint", "uprihgt"], "unknown --constraint 'uprihgt'"),
        (["--cloud", "CLOUD", *ENDS, "--constraint", "upright=x"], "write 1 numbers, VALUE"),
        (["place-task", *ENDS], "one of the four"),
        (["place-task", "--extrinsics", "a.json"], "are of a scan: give --cloud"),
    ],
)
def test_a_motion_that_is_not_told_whole_is_refused(folder, words, message, capsys):
    pose = ["--extrinsics", folder / "depth.extrinsics.json"] if "CLOUD" in words else []
    words = [folder / "cloud.ply" if word == "CLOUD" else word for word in words]
    assert message in refused(capsys, "plan", *words, *pose)
