"""Parts of training examples: shards, splits, clouds, augmentations, sequences of codes."""

import shutil
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from refusals import refused
from scipy.spatial import cKDTree
from small_models import compact_config, published_config, random_checkpoint
from training_data import LOWER, SPAN, UPPER, kinematics, shard, write_dataset, write_shard

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.benchmarks.families import random_scene
from cvqmpt_lab.sensing.camera import KINECT, Camera, DepthNoise, look_at
from cvqmpt_lab.sensing.crop import Crop
from cvqmpt_lab.sensing.observation import CameraSettings, visible_points
from cvqmpt_lab.training.clouds import CloudSettings, measured_points, sample_cloud
from cvqmpt_lab.training.dataset import BaseTurn, Shapes, open_dataset
from cvqmpt_lab.training.generation import scene_rows
from cvqmpt_lab.training.mpnet_stage import (
    MPNetSettings,
    MPNetStage,
    SceneBatchSettings,
    turned,
)
from cvqmpt_lab.training.sequence_dataset import open_sequences
from cvqmpt_lab.vqmpt.config import MPNetConfig, SerialChain
from cvqmpt_lab.vqmpt.dictionary import LinkPositions

CPU = torch.device("cpu")
WHOLE = Crop(radius=9.0)
PLAIN = CloudSettings(points=600, noise=0.0, occlusion=0.0, density=0.0, crop=WHOLE)


def rng(seed=0):
    return np.random.default_rng(seed)


def test_kinematics_that_do_not_fit_are_named():
    told = r"kinematics(: |\.).*(points|offsets|rotation|sliders)"
    changes = [{"points": [7, 0, 0, 0]}, {"points": []}, {"offsets": [[0.0]]}]
    for change in (*changes, {"rotation": "x"}, {"sliders": [7]}):
        refused(told, from_plain, SerialChain, kinematics() | change, "kinematics")


def one(kind, size, at=(0.3, -0.2, 0.4)):
    pose = np.concatenate((np.eye(3), np.array(at)[:, None]), 1)[None].astype(np.float32)
    return Shapes(np.array([kind], dtype=np.uint8), np.array([size], dtype=np.float32), pose)


def test_points_are_uniform_by_area():
    settings = replace(PLAIN, points=20000)

    def local(kind, size):
        shape = one(kind, size)
        return sample_cloud(shape, settings, rng()) - shape.pose[0, :, 3]

    on = (np.abs(np.abs(local(0, (0.2, 0.4, 0.6))) - (0.1, 0.2, 0.3)) < 1e-6).mean(0)
    areas = np.array([0.4 * 0.6, 0.2 * 0.6, 0.2 * 0.4])
    np.testing.assert_allclose(on, areas / areas.sum(), atol=0.015)
    points = local(1, (0.3, 0.3, 0.5))
    caps = np.abs(np.abs(points[:, 2]) - 0.25) < 1e-6
    assert caps.mean() == pytest.approx(0.3 / 0.8, abs=0.015)
    assert (np.hypot(*points[caps, :2].T) < 0.3 / np.sqrt(2)).mean() == pytest.approx(0.5, abs=0.02)
    ball = local(2, (0.3, 0.3, 0.3))
    assert np.abs(ball.mean(0)).max() < 0.01
    np.testing.assert_allclose(np.linalg.norm(ball, axis=1), 0.3, atol=1e-6)


DEPTHS = (
    (0, (0.4, 0.4, 0.4), lambda p: np.abs(p).max(1) - 0.2),
    (1, (0.2, 0.2, 0.4), lambda p: np.maximum(np.hypot(*p[:, :2].T), np.abs(p[:, 2])) - 0.2),
    (2, (0.2, 0.2, 0.2), lambda p: np.linalg.norm(p, axis=1) - 0.2),
)


@pytest.mark.parametrize(("kind", "size", "depth"), DEPTHS)
def test_points_inside_another_shape_are_left_out(kind, size, depth):
    """A smaller shape cuts an edge of a box of 0.5 m."""
    box, other = one(0, (0.5, 0.5, 0.5)), one(kind, size, at=(0.55, -0.2, 0.4))
    both = Shapes(*(np.concatenate(pair) for pair in zip(box, other, strict=True)))
    points = sample_cloud(both, replace(PLAIN, points=4000), rng())
    of_box = np.abs(np.abs(points - box.pose[0, :, 3]).max(1) - 0.25) < 1e-6
    assert 0.5 < of_box.mean() < 1.0
    assert depth(points[of_box] - other.pose[0, :, 3]).min() > -2e-4
    assert np.abs(points[~of_box] - box.pose[0, :, 3]).max(1).min() > 0.25 - 2e-4


