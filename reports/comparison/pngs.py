"""The report's pictures of one result as small PNGs for the tracking store."""

from __future__ import annotations

import threading

import pandas as pd

from models.protocols import PromotionRule
from models.selection.result import GridResult, Training
from reports.comparison.channel import Channel
from reports.comparison.pictures import left_out_panels, time_panel, tried_panel
from reports.comparison.tables import protocols_of, scored
from reports.drawing import picture_bytes

_DRAWING = threading.Lock()  # matplotlib's font and text caches are shared by all figures
_DPI = 90


def figure_pngs(result: GridResult) -> dict[str, bytes]:
    """File name -> PNG: the median and the worst left-out run, all that was tried, left-out runs in the order of time.

    Threads may call it at once. Empty where no cell has a score.
    """
    rule = PromotionRule()
    if scored(result, protocols_of(result)[0]).empty:
        return {}
    training = Training("", pd.Timestamp.now("UTC"), result.simulated, result)
    with _DRAWING:
        own = [Channel.of(f"{result.machine} {result.target}", [training], rule)]
        left_out = [plot for panel in left_out_panels(own) for plot in panel.plots]
        plots = dict(zip(("left_out_median", "left_out_worst"), left_out, strict=False))
        plots |= {n: p.plots[0] for n, p in (("families", tried_panel(own)), ("in_time", time_panel(own))) if p.plots}
        return {f"{name}.png": picture_bytes(plot.figure, "png", _DPI) for name, plot in plots.items()}
