"""`cvqmpt scan` and `cvqmpt plan --cloud`: a file gives a cloud, scene, path, or one error."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from command_line import SCAN_START, refused, run_here
from PIL import Image
from scipy.spatial import cKDTree

from cvqmpt_lab.cli.main import main
from cvqmpt_lab.features.scan.captures import cleaned_by, scan_of_clouds
from cvqmpt_lab.features.scan.scan import Arm, ScanSettings, near_robot, scan
from cvqmpt_lab.features.scan.scan_picture import scan_bodies
from cvqmpt_lab.scene.cloud_files import read_cloud
from cvqmpt_lab.scene.scene_files import read_scene

START, GOAL = SCAN_START, SCAN_START[1:]


@pytest.fixture
def camera(scan_folder):
    return [
        *("--intrinsics", scan_folder / "depth.intrinsics.json"),
        *("--extrinsics", scan_folder / "depth.extrinsics.json"),
    ]


def test_a_depth_image_becomes_a_clean_cloud_and_a_scene(
    scan_folder, camera, tmp_path, cvqmpt, panda, capsys
):
    out = [tmp_path / name for name in ("clean.pcd", "scene.json")]
    words = ["--arm-at", START, "--plane", "box", "--out", out[0], "--out", out[1]]
    told = cvqmpt("scan", scan_folder / "depth.png", *camera, *words)
    lines = [line.split()[0] for line in told.splitlines()]
    assert lines[:6] == ["scan", "voxels", "robot", "outliers", "supporting", "plane"]
    points = read_cloud(out[0]).points
    assert not near_robot(points, panda, np.fromstring(START, sep=","), 0.049).any()
    scene = read_scene(out[1])
    assert set(scene.names) == {"scan", "table"} and scene["scan"].shape.resolution == 0.02
    assert 0.5 < scene.unseen < 1.0 and f"{scene.unseen:.0%} of the arm's reach is unseen" in told
    unknown = ["--arm-at", START, "--unknown", "occupied"]
    told = cvqmpt("scan", scan_folder / "depth.png", *camera, *unknown)
    assert "obstacles, except those in which panda stands during the scan" in told
    assert "unseen" not in told
    words = ["scan", scan_folder / "depth.png", *camera, "--radius", "0.02", *unknown]
    assert "--radius 0.02 makes balls" in refused(capsys, *words)
    off, _ = cKDTree(scene["scan"].shape.centres).query(points, p=np.inf)
    assert off.max() < 0.01 + 1e-6, "every point lies in a cell"


def test_a_picture_shows_raw_and_removed_points_and_a_robot_that_is_named(
    scan_folder, camera, tmp_path, cvqmpt
):
    """The white robot is in the picture only with --robot; red points belong to the arm."""
    words = [scan_folder / "depth.png", *camera, "--arm-at", START]
    light, red = [], []
    for k, more in enumerate(([], ["--robot", "panda"])):
        cvqmpt("scan", *words, *more, "--picture", tmp_path / f"{k}.png")
        image = np.array(Image.open(tmp_path / f"{k}.png").convert("RGB"), dtype=int)[:700]
        light.append(((np.ptp(image, axis=2) < 12) & (image.max(axis=2) < 240)).sum())
        red.append((image[..., 0] - image[..., 1] > 80).sum())
    assert light[1] > light[0] + 3000 and red[0] > 1000


def test_the_bodies_of_a_scan_are_its_points_its_camera_and_axes(scan_folder):
    cloud = read_cloud(scan_folder / "cloud.ply")
    T = np.eye(4)
    T[2, 3] = 1.0
    made = scan([replace(cloud, T_world_camera=T)], ScanSettings(), np.random.default_rng(0))
    groups = {body.group: body for body in scan_bodies(made, ScanSettings().voxel)}
    axes = {f"{name} of the base frame" for name in "xyz"}
    assert groups.keys() - {"raw points, removed"} == {"raw points, kept", "camera", *axes}
    assert groups["camera"].poses[0] == pytest.approx(T)


@pytest.mark.parametrize(
    ("file", "written", "kind", "bound"),
    [
        ("depth.png", "clean.pcd", "upright", r"constraint  tilt 0\.\d+ of 0.1 rad at most"),
        ("cloud.ply", "scene.json", "upright-box=0.2", r"rotation about y [-\d.e]+ of 0.2 rad"),
    ],
)
def test_an_unknown_file_becomes_a_certified_path_in_two_commands(
    scan_folder, camera, file, written, kind, bound, capsys, tmp_path
):
    """The constraint keeps the axis of the hand upright that points up at the start."""
    out = tmp_path / written
    words = [scan_folder / file, *(camera if file == "depth.png" else camera[2:])]
    run_here(["scan", *words, "--arm-at", START, "--out", out])
    words = ["--scene" if out.suffix == ".json" else "--cloud", out]
    ends = ["--start", START, "--goal", GOAL, "--constraint", kind]
    run_here(["plan", *words, *ends, "--iterations", 5000])
    said = capsys.readouterr()
    assert re.search(bound, said.out) and "certificate certified" in said.out
    assert "of the arm's reach is unseen" in said.out


@pytest.mark.parametrize(
    ("size", "message"),
    [
        (
            [],
            r"--voxel 0.1 leaves one point in 0.1 m, and --map 0.02 .* 0.02 m wide: .*--voxel 0.0",
        ),
        (["--padding", 0.02], "obstacles of it that are 0.06 m wide: surfaces would have gaps"),
        (["--radius", 0.03], "and --radius 0.03 makes obstacles .* or a larger --radius"),
    ],
)
def test_voxels_larger_than_the_obstacles_are_refused(scan_folder, tmp_path, size, message, capsys):
    """A wall became separate cells of 2 cm, 10 cm apart, between which an arm could pass."""
    words = [scan_folder / "cloud.ply", "--voxel", 0.1, *size]
    assert re.search(message, refused(capsys, "scan", *words, "--out", tmp_path / "a.json"))


def test_a_cloud_with_large_voxels_is_no_obstacle_without_cells_of_that_size(
    scan_folder, tmp_path, cvqmpt, capsys
):
    cvqmpt("scan", scan_folder / "cloud.ply", "--voxel", 0.1, "--out", tmp_path / "a.pcd")
    words = ["plan", "--cloud", tmp_path / "a.pcd", f"--start={START}", f"--goal={GOAL}"]
    assert main([*map(str, words)]) == 2
    assert "--voxel 0.1 --map 0.1 --out scene.json, and give --scene" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "a.npy"])
def test_a_cleaned_cloud_is_taken_as_it_is(scan_folder, tmp_path, cvqmpt, panda, name):
    """A second cleaning would remove all points of a cloud with large voxels as outliers."""
    cvqmpt("scan", scan_folder / "cloud.ply", "--voxel", 0.04, "--out", tmp_path / name)
    arm = Arm(panda, np.array(START.split(","), dtype=float))
    written, made = read_cloud(tmp_path / name).points, scan_of_clouds([tmp_path / name], arm)
    cleaned = cleaned_by(tmp_path / name)
    if name == "a.npy":  # without comments
        assert cleaned is None and made.steps[0].name == "voxels"
        return
    assert cleaned.voxel == 0.04 and not cleaned.arm and 0.5 < cleaned.unseen <= 1.0
    np.testing.assert_array_equal(made.points, written[~near_robot(written, *arm, 0.05)])


def test_start_of_a_problem_file_is_where_the_arm_was(scan_folder, camera, tmp_path, cvqmpt):
    cvqmpt("problems new", tmp_path / "mine.json")
    data = json.loads((tmp_path / "mine.json").read_text())
    data["start"] = [float(x) for x in START.split(",")]
    (tmp_path / "mine.json").write_text(json.dumps(data))
    words = ["scan", scan_folder / "depth.png", *camera, "--arm-at"]
    assert cvqmpt("", *words, START) == cvqmpt("", *words, "start", tmp_path / "mine.json")


def test_a_network_may_be_shown_the_scan_beside_a_suite(scan_folder, camera, capsys, tmp_path):
    run_here(["scan", scan_folder / "depth.png", *camera, "--out", tmp_path / "clean.pcd"])
    words = ["--cloud", tmp_path / "clean.pcd", "--iterations", 1]
    run_here(["plan", "place-task", *words], code=2)
    assert "roadmap uses no cloud" in capsys.readouterr().err.splitlines()[-1]


def test_a_scan_out_of_reach_gives_one_warning_in_each_command(
    scan_folder, tmp_path, cvqmpt, caplog
):
    """By extrinsics of another frame; it was planned among without a word."""
    (tmp_path / "far.json").write_text(json.dumps({"xyz": [12.0, 0.0, 1.5], "rpy": [3.14, 0, 0]}))
    (tmp_path / "near.json").write_text(json.dumps({"xyz": [0.5, 0.0, 1.5], "rpy": [3.14, 0, 0]}))
    cloud = scan_folder / "cloud.ply"
    motion = [f"--start={START}", f"--goal={GOAL}", "--optimize", 0]
    far = ["--extrinsics", tmp_path / "far.json"]
    told = "no obstacle is in the arm's reach of"
    for words in (
        ["scan", cloud, *far, "--out", tmp_path / "scene.json", "--out", tmp_path / "far.pcd"],
        ["plan", "--cloud", tmp_path / "far.pcd", *motion],
        ["plan", "--scene", tmp_path / "scene.json", *motion],
    ):
        caplog.clear()
        cvqmpt("", *words)
        assert caplog.text.count(told) == 1, words
    caplog.clear()
    two = [cloud, cloud, "--extrinsics", tmp_path / "near.json", *far]
    run_here(["scan", *two, "--out", tmp_path / "two.json"])
    assert caplog.text.count("none of its points is in the arm's reach") == 1
    assert told not in caplog.text
