"""Training paths: random scenes, near-shortest unconstrained motions in them, in shards that can be resumed.

The folder's format is described in `cvqmpt_lab.training.dataset`, which reads it. A shard depends on the
recipe and its own number alone, so a dataset is the same however often it was interrupted. Scene numbers
start at FIRST_SCENE: the scenes of evaluation suites have smaller ones.
"""

import csv
import hashlib
import io
import json
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.kernels.search.motion import motion_free
from cvqmpt_lab.planning.near_shortest import NearShortestSettings, near_shortest
from cvqmpt_lab.planning.result import Path as Motion
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere
from cvqmpt_lab.training.shards import DESCRIPTION_FILE, FULL_SCALE, INDEX_FILE, SCHEMA, SHARDS_FOLDER

FIRST_SCENE = 10_000_000
SCENES_PER_SEED = 1_000_000
SCENES_PER_SHARD = 16
SPACING = 0.13  # [rad] between stored waypoints
PROBES = 128  # labelled configurations a scene, and as many labelled motions
LONGEST_EDGE = 2.0  # [rad] of a labelled motion
NEAR_HAND = 0.25  # [m] of an obstacle: a task-like configuration
TWIN_EVERY = 8  # scenes of each family: their first non-trivial paths get a second, independent label
MOST_TRIVIAL = 0.15  # share of a scene's paths that may be straight lines
DETOUR = 1.03  # a path is nearly straight unless it is this much longer than the straight line
MOST_STRAIGHT = 0.5  # share of a scene's paths that may be straight lines or nearly so
REDRAWS = 10  # pairs drawn to find one that is not trivial
CANDIDATES = 512  # configurations drawn per scene to choose starts and goals from
TABLE = ("shard", "sha256", "scenes", "paths")


@dataclass(frozen=True)
class Recipe:
    """What a dataset is made of.

    Attributes
    ----------
    scenes: number of scenes, families taking turns. paths_per_scene: pairs tried in each; some give no label.
    """

    scenes: int
    paths_per_scene: int
    families: tuple[str, ...] = tuple(FAMILIES)
    seed: int = 0
    labels: NearShortestSettings = field(default_factory=NearShortestSettings)

    def __post_init__(self) -> None:
        for family in self.families:
            if family not in FAMILIES:
                family_scene(family, 0)
        if not 0 <= self.seed < 4000 or not 1 <= self.scenes <= SCENES_PER_SEED:
            raise InvalidInputError(
                f"seed {self.seed} and {self.scenes} scenes: give a seed from 0 to 3999 and at most "
                f"{SCENES_PER_SEED} scenes"
            )

    def scene_of(self, index: int) -> tuple[int, int]:
        """Family index and scene number of scene `index` of this dataset."""
        return index % len(self.families), FIRST_SCENE + self.seed * SCENES_PER_SEED + index


@dataclass(frozen=True, eq=False)
class _Label:
    """A path of one scene; twin_of: index of the path, in the same scene, of which it is a second label, or -1."""

    path: Motion
    trivial: bool
    twin_of: int


def generate(
    recipe: Recipe, out: Path, jobs: int, command: list[str], on_progress: Callable[[int, int], None]
) -> int:
    """Write the shards that `out` does not have yet; returns the number of paths in all.

    Raises
    ------
    InvalidInputError
        If `out` holds a dataset of another recipe, or cannot be written.
    """
    _describe(recipe, out, command)
    shards = -(-recipe.scenes // SCENES_PER_SHARD)
    done = {row["shard"]: int(row["paths"]) for row in _table(out)}
    missing = [k for k in range(shards) if f"{k:06d}" not in done]
    on_progress(len(done), shards)
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        futures = {pool.submit(_shard, recipe, k): k for k in missing}
        try:
            for future in as_completed(futures):
                name, (scenes, paths, content) = f"{futures[future]:06d}", future.result()
                _append(out, name, scenes, paths, content)
                done[name] = paths
                on_progress(len(done), shards)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    write_text(out / "README.md", dataset_card(out))
    return sum(done.values())


def _describe(recipe: Recipe, out: Path, command: list[str]) -> None:
    """Write dataset.json, or check that it says the same."""
    robot = panda()
    settings = json.loads(json.dumps(asdict(recipe)))
    path = out / DESCRIPTION_FILE
    if path.exists():
        existing = json.loads(path.read_text()).get("recipe")
        if existing != settings:
            raise InvalidInputError(
                f"{out} holds a dataset of another recipe, {existing}; choose another --out"
            )
        return
    try:
        (out / SHARDS_FOLDER).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"cannot write to {out}: {error.strerror}; choose another --out") from error
    kinematics, (hand, T) = robot.kinematics, robot.end_effector_link
    points = [*range(1, robot.dof), hand - 1]
    description = {
        "schema": SCHEMA,
        "robot": robot.name,
        "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(),
        "joints": list(robot.joint_names),
        "kinematics_digest": robot.kinematics_digest,
        "families": list(recipe.families),
        "kinematics": {
            "rotation": kinematics.rotation.tolist(),
            "translation": kinematics.translation.tolist(),
            "points": points,
            "offsets": [[0.0, 0.0, 0.0]] * (len(points) - 1) + [T[:3, 3].tolist()],
        },
        "recipe": settings,
        "provenance": provenance(command, [recipe.seed]),
    }
    write_text(path, json.dumps(description, indent=1) + "\n")


