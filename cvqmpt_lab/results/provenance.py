"""Where numbers come from: commit, versions, machine, seeds and configuration of a results directory."""

import contextlib
import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cvqmpt_lab.errors import RunStoreError

SCHEMA = "1"
PROVENANCE_FILE = "provenance.json"

_PACKAGES = (
    "coal",
    "cvqmpt-lab",
    "example-robot-data",
    "numba",
    "numpy",
    "ompl",
    "pin",
    "rerun-sdk",
    "scipy",
    "torch",
)
_THREAD_VARIABLES = ("MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_CHECKOUT = Path(__file__).resolve().parents[2]


def provenance(
    command: Sequence[str],
    configuration: Mapping[str, object],
    seeds: Iterable[int],
    model_hash: str | None = None,
    *,
    calibration_ns: float | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Describe one session of runs, ready for json; unknown facts are None and nothing here fails.

    Parameters
    ----------
    command
        The command line, as words.
    configuration
        The settings that every run of the table shares; see `results.RunStore.open`.
    seeds
        Seeds of the runs.
    model_hash
        sha256 of the checkpoint in use; None when no model was used.
    calibration_ns
        Time of one pass of a fixed kernel [ns], measured by the caller, to compare machines.
    threads
        Threads the caller gave to one run.
    """
    commit, dirty = _git_state(_CHECKOUT)
    return {
        "schema": SCHEMA,
        "date_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": [str(word) for word in command],
        "configuration": dict(configuration),
        "seeds": [int(seed) for seed in seeds],
        "model_hash": model_hash,
        "git_commit": commit,
        "git_dirty": dirty,
        "versions": {name: _version(name) for name in _PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_model": _cpu_model(),
        "cpu_count": os.cpu_count(),
        "gpu": None,
        "threads": threads,
        "thread_variables": {name: os.environ.get(name) for name in _THREAD_VARIABLES},
        "calibration_ns": calibration_ns,
    }


def _git_state(checkout: Path) -> tuple[str | None, bool | None]:
    """Commit and whether the tree has uncommitted changes; (None, None) where this is not a checkout."""
    top = _git(checkout, "rev-parse", "--show-toplevel")
    if top is None or Path(top) != checkout:  # e.g. installed in an environment inside another repository
        return None, None
    commit, changes = _git(checkout, "rev-parse", "--verify", "HEAD"), _git(checkout, "status", "--porcelain")
    return commit, None if changes is None else bool(changes)


def _git(directory: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(directory), *arguments], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None
    return done.stdout.strip()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str | None:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or None


@dataclass(frozen=True)
class ProvenanceFile:
    """``provenance.json`` of a results directory: the first session, and later ones under ``continued``."""

    directory: Path

    @property
    def path(self) -> Path:
        """The json file."""
        return self.directory / PROVENANCE_FILE

    def read(self) -> dict[str, Any]:
        """Return the whole record.

        Raises
        ------
        RunStoreError
            When the file is missing, is not json, or holds no configuration.
        """
        try:
            record = json.loads(self.path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise RunStoreError(
                f"{self.directory} has no {PROVENANCE_FILE}, so its runs cannot be traced; use another --out"
            ) from None
        except OSError as error:
            raise RunStoreError(f"cannot read {self.path}: {error.strerror}; use another --out") from error
        except (ValueError, RecursionError) as error:  # not UTF-8, not json, or nested too deeply
            raise RunStoreError(f"{self.path} is not json ({error}); use another --out") from error
        if not isinstance(record, dict) or not isinstance(record.get("configuration"), dict):
            raise RunStoreError(f"{self.path} records no configuration; use another --out")
        return record

    def create(self, configuration: Mapping[str, object], session: Mapping[str, object]) -> None:
        """Write the record of a new directory."""
        record = {**as_json("the provenance", session), "schema": SCHEMA}
        record["configuration"] = as_json("the configuration", configuration)
        self._write(record)

    def require_equal(self, configuration: Mapping[str, object]) -> None:
        """Raise RunStoreError, naming the settings, unless the recorded configuration equals this one."""
        differences = _differences(self.read()["configuration"], as_json("the configuration", configuration))
        if differences:
            raise RunStoreError(
                f"{self.directory} holds runs of another configuration ({'; '.join(differences)}); "
                "use another --out"
            )

    def add_continuation(self, session: Mapping[str, object]) -> None:
        """List a later session (its commit, machine, date, ...) under ``continued``."""
        record = self.read()
        later = {k: v for k, v in as_json("the provenance", session).items() if k != "configuration"}
        self._write({**record, "continued": [*record.get("continued", []), later]})

    def _write(self, record: Mapping[str, object]) -> None:
        write_text_atomic(self.path, json.dumps(record, indent=2, sort_keys=True) + "\n")


def as_json(what: str, value: Mapping[str, object]) -> dict[str, Any]:
    """Return the value as json would give it back (tuples become lists); RunStoreError when it cannot."""
    try:
        return json.loads(json.dumps(dict(value), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise RunStoreError(f"{what} cannot be json ({error}); use finite numbers, text and lists") from error


def _differences(recorded: object, asked: object, name: str = "") -> list[str]:
    """Describe every setting in which two json values differ, nested ones by dotted name."""
    if not (isinstance(recorded, dict) and isinstance(asked, dict)):
        return [] if recorded == asked else [f"{name} was {json.dumps(recorded)}, now {json.dumps(asked)}"]
    found = []
    for key in sorted(recorded.keys() | asked.keys()):
        found += _differences(recorded.get(key), asked.get(key), f"{name}.{key}" if name else key)
    return found


def write_text_atomic(path: Path, text: str) -> None:
    """Write UTF-8 text as `write_bytes_atomic` does."""
    write_bytes_atomic(path, text.encode("utf-8"))


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write data to a temporary file in the same folder and move it into place.

    Raises
    ------
    RunStoreError
        When the folder cannot be written to; the old file, if any, is then unchanged.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as handle:
            handle.write(data)
            handle.flush()
            os.fsync(handle.fileno())
        temporary.replace(path)
    except OSError as error:
        raise RunStoreError(f"cannot write {path}: {error.strerror}; choose a writable folder") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
