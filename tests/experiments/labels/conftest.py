"""Shards small enough that a tiny dataset has several."""

import pytest

from experiments.labels import training_data


@pytest.fixture(scope="module")
def two_scenes_a_shard():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_data, "SCENES_PER_SHARD", 2)
        yield
