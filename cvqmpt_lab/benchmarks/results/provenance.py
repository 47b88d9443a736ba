"""Provenance of a results directory: commit, versions, machine, weights, seeds, settings."""

import contextlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.arithmetic import facts
from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import RunStoreError, located
from cvqmpt_lab.base.files import differences, read_json_object, write_text

PROVENANCE_FILE = "provenance.json"

# Number of the rule by which `PlanningProblem.random_stream` seeds; rows are compared with rows of
# the same rule. 1: by the start alone.
STREAMS = 2
SESSION_DIGESTS = ("weights", "problem_files", "planners")
"""Fields of a session that map names to digests (of `planners`: to versions).

All sessions of a directory must have equal values for equal names."""


def provenance(
    command: Sequence[str] = (),
    seeds: Iterable[int] = (),
    weights: Mapping[str, str] | None = None,
    processes: int | None = None,
    problems: Mapping[str, str] | None = None,
    planners: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return a description of one session of runs for JSON; unknown facts are None.

    Args:
        command: words of the command line.
        seeds: seeds of the runs.
        weights: digest of each model that is used, by the model's name.
        processes: number of runs at the same time.
        problems: digest of each problem that was read from a file, by the problem's name.
        planners: Python distributions and versions of each external planner, by its name.
    """
    commit, dirty = _git_state(Path(__file__).resolve().parents[3])
    cpus = cpu_facts(r"^model name\s*: (.*)$")
    packages = (
        "coal cvqmpt-lab example-robot-data mujoco numba numpy ompl pin rerun-sdk scipy torch"
    )
    threads = [f"{name}_NUM_THREADS" for name in ("MKL", "NUMBA", "OMP", "OPENBLAS")]
    return {
        "date_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": [str(word) for word in command],
        "seeds": [int(seed) for seed in seeds],
        "weights": dict(weights or {}),
        "git_commit": commit,
        "git_dirty": dirty,
        "versions": {name: _version(name) for name in packages.split()},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_model": cpus[0] if cpus else platform.processor() or None,
        "cpu_count": os.cpu_count(),
        "arithmetic": facts(),
        "processes": processes,
        **({"problem_files": dict(problems)} if problems else {}),
        **({"planners": dict(planners)} if planners else {}),
        "thread_variables": {name: os.environ.get(name) for name in threads},
    }


def _git_state(checkout: Path) -> tuple[str | None, bool | None]:
    """Return the commit and whether there are uncommitted changes, or (None, None)."""
    top = _git(checkout, "rev-parse", "--show-toplevel")
    # an installed package may be inside another repository
    if top is None or Path(top) != checkout:
        return None, None
    changes = _git(checkout, "status", "--porcelain")
    commit = _git(checkout, "rev-parse", "--verify", "HEAD")
    return commit, None if changes is None else bool(changes)


def _git(directory: Path, *arguments: str) -> str | None:
    try:
        words = ["git", "-C", str(directory), *arguments]
        done = subprocess.run(words, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None
    return done.stdout.strip()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def cpu_facts(pattern: str) -> list[str]:
    """Return all matches of a regular expression in /proc/cpuinfo; none if it does not exist."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        return re.findall(pattern, text, re.MULTILINE)
    return []


def sessions(record: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return all sessions of a record, the oldest first."""
    return [record, *record.get("continued", [])]


def streams_of(session: Mapping[str, Any]) -> int:
    """Return the number of the rule that seeds random streams, see STREAMS."""
    return int(session.get("streams") or 1)


def digests_in(record: Mapping[str, Any], field: str) -> dict[str, str]:
    """Return digests by name from all sessions of a record; field: one of `SESSION_DIGESTS`."""
    found: dict[str, str] = {}
    for session in sessions(record):
        found |= session.get(field, {})
    return found


def unlike_settings(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return a line for each setting, and each digest of a name in both records, that differs."""
    old, new = (json.loads(json.dumps(record["configuration"])) for record in (before, now))
    for field in SESSION_DIGESTS:
        known, used = digests_in(before, field), digests_in(now, field)
        both = known.keys() & used.keys()
        old[field], new[field] = ({name: x[name] for name in both} for x in (known, used))
    for settings, record in ((old, before), (new, now)):
        settings["rule of random streams"] = min(map(streams_of, sessions(record)))
    return differences(old, new)


@dataclass(frozen=True)
class ProvenanceFile:
    """``provenance.json`` of a results directory: first session, later ones under ``continued``."""

    directory: Path

    @property
    def path(self) -> Path:
        """Path of the JSON file."""
        return self.directory / PROVENANCE_FILE

    def read(self) -> dict[str, Any]:
        """Return the whole record; InvalidInputError if it is missing or malformed."""
        if not self.path.is_file():
            raise RunStoreError(
                f"{self.directory} has no {PROVENANCE_FILE}, so its runs cannot be traced; use "
                "another --out"
            )
        record = read_json_object(self.path)
        of_session: dict[str, Any] = {
            **dict.fromkeys(
                ("git_commit", "cpu_model", "date_utc", "platform", "profile"), str | None
            ),
            **dict.fromkeys(("versions", "arithmetic"), Mapping[str, Any]),
            "command": tuple[str, ...] | None,
            "git_dirty": bool | None,
            **dict.fromkeys(("cpu_count", "streams"), int | None),
            "wall_s": float,
            **dict.fromkeys(SESSION_DIGESTS, Mapping[str, Any]),
        }
        of_settings = {
            "suite": str,
            **dict.fromkeys(("cutoff_s", "cost_s"), float | None),
            "iterations": int | None,
        }
        with located(f"{self.path}"):
            later = from_plain(
                tuple[Mapping[str, Any], ...], record.get("continued", []), "continued"
            )
            settings = from_plain(Mapping[str, Any], record.get("configuration"), "configuration")
            checked = [(session, of_session) for session in (record, *later)]
            for part, types in (*checked, (settings, of_settings)):
                for name in types.keys() & part.keys():
                    from_plain(types[name], part[name], name)
            for session in (record, *later):
                for field in SESSION_DIGESTS:
                    for name, digest in session.get(field, {}).items():
                        from_plain(str, digest, f"{field}.{name}")
        return record

    def create(self, configuration: Mapping[str, object], session: Mapping[str, object]) -> None:
        """Write the record of a new directory."""
        self._write({**session, "configuration": dict(configuration)})

    def require_same(self, configuration: Mapping[str, object], session: Mapping[str, Any]) -> None:
        """Raise RunStoreError if the configuration, or a digest in both, differs from the file."""
        found = unlike_settings(self.read(), {**session, "configuration": configuration})
        if found:
            raise RunStoreError(
                f"{self.directory} holds runs of another configuration ({'; '.join(found)}); use "
                "another --out"
            )

    def add_continuation(self, session: Mapping[str, object]) -> None:
        """Add a later session (its commit, machine, date, ...) to the list ``continued``."""
        record = self.read()
        self._write({**record, "continued": [*record.get("continued", []), dict(session)]})

    def add_wall_clock(self, seconds: float) -> None:
        """Write the duration of the last session [s] into the file."""
        record = self.read()
        last: Any = sessions(record)[-1]  # part of `record`, changed in place
        last["wall_s"] = round(seconds, 1)
        self._write(record)

    def _write(self, record: Mapping[str, object]) -> None:
        text = json.dumps(record, indent=2, sort_keys=True, allow_nan=False)
        write_text(self.path, text + "\n")
