"""What every reader of a part of the twin needs: the machine, its parameter table, its cells, the laws made so far."""

from __future__ import annotations

from dataclasses import dataclass, field

from data.machine import Machine
from twin.compiling.cells import Cells
from twin.compiling.parameters import ParameterTable
from twin.network import Law
from twin.quantity import convert
from twin.schema import TwinPart


@dataclass
class Scope:
    """Filled while one network is compiled."""

    machine: Machine
    part: TwinPart
    table: ParameterTable
    cells: Cells
    drivers: set[str] = field(default_factory=set)  # channels that some law needs
    laws: dict[str, Law] = field(default_factory=dict)

    @classmethod
    def of(cls, machine: Machine, part: TwinPart) -> Scope:
        return cls(machine, part, ParameterTable(part), Cells(part.bodies))

    @property
    def surroundings(self) -> dict[str, int]:
        """Numbers of the surroundings by name."""
        return {name: k for k, name in enumerate(self.part.surroundings)}


def several(on: tuple[str, ...] | str | None) -> tuple[str, ...]:
    return (on,) if isinstance(on, str) else on or ()


def number(key: str, given: str | float, unit: str) -> float:
    try:
        value = convert(given, unit)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None
    if value < 0:
        raise ValueError(f"{key}: got {given!r}, expected 0 {unit} or more")
    return value
