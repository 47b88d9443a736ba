"""Copies of the files of a depth camera, which tests may change."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import SCAN_START


@pytest.fixture
def files(tmp_path, scan_folder, scan_view, panda):
    """Depth image, intrinsics and extrinsics of one camera, its exact view, and the arm in it."""
    shutil.copytree(scan_folder, tmp_path, dirs_exist_ok=True)
    names = {"depth": "png", "intrinsics": "intrinsics.json", "extrinsics": "extrinsics.json"}
    files = {part: tmp_path / f"depth.{ending}" for part, ending in names.items()}
    q = np.fromstring(SCAN_START, sep=",")
    return SimpleNamespace(**files, folder=tmp_path, view=scan_view, robot=panda, q=q)
