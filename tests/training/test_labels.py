"""Generation of training data: almost shortest paths, and labels on a roadmap."""

import dataclasses
import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from refusals import refused

from cvqmpt_lab.base.files import locked
from cvqmpt_lab.benchmarks.families import FAMILIES, family_scene
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.search.anytime import NearShortestSettings
from cvqmpt_lab.training import generation
from cvqmpt_lab.training.dataset import open_dataset
from cvqmpt_lab.training.generation import PathRecipe, SceneRecipe, generate
from cvqmpt_lab.training.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.training.sequence_dataset import open_labels
from cvqmpt_lab.training.shards import (
    FULL_SCALE,
    LABEL_ARRAYS,
    LINKS_PER_END,
    WAYPOINT_SPACING_RAD,
    RoadmapGraph,
    read_shards,
)
from cvqmpt_lab.vqmpt.dictionary import LinkPositions

SEARCH = NearShortestSettings(restarts=1, finish=32)
TINY = PathRecipe(6, 2, ("cubes-spheres", "shelves"), labels=SEARCH)


FEW = RoadmapRecipe(4, 12, ("table", "cage"))


def make(out, recipe=TINY):
    return generate(recipe, out, ["test"])


@pytest.fixture(scope="module")
def two_scenes_a_shard():
    """Make shards of two scenes, so that a tiny dataset has several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SceneRecipe, "shard_scenes", 2)
        yield


@pytest.fixture(scope="module")
def tiny(tmp_path_factory, two_scenes_a_shard):
    out = tmp_path_factory.mktemp("data")
    make(out)
    return out


@pytest.mark.parametrize("family", FAMILIES)
def test_scenes_depend_only_on_their_number_and_leave_free_space(family):
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
    for scene, seed in enumerate(arrays["scene_seed"].tolist()):
        made = family_scene(dataset.families[arrays["family"][scene]], seed)
        poses = [item.T_world_object[:3] for item in made.obstacles]
        np.testing.assert_allclose(dataset.shapes(scene).pose, poses, atol=1e-6)
        checker = CollisionChecker(robot, made)
        for path in np.flatnonzero(arrays["path_scene"] == scene).tolist():
            q = robot.lower + dataset.path(path) * (robot.upper - robot.lower)
            steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
            assert steps.max() < WAYPOINT_SPACING_RAD + 1e-3
            # waypoints cut corners by less than a tenth of their spacing
            assert steps.sum() == pytest.approx(arrays["length"][path], rel=0.01)
            assert arrays["length"][path] >= arrays["straight"][path] - 1e-4
            assert not checker.in_collision_batch(q[[0, -1]]).any()


def test_interrupted_generation_ends_in_the_same_bytes(tiny, labelled, tmp_path):
    shards = ("shards/000000.npz", "shards/000001.npz")
    for made, recipe, files in (
        (tiny, TINY, ("README.md", *shards, "shards/000002.npz")),
        (labelled, FEW, shards),
    ):
        again = tmp_path / made.name
        shutil.copytree(made, again)
        (again / shards[recipe is FEW]).unlink()
        make(again, recipe)
        for file in files:
            assert (again / file).read_bytes() == (made / file).read_bytes()


def test_a_folder_that_another_run_writes_or_of_another_recipe_is_refused(tiny):
    with locked(tiny):
        refused("in use by another run", make, tiny)
    for change in ({"paths_per_scene": 3}, {"robot": {"name": "ur5"}}):
        refused("another recipe", make, tiny, replace(TINY, **change))


def test_a_dataset_is_not_continued_with_a_robot_whose_files_changed(
    two_scenes_a_shard, slider_arm_urdf, tmp_path
):
    urdf = tmp_path / "arm.urdf"
    shutil.copy(slider_arm_urdf, urdf)
    robot = {"urdf": str(urdf), "end_effector": "tool"}
    recipe = replace(TINY, scenes=4, robot=robot)
    make(tmp_path / "data", recipe)
    (tmp_path / "data" / "shards" / "000001.npz").unlink()
    text = urdf.read_text()
    for change, fields in (
        (('upper="2"', 'upper="1"'), "upper, kinematics_digest, robot_files"),
        (("</robot>", "</robot>\n"), "robot_files"),
    ):
        urdf.write_text(text.replace(*change))
        refused(rf"before its files changed \({fields} ", make, tmp_path / "data", recipe)
    urdf.write_text(text)
    make(tmp_path / "data", recipe)


def test_a_robot_with_two_arms_is_refused(tmp_path):
    two = replace(TINY, robot={"name": "baxter"})
    refused("joints branch.* give one --end-effector", make, tmp_path, two)
    assert not (tmp_path / "dataset.json").exists()


def test_link_positions_of_a_robot_with_a_slider_are_those_of_its_kinematics(slider_arm):
    chain = generation.serial_chain(slider_arm)
    q = slider_arm.random_configurations(np.random.default_rng(0), 20)
    links = LinkPositions(tuple(slider_arm.lower), tuple(slider_arm.upper), chain)
    found = links.positions(torch.tensor(q)).reshape(20, -1, 3)
    _, translations = link_poses(slider_arm.kinematics, q)
    np.testing.assert_allclose(found[:, :-1], translations[:, 2:], atol=1e-5)
    np.testing.assert_allclose(found[:, -1], [slider_arm.pose(x)[:3, 3] for x in q], atol=1e-5)
    assert chain.sliders == (0,)
    mixed = replace(chain, points=chain.points[::-1], offsets=chain.offsets[::-1].copy())
    links = LinkPositions(tuple(slider_arm.lower), tuple(slider_arm.upper), mixed)
    again = links.positions(torch.tensor(q)).reshape(20, -1, 3)
    np.testing.assert_array_equal(again, found.flip(1))


def test_a_dictionary_of_another_arm_is_refused():
    recipe = RoadmapRecipe(1, 2, ("table",), 0, {"name": "ur5"})
    refused(r"for robot 'panda', not 'ur5'.*train stage1", recipe.check)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory, two_scenes_a_shard):
    out = tmp_path_factory.mktemp("roadmap")
    make(out, FEW)
    return out


@pytest.fixture(scope="module")
def graph(labelled):
    return RoadmapGraph.read(labelled)


@pytest.fixture(scope="module", params=[0, 1])
def scene(request, labelled):
    """Return row and exact checker of a scene of the first shard, and the shard's arrays."""
    arrays, row = read_shards(labelled, LABEL_ARRAYS, 7)[0], request.param
    shapes = family_scene(FEW.families[arrays["family"][row]], int(arrays["scene_seed"][row]))
    return row, CollisionChecker(panda(), shapes), arrays


