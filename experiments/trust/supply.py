"""What is planned with is what was made: weights of the stated hashes, pinned distributions, known licences."""

import shutil
import tempfile
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.models.stored import read_model
from cvqmpt_lab.prediction.weights import SHIPPED, WEIGHTS
from experiments.trust.check import Check, Trial
from experiments.trust.inventory import (
    LICENCES,
    ROOT,
    UNKNOWN,
    distributions,
    pinned,
    robots,
    weights,
)


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


def installed_as_pinned(_: int) -> Trial:
    """Distributions of another version than constraints.txt pins."""
    pins = pinned()
    faults = [
        f"{item.name} {item.version} is installed, constraints.txt has {pins.get(item.name)}"
        for item in distributions()
        if item.version != pins.get(item.name)
    ]
    return Trial(len(distributions()), faults)


def known_licences(_: int) -> Trial:
    """What ships under a licence that nobody states, or that LICENSES.md does not list as it is stated."""
    shipped, page = [*distributions(), *robots(), *weights()], read_text(ROOT / LICENCES)
    faults = [f"{item.name} states no licence" for item in shipped if item.licence == UNKNOWN]
    faults += [
        f"{LICENCES} does not say that {item.name} is under {item.licence}; run make inventory"
        for item in shipped
        if f"| {item.name} | {item.licence} |" not in page
    ]
    return Trial(len(shipped), faults)


CHECKS = (
    Check("weights with a wrong bit are not loaded", "flipped bits", 8, 400, flipped_bits),
    Check("what is installed is what is pinned", "distributions", 1, 1, installed_as_pinned),
    Check("all that ships states its licence", "components", 1, 1, known_licences),
)
