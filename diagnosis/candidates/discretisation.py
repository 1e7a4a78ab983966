"""What a lumped network gets wrong by itself, and every fit may therefore do: it is no news.

A sensor in a casting stands in a gradient that a lump does not have, and is late, or early where it is near the heat; a
length of an error's chain spans part of its body, nearer to one neighbour than the body's mean, and bodies beside the
chain tilt it a little; a film that is stated as a constant follows its temperature difference; a heat is not the same
in every run to the last per cent. Without slack the difference passes for physics.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diagnosis.candidates.alternatives import heat_amplitudes
from diagnosis.contracts import Candidate, Fitted

LOOSE = ("sensor_place", "sensor_lag", "time_skew", "column_bending", "spindle_growth", "natural_convection")
PLACE = 0.1  # sd of the share of a neighbour's lead that a sensor sees
SPAN = 0.15  # the same of a length of an error's chain
NOSE = 0.5  # and of one in a small body, whose ends are as far apart as its neighbours are
BESIDE = 0.1  # sd of what a body outside an error's chain adds to it, of the chain's largest
SMALL = 0.03  # of the machine's capacity: what is smaller carries no bending that an error shows
LAG_S, LAG = 240.0, 1.5  # sd of a lag where the file states none; of the logarithm of one that it holds fixed
FILM = 0.2  # sd of a natural film's area in m2 for each W/K that the file states as a constant: about all of it
RUN = 0.05  # sd of the logarithm of a heat, and of an exposure, from run to run
SKEW = 0.1  # of the rows' step: a row is the mean about its time, which blurs a corner to both sides


def slack(proposed: Sequence[Candidate], fitted: Fitted) -> dict[str, float]:
    """By name of a candidate the prior sd of its amplitude, for those that every fit has."""
    out = {}
    gains, small, films = _chain_gains(fitted), _small(fitted), _films(fitted)
    for c in proposed:
        if c.mechanism == "sensor_place":
            out[c.name] = PLACE
        elif c.mechanism == "time_skew":
            out[c.name] = LAG_S if c.where.kind == "sensor" else SKEW * fitted.step_s
        elif c.mechanism == "natural_convection":
            if (stated := films.get((c.where.name, _air(c)), 0.0)) > 0:
                out[c.name] = FILM * stated
        elif c.mechanism == "sensor_lag":
            out[c.name] = LAG_S
        elif c.mechanism == "wrong_parameter" and c.change is not None and c.change.parameter.name.endswith(".lag"):
            out[c.name] = LAG
        elif c.mechanism == "column_bending":
            sides = _sides(c)
            share = NOSE if sides & small else SPAN
            out[c.name] = share * max(abs(gains.get((c.where.name, side), 0.0)) for side in sides)
        elif c.mechanism == "spindle_growth":
            (body,) = _sides(c)
            if (c.where.name, body) not in gains:
                out[c.name] = BESIDE * max((abs(g) for (e, _), g in gains.items() if e == c.where.name), default=0.0)
    return {name: sd for name, sd in out.items() if sd > 0}


def no_news(proposed: Sequence[Candidate], fitted: Fitted) -> set[str]:
    """Those that any size is a lumped network's own fault of: never reported as found."""
    small = _small(fitted)
    return {
        c.name
        for c in proposed
        if c.mechanism == "sensor_place"
        or (c.mechanism == "column_bending" and _sides(c) & small)
        or (c.mechanism == "time_skew" and c.where.kind == "sensor")  # sensors share a logger
    }


def from_run_to_run(fitted: Fitted) -> dict[int, float]:
    """By number of a fit's unknown the sd, in its coordinate, that every batch may have of its own about it.

    Of what the machine file states: what was found since is claimed to be the same in every run.
    """
    network = fitted.problem.network
    stated = (fitted.machine.twin or {}).get("mechanisms", fitted.part.mechanisms)
    heats = {name for j in heat_amplitudes(network) if (name := network.parameters[j].name).split(".")[1] in stated}
    out = {}
    for k, u in enumerate(fitted.problem.unknowns):
        p = network.parameters[network.index(u.name)]
        film = u.name.startswith("exposures.") and u.name.endswith((".conductance", ".coefficient"))
        if p.scale == "log" and p.per_batch == 0 and (film or u.name in heats):
            out[k] = RUN
    return out


def _sides(c: Candidate) -> set[str]:
    assert c.part is not None and isinstance(c.part.at, dict)
    return set(c.part.at.values())


def _air(c: Candidate) -> str:
    assert c.part is not None and isinstance(c.part.at, dict)
    return str(c.part.at["air"])


def _films(fitted: Fitted) -> dict[tuple[str, str], float]:
    """By body and surrounding the conductance that the fit has between them, W/K.

    What a body gives to an enclosure's air counts as given to what that air exchanges with.
    """
    conductance = {e.name: float(e.conductance(fitted.values)) for e in fitted.problem.network.edges}
    exposures = fitted.part.exposures
    around: dict[str, list[str]] = {}
    for e in exposures.values():
        around.setdefault(e.of.partition("@")[0], []).append(e.to)
    out: dict[tuple[str, str], float] = {}
    for name, e in exposures.items():
        for air in around.get(e.to, [e.to]):
            key = e.of.partition("@")[0], air
            out[key] = out.get(key, 0.0) + conductance.get(name, 0.0)
    return out


def _small(fitted: Fitted) -> set[str]:
    """Bodies too small to bend what the tool hangs on."""
    network = fitted.problem.network
    every = network.capacity_J_per_K(fitted.values)
    own = {name: float(every[cells].sum()) for name, cells in network.bodies.items()}
    return {name for name, capacity in own.items() if capacity < SMALL * sum(own.values())}


def _chain_gains(fitted: Fitted) -> dict[tuple[str, str], float]:
    """By error and body what a kelvin of the body adds, tilts left aside; in the error's unit."""
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
