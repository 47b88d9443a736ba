"""The reader of training paths: splits, thinning, and what it refuses."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from training_data import LOWER, SPAN, shard, write_dataset, write_shard

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.dataset import open_dataset


def test_shards_are_joined_with_rows_counted_through(data, dataset):
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
    assert arrays["twin_of"][22] == 21 and arrays["twin_of"][21] == -1


def test_splits_go_by_scene_seed_and_leave_twins_out(dataset):
    train, validation = dataset.split("train"), dataset.split("validation")
    arrays = dataset.arrays
    assert set(arrays["scene_seed"][arrays["path_scene"][validation]]) == {20, 40}
    assert len(train) == 24 and len(validation) == 12  # 6 of 7 paths of a scene are no twins
    assert (arrays["twin_of"][np.concatenate((train, validation))] == -1).all()


def test_the_share_of_trivial_paths_is_capped_and_drawn(dataset):
    rows, trivial = np.arange(42), dataset.arrays["trivial"]
    kept, again, other = (
        dataset.with_few_trivial(rows, 0.2, np.random.default_rng(seed)) for seed in (0, 0, 1)
    )
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
    with pytest.raises(InvalidInputError, match="spacing of waypoints is 0"):
        dataset.thinned(0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 2}, "schema is 2; this version reads 1"),
        ({"upper": LOWER}, "upper"),
        ({"lower": "low"}, "lower"),
        ({"families": []}, "families"),
        ({"kinematics": {"rotation": [1]}}, "kinematics"),
    ],
)
def test_a_description_that_does_not_fit_is_named(tmp_path, changes, message):
    with pytest.raises(InvalidInputError, match=message):
        open_dataset(write_dataset(tmp_path / "d", **changes))


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("shards/000001.npz", lambda b: b[:-100] + bytes(100), "is damaged or lacks an array"),
        ("shards/000001.npz", lambda b: b[:999] + b"?" + b[1000:], "delete it and generate again"),
        ("shards/000001.npz", "pipe", "it is not a regular file"),
        ("dataset.json", lambda b: b"", "is not json"),
        ("dataset.json", lambda b: b"[]", "one json object"),
        ("dataset.json", lambda b: b'{"schema": 1}', "dataset.json"),
        ("dataset.json", lambda b: b'{"schema": 1, "schema": 1}', "occurs twice"),
    ],
)
def test_damaged_files_are_named(data, tmp_path, file, change, message):
    shutil.copytree(data, tmp_path / "d")
    path = tmp_path / "d" / file
    before = path.read_bytes()
    path.unlink()
    if change == "pipe":
        os.mkfifo(path)
    else:
        path.write_bytes(change(before))
    with pytest.raises(InvalidInputError, match=message) as caught:
        open_dataset(tmp_path / "d")
    assert Path(file).name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("without", ["waypoints", "twin_of"])
def test_shards_that_lack_an_array_or_hold_objects_are_named(tmp_path, without):
    arrays = shard(np.random.default_rng(5), (7, 8), 3)
    for name, message in ((without, without), ("family", "pickle")):
        folder = write_dataset(tmp_path / name, shards=())
        kept = {**arrays, "family": np.array([{}], dtype=object)} if name == "family" else arrays
        write_shard(folder, 0, {key: array for key, array in kept.items() if key != without})
        with pytest.raises(InvalidInputError, match=rf"000000.npz.*{message}"):
            open_dataset(folder)


def test_without_validation_scenes_nothing_is_trained(tmp_path):
    with pytest.raises(InvalidInputError, match=r"no dataset in .*nowhere"):
        open_dataset(tmp_path / "nowhere")
    dataset = open_dataset(write_dataset(tmp_path / "d", shards=((1, 2),)))
    with pytest.raises(InvalidInputError, match="no validation path"):
        dataset.require_splits()
