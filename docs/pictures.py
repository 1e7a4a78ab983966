"""The pictures of the documentation: the rooms of the program, and thermal error on the simulated sample year.

`python -m docs.pictures` draws all of them; `make docs` does it before every build.
"""

from __future__ import annotations

import runpy
import sys
import tempfile
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from data.batch import Batch
from data.machine import load_machine
from data.recording import read_batches

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
INK, WARM, COLD, PALE = "#263238", "#d84315", "#1565c0", "#eceff1"
STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 10, "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "grid.color": "#e0e0e0", "text.color": INK, "axes.labelcolor": INK, "figure.dpi": 110,
}  # fmt: skip


def main() -> None:
    """Draws every picture of this file into docs/ and docs/concepts/."""
    plt.rcParams.update(STYLE)
    _save(rooms(runpy.run_path(str(ROOT / "tests" / "test_architecture.py"))["ALLOWED"]), DOCS / "rooms.png")
    batches = _sample_year()
    for name, picture in (
        ("thermal_error", thermal_error), ("seasons", seasons), ("points", points), ("protocols", protocols),
    ):  # fmt: skip
        _save(picture(batches), DOCS / "concepts" / f"{name}.png")


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, metadata={"Software": None})  # the same bytes at each run
    plt.close(figure)


def _sample_year() -> list[Batch]:
    from plants.sample.sample_year import write_sample_year

    machine = load_machine(ROOT / "machines" / "sample_vmc.yml")
    with tempfile.TemporaryDirectory() as folder:
        files = write_sample_year(Path(folder))
        return sorted((b for f in files for b in read_batches(f, machine)), key=lambda b: str(b.start))


# The rooms


def rooms(allowed: Mapping[str, set[str]]) -> Figure:
    """Every room with what it holds, and an arrow to each room whose code it uses.

    A room may also use what the rooms at its arrows' ends may use; those arrows are left out.
    """
    level: dict[str, int] = {}
    for name in _inner_first(allowed):
        level[name] = 1 + max((level[other] for other in allowed[name]), default=-1)
    at = {}
    for height in range(max(level.values()) + 1):
        row = [n for n in allowed if level[n] == height]
        for k, name in enumerate(row):
            at[name] = ((k + 0.5) / len(row) * 9.0, 1.35 * height)
    figure, ax = plt.subplots(figsize=(9.6, 10.5))
    ax.set(xlim=(-0.1, 9.7), ylim=(-0.55, 1.35 * max(level.values()) + 0.6))
    ax.axis("off")
    for name, others in allowed.items():
        for other in others:
            if not any(other in allowed[between] for between in others):
                _arrow(ax, at[name], at[other])
    for name, (x, y) in at.items():
        ax.add_patch(FancyBboxPatch((x - 1.3, y - 0.36), 2.6, 0.72, "round,pad=0.05", fc=PALE, ec=INK, zorder=3))
        ax.text(x, y + 0.2, name, ha="center", va="center", weight="bold", zorder=4)
        ax.text(x, y - 0.13, _purpose(name), ha="center", va="center", size=7.5, zorder=4)
    figure.tight_layout()
    return figure


def _inner_first(allowed: Mapping[str, set[str]]) -> list[str]:
    return sorted(allowed, key=lambda n: len(_reached(allowed, n)))


def _reached(allowed: Mapping[str, set[str]], name: str) -> set[str]:
    return allowed[name].union(*(_reached(allowed, other) for other in allowed[name]))


