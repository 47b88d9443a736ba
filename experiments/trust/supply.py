"""Shipped weights are read only when their sha256 is the stated one."""

import shutil
import tempfile
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.weights import SHIPPED, WEIGHTS, read_model
from experiments.trust.check import Check, Trial


def flipped_bits(count: int) -> Trial:
    """One bit of a file of shipped weights is flipped; reading them must fail in one line."""
    rng, faults = np.random.default_rng(0), []
    with tempfile.TemporaryDirectory() as folder:
        for name in SHIPPED:
            shutil.copytree(WEIGHTS / name, Path(folder) / name)
        files = sorted(Path(folder).rglob("*.safetensors"))
        for trial in range(count):
            path = files[trial % len(files)]
            good = path.read_bytes()
            spoiled, at = bytearray(good), int(rng.integers(len(good)))
            spoiled[at] ^= 1 << int(rng.integers(8))
            path.write_bytes(spoiled)
            try:
                read_model(path.parent)
                faults.append(f"{path.parent.name}/{path.name} is read although byte {at} is wrong")
            except InvalidInputError as error:
                if "sha256" not in str(error):
                    faults.append(f"{path.parent.name}/{path.name}, byte {at}: {error}")
            path.write_bytes(good)
    return Trial(count, faults)


CHECKS = (Check("weights with a wrong bit are not loaded", "flipped bits", 8, 400, flipped_bits),)