def test_crops_and_noise(dataset):
    shapes = dataset.shapes(0)
    ball, box = Crop(radius=0.5), Crop(kind="box", lower=(-0.3, -0.3, 0.0))
    cropped = (CloudSettings(points=300, noise=0.0, crop=crop) for crop in (ball, box))
    inside, within = (sample_cloud(shapes, settings, rng(1)) for settings in cropped)
    assert np.linalg.norm(inside - np.array(ball.centre), axis=1).max() <= 0.5 + 1e-5
    assert (within >= np.subtract(box.lower, 1e-6)).all()
    assert (within <= np.add(box.upper, 1e-6)).all()
    # points of one ball: noise moves them off its surface
    noisy = sample_cloud(one(2, (0.3, 0.3, 0.3)), replace(PLAIN, noise=0.01), rng(1))
    off = np.abs(np.linalg.norm(noisy - [0.3, -0.2, 0.4], axis=1) - 0.3)
    assert 0.005 < off.mean() < 0.01


def test_empty_and_unseen_scenes_still_give_points():
    for count, measured in product((0, 1), (0.0, 1.0)):
        far = Shapes(*(array[:count] for array in one(0, (0.1, 0.1, 0.1), at=(30.0, 0.0, 0.0))))
        cloud = sample_cloud(far, CloudSettings(points=50, measured=measured), rng())
        assert cloud.shape == (50, 3) and np.isfinite(cloud).all() and cloud[:, 2].max() < -0.5


def test_measured_clouds_are_those_of_evaluation_cameras():
    """Cameras at the same positions measure the same points in both, up to the size of a pixel."""
    scene, settings = random_scene(3), CloudSettings(points=1024, measured=1.0, cameras=2)
    arrays = scene_rows(0, 3, scene)
    kind, size, pose = (np.array(arrays[f"shape_{name}"]) for name in Shapes._fields)
    shapes = Shapes(kind, size.astype(np.float32), pose.astype(np.float32))
    eyes = np.array([[1.2, 1.0, 1.5], [-0.9, 1.5, 1.2]])
    ours = measured_points(shapes, eyes, np.array(settings.crop.centre), rng())
    cameras = tuple(Camera(KINECT, look_at(eye, settings.crop.centre)) for eye in eyes)
    seen = CameraSettings(cameras=cameras, crop=Crop(radius=9.0), errors=DepthNoise())
    theirs = visible_points(scene, seen, rng(1))
    for some, others in ((ours, theirs), (theirs, ours)):
        assert np.median(cKDTree(others).query(some)[0]) < 0.02
    cloud = sample_cloud(shapes, settings, rng())
    assert cloud.shape == (1024, 3) and cloud.dtype == np.float32
    assert len(np.unique(cloud, axis=0)) > 600


def test_turning_moves_cloud_and_links_alike(dataset):
    turn, paths = BaseTurn(dataset, True), np.array([3, 4])
    links = LinkPositions(tuple(LOWER), tuple(UPPER), from_plain(SerialChain, kinematics()))
    angles = [turn.draw(paths, rng(seed)) for seed in range(20)]
    for angle in angles:
        for path in paths.tolist():
            u = dataset.path(path)
            moved = u.copy()
            moved[:, 0] += turn.shift(angle)
            assert moved[:, 0].min() >= -1e-6 and moved[:, 0].max() <= 1.0 + 1e-6
            placed = (links.configurations(torch.tensor(each))[:, 7:] for each in (u, moved))
            before, after = (points.reshape(-1, 3) for points in placed)
            np.testing.assert_allclose(after, turned(before.numpy(), angle), atol=5e-6)
    assert np.std(angles) > 0.2
    assert BaseTurn(dataset, False).draw(paths, rng()) == 0.0


def test_robots_that_cannot_be_turned_about_their_base_are_not(dataset, tmp_path):
    tilted = kinematics()
    tilted["rotation"][0] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    assert BaseTurn(dataset, True).draw(np.arange(2), rng()) != 0.0
    for k, other in enumerate((tilted, kinematics() | {"sliders": [0]})):
        turn = BaseTurn(open_dataset(write_dataset(tmp_path / str(k), kinematics=other)), True)
        assert turn.draw(np.arange(2), rng()) == 0.0
        assert not turn.draw_each(np.arange(2), rng()).any()


