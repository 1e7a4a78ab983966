"""Rivals that need no new physics: a value of the machine file that is wrong, or that differs from run to run."""

from __future__ import annotations

from twin.diagnosis.proposals.candidate import Candidate, Change, Kind, Where
from twin.mechanisms import MECHANISMS
from twin.network import Network
from twin.quantity import Parameter

SPREAD = 1.0  # of the logarithm of a value that may be wrong: a factor of 2.7
PER_BATCH = 0.2  # of the logarithm, from run to run
DOUBTED = {"capacity", "mass", "conductance", "coefficient", "lag", "bonding", "follow"}


def rivals(network: Network) -> list[Candidate]:
    """Every fixed value that a recording could prove wrong, and every heat whose size may differ from run to run."""
    amplitudes = heat_amplitudes(network)
    out = []
    for j, p in enumerate(network.parameters):
        place = _where(p)
        if place is None:
            continue
        last = p.name.rsplit(".", 1)[-1]
        if not p.free and p.value > 0 and p.scale != "linear" and (last in DOUBTED or j in amplitudes):
            out.append(_rival("wrong_parameter", place, p, Change(p, spread=SPREAD)))
        if j in amplitudes and p.scale != "linear" and p.value > 0 and p.per_batch == 0:
            out.append(_rival("varies_between_runs", place, p, Change(p, per_batch=PER_BATCH)))
    return out


def _rival(key: str, where: Where, p: Parameter, change: Change) -> Candidate:
    words = {"wrong_parameter": "another value", "varies_between_runs": "a value that differs from run to run"}[key]
    name = f"{key}_{p.name}".replace(".", "_").replace("-", "_").replace("@", "_")
    return Candidate(key, where, name, f"{words}: {p.name}", change=change)


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
