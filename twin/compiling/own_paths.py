"""Where a machine file holds the values that a structural mechanism writes elsewhere in the network."""

from __future__ import annotations

from data.machine import Machine
from twin.compile import compile_network
from twin.compiling.laws import mechanism_of
from twin.quantity import Value
from twin.schema import TwinPart

_MARK = "own path: "


def own_paths(machine: Machine, part: TwinPart) -> dict[str, str]:
    """By parameter of the network: ``{"exposures.bed-sink.conductance": "mechanisms.sink.conductance"}``.

    Parameters that stand under their own path are left out. Every value of a structural mechanism is marked, and the
    marks are looked for in the compiled network, so that a new mechanism needs nothing here.

    Raises:
        InputError: the part makes no sense.
    """
    marked = {}
    for name, given in part.mechanisms.items():
        mechanism = mechanism_of(name, given)
        if "expand" in mechanism.effects():
            values = {}
            for s in mechanism.parameters:
                held = given.parameters.get(s.name) or Value(value=s.value or 0.0)
                values[s.name] = held.model_copy(update={"source": f"{_MARK}mechanisms.{name}.{s.name}"})
            marked[name] = given.model_copy(update={"parameters": values})
    if not marked:
        return {}
    part = part.model_copy(update={"mechanisms": {**part.mechanisms, **marked}})
    parameters = compile_network(machine, part=part).parameters
    return {p.name: p.source.removeprefix(_MARK) for p in parameters if p.source.startswith(_MARK)}
