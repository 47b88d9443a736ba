"""Shards small enough that a tiny dataset has several."""

import pytest

from cvqmpt_lab.labels.generation import SceneRecipe


@pytest.fixture(scope="module")
def two_scenes_a_shard():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SceneRecipe, "shard_scenes", 2)
        yield
