"""Write the figures of frames in docs/gallery: of link, tool and load, and of a region.

python docs/frames.py
"""

from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from cvqmpt_lab import Attachment, Box, PlanningProblem, Scene, pose, robot_from_source
from cvqmpt_lab.features.pictures.picture import still_image
from cvqmpt_lab.features.pictures.raster import Viewpoint

# isort: split
import numpy as np

FOLDER = Path(__file__).parent / "gallery"
SIZE = 640, 380
Q = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.7, 0.785])
VIEW = Viewpoint((0.95, -1.5, 0.65), (0.62, 0.05, 0.43), 0.29)
LENGTH_M = 0.06  # of the axes
COLOURS = (217, 38, 38), (38, 153, 38), (38, 77, 217)  # x, y, z


def tool() -> Image.Image:
    """Return the picture of a Panda with a tool 12 cm before its hand, and a load."""
    robot = robot_from_source({"name": "panda", "tool": {"xyz": [0.0, 0.0, 0.12]}})
    load = Attachment("load", Box((0.05, 0.05, 0.12)), pose((0.0, 0.0, 0.08)))
    problem = PlanningProblem("frames", robot, Scene("none", ()), Q, Q[None], attachments=(load,))
    at = robot.pose(Q)
    frames = {
        "panda_hand: the link of the URDF": robot.pose(Q, "panda_hand"),
        "panda_hand/tool: the hand, at tool in the link": at,
        "the load, at T_hand_object in the hand": at @ load.T_hand_object,
    }
    return with_frames(problem, frames)


def region() -> Image.Image:
    """Return the picture of a Panda's hand, its frame h, and the frame w of a region."""
    robot = robot_from_source({"name": "panda"})
    problem = PlanningProblem("region", robot, Scene("none", ()), Q, Q[None])
    hand = robot.pose(Q)
    h = hand @ pose((0.0, 0.0, 0.10))
    frames = {
        "the hand": hand,
        "h: fixed to the hand": h,
        "w: at T0_w in the world; Bw bounds h in w": h @ pose((0.1, 0.05, 0.13), 0.4),
    }
    return with_frames(problem, frames)


def with_frames(problem: PlanningProblem, frames: dict[str, np.ndarray]) -> Image.Image:
    """Return the picture of a problem at Q with frames, poses by their text."""
    image = Image.fromarray(still_image(problem, Q, SIZE, VIEW))
    drawing = ImageDraw.Draw(image)
    for text, T in frames.items():
        points = np.vstack([T[:3, 3], T[:3, 3] + LENGTH_M * T[:3, :3].T])
        origin, *ends = VIEW.screen(points, SIZE[::-1])[:, :2]
        for end, colour in zip(ends, COLOURS, strict=True):
            drawing.line([*origin, *end], colour, 4)
        right, y = 340, origin[1]
        drawing.line([origin[0] + 70, y, right - 8, y], (150, 150, 150))
        drawing.text((right, y), text, "black", ImageFont.load_default(15), "lm")
    return image


def few_colours(image: Image.Image) -> Image.Image:
    """Return an image with 256 colours: white, most for smooth surfaces, some for rare ones."""
    smooth = image.quantize(175, Image.Quantize.MEDIANCUT).getpalette() or []
    rare = image.quantize(80, Image.Quantize.MAXCOVERAGE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *smooth, *rare])
    made = image.quantize(palette=palette, dither=Image.Dither.NONE)
    # the search in a palette is approximate, and white must be that of the page
    indices = np.where((np.asarray(image) == 255).all(axis=2), 0, np.asarray(made))
    made.putdata(indices.ravel().tolist())
    return made


FIGURES = {"frames": tool, "region": region}

if __name__ == "__main__":
    for name, draw in FIGURES.items():
        few_colours(draw()).save(FOLDER / f"{name}.png", optimize=True)
