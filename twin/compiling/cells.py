"""Cells: bodies cut into lumps, and places in them as weights over all cells."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from data.errors import closest
from twin.schema import Body

Array = NDArray[np.float64]


class Cells:
    """The cells of all bodies in the file's order: names, which belong to a body, and what a place means.

    A place is a body, meaning all of it evenly, or a point "column@0.8" (0 to 1 along a bar) or "table@0.3,0.7" (of a
    plate), interpolated between the nearest cell centres so that refining a body moves nothing by a jump.
    """

    def __init__(self, bodies: Mapping[str, Body]) -> None:
        self.shape: dict[str, tuple[int, int]] = {}
        self.of: dict[str, NDArray[np.int64]] = {}
        names: list[str] = []
        for name, body in bodies.items():
            nx, ny = grid(name, body)
            self.shape[name] = (nx, ny)
            self.of[name] = np.arange(len(names), len(names) + nx * ny)
            names += [name] if nx * ny == 1 else [f"{name}[{i}]" for i in range(nx * ny)]
        self.names = tuple(names)

    def __len__(self) -> int:
        return len(self.names)

    def body_of(self, place: str, key: str) -> str:
        """The body that a place lies in.

        Raises:
            ValueError: no such body, with the closest.
        """
        body = place.partition("@")[0]
        if body not in self.of:
            raise ValueError(f"{key}: no body {body!r}; {closest(body, self.of)}")
        return body

    def weights(self, place: str, key: str) -> Array:
        """Weights (N,) over all cells, sum 1.

        Raises:
            ValueError: no such body, or a position outside 0..1 or of the wrong number of coordinates.
        """
        body, _, position = place.partition("@")
        self.body_of(place, key)
        nx, ny = self.shape[body]
        out = np.zeros(len(self))
        if not position:
            out[self.of[body]] = 1.0 / (nx * ny)
            return out
        try:
            at = [float(p) for p in position.split(",")]
        except ValueError:
            at = [-1.0]
        if len(at) > 2 or any(not 0 <= a <= 1 for a in at):
            raise ValueError(f"{key}: got {place!r}, expected a position from 0 to 1 after @, e.g. {body}@0.5")
        if ny > 1 and len(at) == 1:
            raise ValueError(f"{key}: got {place!r}, but {body} is a plate; give two positions, e.g. {body}@0.5,0.5")
        out[self.of[body]] = np.outer(_between(at[0], nx), _between(at[1] if len(at) > 1 else 0.5, ny)).ravel()
        return out


def grid(name: str, body: Body) -> tuple[int, int]:
    """Cells along the first and the second side.

    Raises:
        ValueError: several cells in a lump, or two counts for a bar.
    """
    if isinstance(body.cells, int):
        nx, ny = body.cells, 1
    else:
        nx, ny = body.cells
    if nx < 1 or ny < 1:
        raise ValueError(f"bodies.{name}.cells: got {list(body.cells)!r}, expected counts of 1 or more")  # type: ignore[arg-type]
    if body.shape == "lump" and nx * ny > 1:
        raise ValueError(f"bodies.{name}.cells: got {nx * ny} for a lump; set shape: bar or plate, or cells: 1")
    if body.shape == "bar" and ny > 1:
        raise ValueError(f"bodies.{name}.cells: got [{nx}, {ny}] for a bar; give one number, or set shape: plate")
    return nx, ny


def _between(at: float, n: int) -> Array:
    """Linear weights (n,) of a position 0..1 between the cell centres (i + ½)/n."""
    where = np.clip(at * n - 0.5, 0, n - 1)
    low = min(int(where), max(n - 2, 0))
    out = np.zeros(n)
    out[low] = 1.0 - (where - low)
    if n > 1:
        out[low + 1] = where - low
    return out
