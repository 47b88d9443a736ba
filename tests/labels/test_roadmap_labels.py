import dataclasses
import shutil
from itertools import pairwise

import numpy as np
import pytest

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.labels.generation import generate
from cvqmpt_lab.labels.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.training.dataset import open_dataset, open_labels
from cvqmpt_lab.training.shards import (
    FULL_SCALE,
    LABEL_ARRAYS,
    LINKS,
    RoadmapGraph,
    read_shards,
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
def graph(tiny):
    return RoadmapGraph.read(tiny)


@pytest.fixture(scope="module", params=[0, 1])
def scene(request, tiny):
    """A scene of the first shard: its row, its exact checker, and the shard's arrays."""
    arrays, row = read_shards(tiny, LABEL_ARRAYS)[0], request.param
    shapes = family_scene(TINY.families[arrays["family"][row]], int(arrays["scene_seed"][row]))
    return row, CollisionChecker(panda(), shapes), arrays


def configurations(stored):
    robot = panda()
    return robot.lower + stored / FULL_SCALE * (robot.upper - robot.lower)


def collisions(checker, starts, ends):
    """Whether each straight motion (..., n) collides, at 40 states."""
    marks = np.linspace(0.0, 1.0, 40)[:, None]
    states = (1.0 - marks) * starts[..., None, :] + marks * ends[..., None, :]
    return checker.in_collision_batch(states.reshape(-1, 7)).reshape(states.shape[:-1]).any(-1)


def codes_of(arrays, row):
    return arrays["codes"][slice(*arrays["code_start"][row : row + 2])].astype(int)


def test_nodes_edges_and_links_called_free_are_free_by_the_exact_checker(scene, graph):
    row, checker, arrays = scene
    node_free = np.unpackbits(arrays["node_free"][row], count=len(graph.nodes)).astype(bool)
    assert not checker.in_collision_batch(graph.nodes[node_free]).any()
    # others are at least very near
    assert checker.in_collision_batch(graph.nodes[~node_free]).mean() > 0.8
    edge_free = np.unpackbits(arrays["edge_free"][row], count=len(graph.edges)).astype(bool)
    edges = graph.edges[edge_free][::37]
    assert not collisions(checker, graph.nodes[edges[:, 0]], graph.nodes[edges[:, 1]]).any()
    rows = slice(*arrays["link_start"][row : row + 2])
    link_free, ends = arrays["link_free"][rows], configurations(arrays["link_end"][rows])
    assert 0.02 < link_free.mean() < 0.98
    nodes = graph.nodes[arrays["link_code"][rows]]
    farthest = np.sort(np.linalg.norm(ends[:, None] - graph.nodes, axis=2))[:, [LINKS - 1]]
    # as far as ends are rounded
    assert (np.linalg.norm(ends[:, None] - nodes, axis=2) <= farthest + 1e-3).all()
    collides = collisions(checker, ends[:, None], nodes)
    assert not collides[link_free].any() and collides[~link_free].mean() > 0.9


def test_paths_walk_free_edges_and_cost_what_they_say(scene, graph):
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


def test_shards_that_are_missing_are_made_again_as_they_were(tiny, tmp_path):
    shutil.copytree(tiny, tmp_path / "again")
    (tmp_path / "again/shards/000001.npz").unlink()
    make(tmp_path / "again")
    again, before = (folder / "shards/000001.npz" for folder in (tmp_path / "again", tiny))
    assert again.read_bytes() == before.read_bytes()


def test_motions_of_all_shards_are_read(tiny):
    arrays = open_labels(tiny).arrays
    start = arrays["link_start"]
    assert len(start) == len(arrays["scene_seed"]) + 1 == 5
    assert (np.diff(start)[arrays["path_scene"]] > 0).all()
    assert len(arrays["link_end"]) == start[-1] > 4
    assert arrays["link_free"].shape == arrays["link_code"].shape == (start[-1], LINKS)


def test_labels_are_no_paths(tiny):
    with pytest.raises(InvalidInputError, match="holds labels on a roadmap, not paths; make those"):
        open_dataset(tiny)


def test_labels_of_another_dictionary_are_not_continued_and_damage_is_named(tiny, graph, tmp_path):
    dataclasses.replace(graph, nodes=graph.nodes + 0.1).write(tmp_path)
    with pytest.raises(InvalidInputError, match="another roadmap"):
        make(tmp_path)
    (tmp_path / "roadmap.npz").write_bytes((tiny / "roadmap.npz").read_bytes()[:200])
    with pytest.raises(InvalidInputError, match="is damaged or lacks an array"):
        RoadmapGraph.read(tmp_path)


def test_an_arm_that_the_dictionary_is_not_of_is_refused():
    with pytest.raises(InvalidInputError, match=r"for robot 'panda', not 'ur5'.*train stage1"):
        RoadmapRecipe(1, 2, ("table",), 0, {"name": "ur5"}).check()