def _arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    """From the lower side of one box to the upper side of another; past other boxes in an arc on their right."""
    style: dict[str, Any] = {"arrowstyle": "-|>", "color": "#78909c", "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
    if start[1] - end[1] > 2.0:
        style["connectionstyle"] = "arc3,rad=-0.25"
        ax.annotate("", (end[0] + 1.0, end[1] + 0.42), (start[0] + 1.36, start[1]), arrowprops=style, zorder=2)
    else:
        ax.annotate("", (end[0], end[1] + 0.42), (start[0], start[1] - 0.42), arrowprops=style, zorder=2)


def _purpose(room: str) -> str:
    """The first sentence of the room's docstring in lines of about 38 characters."""
    import textwrap

    text = (import_module(room).__doc__ or "").split("\n\n")[0].split(". ")[0].rstrip(".")
    return "\n".join(textwrap.wrap(" ".join(text.split()), 42)[:3])


# Thermal error


def thermal_error(batches: list[Batch]) -> Figure:
    """One run: the speed, the temperatures' rises, and the error that follows them."""
    batch = next(b for b in batches if b.batch_id.endswith("spectrum"))
    hours = batch.table["time_s"] / 3600.0
    figure, axes = plt.subplots(3, 1, figsize=(9, 6.5), sharex=True, height_ratios=(1, 2, 2))
    axes[0].step(hours, batch.values("spindle_rpm") / 1000.0, where="post", color=INK)
    axes[0].set_ylabel("spindle\n1000/min")
    for name, colour in (("front", WARM), ("motor", "#f9a825"), ("column_front", COLD), ("bed", "#00897b")):
        axes[1].plot(hours, _rise(batch, name), color=colour, label=name)
    axes[1].set_ylabel("temperature rise, K")
    axes[1].legend(ncols=4, frameon=False, loc="upper left")
    for name, colour in (("z", WARM), ("y", COLD), ("x", "#00897b")):
        axes[2].plot(hours, _rise(batch, name), color=colour, label=name)
    axes[2].set(ylabel="error, µm", xlabel="hours since the start")
    axes[2].legend(ncols=3, frameon=False, loc="upper left")
    axes[0].set_title(f"A run with changing speeds ({batch.batch_id}, simulated)", loc="left")
    figure.tight_layout()
    return figure


def seasons(batches: list[Batch]) -> Figure:
    """Runs of one speed in different months: the same work, another error."""
    same = [b for b in batches if b.batch_id.endswith("4000rpm")]
    starts = [float(b.values("room")[0]) for b in same]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), width_ratios=(3, 2))
    for b, room in zip(same, starts, strict=True):
        warm = (room - min(starts)) / (max(starts) - min(starts))
        left.plot(
            b.table["time_s"] / 3600.0, _rise(b, "z"), color=plt.get_cmap("coolwarm")(warm), label=f"{room:.0f} °C"
        )
    left.set(xlabel="hours since the start", ylabel="error of z, µm")
    left.set_title("4000/min throughout the year (simulated)", loc="left")
    right.scatter(starts, [float(np.nanmax(_rise(b, "z"))) for b in same], c=starts, cmap="coolwarm", s=50)
    right.set(xlabel="room at the start, °C", ylabel="largest error of z, µm")
    figure.tight_layout()
    return figure


def points(batches: list[Batch]) -> Figure:
    """Correlation of the sensors' rises with each other and with the error, over the whole year."""
    names = [n for n, c in batches[0].channels.items() if c.role == "temperature"]
    stacked = np.array([np.concatenate([_rise(b, n) for b in batches]) for n in [*names, "z"]])
    correlation = np.corrcoef(stacked[:, np.isfinite(stacked).all(axis=0)])
    figure, ax = plt.subplots(figsize=(6.6, 5.4))
    image = ax.imshow(correlation, vmin=0.0, vmax=1.0, cmap="YlOrRd")
    ax.set_xticks(range(len(names) + 1), [*names, "z"], rotation=45, ha="right")
    ax.set_yticks(range(len(names) + 1), [*names, "z"])
    ax.grid(visible=False)
    for i, j in np.ndindex(correlation.shape):
        value = correlation[i, j]
        ax.text(j, i, f"{value:.2f}", ha="center", va="center", size=7.5, color="white" if value > 0.65 else INK)
    figure.colorbar(image, ax=ax, label="correlation of the rises")
    ax.set_title("Sensors and the error of z (sample year, simulated)", loc="left", size=10)
    figure.tight_layout()
    return figure


def protocols(batches: list[Batch]) -> Figure:
    """What each fold of two protocols learns from and is tested on; one column per run, in order of time."""
    from models.protocols import PROTOCOLS

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), width_ratios=(1, 1))
    for ax, protocol in zip(axes, ("forward", "leave-batch-out"), strict=True):
        cells = np.zeros((0, len(batches)))
        for fold in PROTOCOLS[protocol](batches)[:: 1 if protocol == "forward" else 5]:
            row = np.zeros(len(batches))
            row[list(fold.train)], row[list(fold.test)] = 1.0, 2.0
            cells = np.vstack([cells, row])
        colours = matplotlib.colors.ListedColormap(["white", "#90a4ae", WARM])
        ax.pcolormesh(cells[::-1], cmap=colours, vmin=0, vmax=2, edgecolors="white", linewidth=1.5)
        ax.set(xlabel="run, in order of time", yticks=[], title=protocol)
        ax.grid(visible=False)
    axes[0].set_ylabel("fold")
    handles = [plt.Rectangle((0, 0), 1, 1, color=c) for c in ("#90a4ae", WARM)]
    figure.legend(handles, ["learned from", "tested on"], ncols=2, loc="lower center", frameon=False)
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    return figure


def _rise(batch: Batch, name: str) -> Any:
    values = batch.values(name)
    return values - values[0]


if __name__ == "__main__":
    main()
    sys.exit(0)
