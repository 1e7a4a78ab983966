"""Alternatives that need no new physics: a finer network near a sensor, a wrong value, a value that varies.

A sensor in a big casting sees what is near it first. A local node with a part of the casting's capacity behind a free
conductance is the smallest refinement that can lag, and lead where a neighbour's heat enters through it; a far node
lets the sensor's body respond at once and settle slowly.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations

import numpy as np
from pydantic import BaseModel

from diagnosis.candidates.library import ends_of, linked
from diagnosis.contracts import (
    FAR_SUFFIX,
    NEAR_SUFFIX,
    Candidate,
    CandidateKind,
    Change,
    Fitted,
    Kind,
    Where,
    pieces_of,
)
from diagnosis.policy import POLICY
from twin.mechanisms import MECHANISMS
from twin.network import Network
from twin.quantity import Parameter, Value
from twin.schema import Body, Link, MechanismPart


def coarse_candidates(
    fitted: Fitted,
    mean_squares: np.ndarray,
    most: int = POLICY.coarse_sensors,
    worse: float = POLICY.coarse_min_mean_square,
) -> list[Candidate]:
    """Refinements at the sensors whose left-out mean square (in units of the given noise's) is `worse` and largest,
    and where a heat that was found enters: a sensor near it sees more of it than its body's mean."""
    part = fitted.part
    names = [r.channel for r in fitted.problem.network.readings]
    ranked = sorted(range(len(names)), key=lambda k: -np.nan_to_num(mean_squares[k]))
    out = []
    for n, k in enumerate(ranked):
        if not mean_squares[k] > worse:
            continue
        body = part.sensors[names[k]].at.partition("@")[0]
        if n < most:
            out += list(_of_sensor(fitted, names[k]))
        elif any(body in _into(part.mechanisms[name]) for name in found_since(fitted)):
            out += [c for c in _of_sensor(fitted, names[k]) if any(p.startswith("mechanisms.") for p in c.parts)]
    return out


def found_since(fitted: Fitted) -> list[str]:
    """The mechanisms that the machine file lacks."""
    if not fitted.machine.twin:
        return []  # drafted: the machine file states nothing
    known = fitted.machine.twin.get("mechanisms") or {}
    return [name for name in fitted.part.mechanisms if name not in known]


def _into(given: MechanismPart) -> list[str]:
    """The bodies that its heat enters whole, or what is left of it."""
    if isinstance(given.into, str):
        return [given.into]
    return [body for body, share in (given.into or {}).items() if share == "rest"]


def _entering(given: MechanismPart, body: str, place: str) -> MechanismPart:
    """The mechanism with its heat into a place of the body."""
    if isinstance(given.into, str):
        return given.model_copy(update={"into": place})
    return given.model_copy(update={"into": {place if b == body else b: s for b, s in (given.into or {}).items()}})


def _of_sensor(fitted: Fitted, channel: str) -> Iterator[Candidate]:
    part, network = fitted.part, fitted.problem.network
    sensor = part.sensors[channel]
    body = sensor.at.partition("@")[0]
    near = f"{channel}{NEAR_SUFFIX}"
    if near in part.bodies or part.bodies[body].shape != "lump":
        return
    cell = int(network.bodies[body][0])
    capacity = float(network.capacity_J_per_K(fitted.values)[cell])
    leaves = float(network.conductance_W_per_K(fitted.values)[cell, cell])
    own = partial(_piece, part.bodies[body], body, f"the sensor {channel}")
    piece = {
        **own(near, "near", POLICY.near_piece_capacity_share * capacity, POLICY.near_piece_conductance_factor * leaves),
        f"sensors.{channel}": sensor.model_copy(update={"at": near}),
    }
    where = Where("sensor", channel)
    yield from _shortcuts(fitted, body, channel, where, leaves)
    far = f"{channel}{FAR_SUFFIX}"
    if far not in part.bodies:
        yield Candidate(
            CandidateKind.COARSE_NETWORK.value,
            where,
            f"coarse_network_{channel}_far",
            f"a piece of the {body} far from {channel}",
            parts=own(far, "far from", POLICY.far_piece_capacity_share * capacity, leaves),
        )
    label = f"a piece of the {body} of its own around {channel}"
    yield Candidate(CandidateKind.COARSE_NETWORK.value, where, f"coarse_network_{channel}", label, parts=piece)
    ranked = sorted(part.links, key=lambda k: -_conductance(fitted, k))  # heat comes through the best ones
    for key in [k for k in ranked if body in ends_of(part.links[k])][: POLICY.coarse_entry_links]:
        link = part.links[key]
        ends = ends_of(link)
        moved = tuple(near if end == body else place for end, place in zip(ends, link.between, strict=True))
        other = ends[1 - ends.index(body)]
        yield Candidate(
            CandidateKind.COARSE_NETWORK.value,
            where,
            f"coarse_network_{channel}_{other}",
            f"{label}, through which the heat of {other} enters",
            parts={**piece, f"links.{key}": link.model_copy(update={"between": moved})},
        )
    for key in [k for k in (*found_since(fitted), *part.mechanisms) if body in _into(part.mechanisms[k])][
        : POLICY.coarse_heats
    ]:
        given, half = part.mechanisms[key], f"{body}@0.25"
        cut = Value(value=f"{POLICY.half_body_conductance_factor * leaves:.4g} W/K", spread=POLICY.coarse_log_sd)
        yield Candidate(
            CandidateKind.COARSE_NETWORK.value,
            where,
            f"coarse_network_{channel}_{key}",
            f"a half of the {body} with {channel}, which {MECHANISMS[given.law].summary} enters",
            parts={
                f"bodies.{body}": part.bodies[body].model_copy(update={"shape": "bar", "cells": 2, "conductance": cut}),
                f"sensors.{channel}": sensor.model_copy(update={"at": half}),
                f"mechanisms.{key}": _entering(given, body, half),
            },
        )


def _piece(
    whole: Body, body: str, sensor: str, name: str, where: str, capacity_J_per_K: float, conductance_W_per_K: float
) -> dict[str, BaseModel]:
    """A body of its own, `where` ("near") the sensor, and its link to the rest."""
    return {
        f"bodies.{name}": Body(
            capacity=Value(value=f"{capacity_J_per_K:.4g} J/K", spread=POLICY.coarse_log_sd),
            material=whole.material,
            words=f"{whole.words or body}, {where} {sensor}",
        ),
        f"links.{name}-{body}": Link(
            between=(name, body), conductance=Value(value=f"{conductance_W_per_K:.4g} W/K", spread=POLICY.coarse_log_sd)
        ),
    }


def _shortcuts(fitted: Fitted, body: str, channel: str, where: Where, leaves: float) -> Iterator[Candidate]:
    """Heat that crosses a body from one neighbour to another without warming all of it, or a neighbour from its own."""
    best = _nearest(fitted, body)
    across = [(one, body, other) for one, other in combinations(best, 2)]
    through = [(one, best[0], body) for one in _nearest(fitted, best[0]) if one != body] if best else []
    for one, between, other in (*across[: POLICY.coarse_shortcuts], *through[: POLICY.coarse_shortcuts]):
        if other in linked(fitted.part, one):
            continue
        yield Candidate(
            CandidateKind.COARSE_NETWORK.value,
            where,
            f"coarse_network_{channel}_{one}_{other}",
            f"heat that crosses the {between} from {one} to {other}",
            parts={
                f"links.{one}-{other}": Link(
                    between=(one, other),
                    conductance=Value(
                        value=f"{POLICY.shortcut_conductance_factor * leaves:.4g} W/K", spread=POLICY.shortcut_log_sd
                    ),
                )
            },
        )


def _nearest(fitted: Fitted, body: str) -> list[str]:
    """The body's neighbours, the best conducting first."""
    links, whole = fitted.part.links, pieces_of(fitted.part)
    here = whole.get(body, body)

    def conductance(other: str) -> float:
        pair = {here, other}
        return max(_conductance(fitted, k) for k in links if {whole.get(n, n) for n in ends_of(links[k])} == pair)

    return sorted(linked(fitted.part, body), key=lambda other: -conductance(other))


def _conductance(fitted: Fitted, key: str) -> float:
    network = fitted.problem.network
    return next((float(e.conductance(fitted.values)) for e in network.edges if e.name == key), 0.0)


DOUBTED_PARAMETERS = {"capacity", "mass", "conductance", "coefficient", "lag", "bonding", "follow"}


def alternatives(network: Network) -> list[Candidate]:
    """Every fixed value that recordings could contradict, and every heat whose size may differ from run to run."""
    amplitudes = heat_amplitudes(network)
    out = []
    for j, p in enumerate(network.parameters):
        place = _where(p)
        if place is None:
            continue
        last = p.name.rsplit(".", 1)[-1]
        if not p.free and p.value > 0 and p.scale != "linear" and (last in DOUBTED_PARAMETERS or j in amplitudes):
            out.append(_alternative(CandidateKind.WRONG_PARAMETER, place, p, Change(p, spread=POLICY.coarse_log_sd)))
        if j in amplitudes and p.scale != "linear" and p.value > 0 and p.per_batch == 0:
            out.append(
                _alternative(
                    CandidateKind.VARIES_BETWEEN_RUNS, place, p, Change(p, per_batch=POLICY.doubted_run_to_run_log_sd)
                )
            )
    return out


def _alternative(kind: CandidateKind, where: Where, p: Parameter, change: Change) -> Candidate:
    doubts = kind is CandidateKind.WRONG_PARAMETER
    label = "another value" if doubts else "a value that differs from run to run"
    name = f"{kind}_{p.name}".replace(".", "_").replace("-", "_").replace("@", "_")
    return Candidate(kind.value, where, name, f"{label}: {p.name}", change=change)


def heat_amplitudes(network: Network) -> set[int]:
    """Numbers of the parameters that scale a heat."""
    out = set()
    for heat in network.heats:
        for name in MECHANISMS[heat.law.mechanism.key].off or {}:
            if name in heat.law.parameters:
                out.add(heat.law.parameters[name])
    return out


def _where(p: Parameter) -> Where | None:
    group, name, *_ = p.name.split(".")
    kinds: dict[str, Kind] = {
        "bodies": "node", "links": "link", "exposures": "link", "sensors": "sensor", "errors": "error",
        "mechanisms": "node", "surroundings": "node",
    }  # fmt: skip
    return Where(kinds[group], name) if group in kinds else None
