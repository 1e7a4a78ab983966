"""The cell: its lost voltage heats it, its charge makes it grow. Values: the full file, calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from data.batch import Batch
from plants.real import term
from plants.withheld.kept_back import KeptBack, Term

NEUTRAL_V = (4.113, 4.056, 3.938, 3.827, 3.712, 3.646, 3.507, 3.233)
STRAIN_UM_PER_M = (
    -101.6, -49.27, -99.87, -181.9, -246.2, -263.3, -232.6, -195.0, -144.4, -74.93, -23.54, 2.359,
)  # fmt: skip
STRAIN_UM_PER_M_K = (15.92, 7.513, -1.334, -3.936, -5.299)
CALIBRATED: Mapping[str, float] = MappingProxyType(
    {f"mechanisms.heat.u{k}": v for k, v in enumerate(NEUTRAL_V)}
    | {f"mechanisms.growth.f{k}": v for k, v in enumerate(STRAIN_UM_PER_M, 1)}
    | {f"mechanisms.growth.g{k}": v for k, v in enumerate(STRAIN_UM_PER_M_K)}
    | {"mechanisms.loss.area": 0.01816}
)
JOULE = {
    "law": "ohmic_heat", "drivers": {"current": "current"}, "at": "core", "into": "core",
    "parameters": {"resistance": {"value": "25 mohm", "spread": 0.7}},
}  # fmt: skip
WARMTH = {"chain": [{"body": "can", "gain": {"value": "10 um/m/K", "spread": "20 um/m/K"}}], "noise": "1.1 um/m"}


def _values(mechanism: str, unit: Mapping[str, str]) -> dict[str, tuple[float, str]]:
    """Calibrated parameters of a mechanism; the unit goes by the first letter of the name."""
    start = f"mechanisms.{mechanism}."
    own = {k.removeprefix(start): v for k, v in CALIBRATED.items() if k.startswith(start)}
    return {k: (v, unit[k[0]]) for k, v in own.items()}


def lost_voltage(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    """Heat by what the cell's voltage lacks."""
    return [
        term(
            "voltage_loss_heat", "voltage_loss_heat", ("node", "core"), parameters=_values("heat", {"u": "V"}),
            neighbours=["can"], driver="current times voltage", words="the cell's lost voltage warms its core",
        )
    ]  # fmt: skip


def charge(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    """Growth with the charge drawn."""
    return [
        term(
            "charge_strain", "charge_strain", ("error", "hoop_strain"),
            parameters=_values("growth", {"f": "um/m", "g": "um/m/K"}), driver="current",
            words="the electrodes swell and shrink with the charge",
        )
    ]  # fmt: skip


def both(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    return [*lost_voltage(twin, batches), *charge(twin, batches)]


def fourth_power(twin: Mapping[str, Any], batches: list[Batch]) -> list[Term]:
    """Radiation, where the file has a linear exchange only."""
    values = {"area": (CALIBRATED["mechanisms.loss.area"], "m**2"), "emissivity": (0.9, "1")}
    return [
        term(
            "radiation", "radiation", ("node", "can"), parameters=values, neighbours=["core"],
            same_as=[("natural_convection", ("node", "can"))],
            words="the loss grows faster than the temperature difference",
        )
    ]  # fmt: skip


CASES = (
    KeptBack(
        "cell_lost_voltage", "cell_30q", "Joule heat instead of the heat by lost voltage", lost_voltage,
        instead={"mechanisms.heat": JOULE},
    ),
    KeptBack(
        "cell_charge", "cell_30q", "growth with the charge kept back", charge,
        without=("mechanisms.growth",), instead={"errors.hoop_strain": WARMTH},
    ),
    KeptBack(
        "cell_both", "cell_30q", "Joule heat and thermal expansion alone", both, kind="two",
        without=("mechanisms.growth",), instead={"mechanisms.heat": JOULE, "errors.hoop_strain": WARMTH},
    ),
    KeptBack(
        "cell_radiation", "cell_30q", "a linear loss instead of radiation", fourth_power,
        without=("mechanisms.loss",), instead={"exposures": {"can-room": {"value": "0.1 W/K", "spread": 0.7}}},
    ),
)  # fmt: skip
