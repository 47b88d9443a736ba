import dataclasses
import shutil
from itertools import pairwise

import numpy as np
import pytest

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.labels.generation import generate
from cvqmpt_lab.labels.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.training.dataset import open_dataset
from cvqmpt_lab.training.roadmap_dataset import open_roadmap_dataset
from cvqmpt_lab.training.shards import (
    FULL_SCALE,
    LINKS,
    RoadmapGraph,
    finished_shards,
    packed_shard,
    read_roadmap_shards,
    write_shard,
)

TINY = RoadmapRecipe(4, 12, ("table", "cage"))


def make(out, recipe=TINY):
    return generate(recipe, out, ["test"])


@pytest.fixture(scope="module")
def tiny(tmp_path_factory, two_scenes_a_shard):
    out = tmp_path_factory.mktemp("roadmap")
    make(out)
    return out


@pytest.fixture(scope="module")
def shard(tiny):
    return read_roadmap_shards(tiny)[0]


def scene_of(shard, scene):
    return family_scene(
        TINY.families[shard.arrays["family"][scene]], int(shard.arrays["scene_seed"][scene])
    )


@pytest.mark.parametrize("scene", [0, 1])
def test_nodes_and_edges_called_free_are_free_by_the_exact_checker(shard, scene):
    checker, graph = CollisionChecker(panda(), scene_of(shard, scene)), shard.graph
    free = shard.node_free(scene)
    assert not checker.in_collision_batch(graph.nodes[free]).any()
    # others are at least very near
    assert checker.in_collision_batch(graph.nodes[~free]).mean() > 0.8
    edges = graph.edges[np.flatnonzero(shard.edge_free(scene))[::37]]
    marks = np.linspace(0.0, 1.0, 40)[:, None, None]
    states = (1.0 - marks) * graph.nodes[edges[:, 0]] + marks * graph.nodes[edges[:, 1]]
    assert not checker.in_collision_batch(states.reshape(-1, 7)).any()


@pytest.mark.parametrize("scene", [0, 1])
def test_paths_walk_free_edges_and_cost_what_they_say(shard, scene):
    robot, arrays, graph = panda(), shard.arrays, shard.graph
    free = {tuple(edge) for edge in graph.edges[shard.edge_free(scene)].tolist()}
    rows = np.flatnonzero((arrays["path_scene"] == scene) & np.isfinite(arrays["cost"]))
    assert len(rows) >= 2
    for row in rows:
        codes = arrays["codes"][arrays["code_start"][row] : arrays["code_start"][row + 1]].astype(
            int
        )
        assert len(codes) > 0
        assert all((min(a, b), max(a, b)) in free for a, b in pairwise(codes))
        start, goal = robot.lower + arrays["ends"][row] / FULL_SCALE * (robot.upper - robot.lower)
        states = np.concatenate([[start], graph.nodes[codes], [goal]])
        length = np.linalg.norm(np.diff(states, axis=0), axis=1).sum()
        assert length == pytest.approx(arrays["cost"][row], rel=1e-3)


@pytest.mark.parametrize("scene", [0, 1])
def test_motions_called_free_are_free_by_the_exact_checker(shard, scene):
    checker, arrays, robot = (
        CollisionChecker(panda(), scene_of(shard, scene)),
        shard.arrays,
        panda(),
    )
    rows = slice(arrays["link_start"][scene], arrays["link_start"][scene + 1])
    free = arrays["link_free"][rows]
    assert 0.02 < free.mean() < 0.98
    ends = robot.lower + arrays["link_end"][rows] / FULL_SCALE * (robot.upper - robot.lower)
    nodes = shard.graph.nodes[arrays["link_code"][rows]]
    farthest = np.sort(np.linalg.norm(ends[:, None] - shard.graph.nodes, axis=2))[:, [LINKS - 1]]
    near = np.linalg.norm(ends[:, None] - nodes, axis=2)
    assert (near <= farthest + 1e-3).all()  # as far as ends are rounded
    marks = np.linspace(0.0, 1.0, 40)[:, None]
    states = (1.0 - marks) * ends[:, None, None] + marks * nodes[:, :, None]
    collides = (
        checker.in_collision_batch(states.reshape(-1, 7)).reshape(*free.shape, -1).any(axis=2)
    )
    assert not collides[free].any()
    assert collides[~free].mean() > 0.9  # others are at least very near


def test_shards_that_are_missing_are_made_again_as_they_were(tiny, tmp_path):
    shutil.copytree(tiny, tmp_path / "again")
    (tmp_path / "again/shards/000001.npz").unlink()
    make(tmp_path / "again")
    assert (tmp_path / "again/shards.csv").read_bytes() == (tiny / "shards.csv").read_bytes()


