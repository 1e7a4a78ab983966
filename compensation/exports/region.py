"""Programs for controls: the authority that the distance from the trained region leaves, and checks of sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from compensation.runtime import AxisModel
from compensation.substitutes import HELD_MARGIN, Guard
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
    distance = _largest(b, b.join(*beyond))
    one = b.constant(1.0)
    untested = b.two("max", b.sub(distance, b.constant(max(a.tested, SLACK))), b.constant(0.0))
    worth = b.add("power", [b.two("add", one, untested)], 1, exponents=[-1.0])
    trust = b.two("min", b.scaled(worth, np.array([a.share])), one)
    return b.program([trust], zero_start=False)


def _excess(b: Builder, x: int, low: Array, high: Array, width: Array) -> int:
    """How far outside, in widths."""
    outside = b.two("max", b.sub(b.constant(low), x), b.sub(x, b.constant(high)), b.constant(np.zeros(len(low))))
    return b.scaled(outside, width)


def checks_program(guard: Guard, channels: Sequence[str], known: Mapping[str, Channel], step_s: float) -> Program:
    """What `Guard.step` finds stepping or frozen, and when it takes it again, while one of these channels fails.

    Outputs are the guarded ones among them, replaced where they fail, and how many fail.
    """
    s, limits = guard.substitutes, guard.limits
    used = np.isin(s.names, channels)
    weights, usual_K, sd_K = s.changes(used)
    b, n = Builder(known, step_s), int(used.sum())
    zero, one = (b.constant([value] * n) for value in (0.0, 1.0))
    both, either = partial(b.two, "mul"), partial(b.two, "max")  # of numbers that are 0 or 1
    states = begun, was_bad, was, was_held_s, was_moved_K, was_near = [b.previous(n) for _ in range(6)]

    def beyond(x: int, limit: Array) -> int:
        return b.two("less", b.constant(limit[used]), b.two("max", x, b.sub(zero, x)))

    x, fine = b.channels(list(np.array(s.names)[used])), b.two("less", was_bad, begun)
    last = b.select(begun, was, x)
    change = both(fine, b.sub(x, last))
    fast = beyond(change, s.usual_K(step_s))
    change = both(b.two("less", fast, one), change)
    predicted = b.affine(change, weights[np.ix_(used, used)])
    off = b.sub(change, predicted)
    odd = both(b.sub(fine, fast), beyond(off, limits.step_sd * usual_K + s.resolution_K))
    score = both(odd, b.scaled(both(off, off), sd_K[used] ** 2))
    odd = both(odd, b.two("equal", score, _largest(b, score)))  # its step is in the predictions of the others
    same = both(fine, b.two("equal", x, last))
    held_s = both(same, b.two("add", was_held_s, b.constant([step_s] * n)))
    moved_K = both(same, b.two("add", was_moved_K, predicted))
    long = beyond(held_s, HELD_MARGIN * np.maximum(s.held_s, s.step_s))
    frozen = both(long, beyond(moved_K, limits.frozen_sd * usual_K + s.resolution_K))
    guess = b.two("add", last, b.select(frozen, moved_K, predicted))
    away = beyond(b.sub(x, guess), limits.back_sd * usual_K + s.resolution_K)
    away = either(away, beyond(b.sub(x, b.delay(x, step_s, 1.0)), s.usual_K(step_s)))
    near = both(b.two("less", away, was_bad), b.two("add", was_near, one))  # rows without a break
    bad = both(either(was_bad, fast, odd, frozen), b.two("less", near, b.constant([limits.back_samples] * n)))
    filled = b.select(bad, guess, x)
    for state, after in zip(states, (one, bad, filled, held_s, moved_K, near), strict=True):
        b.feed(state, after)
    return b.program([filled, b.affine(bad, np.ones((1, n)))], zero_start=False)


def _largest(b: Builder, x: int) -> int:
    return b.two("max", *(b.pick(x, [k]) for k in range(b.size(x))))
