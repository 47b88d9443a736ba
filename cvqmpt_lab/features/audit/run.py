"""An audit of a folder: its files in several processes, rows of unchanged files kept."""

import hashlib
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from cvqmpt_lab.base.errors import InvalidInputError, few
from cvqmpt_lab.base.modules import Code, allow_code
from cvqmpt_lab.base.processes import end_with_parent, one_thread
from cvqmpt_lab.features.audit.episodes import Source, episodes_of, find_sources
from cvqmpt_lab.features.audit.judging import Auditor, Settings, whole_error
from cvqmpt_lab.features.audit.lerobot import INFO, read_info
from cvqmpt_lab.features.audit.rows import NOT_READ, REFUSED, Row, read_rows, write_rows
from cvqmpt_lab.features.audit.swapped import with_swapped_joints

ROWS_FILE = "rows.csv"
UNFINISHED = "~"  # behind the key of rows of a file that was not finished
EPISODES_OF_A_JOB = 50
MOST_PARTS = 64  # shares of one file
SAVED_EVERY_S = 5.0  # unfinished audits are written at most this often
Progress = Callable[[int, int, str], None]


class Job(NamedTuple):
    """A share of the episodes of one file."""

    source: Source
    part: int  # this one of `parts`
    parts: int
    key: str  # digest of file and settings
    have: frozenset[str] = frozenset()  # episodes whose rows are kept


def audit(
    folder: Path,
    settings: Settings,
    out: Path | None = None,
    jobs: int = 1,
    progress: Progress = lambda done, total, note: None,
) -> list[Row]:
    """Judge every episode below a folder; return one row each, by file and number.

    A file that cannot be read has one row, and so has every episode that a data set counts but
    does not have.

    Args:
        folder: the folder.
        settings: robot, units and so on.
        out: folder for `rows.csv`, which exists; rows in it of unchanged files are kept. None:
            nothing is written.
        jobs: number of processes.
        progress: called with the numbers of finished and of all files, and the name of one.

    Raises InvalidInputError for a folder without episodes and settings that cannot be used.
    """
    Auditor(settings)  # refuses wrong settings before anything is judged
    sources, stated = find_sources(folder), _digest_of(settings)
    kept = {} if out is None else _kept(out)
    found, ended, work = dict[str, list[Row]](), dict[str, list[Row]](), list[Job]()
    for source in sources:
        key = hashlib.sha256(f"{source.digest} {stated}".encode()).hexdigest()[:16]
        old = kept.get(source.name, [])
        if old and all(row.key == key for row in old):
            found[source.name] = old
            continue
        half = [row for row in old if row.key == key + UNFINISHED and row.episode]
        ended[source.name] = [replace(row, key=key) for row in half]
        parts = _parts(source, len(sources), jobs)
        have = frozenset(row.episode for row in half)
        work += [Job(source, part, parts, key, have) for part in range(parts)]
    saved = time.monotonic()
    left = {job.source.name: job.parts for job in work}
    try:
        for job, rows in _finished(work, settings, jobs):
            ended[job.source.name] += rows
            left[job.source.name] -= 1
            if not left[job.source.name]:
                found[job.source.name] = ended.pop(job.source.name)
            progress(len(found), len(sources), job.source.name)
            if out is not None and time.monotonic() - saved > SAVED_EVERY_S:
                write_rows(out / ROWS_FILE, _ordered(found | _unfinished(ended)))
                saved = time.monotonic()
    finally:  # an interrupted audit is continued by the same command
        if out is not None and (found or ended):
            write_rows(out / ROWS_FILE, _ordered(found | _unfinished(ended)))
    rows = _ordered(found)
    rows = with_swapped_joints(rows) + list(_absent(sources, rows))
    if out is not None:
        write_rows(out / ROWS_FILE, rows)
    return rows