@pytest.mark.parametrize("turn_base", [False, True])
def test_batches_repeat_by_seed_and_have_equal_shares_of_each_scene(dataset, turn_base):
    how = {"trivial_share": 1.0, "turn_base": turn_base, "cloud": CloudSettings(points=64)}
    settings = MPNetSettings(batches=SceneBatchSettings(scenes=2, paths_per_scene=4, **how))
    stage = MPNetStage(dataset, MPNetConfig(n_points=64), settings, 5, CPU)
    first, same, other = (list(stage.batches(epoch)) for epoch in (0, 0, 1))
    for batch, again in zip(first, same, strict=True):
        assert batch["cloud"].shape[1:] == (64, 3) and len(batch["u"]) == 4 * len(batch["cloud"])
        for name, array in again.items():
            np.testing.assert_array_equal(batch[name], array)
    assert not np.array_equal(first[0]["cloud"], other[0]["cloud"])
    # each path occurs once, and paths of one scene are together
    lengths = {row: len(dataset.path(row)) for row in dataset.split("train").tolist()}
    scenes = np.concatenate([batch["scene"].repeat(4)[batch["weight"]] for batch in first])
    counts = np.concatenate([batch["counts"][batch["weight"]] for batch in first])
    found = zip(scenes.tolist(), counts.tolist(), strict=True)
    of_path = dataset.arrays["path_scene"].tolist()
    assert sorted(found) == sorted((of_path[row], count) for row, count in lengths.items())


def test_validation_batches_are_held_out_paths_as_they_are(dataset):
    settings = MPNetSettings(batches=SceneBatchSettings(scenes=2, paths_per_scene=3))
    stage = MPNetStage(dataset, MPNetConfig(n_points=1024), settings, 0, CPU)
    first, same = list(stage.validation_batches()), list(stage.validation_batches())
    np.testing.assert_array_equal(first[0]["cloud"], same[0]["cloud"])
    paths = [dataset.path(row) for row in dataset.split("validation").tolist()]
    held_out = {tuple(path[[0, -1]].ravel()) for path in paths}
    for batch in first:
        pairs = zip(batch["u"], batch["counts"], strict=True)
        assert {(*u[0], *u[count - 1]) for u, count in pairs} <= held_out


@pytest.mark.parametrize("config", [compact_config, published_config])
def test_sequences_of_paths_are_their_codes_without_repeats(dataset, panda, config):
    model = random_checkpoint(panda, config())
    opened, paths = open_sequences(dataset.folder, model), dataset.arrays
    assert opened.graph is None
    found, start = opened.arrays, paths["path_start"]
    by_ends = {}
    for path in range(len(start) - 1):
        ends = paths["waypoints"][[start[path], start[path + 1] - 1]]
        by_ends[ends.tobytes()] = path
    links = LinkPositions(LOWER, UPPER, dataset.chain if model.config.feature_dim else None)
    rows = [by_ends[ends.tobytes()] for ends in found["ends"]]
    assert len(set(rows)) == len(rows) and 0 < paths["trivial"][rows].mean() <= 0.15
    for sequence, path in enumerate(rows):
        u = torch.from_numpy(dataset.path(path))[None]
        codes = model.modules["dictionary"].encode(links.configurations(u))[0].tolist()
        kept = [c for i, c in enumerate(codes) if i == 0 or codes[i - 1] != c]
        assert found["codes"][slice(*found["code_start"][sequence : sequence + 2])].tolist() == kept
        assert found["path_scene"][sequence] == paths["path_scene"][path]


def test_shards_are_joined_and_split_by_scene_seed(data, dataset):
    assert dataset.robot.name == "panda" and dataset.families == ("cubes",)
    arrays = dataset.arrays
    assert arrays["scene_seed"].tolist() == [20, 1, 2, 40, 3, 4]
    assert arrays["path_scene"].tolist() == np.repeat(np.arange(6), 7).tolist()
    second = np.load(data / "shards" / "000001.npz")
    for path in (0, 20):
        rows = slice(second["path_start"][path], second["path_start"][path + 1])
        expected = second["waypoints"][rows] / np.float32(65535)
        np.testing.assert_array_equal(dataset.path(21 + path), expected)
    np.testing.assert_array_equal(dataset.shapes(4).size, second["shape_size"][5:10])
    train, validation = dataset.split("train"), dataset.split("validation")
    assert set(arrays["scene_seed"][arrays["path_scene"][validation]]) == {20, 40}
    assert len(train) == 28 and len(validation) == 14


