import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from cli.main import main
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import locked
from cvqmpt_lab.labels import generation
from cvqmpt_lab.labels.generation import generate
from cvqmpt_lab.labels.path_labels import PathRecipe
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.search.anytime import NearShortestSettings
from cvqmpt_lab.training.dataset import open_dataset
from cvqmpt_lab.training.shards import SPACING
from cvqmpt_lab.vqmpt.dictionary import LinkPositions

TINY = PathRecipe(
    6, 2, ("cubes-spheres", "shelves"), labels=NearShortestSettings(restarts=1, finish=32)
)


def make(out, recipe=TINY):
    return generate(recipe, out, ["test"])


@pytest.fixture(scope="module")
def tiny(tmp_path_factory, two_scenes_a_shard):
    out = tmp_path_factory.mktemp("data")
    make(out)
    return out


@pytest.mark.parametrize("family", FAMILIES)
def test_scenes_depend_on_their_number_alone_and_leave_room(family):
    number = PathRecipe.first_scene
    scene = family_scene(family, number)
    assert scene == family_scene(family, number) and scene != family_scene(family, number + 1)
    robot = panda()
    states = robot.random_configurations(np.random.default_rng(0), 200)
    blocked = CollisionChecker(robot, scene).in_collision_batch(states).mean()
    assert 0.05 < blocked < 0.95


def test_paths_are_free_and_join_their_ends_among_the_shapes_of_their_scene(tiny):
    robot, dataset = panda(), open_dataset(tiny)
    arrays = dataset.arrays
    assert len(arrays["path_scene"]) >= 8
    for scene, (family, seed) in enumerate(
        zip(arrays["family"], arrays["scene_seed"], strict=True)
    ):
        made = family_scene(dataset.families[family], int(seed))
        poses = [item.T_world_object[:3] for item in made.obstacles]
        np.testing.assert_allclose(dataset.shapes(scene).pose, poses, atol=1e-6)
        checker = CollisionChecker(robot, made)
        for path in np.flatnonzero(arrays["path_scene"] == scene).tolist():
            q = robot.lower + dataset.path(path) * (robot.upper - robot.lower)
            steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
            assert steps.max() < SPACING + 1e-3
            # waypoints cut corners by less than a tenth of their spacing
            assert steps.sum() == pytest.approx(arrays["length"][path], rel=0.01)
            assert arrays["length"][path] >= arrays["straight"][path] - 1e-4
            assert not checker.in_collision_batch(q[[0, -1]]).any()


def test_interrupted_generation_ends_in_the_same_bytes(tiny, tmp_path):
    shutil.copytree(tiny, tmp_path / "d")
    (tmp_path / "d" / "shards" / "000000.npz").unlink()
    make(tmp_path / "d")
    for file in ("README.md", *(f"shards/{number:06d}.npz" for number in range(3))):
        assert (tmp_path / "d" / file).read_bytes() == (tiny / file).read_bytes()


def test_a_folder_that_another_run_writes_or_of_another_recipe_is_refused(tiny):
    with locked(tiny), pytest.raises(InvalidInputError, match="in use by another run"):
        make(tiny)
    for change in ({"paths_per_scene": 3}, {"robot": {"name": "ur5"}}):
        with pytest.raises(InvalidInputError, match="another recipe"):
            make(tiny, replace(TINY, **change))


def test_link_positions_of_a_robot_with_a_slider_are_those_of_its_kinematics(slider_arm):
    chain = generation.serial_chain(slider_arm)
    q = slider_arm.random_configurations(np.random.default_rng(0), 20)
    links = LinkPositions(tuple(slider_arm.lower), tuple(slider_arm.upper), chain)
    found = links.positions(torch.tensor(q)).reshape(20, -1, 3)
    _, translations = link_poses(slider_arm.kinematics, q)
    np.testing.assert_allclose(found[:, :-1], translations[:, 2:], atol=1e-5)
    np.testing.assert_allclose(found[:, -1], [slider_arm.pose(x)[:3, 3] for x in q], atol=1e-5)
    assert chain.sliders == (0,)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--scenes 2 --family castle", "castle"),
        ("--scenes 2 --seed -1", "-1"),
        ("--scenes 0", "'0'"),
        ("--scenes 2 --out /dev/null/x", "/dev/null"),
    ],
)
def test_bad_input_is_named(capsys, tmp_path, options, says):
    assert main(["data", "generate", "--out", str(tmp_path / "d"), *options.split()]) == 2
    # the line before may say that kernels are compiled
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("cvqmpt: ") and says in last
