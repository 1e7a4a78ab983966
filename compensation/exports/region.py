"""The distance from the trained region and the authority that it leaves, as a program for controls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from compensation.runtime import AxisModel
from data.arrays import Array
from data.batch import Channel
from models.program import Builder, Program
from models.selection.trust import SLACK


def trust_program(a: AxisModel, known: Mapping[str, Channel]) -> Program | None:
    """`AxisModel.authority` at `Region.row`, over `share`: one value for each row; None without watched quantities.

    Only quantities of the model's own channels count, as a control reads no others.
    """
    watched = [n for n in a.region.ranges if n.partition("@")[0] in a.program.channels]
    if not watched:
        return None
    region = replace(a.region, ranges={n: a.region.ranges[n] for n in watched})
    b = Builder(known, a.program.step_s)
    low, high, width = region.widths()
    x = b.features(watched, required=False)
    beyond = [_excess(b, x, low, high, width)]
    if len(region.points) > 1 and set(region.points) <= set(watched):
        points = b.pick(x, [watched.index(n) for n in region.points])
        scores = b.affine(points, region.directions.T, -region.directions.T @ region.centre)
        beyond.append(_excess(b, scores, region.low, region.high, region.pattern()["spread"]))
    distance = b.join(*beyond)
    while b.size(distance) > 1:
        half, odd = divmod(b.size(distance), 2)
        pair = [b.pick(distance, list(range(at, at + half))) for at in (0, half)]
        rest = [b.pick(distance, [2 * half])] * odd
        distance = b.join(b.two("max", *pair), *rest)
    # The factor of `RunBound` is a power of 1 + distance; without a bound it is 1 + distance itself.
    slope = a.bound.slopes[1] if a.bound is not None else 1.0
    one = b.constant(1.0)
    worth = b.add("power", [b.two("add", one, distance)], 1, exponents=[-slope])
    outside = b.two("less", b.constant(SLACK), distance)
    trust = b.select(outside, b.two("min", b.scaled(worth, np.array([a.share])), one), one)
    return b.program([trust], zero_start=False)


def _excess(b: Builder, x: int, low: Array, high: Array, width: Array) -> int:
    """How far outside, in widths."""
    outside = b.two("max", b.sub(b.constant(low), x), b.sub(x, b.constant(high)), b.constant(np.zeros(len(low))))
    return b.scaled(outside, width)
