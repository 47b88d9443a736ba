"""Small data sets in the form of LeRobot, for tests of the audit."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

SO_ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
NAMES = tuple(f"{name}.pos" for name in SO_ARM)
HOME = np.array([0.0, -20.0, 20.0, 20.0, 0.0, 40.0])  # degrees, and per cent of the gripper
FPS = 30


def episode(seed, count=60, size=15.0):
    """Return smooth commands (m, 6) in degrees, the gripper in per cent."""
    rng = np.random.default_rng(seed)
    t = np.arange(count)[:, None] / FPS
    return HOME + size * np.sin(0.8 * rng.uniform(0.5, 1.0, 6) * t) * rng.uniform(-1.0, 1.0, 6)


def table_of(action, number=0, state=None, **changes):
    """Return the parquet table of an episode; a change None leaves a column out."""
    m, n = action.shape
    kind = pa.list_(pa.float32(), n)
    late = np.vstack([action[:1], action[:-1]]) if state is None else state
    columns = {
        "action": pa.array(list(action.astype(np.float32)), type=kind),
        "observation.state": pa.array(list(late.astype(np.float32)), type=kind),
        "timestamp": pa.array((np.arange(m) / FPS).astype(np.float32)),
        "frame_index": np.arange(m),
        "episode_index": np.full(m, number),
        **changes,
    }
    return pa.table({name: column for name, column in columns.items() if column is not None})


def write_info(root, names=NAMES, fps=FPS, episodes=None, **changes):
    """Write meta/info.json of a data set."""
    feature = {"dtype": "float32", "shape": [6], "names": names and list(names)}
    features = {"action": feature, "observation.state": feature}
    info = {"codebase_version": "v3.0", "fps": fps, "total_episodes": episodes}
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta" / "info.json").write_text(json.dumps({**info, "features": features, **changes}))


def write_set(root, tables, version=3, **info):
    """Write a data set: all episodes in one file, or of version 2 one file an episode."""
    write_info(root, episodes=len(tables), **info)
    folder = root / "data" / "chunk-000"
    folder.mkdir(parents=True, exist_ok=True)
    if version == 3:
        pq.write_table(pa.concat_tables(tables), folder / "file-000.parquet")
    else:
        for k, table in enumerate(tables):
            pq.write_table(table, folder / f"episode_{k:06d}.parquet")
    return root
