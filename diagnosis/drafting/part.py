"""From groups of sensors and first guesses to the twin part of a machine file, and from fitted values to the same."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from data.arrays import Array
from data.machine import Machine
from diagnosis.contracts import with_value
from diagnosis.drafting.first_guess import Balance, Driven, Guess, guess, valid_names
from diagnosis.drafting.groups import Rises, Rows, between, tree_of
from diagnosis.policy import POLICY
from twin.network import Network
from twin.schema import TwinPart


@dataclass(frozen=True)
class Sketch:
    """A network before it has a form: groups of sensors (one body each), named; links; heats and error chains.

    `into` gives for every heat its bodies by share, the largest first; `chains` bodies by error channel.
    """

    groups: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]
    links: tuple[tuple[int, int], ...]
    guess: Guess
    heats: tuple[Driven, ...]
    into: tuple[tuple[tuple[int, float], ...], ...]
    held: int | None  # number of the heat that fixes the scale
    chains: Mapping[str, tuple[int, ...]]


def sketch(rows: Rows, rises: Rises, heats: Sequence[Driven], count: int, extra_links: bool = False) -> Sketch:
    """The network of at most `count` bodies that the recordings suggest: a tree, or with every body's second link."""
    groups = rises.clusters(count)
    distance = between(rises.distance, groups)
    links = tree_of(distance)
    if extra_links:
        links = sorted({*links, *_second(distance, links)})
    body = np.column_stack([rises.body_degC(g) for g in groups])
    room = _room(rows, rises)
    level = {h.driver: np.concatenate([b.values(h.driver) for b in rows.batches]) for h in heats}
    heat = np.column_stack([h.share(level[h.driver]) for h in heats] or [np.zeros((len(body), 0))])
    found = guess(Balance(body, room, heat, rises.parts, rises.time_s), links)
    warm = [k for k in range(len(heats)) if found.heat_W[:, k].sum() > 0]
    scalable = [k for k in warm if heats[k].scalable]
    held = max(scalable, key=lambda k: float(found.heat_W[:, k].sum() * heat[:, k].mean()), default=None)
    size = (
        float(found.heat_W[:, held].sum()) / POLICY.draft_held_heat_W
        if held is not None
        else found.capacity_J_per_K[0] / POLICY.draft_held_capacity_J_per_K
    )
    found = replace(found.scaled(1.0 / size), heat_W=found.heat_W[:, warm] / size)
    return Sketch(
        groups=tuple(tuple(g) for g in groups),
        names=valid_names([rises.names[rises.centre(g)] for g in groups], ["room"]),
        links=tuple(links),
        guess=found,
        heats=tuple(heats[k] for k in warm),
        into=tuple(_outlets(found.heat_W[:, k]) for k in range(len(warm))),
        held=None if held is None else warm.index(held),
        chains={e: _chain(e, rows, rises, body) for e in rows.errors},
    )


def part_of(machine: Machine, rows: Rows, rises: Rises, drawn: Sketch) -> TwinPart:
    """The twin part that a sketch means, every value with a wide prior but the one that fixes the scale."""
    name, found = drawn.names, drawn.guess
    bodies: dict[str, Any] = {}
    held_J_per_K = POLICY.draft_held_capacity_J_per_K
    for k, group in enumerate(drawn.groups):
        held = drawn.held is None and k == 0
        bodies[name[k]] = {
            "capacity": f"{held_J_per_K:g} J/K" if held else _free(found.capacity_J_per_K[k], "J/K"),
            "words": "drafted: where " + ", ".join(rises.names[s] for s in group) + (" sit" if group[1:] else " sits")
            + (f"; held at {held_J_per_K / 1e3:g} kJ/K, all J/K and W/K are relative to it" if held else ""),
        }  # fmt: skip
    raw = {
        "surroundings": {"room": _surrounding(rows, rises)},
        "bodies": bodies,
        "links": {
            f"{name[a]}-{name[b]}": _free(g, "W/K") for (a, b), g in zip(drawn.links, found.link_W_per_K, strict=True)
        },
        "exposures": {f"{b}-room": _free(g, "W/K") for b, g in zip(name, found.exposure_W_per_K, strict=True)},
        "mechanisms": {h.name: _heat(drawn, k) for k, h in enumerate(drawn.heats)},
        "sensors": dict(sorted(_sensors(machine, rows, rises, drawn), key=lambda s: rises.names.index(s[0]))),
        "errors": {e: _error(machine, rows, rises, drawn, e) for e in rows.errors},
        "initial_spread": f"{POLICY.draft_start_sd_K:g} K",
    }
    return TwinPart.model_validate(raw)


