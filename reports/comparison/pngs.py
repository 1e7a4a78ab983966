"""The report's figures of one result as small pictures for the tracking store."""

from __future__ import annotations

import threading

from models.protocols import PromotionRule
from models.selection.promotion import choose
from models.selection.result import GridResult
from reports.comparison import figures
from reports.comparison.tables import best_per, left_out_batches, paths, protocols_of, scored, zero_um
from reports.drawing import picture_bytes

_DRAWING = threading.Lock()  # matplotlib's font and text caches are shared by all figures
_DPI = 90
_MOST_LINES = 8


def figure_pngs(result: GridResult) -> dict[str, bytes]:
    """File name -> PNG: the families' best cells, accuracy against the number of points, left-out predictions.

    Threads may call it at once. Empty where no cell has a score.
    """
    rule = PromotionRule()
    protocol = protocols_of(result)[0]
    cells = scored(result, protocol)
    if cells.empty:
        return {}
    choice = choose(result, rule.only(protocol))
    title, simulated = f"{result.machine} {result.target}, {protocol}", result.simulated
    best, shown = best_per(cells, "family"), [b for b in left_out_batches(result, choice) if b.place]
    tried = paths(cells)
    lines = best_per(tried, "family").head(_MOST_LINES)[["family", "selector"]].merge(tried)
    with _DRAWING:
        points = figures.against_points(
            lines, best[best["n_tsp"] == 0], "S_mean_um", f"{title}: S_mean, µm", choice.family, simulated
        )
        points.axes[0].legend(fontsize=6, framealpha=0.85, edgecolor="none", ncols=2)
        drawn = {"families": figures.best_cells(best, zero_um(cells), title, simulated), "points": points}
        if shown:
            draw = figures.curves if shown[0].position_mm is None else figures.fan
            drawn["left_out"] = draw(shown, shown, result.target, 1, simulated)
        return {f"{name}.png": picture_bytes(figure, "png", _DPI) for name, figure in drawn.items()}
