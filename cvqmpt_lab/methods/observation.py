"""The point cloud that a planner with a network is given of a problem."""

from collections import OrderedDict

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.cameras import CameraSettings, camera_cloud
from cvqmpt_lab.scene.scene import Scene


class Observer:
    """Virtual cameras that look at a problem's scene; the same scene gives the same cloud.

    Casting rays takes a second, a camera's cloud nothing: planners look before their clock starts, and scenes
    seen lately are remembered.
    """

    def __init__(self, settings: CameraSettings | None = None, seed: int = 0, scenes: int = 8) -> None:
        """Look with settings (like training's clouds by default); keep `scenes` clouds."""
        if scenes < 1:
            raise InvalidInputError(f"scenes kept by an observer: {scenes}; give at least 1")
        self.settings = CameraSettings.like_training() if settings is None else settings
        self.seed, self._kept = seed, scenes
        self._clouds: OrderedDict[Scene, np.ndarray] = OrderedDict()

    def __call__(self, problem: PlanningProblem) -> np.ndarray:
        """The cloud (m, 3) [m] of a problem's scene, not to be written to."""
        scene = problem.scene
        if scene in self._clouds:
            self._clouds.move_to_end(scene)
        else:
            cloud = camera_cloud(scene, self.settings, np.random.default_rng(self.seed))
            cloud.setflags(write=False)
            self._clouds[scene] = cloud
            if len(self._clouds) > self._kept:
                self._clouds.popitem(last=False)
        return self._clouds[scene]
