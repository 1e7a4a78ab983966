"""Alternatives that need no new physics: values of the machine file that recordings contradict."""

from __future__ import annotations

from diagnosis.contracts import Candidate, CandidateKind, Change, Kind, Where
from diagnosis.policy import POLICY
from twin.mechanisms import MECHANISMS
from twin.network import Network
from twin.quantity import Parameter

DOUBTED_PARAMETERS = {"capacity", "mass", "conductance", "coefficient", "lag", "bonding", "follow"}


def alternatives(network: Network) -> list[Candidate]:
    """Every fixed value that recordings could contradict."""
    amplitudes = heat_amplitudes(network)
    out = []
    for j, p in enumerate(network.parameters):
        place = _where(p)
        if place is None:
            continue
        last = p.name.rsplit(".", 1)[-1]
        if not p.free and p.value > 0 and p.scale != "linear" and (last in DOUBTED_PARAMETERS or j in amplitudes):
            name = f"{CandidateKind.WRONG_PARAMETER}_{p.name}"
            for sign in ".-@":
                name = name.replace(sign, "_")
            change = Change(p, spread=POLICY.doubted_value_log_sd)
            out.append(Candidate("wrong_parameter", place, name, f"another value: {p.name}", change=change))
    return out


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
