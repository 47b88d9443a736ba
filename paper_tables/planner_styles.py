"""How a planner is drawn in every figure: its colour, and its line, which is thick for ours."""

from typing import Any
from zlib import crc32

COLOURS = {
    "birrt": "#70757d",
    "ompl-projected": "#8c6d1f",
    "atlas-rrt": "#3aa6a6",
    "tb-rrt": "#7cae3c",
    "mpnet": "#8a4fa3",
    "mpnet-bridged": "#d987c0",
    "cvq-mpt": "#e58a2f",
    "opt-cvq-mpt": "#c8452d",
    "cvq-wide": "#2e8b57",
    "graph-cvq": "#b8336a",
    "roadmap": "#1b3fa0",
    "roadmap-cvq": "#4f9fd9",
}
OURS = "roadmap"
THICK, THIN = 2.6, 1.4  # [points]


def line_style(name: str) -> dict[str, Any]:
    """Arguments of matplotlib's `plot` for a planner, or for a variant of it: "birrt improved".

    Variants have the planner's colour and dashes; a planner that is not listed has dots and a
    colour by its name.
    """
    planner, *variant = name.split()
    known = planner in COLOURS
    colour = (
        COLOURS[planner]
        if known
        else list(COLOURS.values())[crc32(planner.encode()) % len(COLOURS)]
    )
    dash = ("--" if variant else "-") if known else ":"
    return {"color": colour, "linestyle": dash, "linewidth": THICK if planner == OURS else THIN}
