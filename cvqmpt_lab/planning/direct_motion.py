"""The direct motion between two states: straight in joints, projected on the manifold, free of collision."""

import numpy as np

from cvqmpt_lab.kernels.search.motion import DEVIATION, bisect_motion
from cvqmpt_lab.planning.result import JointPath
from cvqmpt_lab.planning.space import ConstrainedSpace

COARSE_STEP = 0.15
"""Between neighbouring states of the first look [rad], as in `BiRRT`; the path is then mended to the space's step."""


def direct_motion(space: ConstrainedSpace, origin: np.ndarray, target: np.ndarray) -> JointPath | None:
    """The motion from origin to target (n,), both on the manifold, or None when there is none.

    Projected midpoints from coarse to fine, so that most failures cost a few states; a motion more than
    twice as long as straight is none. What is found is checked at the space's fine resolution.
    """
    origin, target = (np.ascontiguousarray(q, dtype=float) for q in (origin, target))
    straight = float(np.linalg.norm(target - origin))
    room = np.empty((2 * int(straight / COARSE_STEP) + 2, len(origin)))
    arrays = space.arrays._replace(step=COARSE_STEP)
    count = bisect_motion(arrays, origin, target, max(DEVIATION * straight, COARSE_STEP), room)
    space.reraise()
    if count == 0:
        return None
    return space.checked_path(np.vstack((origin[None], room[:count])))[0]
