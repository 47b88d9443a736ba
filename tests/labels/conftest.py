"""Shards small enough that a tiny dataset has several."""

import pytest

from cvqmpt_lab.labels import generation


@pytest.fixture(scope="module")
def two_scenes_a_shard():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "SCENES_PER_SHARD", 2)
        yield