def _table(out: Path) -> list[dict[str, str]]:
    """Rows of shards.csv whose shard is there."""
    path = out / INDEX_FILE
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if (out / SHARDS_FOLDER / f"{row['shard']}.npz").exists()]


def _append(out: Path, name: str, scenes: int, paths: int, content: bytes) -> None:
    """Put a finished shard on disk, then into the table."""
    path, table = out / SHARDS_FOLDER / f"{name}.npz", out / INDEX_FILE
    temporary = path.with_suffix(".tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
        new = not table.exists()
        with table.open("a", newline="") as file:
            writer = csv.writer(file)
            if new:
                writer.writerow(TABLE)
            writer.writerow([name, hashlib.sha256(content).hexdigest(), scenes, paths])
    except OSError as error:
        raise InvalidInputError(
            f"cannot write {path}: {error.strerror}; finished shards are kept, free some space and run again"
        ) from error


def _shard(recipe: Recipe, number: int) -> tuple[int, int, bytes]:
    """Scenes, paths and file content of one shard."""
    first = number * SCENES_PER_SHARD
    indices = range(first, min(first + SCENES_PER_SHARD, recipe.scenes))
    columns: dict[str, list] = {
        name: [] for name in ("family", "scene_seed", "probe_q", "probe_free", "edge_q", "edge_free")
    }
    kinds, sizes, poses, shape_start = [], [], [], [0]
    labels: list[tuple[int, _Label]] = []
    twin_rows: list[int] = []
    robot = panda()
    for row, index in enumerate(indices):
        family, scene_number = recipe.scene_of(index)
        scene = family_scene(recipe.families[family], scene_number)
        space = _space(scene)
        rng = np.random.default_rng([recipe.seed, index])
        offset = len(labels)
        found = _labels(space, rng, recipe, with_twins=index // len(recipe.families) % TWIN_EVERY == 0)
        labels += [(row, label) for label in found]
        twin_rows += [label.twin_of + offset if label.twin_of >= 0 else -1 for label in found]
        for item in scene.obstacles:
            kind, size = SHAPES[type(item.shape)](item.shape)
            kinds.append(kind)
            sizes.append(size)
            poses.append(item.T_world_object[:3])
        shape_start.append(len(kinds))
        probes = robot.random_configurations(rng, PROBES)
        columns["family"].append(family)
        columns["scene_seed"].append(scene_number)
        columns["probe_q"].append(_packed(probes))
        columns["probe_free"].append(space.valid_batch(probes))
        edges = _edges(probes, rng)
        columns["edge_q"].append(_packed(edges))
        columns["edge_free"].append([motion_free(space.arrays, *edge) for edge in edges])
    waypoints = [_packed(label.path.spaced(SPACING)) for _, label in labels]
    straight = [np.linalg.norm(label.path.states[-1] - label.path.states[0]) for _, label in labels]
    arrays: dict[str, np.ndarray] = {
        "family": np.array(columns["family"], np.uint8),
        "scene_seed": np.array(columns["scene_seed"], np.int64),
        "shape_start": np.array(shape_start, np.int32),
        "shape_kind": np.array(kinds, np.uint8),
        "shape_size": np.array(sizes, np.float32).reshape(-1, 3),
        "shape_pose": np.array(poses, np.float32).reshape(-1, 3, 4),
        "path_scene": np.array([row for row, _ in labels], np.int32),
        "path_start": np.cumsum([0, *(len(w) for w in waypoints)], dtype=np.int32),
        "waypoints": np.concatenate([np.empty((0, robot.dof), np.uint16), *waypoints]),
        "length": np.array([label.path.length for _, label in labels], np.float32),
        "straight": np.array(straight, np.float32),
        "trivial": np.array([label.trivial for _, label in labels], bool),
        "twin_of": np.array(twin_rows, np.int32),
        "probe_q": np.array(columns["probe_q"], np.uint16),
        "probe_free": np.array(columns["probe_free"], bool),
        "edge_q": np.array(columns["edge_q"], np.uint16),
        "edge_free": np.array(columns["edge_free"], bool),
    }
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # the stubs know only bool options
    return len(indices), len(labels), file.getvalue()


SHAPES = {
    Box: lambda box: (0, box.size),
    Cylinder: lambda cylinder: (1, (cylinder.radius, cylinder.radius, cylinder.height)),
    Sphere: lambda sphere: (2, (sphere.radius,) * 3),
}


def _space(scene: Scene) -> ConstrainedSpace:
    """The unconstrained planning space of a scene."""
    robot = panda()
    middle = 0.5 * (robot.lower + robot.upper)
    return ConstrainedSpace(PlanningProblem(scene.name, robot, scene, middle, middle[None]))


def _edges(configurations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A straight motion (e, 2, n) from each of the configurations (e, n), up to LONGEST_EDGE long, any way."""
    robot = panda()
    way = rng.normal(size=configurations.shape)
    way *= rng.uniform(0.1, LONGEST_EDGE, (len(way), 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    ends = np.clip(configurations + way, robot.lower, robot.upper)
    return np.stack([configurations, ends], axis=1)


def _labels(
    space: ConstrainedSpace, rng: np.random.Generator, recipe: Recipe, with_twins: bool
) -> list[_Label]:
    """Labelled paths of one scene: half of the starts and goals anywhere, half with the hand near an obstacle.

    Most motions are nearly straight and say little about the scene: beyond MOST_STRAIGHT they are left out.
    """
    candidates = space.robot.random_configurations(rng, CANDIDATES)
    candidates = candidates[space.valid_batch(candidates)]
    if len(candidates) < 2:
        return []
    tasklike = candidates[_near_obstacles(space, candidates)]
    labels: list[_Label] = []
    twins, straight = 2 if with_twins else 0, 0
    for pair in range(recipe.paths_per_scene):
        pool = tasklike if pair % 2 and len(tasklike) >= 2 else candidates
        enough = sum(label.trivial for label in labels) >= MOST_TRIVIAL * recipe.paths_per_scene
        for _ in range(REDRAWS):
            start, goal = pool[rng.choice(len(pool), 2, replace=False)]
            trivial = bool(motion_free(space.arrays, start, goal))
            if not (trivial and enough):
                break
        else:
            continue
        path = (
            Motion(np.array([start, goal]))
            if trivial
            else near_shortest(space, start, goal, rng, recipe.labels)
        )
        if path is None:
            continue
        nearly = path.length < DETOUR * np.linalg.norm(goal - start)
        if nearly and straight >= MOST_STRAIGHT * recipe.paths_per_scene:
            continue
        straight += int(nearly)
        labels.append(_Label(path, trivial, -1))
        if twins and not nearly:
            again = near_shortest(space, start, goal, rng, recipe.labels)
            if again is not None:
                labels.append(_Label(again, False, len(labels) - 1))
                twins -= 1
    return labels


def _near_obstacles(space: ConstrainedSpace, configurations: np.ndarray) -> np.ndarray:
    """Whether the hand (b,) is within NEAR_HAND of a box around an obstacle."""
    robot = space.robot
    link, T = robot.end_effector_link
    rotations, translations = link_poses(robot.kinematics, configurations)
    hand = rotations[:, link] @ T[:3, 3] + translations[:, link]
    near = np.zeros(len(configurations), dtype=bool)
    for item in space.problem.scene.obstacles:
        _, size = SHAPES[type(item.shape)](item.shape)
        half = 0.5 * np.array(size) if isinstance(item.shape, Box) else np.array(size)
        local = (hand - item.T_world_object[:3, 3]) @ item.T_world_object[:3, :3]
        outside = np.maximum(np.abs(local) - half, 0.0)
        near |= np.linalg.norm(outside, axis=1) < NEAR_HAND
    return near


def _packed(configurations: np.ndarray) -> np.ndarray:
    """Joints as 16-bit shares of their range."""
    robot = panda()
    u = (configurations - robot.lower) / (robot.upper - robot.lower)
    return np.rint(np.clip(u, 0.0, 1.0) * FULL_SCALE).astype(np.uint16)


def dataset_card(out: Path) -> str:
    """What a dataset holds, counted from its shards, and how far two labels of one problem lie apart."""
    description = json.loads((out / DESCRIPTION_FILE).read_text())
    lower, upper = np.array(description["lower"]), np.array(description["upper"])
    counts = {name: [0, 0, 0, 0.0, 0.0] for name in description["families"]}
    twins: dict[str, list[tuple[float, float]]] = {name: [] for name in description["families"]}
    for row in _table(out):
        with np.load(out / SHARDS_FOLDER / f"{row['shard']}.npz") as shard:
            data = {key: shard[key] for key in shard.files}
        joints = lower + data["waypoints"] / FULL_SCALE * (upper - lower)
        for name, k in zip(description["families"], range(len(counts)), strict=True):
            counts[name][0] += int((data["family"] == k).sum())
        for p, scene in enumerate(data["path_scene"]):
            name = description["families"][data["family"][scene]]
            other = int(data["twin_of"][p])
            if other >= 0:
                twins[name].append(_apart(joints, data["path_start"], p, other))
                continue
            entry = counts[name]
            entry[1] += 1
            entry[2] += int(data["trivial"][p])
            entry[3] += float(data["length"][p])
            entry[4] += float(data["straight"][p])
    lines = [
        f"# Training paths of {description['robot']}",
        "",
        f"Recipe: `{json.dumps(description['recipe'])}`",
        "",
        "Scenes whose number is divisible by 20 validate, the others train. Twins are second, independent labels; "
        "the ratio is their mean waypoint distance over that from the first label to the straight line.",
        "",
        "| family | scenes | paths | trivial | length rad | straight rad | twins | twin / straight-line distance |",
        "|---|---|---|---|---|---|---|---|",
    ]
    everything = [pair for pairs in twins.values() for pair in pairs]
    for name, (scenes, paths, trivial, length, straight) in counts.items():
        share = f"{100 * trivial / paths:.0f} %" if paths else "-"
        mean = f"{length / paths:.2f} | {straight / paths:.2f}" if paths else "- | -"
        lines.append(f"| {name} | {scenes} | {paths} | {share} | {mean} | {_ratio(twins[name])} |")
    total = [sum(entry[k] for entry in counts.values()) for k in range(3)]
    lines.append(
        f"| all | {total[0]} | {total[1]} | {100 * total[2] / max(total[1], 1):.0f} % | | | {_ratio(everything)} |"
    )
    return "\n".join(lines) + "\n"


def _apart(joints: np.ndarray, start: np.ndarray, path: int, other: int) -> tuple[float, float]:
    """Mean waypoint distance of two paths, and of the second to the straight line [rad]."""
    marks = np.linspace(0.0, 1.0, 32)
    a, b = (
        np.stack([np.interp(marks, np.linspace(0.0, 1.0, len(rows)), joint) for joint in rows.T], axis=1)
        for rows in (joints[start[k] : start[k + 1]] for k in (path, other))
    )
    line = b[0] + marks[:, None] * (b[-1] - b[0])
    return float(np.linalg.norm(a - b, axis=1).mean()), float(np.linalg.norm(b - line, axis=1).mean())


def _ratio(pairs: list[tuple[float, float]]) -> str:
    """Number of twins and the ratio of mean distances."""
    if not pairs:
        return "0 | -"
    twin, line = np.mean(pairs, axis=0)
    return f"{len(pairs)} | {twin / line:.2f}"