def _parts(source: Source, files: int, jobs: int) -> int:
    """Return the number of jobs of a file: of LeRobot's version 2 there is one episode in each.

    Args:
        source: the file.
        files: number of all files.
        jobs: number of processes, which share the episodes of a file.
    """
    if source.root is None or source.path.stem.startswith("episode"):
        return 1
    count = 0
    with suppress(InvalidInputError):
        count = read_info(source.root).episodes or 0
    return max(jobs, min(count // (files * EPISODES_OF_A_JOB), MOST_PARTS))


def _unfinished(ended: dict[str, list[Row]]) -> dict[str, list[Row]]:
    """Return the rows of files that are not finished, marked as such."""
    return {
        name: [replace(row, key=row.key + UNFINISHED) for row in rows if row.episode]
        for name, rows in ended.items()
    }


def _ordered(found: dict[str, list[Row]]) -> list[Row]:
    """Return rows by file and by number of the episode."""
    return [
        row
        for name in sorted(found)
        for row in sorted(found[name], key=lambda row: (len(row.episode), row.episode))
    ]


def _kept(out: Path) -> dict[str, list[Row]]:
    """Return the rows of an earlier audit by file, without what whole data sets showed."""
    kept = dict[str, list[Row]]()
    for row in read_rows(out / ROWS_FILE):
        if row.key:
            kept.setdefault(row.file, []).append(row)
    # a fault that the other episodes showed is looked for again
    return {name: rows for name, rows in kept.items() if not any(_compared(row) for row in rows)}


def _compared(row: Row) -> bool:
    return row.verdict == REFUSED and row.kinds == "swapped" and "other episodes" in row.fault


def _digest_of(settings: Settings) -> str:
    """Return a digest of the version and of all that the rows depend on beside the file."""
    calibration = settings.calibration or {}
    scene = "" if settings.scene is None else Path(settings.scene).read_text(encoding="utf-8")
    robot = Auditor(settings).robot
    plain = [
        version("cvqmpt-lab"),
        json.dumps(dict(settings.robot), sort_keys=True, default=str),
        sorted(robot.files),
        settings.units,
        sorted((name, str(motor)) for name, motor in calibration.items()),
        scene,
        settings.rate,
        settings.column,
    ]
    return hashlib.sha256(repr(plain).encode()).hexdigest()


def _absent(sources: Sequence[Source], rows: Sequence[Row]) -> Iterator[Row]:
    """Yield a row for every data set that counts episodes which no file has."""
    for root in dict.fromkeys(source.root for source in sources if source.root is not None):
        files = {source.name for source in sources if source.root == root}
        own = [row for row in rows if row.file in files]
        if any(not row.episode for row in own):
            continue  # a broken file may have any of them
        with suppress(InvalidInputError):
            count, have = read_info(root).episodes or 0, {int(row.episode) for row in own}
            lacking = [str(k) for k in range(count) if k not in have]
            if lacking:
                why = f"{INFO} counts {count} episodes, no file has {few(lacking)}"
                yield Row(root.name, "", NOT_READ, fault=why)


def rows_of(job: Job, auditor: Auditor) -> list[Row]:
    """Return the rows of a job; an episode that cannot be judged has one that says why."""
    rows, file = list[Row](), job.source.name
    settings = auditor.settings
    try:
        for k, episode in enumerate(episodes_of(job.source, settings.column, settings.rate)):
            if k % job.parts != job.part or episode.name in job.have:
                continue
            try:
                row = auditor.row(file, episode)
            except Exception as error:  # one episode must not end the others
                row = Row(file, episode.name, NOT_READ, fault=whole_error(error))
            rows.append(replace(row, key=job.key))
    except Exception as error:
        if job.part == 0:
            rows.append(Row(file, "", NOT_READ, fault=whole_error(error), key=job.key))
    return rows


_OWN: list[Auditor] = []  # of a process of the pool, made when it begins


def _begin(parent: int, code_allowed: bool, settings: Settings) -> None:
    """Begin a process of an audit."""
    end_with_parent(parent)
    if code_allowed:
        allow_code()
    _OWN[:] = [Auditor(settings)]


def _rows_here(job: Job) -> list[Row]:
    """Return the rows of a job in a process of the pool."""
    with one_thread():
        return rows_of(job, _OWN[0])


def _finished(
    work: Sequence[Job], settings: Settings, jobs: int
) -> Iterator[tuple[Job, list[Row]]]:
    """Yield jobs and their rows as they end; a job whose process breaks twice has a row."""
    if jobs == 1 or len(work) < 2:
        auditor = Auditor(settings)
        for job in work:
            with one_thread():
                found = rows_of(job, auditor)
            yield job, found
        return
    waiting, broken = list(work), set[Job]()
    while waiting:
        # after a break, jobs that were under way run alone
        suspects = [job for job in waiting if job in broken]
        batch = suspects[:1] or waiting
        for job, rows in _batch(batch, settings, jobs):
            waiting.remove(job)
            if rows is None and job in broken:
                why = "its process ended: too large for the memory?"
                yield job, [Row(job.source.name, "", NOT_READ, fault=why, key="")]
            elif rows is None:
                broken.add(job)
                waiting.append(job)
            else:
                yield job, rows


def _batch(
    batch: Sequence[Job], settings: Settings, jobs: int
) -> Iterator[tuple[Job, list[Row] | None]]:
    """Yield jobs and their rows from a pool of processes; None after it broke."""
    context = multiprocessing.get_context("spawn")
    count = min(jobs, len(batch))
    given = os.getpid(), Code.allowed, settings
    with ProcessPoolExecutor(count, context, _begin, given) as pool:
        under_way: dict[Future[list[Row]], Job] = {
            pool.submit(_rows_here, job): job for job in batch
        }
        try:
            while under_way:
                done, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for future in done:
                    job = under_way.pop(future)
                    try:
                        yield job, future.result()
                    except BrokenProcessPool:
                        yield job, None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
