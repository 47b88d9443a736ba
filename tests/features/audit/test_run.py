"""Audits of folders: one row an episode, bad input has a row with its reason, the rest goes on."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from data_sets import NAMES, SO_ARM, episode, table_of, write_info, write_set
from refusals import refused

from cvqmpt_lab.features.audit import episodes, parquet, run
from cvqmpt_lab.features.audit.judging import Settings
from cvqmpt_lab.features.audit.rows import Row, read_rows, worst_first, write_rows
from cvqmpt_lab.features.audit.run import audit

SETTINGS = Settings({"name": "so-arm101"}, "degrees")


def verdicts(rows):
    return {row.name: row.verdict for row in rows}


@pytest.mark.parametrize("version", [2, 3])
def test_every_episode_of_a_data_set_has_a_row(tmp_path, version):
    tables = [table_of(episode(k), k) for k in range(3)]
    rows = audit(write_set(tmp_path / "set", tables, version), SETTINGS)
    assert [row.verdict for row in rows] == ["certified"] * 3
    assert [row.episode for row in rows] == ["0", "1", "2"]
    for row in rows:
        assert row.states == 60 and row.duration_s == pytest.approx(59 / 30, abs=1e-3)
        assert row.self_mm > 0.0 and 0.0 < row.position < 1.0 and 0.0 < row.velocity < 0.1
        assert row.acceleration is None and row.jumps == row.gaps == row.repeated == 0
        assert {*row.medians} == {*SO_ARM}


def bent(change):
    """Return an episode in which `change` has changed the commands."""
    action = episode(0)
    changed = change(action)
    return action if changed is None else changed


def test_faults_have_a_kind_a_place_and_a_joint(tmp_path):
    def beyond(q):
        q[:, 1] += np.linspace(0.0, -120.0, len(q))

    def spike(q):
        q[30, 2] += 30.0

    def nan(q):
        q[17, 3] = np.nan

    cases = {
        "limits": (bent(beyond), ""),
        "jump": (bent(spike), "elbow_flex"),
        "nan": (bent(nan), "wrist_flex"),
        "units": (np.radians(episode(0)), ""),
        "collision": (bent(lambda q: fold(q)), "gripper_link"),
    }
    tables = [table_of(action, k) for k, (action, _) in enumerate(cases.values())]
    rows = audit(write_set(tmp_path, tables), SETTINGS)
    for row, (kind, (_, joint)) in zip(rows, cases.items(), strict=True):
        assert row.verdict == "refused" and kind in row.kinds.split(), (kind, row)
        assert joint in row.joint, (kind, row)
    assert rows[0].position > 1.0 and rows[1].time_s == pytest.approx(1.0, abs=0.05)


def fold(q):
    """Fold the arm onto itself, within its limits."""
    q[:, 1:4] = np.linspace(0.0, 1.0, len(q))[:, None] * [-95.0, 95.0, 90.0]


def test_degrees_that_are_stated_as_radians_are_named(tmp_path):
    root = write_set(tmp_path, [table_of(episode(0))])
    (row,) = audit(root, replace(SETTINGS, units="radians"))
    assert (row.verdict, row.kinds) == ("refused", "units") and "degrees" in row.fault


def test_bad_input_has_a_row_and_the_rest_goes_on(tmp_path, monkeypatch):
    root = write_set(tmp_path / "good", [table_of(episode(0))])
    folder = root / "data" / "chunk-000"
    (folder / "file-001.parquet").write_bytes((folder / "file-000.parquet").read_bytes()[:300])
    pq.write_table(table_of(episode(1))[:0], folder / "file-002.parquet")
    pq.write_table(table_of(episode(1))[:1], folder / "file-003.parquet")
    pq.write_table(pa.table({"other": [1.0]}), folder / "file-004.parquet")
    text = pa.array(["a"] * 60)
    pq.write_table(table_of(episode(1), timestamp=text), folder / "file-005.parquet")
    other = write_set(tmp_path / "other robot", [table_of(episode(0))], names=list("abcdef"))
    less = write_set(tmp_path / "missing joint", [table_of(episode(0)[:, :5])], names=NAMES[1:])
    wrong = write_set(tmp_path / "wrong info", [table_of(episode(0))], names=NAMES[1:])
    no_fps = write_set(tmp_path / "no fps", [table_of(episode(0), timestamp=None)], fps=None)
    write_info(tmp_path / "fps 0", fps=0)
    (tmp_path / "plain.csv").write_text("1,2,x\n")
    monkeypatch.setattr(episodes, "MOST_BYTES", 2**20)
    (tmp_path / "huge.csv").write_bytes(bytes(2**21))
    rows = {row.file: row for row in audit(tmp_path, SETTINGS)}
    reasons = {
        "file-001": "no whole parquet file",
        "file-002": "empty",
        "file-003": "one state",
        "file-004": "no column action or observation.state",
        "file-005": "column 'timestamp'",
        f"{other.name}/": "no joint shoulder_pan, shoulder_lift",
        f"{less.name}/": "no joint shoulder_pan;",
        f"{wrong.name}/": "names 5 joints",
        f"{no_fps.name}/": "give --rate",
        "plain.csv": "no states under it",
        "huge.csv": "2 MB, at most 1 are read",
    }
    for part, why in reasons.items():
        (row,) = (row for file, row in rows.items() if part in file)
        assert row.verdict == "not read" and why in row.fault, (part, row.fault)
    assert rows["good/data/chunk-000/file-000.parquet"].verdict == "certified"
    assert len(rows) == len(reasons) + 1


def test_a_file_with_too_many_rows_or_numbers_is_refused_before_it_is_read(tmp_path, monkeypatch):
    root = write_set(tmp_path, [table_of(episode(0))])
    monkeypatch.setattr(parquet, "MOST_NUMBERS", 100)
    (row,) = audit(root, SETTINGS)
    assert row.verdict == "not read" and "more than 100 numbers" in row.fault
    monkeypatch.setattr(parquet, "MOST_ROWS", 50)
    (row,) = audit(root, SETTINGS)
    assert row.verdict == "not read" and "60 rows, at most 50 are read" in row.fault


def test_stamps_gaps_and_missing_times(tmp_path):
    twice, late = (np.arange(60) / 30 for _ in range(2))
    twice[20] = twice[19]
    late[30:] += 0.5
    tables = [
        table_of(episode(k), k, timestamp=pa.array(times)) for k, times in enumerate((twice, late))
    ]
    rows = audit(write_set(tmp_path / "a", tables), SETTINGS)
    assert [row.kinds for row in rows] == ["stamps", "gap"]
    assert rows[0].repeated == 1 and rows[1].largest_gap_s == pytest.approx(0.5 + 1 / 30, abs=1e-4)
    bare = write_set(tmp_path / "b", [table_of(episode(0), timestamp=None)], fps=None)
    (row,) = audit(bare, replace(SETTINGS, rate=30.0))
    assert row.verdict == "certified" and row.duration_s == pytest.approx(59 / 30, abs=1e-3)


def test_files_that_certify_reads_are_episodes_too(tmp_path, panda):
    t = np.arange(40) / 20.0
    q = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]) + 0.2 * np.sin(t)[:, None]
    header = ",".join(["time", *panda.joint_names])
    rows = "\n".join(",".join(map(str, [a, *b])) for a, b in zip(t, q, strict=True))
    (tmp_path / "a.csv").write_text(f"{header}\n{rows}\n")
    np.savez(tmp_path / "b.npz", q=q)
    points = [
        {"positions": b.tolist(), "time_from_start": {"sec": 0, "nanosec": int(1e9 * a)}}
        for a, b in zip(t[:19], q[:19], strict=True)
    ]
    message = {"joint_names": list(panda.joint_names)[::-1], "points": points}
    (tmp_path / "c.json").write_text(json.dumps(message))
    rows = audit(tmp_path, Settings({"name": "panda"}, rate=20.0))
    assert [row.file for row in rows] == ["a.csv", "b.npz", "c.json"]
    assert [row.verdict for row in rows] == ["certified", "certified", "refused"]
    assert "no names" in rows[1].note and rows[0].effort > 0.0


def test_rows_of_unchanged_files_are_kept(tmp_path, monkeypatch):
    root = write_set(tmp_path / "set", [table_of(episode(k), k) for k in range(3)], 2)
    out = tmp_path / "out"
    out.mkdir()
    first = audit(root, SETTINGS, out)
    judged = list[str]()
    own = run.rows_of
    monkeypatch.setattr(
        run, "rows_of", lambda job, auditor: judged.append(job.source.name) or own(job, auditor)
    )
    assert audit(root, SETTINGS, out) == first == read_rows(out / "rows.csv") and not judged
    folder = root / "data" / "chunk-000"
    pq.write_table(table_of(np.radians(episode(1)), 1), folder / "episode_000001.parquet")
    (folder / "episode_000002.parquet").unlink()
    rows = audit(root, SETTINGS, out)
    assert judged == ["data/chunk-000/episode_000001.parquet"]
    assert [row.verdict for row in rows] == ["certified", "refused", "not read"]
    assert "counts 3 episodes, no file has 2" in rows[2].fault
    judged.clear()
    audit(root, replace(SETTINGS, rate=30.0), out)  # other settings
    assert len(judged) == 2
    (out / "rows.csv").write_text("nonsense\n1,2\n")
    assert len(audit(root, SETTINGS, out)) == 3


def test_an_interrupted_audit_goes_on_inside_of_a_file(tmp_path, monkeypatch):
    root = write_set(tmp_path / "set", [table_of(episode(k), k) for k in range(4)])
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.setattr(run, "_parts", lambda *_: 2)
    own = run.rows_of

    def broken(job, auditor):
        if job.part == 1:
            raise KeyboardInterrupt
        return own(job, auditor)

    monkeypatch.setattr(run, "rows_of", broken)
    with pytest.raises(KeyboardInterrupt):
        audit(root, SETTINGS, out)
    assert [row.episode for row in read_rows(out / "rows.csv")] == ["0", "2"]
    seen = list[str]()
    row_of = run.Auditor.row
    monkeypatch.setattr(run, "rows_of", own)
    monkeypatch.setattr(
        run.Auditor, "row", lambda me, file, one: seen.append(one.name) or row_of(me, file, one)
    )
    rows = audit(root, SETTINGS, out)
    assert seen == ["1", "3"] and [row.episode for row in rows] == ["0", "1", "2", "3"]
    assert len({row.key for row in rows}) == 1


def test_two_processes_give_the_same_rows(tmp_path):
    root = write_set(tmp_path / "set", [table_of(episode(k), k) for k in range(4)])
    assert audit(root, SETTINGS, jobs=2) == audit(root, SETTINGS)


def test_an_episode_with_two_swapped_joints_is_found_among_the_others(tmp_path):
    tables = [table_of(episode(k, size=5.0), k) for k in range(9)]
    odd = episode(3, size=5.0)[:, [0, 2, 1, 3, 4, 5]]
    rows = audit(write_set(tmp_path, [*tables, table_of(odd, 9)]), SETTINGS)
    assert [row.verdict for row in rows] == ["certified"] * 9 + ["refused"]
    assert rows[9].kinds == "swapped" and "shoulder_lift and elbow_flex" in rows[9].fault


def test_a_folder_without_episodes_is_refused(tmp_path):
    refused("has no episodes", audit, tmp_path, SETTINGS)
    refused("is no folder", audit, tmp_path / "none", SETTINGS)


def test_rows_survive_their_file_and_the_worst_are_first(tmp_path):
    rows = [
        Row("a", "1", "certified", velocity=0.5, middle='{"j": 0.5}', key="k"),
        Row("b", "", "not read", fault="it, is\n broken"),
        Row("c", "", "refused", "limits jump", "x", "j", 0.5, 10, 0.3, 1.2),
    ]
    write_rows(tmp_path / "r.csv", rows)
    assert read_rows(tmp_path / "r.csv") == rows
    assert [row.file for row in worst_first(rows)] == ["c", "b", "a"]
