"""Discretisation errors of a lumped network, which every fit may take up as slack.

A sensor in a casting sits in a gradient that a lump does not have: it lags, or leads where it is near the heat. A
length of an error chain spans a part of its body, and bodies outside the chain tilt it a little. Without slack these
errors would pass for physics. Their common size is a hyperparameter of every fit (`marginal.Hyper.imperfections`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diagnosis.contracts import Candidate, CandidateKind, Point, Where
from diagnosis.policy import POLICY
from twin.mechanisms import MECHANISMS
from twin.schema import MechanismPart

SLACK_MECHANISMS = (
    "sensor_place",
    "sensor_lag",
    "column_bending",
    "spindle_growth",
    "sensor_bonding",
    "sensor_offset",
)


def slack(proposed: Sequence[Candidate], fitted: Point) -> dict[str, float]:
    """Prior sd of the amplitude, by candidate, of those that every fit has as slack."""
    out = {}
    gains, small = _chain_gains(fitted), _small(fitted)
    for c in proposed:
        if c.variant_of:
            continue
        if c.mechanism == "sensor_place":
            out[c.name] = POLICY.sensor_place_sd
        elif c.mechanism == "sensor_bonding":
            out[c.name] = POLICY.sensor_bonding_sd
        elif c.mechanism == "sensor_offset":
            out[c.name] = POLICY.sensor_offset_sd_K
        elif c.mechanism == "sensor_lag":
            out[c.name] = POLICY.sensor_lag_sd_s
        elif (
            c.kind is CandidateKind.WRONG_PARAMETER
            and c.change is not None
            and c.change.parameter.name.endswith(".lag")
        ):
            out[c.name] = POLICY.held_lag_log_sd
        elif c.mechanism == "column_bending":
            sides = _sides(c)
            share = POLICY.small_body_span_sd if sides & small else POLICY.chain_span_sd
            out[c.name] = share * max(abs(gains.get((c.where.name, side), 0.0)) for side in sides)
        elif c.mechanism == "spindle_growth":
            (body,) = _sides(c)
            if (c.where.name, body) not in gains:
                out[c.name] = POLICY.outside_body_sd * max(
                    (abs(g) for (e, _), g in gains.items() if e == c.where.name), default=0.0
                )
    return {name: sd for name, sd in out.items() if sd > 0}


def never_reported(proposed: Sequence[Candidate], fitted: Point) -> set[str]:
    """Names of the candidates that a lumped network explains at any size; they are never reported."""
    small = _small(fitted)
    return {
        c.name
        for c in proposed
        if c.mechanism == "sensor_place"
        or (c.mechanism == "column_bending" and _sides(c) & small)
        or (c.mechanism == "time_skew" and c.where.kind == "sensor")  # sensors share a logger
    }


def _sides(c: Candidate) -> set[str]:
    assert c.part is not None and isinstance(c.part.at, dict)
    return set(c.part.at.values())


def films_that_rise(fitted: Point) -> list[tuple[Candidate, float]]:
    """Heat of every exposure that grows faster than its temperature difference, with the sd of its size: films rise by
    natural convection and radiation (McAdams 1954)."""
    conductance = {e.name: float(e.conductance(fitted.values)) for e in fitted.problem.network.edges}
    out = []
    for key, film in fitted.part.exposures.items():
        law = MechanismPart(law="natural_convection", at={"body": film.of, "air": film.to}, into=film.of)
        name = f"rising_{key}".replace("-", "_")
        rising = Candidate(law.law, Where("node", film.of), name, "", law, dict(MECHANISMS[law.law].off or {}))
        out.append((rising, POLICY.rising_film_share * conductance[key] / POLICY.rising_W_per_m2K))
    return out


def _small(fitted: Point) -> set[str]:
    """Bodies whose capacity is too small to bend the structure that carries the tool."""
    network = fitted.problem.network
    every = network.capacity_J_per_K(fitted.values)
    own = {name: float(every[cells].sum()) for name, cells in network.bodies.items()}
    return {name for name, capacity in own.items() if capacity < POLICY.small_body_capacity_share * sum(own.values())}


def _chain_gains(fitted: Point) -> dict[tuple[str, str], float]:
    """Displacement per kelvin, in the error's unit, by error and body; tilts are left out."""
    network = fitted.problem.network
    out: dict[tuple[str, str], float] = {}
    for e in network.errors:
        for row, gain in zip(e.rows, e.gains, strict=True):
            if abs(float(np.sum(row))) < 1e-9:  # two sides of a tilt
                continue
            for name, cells in network.bodies.items():
                if share := float(np.sum(row[cells])):
                    out[e.channel, name] = out.get((e.channel, name), 0.0) + share * float(gain(fitted.values))
    return out