def test_the_share_of_trivial_paths_is_capped_and_drawn(dataset):
    rows, trivial = np.arange(42), dataset.arrays["trivial"]
    kept, again, other = (dataset.with_few_trivial(rows, 0.2, rng(seed)) for seed in (0, 0, 1))
    assert (~trivial[kept]).sum() == 28 and trivial[kept].sum() == 7 and (np.diff(kept) > 0).all()
    assert kept.tolist() == again.tolist() != other.tolist()
    for all_kept, share in ((rows, 1.0), (np.flatnonzero(trivial), 0.1)):
        found = dataset.with_few_trivial(all_kept, share, np.random.default_rng(0))
        assert found.tolist() == all_kept.tolist()


@pytest.mark.parametrize("spacing", [0.5, 100.0])
def test_thinning_keeps_ends_and_spaces_evenly(dataset, spacing):
    thin = dataset.thinned(spacing)
    for path in range(42):
        before, after = dataset.path(path), thin.path(path)
        np.testing.assert_array_equal(after[[0, -1]], before[[0, -1]])
        length = np.linalg.norm(np.diff(before * SPAN, axis=0), axis=1).sum()
        assert len(after) == max(1, int(np.ceil(length / spacing))) + 1
        assert np.linalg.norm(np.diff(after * SPAN, axis=0), axis=1).max() <= spacing + 0.131
        assert {tuple(row) for row in after} <= {tuple(row) for row in before}
    refused("spacing of waypoints is 0", dataset.thinned, 0.0)


def test_damaged_and_missing_files_and_descriptions_that_do_not_fit_are_named(data, tmp_path):
    for k, (change, message) in enumerate(
        (
            (lambda b: b[:-100] + bytes(100), "is damaged or lacks an array"),
            (lambda b: b[:999] + b"?" + b[1000:], "delete it and generate again"),
        )
    ):
        shutil.copytree(data, tmp_path / f"{k}")
        path = tmp_path / f"{k}" / "shards" / "000001.npz"
        path.write_bytes(change(path.read_bytes()))
        assert path.stem in refused(message, open_dataset, tmp_path / f"{k}")
    path.with_stem("000000").unlink()
    refused("lacks shard 000000 but has 000001.npz: generate", open_dataset, tmp_path / f"{k}")
    for changes, message in (
        ({"schema": 2}, "schema is 2; this version reads 1"),
        ({"upper": LOWER}, "upper"),
        ({"lower": "low"}, "lower"),
        ({"families": []}, "families"),
        ({"kinematics": {"rotation": [1]}}, "kinematics"),
    ):
        refused(message, open_dataset, write_dataset(tmp_path / message[:5], **changes))


def test_a_dataset_whose_last_shards_are_missing_is_refused_with_the_command_that_adds_them(
    tmp_path,
):
    """The rest was read without a word, and trained on."""
    ran = {"command": ["cvqmpt", "data", "generate", "--scenes", "40", "--out", "my data"]}
    made = {"recipe": {"scenes": 40}, "provenance": ran}
    message = "has 2 of 3 shards: .*: cvqmpt data generate --scenes 40 --out 'my data'$"
    refused(message, open_dataset, write_dataset(tmp_path / "part", **made))
    whole = write_dataset(tmp_path / "whole", shards=((20, 1), (40, 3), (5, 6)), **made)
    assert len(open_dataset(whole).arrays["scene_seed"]) == 6
    refused("recipe.scenes", open_dataset, write_dataset(tmp_path / "x", recipe={"scenes": "4"}))


def test_shards_that_lack_an_array_or_hold_objects_and_missing_splits_are_named(tmp_path):
    arrays = shard(np.random.default_rng(5), (7, 8), 3)
    bad = {"objects": arrays | {"family": np.array([{}], dtype=object)}}
    for name in ("waypoints", "trivial"):
        bad[name] = {key: array for key, array in arrays.items() if key != name}
    bad["has 7 joints"] = arrays | {"waypoints": arrays["waypoints"][:, :6]}
    for message, found in bad.items():
        folder = write_dataset(tmp_path / message, shards=())
        write_shard(folder, 0, found)
        refused(rf"000000.npz.*{message}", open_dataset, folder)
    refused(r"no dataset in .*nowhere", open_dataset, tmp_path / "nowhere")
    dataset = open_dataset(write_dataset(tmp_path / "d", shards=((1, 2),)))
    refused("no validation path", dataset.require_splits)
