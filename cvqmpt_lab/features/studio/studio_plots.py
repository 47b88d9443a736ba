"""Plots of a timed path on the panel of the studio."""

from typing import Any

import numpy as np

from cvqmpt_lab.features.pictures.curves import Plot
from cvqmpt_lab.features.pictures.web_page import BOUND_COLOUR, PALETTE
from cvqmpt_lab.features.studio.studio_look import Timed


class PlotPanel:
    """The plots of a path in a folder of viser's panel."""

    def __init__(self, gui: Any, folder: Any) -> None:
        self.made: list[Any] = []  # elements of viser
        self._gui, self._folder = gui, folder
        self._curves: list[tuple[str, ...]] = []  # title and names of the curves of each plot

    def show(self, shown: Timed | None) -> None:
        """Show the plots of a timed path; plots of the same curves get new values."""
        plots = [] if shown is None else shown.plots
        curves = [(plot.title, *plot.lines) for plot in plots]
        if shown is not None and curves == self._curves:
            for made, plot in zip(self.made, plots, strict=True):
                made.data = _columns(shown, plot)
            return
        for made in self.made:
            made.remove()
        self.made = [] if shown is None else [self._new(shown, plot) for plot in plots]
        self._curves = curves

    def _new(self, shown: Timed, plot: Plot) -> Any:
        """Draw a plot."""
        from viser import uplot

        series = [uplot.Series(label="state" if shown.times is None else "s")]
        for k, name in enumerate(plot.lines):
            bound = name in plot.bounds
            colour = BOUND_COLOUR if bound else PALETTE[k % len(PALETTE)]
            series.append(uplot.Series(label=name, stroke=colour, width=1 if bound else 2))
        scales = {"x": uplot.Scale(time=False)}  # x is not a date
        with self._folder:
            return self._gui.add_uplot(
                _columns(shown, plot), tuple(series), title=plot.title, scales=scales, height=170
            )


def _columns(shown: Timed, plot: Plot) -> tuple[np.ndarray, ...]:
    """Horizontal axis and curves (m,) of a plot."""
    curves = (np.asarray(values, dtype=float) for values in plot.lines.values())
    return (shown.across.astype(float), *curves)
