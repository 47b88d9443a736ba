"""Hostile files give a result or one line within 1 s, start no process, write nothing elsewhere."""

import shutil

import numpy as np
import pytest
from fuzz.isolation import judge
from fuzz.readers import READERS
from hypothesis import given, seed, settings
from refusals import refused

from cvqmpt_lab.vqmpt.weights import SHIPPED, WEIGHTS_FOLDER, read_model

AT_ONCE = 1000  # files that hypothesis draws before it forgets those it has drawn


def promised(reader):
    mark = pytest.mark.promise(
        reader.promise,
        "files",
        ci=4 if reader.seconds > 1 else 20,
        long=reader.long,
    )
    return pytest.param(reader, marks=mark, id=f"{reader.kind}: {reader.file}")


@pytest.mark.parametrize("reader", map(promised, READERS))
def test_hostile_files(reader, trials):
    content = reader.good()
    with judge(reader) as fault:
        assert fault(content) == "", "of the good file"

        def attempt(hostile):
            assert fault(hostile) == ""

        for first in range(0, trials, AT_ONCE):
            examples = settings(max_examples=min(AT_ONCE, trials - first))
            seed(first)(examples(given(reader.mutated(content))(attempt)))()


@pytest.mark.promise("weights with a wrong bit are not loaded", "flipped bits", ci=8, long=400)
def test_a_wrong_bit_of_shipped_weights(tmp_path, trials):
    rng = np.random.default_rng(0)
    for name in SHIPPED:
        shutil.copytree(WEIGHTS_FOLDER / name, tmp_path / name)
    files = sorted(tmp_path.rglob("*.safetensors"))
    for trial in range(trials):
        path = files[trial % len(files)]
        good = path.read_bytes()
        spoiled = bytearray(good)
        spoiled[rng.integers(len(good))] ^= 1 << int(rng.integers(8))
        path.write_bytes(spoiled)
        refused("sha256", read_model, path.parent)
        path.write_bytes(good)
