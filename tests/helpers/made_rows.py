"""Made rows for tests without a run."""

import json
from itertools import zip_longest

from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, ResultRow, write_rows

CLEAN = {"git_commit": "a" * 40, "git_dirty": False}
CONFIGURATION = {"suite": "place", "cutoff_s": 10.0, "tolerance": {"rad": 0.1}}


def a_row(problem="place_0", planner="birrt", **values):
    defaults = {"suite": "place", "seed": 0, "backend": "compiled", "solved": True}
    return ResultRow(problem=problem, planner=planner, **{**defaults, "certified": True, **values})


def a_failure(problem="place_0", planner="birrt", **values):
    return a_row(
        problem, planner, solved=False, certified=None, **{"fail_reason": "timeout", **values}
    )


def names(directory):
    return sorted(path.name for path in directory.iterdir())


def a_results_folder(tmp_path, **times):
    """Rows of 30 place problems; times [s] by planner (underscores for dashes), None: failed."""
    folder = tmp_path / "place-task"
    folder.mkdir()
    rows = []
    for name, time in times.items():
        values = {"suite": "place-task", "planner": name.replace("_", "-")}
        for k in range(30):
            if time is None:
                rows.append(a_failure(f"p{k}", **values, t_total_s=10.0))
                continue
            work = {"n_projections": 10, "n_state_checks": round(1000 * time), "vertices": 5}
            made = {"t_total_s": time * (1.0 + 0.01 * k), "path_length_rad": 6.0, **work}
            rows.append(a_row(f"p{k}", **values, **made))
    write_rows(folder / RUNS_FILE, rows)
    configuration = {"suite": "place-task", "cutoff_s": 10.0}
    record = {"configuration": configuration, "command": ["cvqmpt", "x"], "wall_s": 300.0}
    (folder / PROVENANCE_FILE).write_text(json.dumps(record | CLEAN))
    return tmp_path


def untimed(row):
    """The columns that a repeated run must reproduce."""
    return {} if row is None else {k: v for k, v in vars(row).items() if not k.startswith("t_")}


def differences(rows, again):
    """A line for every row that differs, with the first column that does."""
    found = []
    for one, two in zip_longest(rows, again):
        old, new = untimed(one), untimed(two)
        column = next((name for name in {**old, **new} if old.get(name) != new.get(name)), None)
        if column is not None:
            row = one or two
            found.append(f"{row.problem} {row.planner} seed {row.seed}: {column}")
    return found