def rewritten(folder, number, change):
    """The shard with changed arrays, and a fitting index."""
    arrays = dict(np.load(folder / f"shards/{number:06d}.npz"))
    rows = {row.shard: row for row in finished_shards(folder)}
    change(arrays)
    rows[number], content = packed_shard(number, arrays)
    write_shard(folder, rows[number], content, rows.values())


def test_motions_of_all_shards_are_read(tiny):
    labels = open_roadmap_dataset(tiny)
    assert len(labels.link_start) == len(labels.scenes) + 1 == 5
    assert (np.diff(labels.link_start)[labels.path_scene] > 0).all()
    assert len(labels.link_end) == labels.link_start[-1] > 4
    assert labels.link_free.shape == labels.link_code.shape == (len(labels.link_end), LINKS)


@pytest.mark.parametrize("read", [open_dataset, open_roadmap_dataset])
def test_a_shard_that_is_not_as_it_was_written_is_refused(tiny, tmp_path, read):
    folder = tmp_path / "bad"
    shutil.copytree(tiny, folder)
    path = folder / "shards/000001.npz"
    arrays = dict(np.load(path))
    np.savez_compressed(path, **arrays | {"cost": arrays["cost"] + 1.0})
    with pytest.raises(InvalidInputError, match=r"000001\.npz is damaged \(sha256\)"):
        read(folder)


def cut(arrays):
    arrays["link_free"] = arrays["link_free"][:-1]


def beyond(arrays):
    arrays["link_code"] = arrays["link_code"] + np.uint16(1024)


def without(arrays):
    del arrays["link_start"], arrays["link_end"], arrays["link_code"], arrays["link_free"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [(cut, "does not fit"), (beyond, "does not fit"), (without, "array 'link_start' is missing")],
)
def test_labels_of_motions_that_are_missing_or_contradict_the_roadmap_are_refused(
    tiny, tmp_path, damage, message
):
    folder = tmp_path / "bad"
    shutil.copytree(tiny, folder)
    rewritten(folder, 0, damage)
    with pytest.raises(InvalidInputError, match=rf"000000\.npz:? {message}"):
        open_roadmap_dataset(folder)


def test_paths_opened_for_training_pass_their_codes_and_are_as_long_as_labelled(tiny):
    dataset, robot = open_dataset(tiny), panda()
    shards = read_roadmap_shards(tiny)
    labels = [
        (shard, row)
        for shard in shards
        for row in np.flatnonzero(np.isfinite(shard.arrays["cost"])).tolist()
    ]
    assert len(dataset.paths) == len(labels) > 4
    assert len(dataset.scenes) == sum(len(shard.arrays["family"]) for shard in shards) == 4
    for path, (shard, row) in enumerate(labels):
        arrays = shard.arrays
        q = robot.lower + dataset.paths.joints(path) * (robot.upper - robot.lower)
        steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
        assert steps.max() < 0.135 and steps.sum() == pytest.approx(arrays["cost"][row], rel=2e-3)
        codes = arrays["codes"][arrays["code_start"][row] : arrays["code_start"][row + 1]].astype(
            int
        )
        nearest = np.linalg.norm(q[:, None] - shard.graph.nodes[codes], axis=2).argmin(0)
        assert (np.diff(nearest) > 0).all()
        assert np.abs(q[nearest] - shard.graph.nodes[codes]).max() < 1e-3
        scene = int(dataset.paths.scene[path])
        assert dataset.scenes.seed[scene] == arrays["scene_seed"][arrays["path_scene"][row]]


def test_labels_of_another_dictionary_are_not_continued(tiny, tmp_path):
    graph = RoadmapGraph.read(tiny)
    other = dataclasses.replace(graph, nodes=graph.nodes + 0.1)
    other.write(tmp_path)
    with pytest.raises(InvalidInputError, match="another roadmap"):
        make(tmp_path)


def test_a_damaged_roadmap_says_so(tiny, tmp_path):
    (tmp_path / "roadmap.npz").write_bytes((tiny / "roadmap.npz").read_bytes()[:200])
    with pytest.raises(InvalidInputError, match="not a readable archive"):
        RoadmapGraph.read(tmp_path)


def test_an_arm_without_dictionary_gets_free_nodes_and_another_s_dictionary_is_refused(tmp_path):
    make(tmp_path, RoadmapRecipe(2, 2, ("shelves", "cage"), 1, {"name": "kinova"}))
    graph = RoadmapGraph.read(tmp_path)
    assert graph.nodes.shape == (1024, 6) and graph.node_possible.mean() > 0.9
    assert np.abs(graph.nodes).max() < 2.0 * np.pi  # its joints turn further
    assert any(np.isfinite(shard.arrays["cost"]).any() for shard in read_roadmap_shards(tmp_path))
    with pytest.raises(
        InvalidInputError, match=r"vq_mpt is no dictionary of ur5.*; leave --dictionary out"
    ):
        RoadmapRecipe(1, 2, ("table",), 0, {"name": "ur5"}, model="vq_mpt").check()
