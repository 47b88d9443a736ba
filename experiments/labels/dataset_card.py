"""What a dataset of training paths holds, as a page to read."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.training.dataset import PathDataset, open_dataset
from cvqmpt_lab.training.shards import DESCRIPTION_FILE


def dataset_card(folder: Path) -> str:
    """What a dataset holds, counted from its shards, and how far two labels of one problem lie apart."""
    dataset = open_dataset(folder, verify=False)
    every = range(len(dataset.families))
    lines = [
        f"# Training paths of {dataset.robot.name}",
        "",
        f"Recipe: `{json.dumps(read_json_object(folder / DESCRIPTION_FILE).get('recipe'))}`",
        "",
        "Scenes whose number is divisible by 20 validate, the others train. Twins are second, independent labels; "
        "the ratio is their mean waypoint distance over that from the first label to the straight line.",
        "",
        "| family | scenes | paths | trivial | length rad | straight rad | twins | twin / straight-line distance |",
        "|---|---|---|---|---|---|---|---|",
        *(_row(dataset, dataset.families[k], [k]) for k in every),
        _row(dataset, "all", every),
    ]
    return "\n".join(lines) + "\n"


def _row(dataset: PathDataset, name: str, families: Sequence[int]) -> str:
    """Counts and means of the scenes of some families."""
    scenes, paths = dataset.scenes, dataset.paths
    chosen = np.isin(scenes.family, families)
    own = chosen[paths.scene]
    first, twins = np.flatnonzero(own & (paths.twin_of < 0)), np.flatnonzero(own & (paths.twin_of >= 0))
    share = f"{100 * paths.trivial[first].mean():.0f} %" if len(first) else "-"
    means = [f"{array[first].mean():.2f}" if len(first) else "-" for array in (paths.length, paths.straight)]
    ratio = _ratio(dataset, twins)
    return (
        f"| {name} | {chosen.sum()} | {len(first)} | {share} | {' | '.join(means)} | {len(twins)} | {ratio} |"
    )


def _ratio(dataset: PathDataset, twins: np.ndarray) -> str:
    """Mean waypoint distance of twins to their first labels, over that of the latter to the straight line."""
    if len(twins) == 0:
        return "-"
    span = np.array(dataset.robot.upper) - np.array(dataset.robot.lower)
    apart = 0.0
    off_line = 0.0
    marks = np.linspace(0.0, 1.0, 32)
    for twin in twins.tolist():
        one, other = (
            _resampled(dataset.paths.joints(p) * span, marks) for p in (twin, dataset.paths.twin_of[twin])
        )
        line = other[0] + marks[:, None] * (other[-1] - other[0])
        apart += float(np.linalg.norm(one - other, axis=1).mean())
        off_line += float(np.linalg.norm(other - line, axis=1).mean())
    return f"{apart / off_line:.2f}" if off_line else "-"


def _resampled(path: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Waypoints of a path (t, n) at shares of their number."""
    places = np.linspace(0.0, 1.0, len(path))
    return np.stack([np.interp(marks, places, joint) for joint in path.T], axis=1)
