"""The point cloud of a scene that a learned planner gets as input."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.caches import LruCache, cached_arrays, sources_digest
from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.scene.cells import seen_points
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Measured
from cvqmpt_lab.sensing.virtual import CameraSettings, camera_cloud, thinned, visible_points
from cvqmpt_lab.values import frozen


class Observer:
    """Makes the cloud of a scene, the same one every time; by default like training clouds.

    Virtual cameras see the shapes; clouds and occupancy maps are used as they are. Rendering takes
    half a second, so the last `scenes` clouds are cached, and rendered ones also in the user's disk
    cache.
    """

    def __init__(
        self, settings: CameraSettings | None = None, seed: int = 0, scenes: int = 8
    ) -> None:
        whole_number("scenes kept by an observer", scenes, 1)
        whole_number("seed", seed)
        self.settings = CameraSettings.like_training() if settings is None else settings
        self.seed, self._clouds = seed, LruCache[np.ndarray](scenes)

    def __call__(self, scene: Scene) -> np.ndarray:
        """The cloud (m, 3) [m] of a scene, not to be written to."""
        return self._clouds.get(scene, lambda: self._look(scene))

    def of_points(self, points: np.ndarray) -> np.ndarray:
        """Cloud (m, 3) of points (p, 3) [m, base frame]; InvalidInputError: none is in the crop."""
        crop = self.settings.crop
        near = points[crop.contains(points)]
        if len(near) == 0:
            raise InvalidInputError(
                f"none of the cloud's {len(points)} points is in the region that networks know, "
                f"{crop}: give it in metres, in the frame of the robot's base"
            )
        measured = replace(self.settings, noise=0.0)  # it has its own
        cloud = thinned(near, measured, np.random.default_rng(self.seed))
        return frozen(cloud)

    def _look(self, scene: Scene) -> np.ndarray:
        clouds = [item for item in scene.objects if isinstance(item.shape, Measured)]
        if clouds:
            rest = scene.without(*(item.name for item in clouds))
            seen = visible_points(rest, self.settings, np.random.default_rng(self.seed))
            world = [
                seen_points(item.shape) @ item.T_world_object[:3, :3].T + item.T_world_object[:3, 3]
                for item in clouds
                if isinstance(item.shape, Measured)
            ]
            return self.of_points(np.concatenate([*world, seen]))
        rng = np.random.default_rng(self.seed)
        cameras = [
            (each.intrinsics, each.T_world_camera.tolist()) for each in self.settings.cameras
        ]
        settings = replace(self.settings, cameras=())
        made_of = f"{_sources()} {cameras} {settings} {self.seed} {json.dumps(to_plain(scene))}"
        arrays = cached_arrays(
            "clouds", made_of.encode(), lambda: {"cloud": camera_cloud(scene, self.settings, rng)}
        )
        cloud = arrays["cloud"]
        # networks need two points: under the base
        if len(cloud) < 2:
            cloud = np.concatenate([cloud, [[0.0, -0.1, -0.8], [0.0, 0.1, -0.8]]])
        return frozen(cloud)


@cache
def _sources() -> str:
    """Digest of what clouds are rendered by."""
    library = Path(__file__).parents[1]
    return f"{sources_digest(library / 'sensing', library / 'scene')} {np.__version__}"
