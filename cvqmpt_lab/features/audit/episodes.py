"""Episodes of a folder: data sets of LeRobot, and every file that `cvqmpt certify` reads."""

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.features.audit.lerobot import INFO, read_episodes, read_info
from cvqmpt_lab.features.motion.bags import SUFFIXES as BAG_SUFFIXES
from cvqmpt_lab.features.motion.bags import is_bag
from cvqmpt_lab.features.motion.trajectory import Motion, read_motion

SUFFIXES = (".csv", ".npz", ".json", ".yaml", ".yml", *BAG_SUFFIXES)
MOST_BYTES = 2**30  # of a file; larger ones are not read


@dataclass(frozen=True)
class Source:
    """A file with one episode, or with several of a data set of LeRobot."""

    name: str  # path below the folder of the audit
    path: Path
    root: Path | None = None  # folder of its data set; None: it belongs to none

    @property
    def digest(self) -> str:
        """Hash of the file, and of what describes its data set."""
        files = self.files if self.root is None else [*self.files, self.root / INFO]
        found = hashlib.sha256()
        for file in files:
            with suppress(OSError), file.open("rb") as stream:  # one that is lost has a row
                found.update(hashlib.file_digest(stream, "sha256").digest())
        return found.hexdigest()

    @property
    def files(self) -> list[Path]:
        """The file, or those of a recording's folder."""
        if not self.path.is_dir():
            return [self.path]
        return sorted(file for file in self.path.iterdir() if file.is_file())


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode in the units of its file."""

    name: str  # number in its data set, or ""
    motion: Motion  # states, perhaps times
    other: np.ndarray | None = None  # (m, n) measured positions where commanded ones are judged
    period: float | None = None  # usual step of time [s]; None: that of the times
    of_lerobot: bool = False


def find_sources(folder: Path) -> list[Source]:
    """Return the files with episodes below a folder, by name; hidden ones are left out."""
    if not folder.is_dir():
        raise InvalidInputError(f"{folder} is no folder: give one with the files of episodes")
    roots = [path.parents[1] for path in sorted(folder.rglob(INFO)) if _shown(path, folder)]
    found = list[Source]()
    for path in sorted(folder.rglob("*")):
        root = next((root for root in roots if path.is_relative_to(root)), None)
        if not _shown(path, folder) or is_bag(path.parent):
            continue
        if root is not None:
            wanted = path.suffix == ".parquet" and (root / "data") in path.parents
        else:
            wanted = path.suffix.lower() in (*SUFFIXES, ".parquet") or is_bag(path)
        if wanted and (path.is_file() or is_bag(path)):
            found.append(Source(str(path.relative_to(folder)), path, root))
    if not found:
        raise InvalidInputError(
            f"{folder} has no episodes: no data set of LeRobot ({INFO}) and no file "
            f"{', '.join(SUFFIXES)}"
        )
    return found


def _shown(path: Path, folder: Path) -> bool:
    """Return whether no part of a path below a folder is hidden."""
    return not any(part.startswith(".") for part in path.relative_to(folder).parts)


def episodes_of(source: Source, column: str, rate: float | None) -> Iterator[Episode]:
    """Yield the episodes of a source; InvalidInputError: it cannot be read.

    Args:
        source: the file.
        column: which positions of a data set of LeRobot are judged.
        rate: samples a second where the file does not say; None: not given.
    """
    size = sum(file.stat().st_size for file in source.files)
    if size > MOST_BYTES:
        raise InvalidInputError(
            f"it has {size / 2**20:.0f} MB, at most {MOST_BYTES / 2**20:.0f} are read: write its "
            "episodes in several files"
        )
    if source.path.suffix == ".parquet":
        if source.root is None:
            raise InvalidInputError(f"no {INFO} beside it says what its columns are")
        info = read_info(source.root)
        fps = info.fps or rate
        for found in read_episodes(source.path, info, column, rate):
            motion = Motion(found.names, found.positions, found.times, in_seconds=True)
            period = None if fps is None else 1.0 / fps
            yield Episode(str(found.number), motion, found.other, period, True)
        return
    motion = read_motion(source.path)
    if motion.times is None:
        if rate is None:
            raise InvalidInputError("it has no times: give --rate, samples a second")
        times = np.arange(len(motion.positions)) / rate
        motion = Motion(motion.joint_names, motion.positions, times, limits=motion.limits)
    yield Episode("", motion)
