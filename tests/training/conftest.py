"""A tiny dataset of paths, which is written once."""

import pytest
from training_data import write_dataset


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "paths")


@pytest.fixture(scope="session")
def dataset(data):
    from cvqmpt_lab.training.dataset import open_dataset

    return open_dataset(data)
