"""The picture of a gallery script: one style and size, saved next to the script as NAME.png.

with picture(__file__, "Title", xlabel="hours", ylabel="error, µm") as ax:
    ax.plot(hours, error_um, color=WARM)
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from docs.pictures import COLD, INK, STYLE, WARM

__all__ = ["COLD", "GOLD", "GREEN", "GREY", "INK", "PALE", "WARM", "picture", "pictures"]
GREEN, GOLD, GREY, PALE = "#00897b", "#f9a825", "#90a4ae", "#dfe6ea"
_SIZE_IN, _DPI = (7.0, 4.2), 140  # 980 pixels: on a phone, 360 pixels wide, the text keeps 8 pixels


@contextmanager
def picture(script: str, title: str, **labels: Any) -> Iterator[Axes]:
    """Axes to draw on; `labels` are those of `Axes.set`. The picture is saved when the block ends without an error.

    Args:
        script: ``__file__`` of the script.
    """
    with pictures(script, title, 1, 1) as axes:
        axes[0].set(**labels)
        yield axes[0]
        if axes[0].get_legend_handles_labels()[0]:
            axes[0].legend(frameon=False)


@contextmanager
def pictures(script: str, title: str, rows: int, columns: int, **given: Any) -> Iterator[list[Axes]]:
    """The same for several axes, row by row; `given` are keywords of `pyplot.subplots`."""
    with plt.rc_context({**STYLE, "font.size": 11, "axes.axisbelow": True}):
        figure, axes = plt.subplots(rows, columns, figsize=_SIZE_IN, layout="constrained", squeeze=False, **given)
        try:
            yield list(axes.flat)
            figure.suptitle(title, x=0.01, ha="left", size=12)
            _save(figure, Path(script).with_suffix(".png"))
        finally:
            plt.close(figure)


def _save(figure: Figure, path: Path) -> None:
    figure.text(0.995, 0.985, "simulated", ha="right", va="top", size=8, color="#78909c")
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=_DPI, metadata={"Software": None})  # the same bytes at each run
    Image.open(drawn).convert("RGB").quantize(64).save(path, optimize=True)  # a third of the size