def configurations(stored):
    robot = panda()
    return robot.lower + stored / FULL_SCALE * (robot.upper - robot.lower)


def collisions(checker, starts, ends):
    """Return whether each straight motion (..., n) collides at one of 40 states."""
    marks = np.linspace(0.0, 1.0, 40)[:, None]
    states = (1.0 - marks) * starts[..., None, :] + marks * ends[..., None, :]
    return checker.in_collision_batch(states.reshape(-1, 7)).reshape(states.shape[:-1]).any(-1)


def codes_of(arrays, row):
    return arrays["codes"][slice(*arrays["code_start"][row : row + 2])].astype(int)


def test_free_nodes_edges_and_links_are_free_by_the_exact_checker(scene, graph):
    row, checker, arrays = scene
    node_free = np.unpackbits(arrays["node_free"][row], count=len(graph.nodes)).astype(bool)
    assert not checker.in_collision_batch(graph.nodes[node_free]).any()
    # other collisions are at least very near
    assert checker.in_collision_batch(graph.nodes[~node_free]).mean() > 0.8
    edge_free = np.unpackbits(arrays["edge_free"][row], count=len(graph.edges)).astype(bool)
    edges = graph.edges[edge_free][::37]
    assert not collisions(checker, graph.nodes[edges[:, 0]], graph.nodes[edges[:, 1]]).any()
    rows = slice(*arrays["link_start"][row : row + 2])
    link_free, ends = arrays["link_free"][rows], configurations(arrays["link_end"][rows])
    assert 0.02 < link_free.mean() < 0.98
    nodes = graph.nodes[arrays["link_code"][rows]]
    farthest = np.sort(np.linalg.norm(ends[:, None] - graph.nodes, axis=2))[:, [LINKS_PER_END - 1]]
    # equal up to the rounding of stored ends
    assert (np.linalg.norm(ends[:, None] - nodes, axis=2) <= farthest + 1e-3).all()
    collides = collisions(checker, ends[:, None], nodes)
    assert not collides[link_free].any() and collides[~link_free].mean() > 0.9


def test_paths_use_free_edges_and_have_the_stored_cost(scene, graph):
    number, _, arrays = scene
    edge_free = np.unpackbits(arrays["edge_free"][number], count=len(graph.edges)).astype(bool)
    pairs = {tuple(edge) for edge in graph.edges[edge_free].tolist()}
    rows = np.flatnonzero((arrays["path_scene"] == number) & np.isfinite(arrays["cost"]))
    assert len(rows) >= 2
    for row in rows:
        codes = codes_of(arrays, row)
        assert len(codes) > 0
        assert all((min(a, b), max(a, b)) in pairs for a, b in pairwise(codes))
        start, goal = configurations(arrays["ends"][row])
        states = np.concatenate([[start], graph.nodes[codes], [goal]])
        length = np.linalg.norm(np.diff(states, axis=0), axis=1).sum()
        assert length == pytest.approx(arrays["cost"][row], rel=1e-3)


def test_motions_of_all_shards_are_read(labelled):
    arrays = open_labels(labelled).arrays
    start = arrays["link_start"]
    assert len(start) == len(arrays["scene_seed"]) + 1 == 5
    assert (np.diff(start)[arrays["path_scene"]] > 0).all()
    assert len(arrays["link_end"]) == start[-1] > 4
    assert arrays["link_free"].shape == arrays["link_code"].shape == (start[-1], LINKS_PER_END)
    refused("holds labels on a roadmap, not paths; make those", open_dataset, labelled)


def test_labels_of_another_dictionary_are_refused_and_damage_is_named(labelled, graph, tmp_path):
    dataclasses.replace(graph, nodes=graph.nodes + 0.1).write(tmp_path)
    refused("another roadmap", make, tmp_path, FEW)
    (tmp_path / "roadmap.npz").write_bytes((labelled / "roadmap.npz").read_bytes()[:200])
    refused("is damaged or lacks an array", RoadmapGraph.read, tmp_path)