def with_values(part: TwinPart, network: Network, values: Array) -> TwinPart:
    """The part with its network's free parameters at values (n,), which become the centres of their priors."""
    for k in network.free.tolist():
        p = network.parameters[k]
        value = float(np.clip(values[k], *POLICY.draft_share_bounds)) if p.scale == "logit" else float(values[k])
        part = with_value(part, p, value=f"{value:.4g} {p.unit}" if p.unit != "1" else float(f"{value:.4g}"))
    return part


def _free(value: float, unit: str) -> dict[str, Any]:
    return {"value": f"{value:.3g} {unit}", "spread": POLICY.draft_log_sd}


def _second(distance: Array, links: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """For every body the nearest that it is not linked with."""
    out = []
    for k in range(len(distance)):
        rest = [j for j in range(len(distance)) if j != k and (min(j, k), max(j, k)) not in links]
        if rest:
            j = min(rest, key=lambda j: distance[k, j])
            out.append((min(j, k), max(j, k)))
    return out


def _room(rows: Rows, rises: Rises) -> Array:
    """The room's temperature at every row (n,): the first ambient, or by the first readings."""
    if rows.rooms:
        return np.concatenate([b.values(rows.rooms[0]) for b in rows.batches])
    if rows.blocks:
        return np.full(len(rises.part), float(np.nanmin(rises.first_degC)))
    return np.asarray(np.nanmean(rises.first_degC, axis=1)[rises.part])


def _surrounding(rows: Rows, rises: Rises) -> dict[str, Any]:
    offset = {"value": "0 K", "spread": "1 K"}
    if rows.rooms:
        return {"channel": rows.rooms[0], "offset": offset}
    if rows.blocks:
        cold = float(np.nanmin(rises.first_degC))
        return {
            "value": {"value": f"{cold:.4g} degC", "spread": "3 K"}, "per_batch": "1 K",
            "words": "no ambient was recorded: a constant near the coldest first reading",
        }  # fmt: skip
    return {
        "first": list(rises.names), "offset": offset, "per_batch": "1 K",
        "words": "no ambient was recorded: held at the first readings of each batch",
    }  # fmt: skip


def _outlets(heat_W: Array) -> tuple[tuple[int, float], ...]:
    """The bodies that a heat goes into with their shares, the largest first."""
    order = np.argsort(-heat_W, kind="stable")[: POLICY.draft_heat_outlets]
    kept = [k for k in order.tolist() if heat_W[k] > POLICY.draft_min_outlet_share * heat_W.sum()]
    total = float(heat_W[kept].sum())
    return tuple((k, float(heat_W[k]) / total) for k in kept)


def _heat(drawn: Sketch, k: int) -> dict[str, Any]:
    given, outlets = drawn.heats[k], drawn.into[k]
    names = [drawn.names[b] for b, _ in outlets]
    held = k == drawn.held
    heat_W = (
        POLICY.draft_held_heat_W
        if held
        else max(float(drawn.guess.heat_W[:, k].sum()), POLICY.draft_min_heat_share * POLICY.draft_held_heat_W)
    )
    shares: dict[str, Any] = {
        n: {"value": float(f"{np.clip(share, *POLICY.draft_start_share_bounds):.3g}"), "spread": POLICY.draft_log_sd}
        for n, (_, share) in zip(names[1:], outlets[1:], strict=True)
    }
    summary = f"drafted: what grows with {given.driver} and warms {', '.join(names)}"
    top = f"{POLICY.draft_held_heat_W:g} W at {given.top:g} {given.unit}"
    scale = f"; held at {top}: all other W, W/K and J/K are relative to it"
    raw = {
        "law": given.law,
        "drivers": given.driver,
        "into": {names[0]: "rest", **shares} if shares else names[0],
        "parameters": given.parameters(heat_W, held),
        "words": summary + (scale if held else ""),
    }
    return raw | ({"at": {"body": names[0]}} if given.law == "ohmic_heat" else {})


def _sensors(machine: Machine, rows: Rows, rises: Rises, drawn: Sketch) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, group in zip(drawn.names, drawn.groups, strict=True):
        for s, offset_K in zip(group, rises.offsets_K(group), strict=True):
            channel = rises.names[s]
            offset = {"value": f"{offset_K:.2f} K", "spread": f"{POLICY.draft_offset_sd_K:g} K"}
            yield channel, {"at": name, "offset": offset, **_noise(machine, rows, channel, "K")}


def _error(machine: Machine, rows: Rows, rises: Rises, drawn: Sketch, channel: str) -> dict[str, Any]:
    unit = machine.channels[channel].unit
    spread = POLICY.draft_gain_sd_um_per_K
    if unit != "um":
        largest = max(float(np.nanmax(np.abs(_moved(b.values(channel))), initial=0.0)) for b in rows.batches)
        spread = 3.0 * largest / max(float(np.nanmax(np.abs(rises.rise_K))), 1e-3) or 1.0
    gain = {"value": f"0 {unit}/K", "spread": f"{spread:.3g} {unit}/K"}
    chain = [{"body": drawn.names[k], "gain": gain} for k in drawn.chains[channel]]
    return {"chain": chain, **_noise(machine, rows, channel, unit)}


def _noise(machine: Machine, rows: Rows, channel: str, unit: str) -> dict[str, str]:
    """Stated only where the machine file's resolution does not say it."""
    stated = machine.channels[channel].resolution is not None
    return {} if stated else {"noise": f"{rows.noise[channel]:.2g} {unit}"}


def _chain(channel: str, rows: Rows, rises: Rises, body_degC: Array) -> tuple[int, ...]:
    """The bodies whose rises explain most of an error, one after the other, by ordinary least squares."""
    error = np.concatenate([_moved(b.values(channel)) for b in rows.batches])
    first = np.concatenate([[at[0]] * len(at) for at in rises.parts])
    rise_K = body_degC - body_degC[first]
    good = np.isfinite(error) & np.isfinite(rise_K).all(axis=1)
    error, rise_K = error[good], rise_K[good]
    chosen: list[int] = []
    left = float(np.linalg.norm(error))
    while len(chosen) < min(POLICY.draft_chain_bodies[1], rise_K.shape[1]):
        rest = [k for k in range(rise_K.shape[1]) if k not in chosen]
        tried = {k: _left(rise_K[:, [*chosen, k]], error) for k in rest}
        best = min(rest, key=lambda k: tried[k])
        if len(chosen) >= POLICY.draft_chain_bodies[0] and tried[best] > (1 - POLICY.draft_chain_min_drop) * left:
            break
        chosen.append(best)
        left = tried[best]
    return tuple(sorted(chosen))


def _left(rows: Array, aim: Array) -> float:
    """Norm of the residual of a regression."""
    return float(np.linalg.norm(aim - rows @ np.linalg.lstsq(rows, aim, rcond=None)[0])) if len(aim) else 0.0


def moved(rows: Rows) -> dict[str, float]:
    """Rms of every channel's movement from its first value of each part, in its unit."""
    out = {}
    for channel in (*rows.temperatures, *rows.errors):
        values = np.concatenate([_moved(b.values(channel)) for b in rows.batches])
        out[channel] = float(np.sqrt(np.mean(values[np.isfinite(values)] ** 2)))
    return out


def _moved(values: Array) -> Array:
    """Less the first usable value."""
    good = np.flatnonzero(np.isfinite(values))
    return values - values[good[0]] if len(good) else values
