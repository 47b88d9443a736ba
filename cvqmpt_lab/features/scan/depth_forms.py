"""Tell depth in metres from the depth buffer of a renderer, whose values are 0 to 1.

A buffer with planes near and far holds d = far (z - near) / (z (far - near)) for the depth z, which
is linear in 1 / z (OpenGL, PyBullet, MuJoCo). Others hold (z - near) / (far - near).
"""

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import FloatArray

# lengths of a unit of 16-bit images that cameras and data sets use beside 1 mm [m]
OTHER_UNITS_M = (0.0001, 0.0002, 0.00025)


def refuse_buffer(image: np.ndarray) -> None:
    """Raise InvalidInputError if an image (height, width) of floats is probably no depth in metres.

    Every value is at most 1, and it is not rounded to 0.1 mm, as a camera's may be. Then it is a
    buffer if a value is exactly 1, the far plane; or if surfaces are planes when it is read as a
    buffer, but not in metres; or if most values are above 0.9, without noise, and do not tell.
    """
    depth = np.where(np.isfinite(image) & (image > 0.0), image, np.nan).astype(np.float64)
    values = depth[np.isfinite(depth)]
    if len(values) == 0 or values.max() > 1.0 or _is_rounded(values):
        return
    far = int((values == 1.0).sum())
    if image.dtype == np.float16 and far < 0.01 * len(values):
        far = 0  # rounded to 1
    buffer, metres = _planes(depth)
    most = float((values > 0.9).mean())
    few = 20 + 0.02 * len(values)
    if far:
        why = f"{far} of them are exactly 1, as of a far plane"
    elif buffer > max(few, 2 * metres):
        why = "surfaces in it are plane if it is a buffer, and bent if it is in metres"
    elif most > 0.5 and metres <= few and _is_smooth(depth):
        why = f"{most:.0%} of them are above 0.9, without noise"
    else:
        return
    raise InvalidInputError(
        f"its values are {values.min():.4g} to {values.max():.4g} and {why}: a renderer's depth "
        "buffer d, not metres? write z = near*far/(far - d*(far - near)) (OpenGL, PyBullet, "
        "MuJoCo) or z = near + d*(far - near) (linear), without pixels where d is 1, to an npy "
        "file; if they are metres, give --scale 1"
    )


def other_units(depth: FloatArray) -> str:
    """Return units [m] in which depths (m,), read as millimetres, would be 0.3 to 2.5 m, as text.

    The text is empty if they are in that range as millimetres, too.
    """
    middle = float(np.median(depth))
    if middle <= 2.5:
        return ""
    fitting = [unit for unit in OTHER_UNITS_M if 0.3 <= middle * unit / 0.001 <= 2.5]
    return ", ".join(f"--scale {unit:g} (units of {1e3 * unit:g} mm)" for unit in fitting)


def _is_rounded(values: FloatArray) -> bool:
    """Whether all values (m,) [m] but 1 are multiples of 0.1 mm, and some are not 1."""
    tenths = 1e4 * values[values != 1.0]
    return len(tenths) > 0 and bool((np.abs(tenths - np.rint(tenths)) < 0.01).all())


def _is_smooth(depth: FloatArray) -> bool:
    """Whether most neighbours in an image are on lines to 0.01 mm: noise of cameras is larger."""
    bends = np.abs(depth[:, :-2] - 2.0 * depth[:, 1:-1] + depth[:, 2:])
    bends = bends[np.isfinite(bends)]
    return len(bends) > 0 and float(np.median(bends)) < 1e-5


def _planes(depth: FloatArray) -> tuple[int, int]:
    """Count triples of pixels on a sloping line that are plane as a buffer, and as metres.

    Along a line of an image of a plane a buffer d is linear, and 1 / z of the depth z in metres.
    If 1 / z is linear, the second difference of z is 2 z'^2 / z.
    """
    step = max(1, min(depth.shape) // 12)
    buffer = metres = 0
    for lines in (depth, depth.T):
        if lines.shape[1] <= 2 * step:
            continue
        before, middle, after = lines[:, : -2 * step], lines[:, step:-step], lines[:, 2 * step :]
        bend, slope = before - 2.0 * middle + after, 0.5 * (after - before)
        if_metres = 2.0 * slope**2 / middle
        # float32 has rounding errors of 1e-7; steeper ones cross edges of bodies
        telling = (if_metres > 3e-6) & (np.abs(slope) < 0.2 * middle)
        buffer += int((telling & (np.abs(bend) < 0.1 * if_metres)).sum())
        reciprocal = middle**2 * (1.0 / before - 2.0 / middle + 1.0 / after)
        metres += int((telling & (np.abs(reciprocal) < 0.1 * if_metres)).sum())
    return buffer, metres
