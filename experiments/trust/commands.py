"""The commands that write a folder step by step, small enough to be broken off and begun again many times."""

import contextlib
import csv
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.training.shards import INDEX_FILE, SHARDS_FOLDER, finished_shards
from experiments.trust import command
from experiments.trust.determinism import untimed

CURVES_FILE = "curves.csv"


@dataclass(frozen=True)
class Command:
    """A command that continues what is in its folder."""

    words: tuple[object, ...]
    """`cvqmpt WORDS --out DIR`."""
    result: Callable[[Path], object]
    """What must be the same, however often it was broken off."""
    kept: Callable[[Path], set]
    """What is finished in a folder, and must never be lost."""

    def finish(self, out: Path) -> None:
        """Run it to its end; RuntimeError when it fails."""
        done = command.run((*self.words, "--out", out))
        if done.returncode:
            raise RuntimeError(f"{self.words} ended with {done.returncode}: {done.stderr[-400:]}")


def _rows(out: Path) -> object:
    return [untimed(row) for row in read_rows(out / RUNS_FILE)]


def _shards(out: Path) -> object:
    files = sorted((out / SHARDS_FOLDER).iterdir())
    return [(file.name, file.read_bytes()) for file in files], (out / INDEX_FILE).read_bytes()


def _kept_shards(out: Path) -> set[object]:
    with contextlib.suppress(CvqmptError):
        return set(finished_shards(out))
    return set()


def _curves(out: Path) -> list[tuple[str, ...]]:
    """Lines of the curves, but for the time that they took."""
    if not (out / CURVES_FILE).is_file():
        return []
    with (out / CURVES_FILE).open(newline="") as file:
        return [tuple(v for k, v in row.items() if k != "seconds") for row in csv.DictReader(file)]


def _trained(out: Path) -> object:
    return [path.read_bytes() for path in sorted(out.glob("model/*.safetensors"))], _curves(out)


REPRODUCE = Command(
    ("reproduce", "place-task", "--problems", 3, "--planners", "birrt", "--iterations", 300, "--jobs", 2),
    _rows,
    lambda out: set(),
)
GENERATE = Command(
    ("data", "generate", "--scenes", 48, "--paths-per-scene", 1, "--family", "table", "--jobs", 2),
    _shards,
    _kept_shards,
)


@contextmanager
def training() -> Iterator[Command]:
    """A dictionary's training of twelve short epochs, saved after each, on data made for it."""
    from cvqmpt_lab.training.profiles import profile_named  # torch, which other commands do without

    smoke = profile_named("smoke")
    stage1 = replace(smoke.stage1, epochs=12, batches_per_epoch=5, restart_every=7, restart_epochs=9)
    with TemporaryDirectory() as parent:
        data, config = Path(parent) / "data", Path(parent) / "profile.json"
        GENERATE.finish(data)
        config.write_text(json.dumps(to_plain(replace(smoke, stage1=stage1), complete=True)))
        words = ("train", "stage1", "--config", config, "--data", data, "--device", "cpu")
        yield Command(words, _trained, lambda out: set(_curves(out)))
