"""Built-in materials: specific heat [J/kg/K], conductivity [W/m/K], expansion [um/m/K], typical values at 20 degC."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

# The expansions of steel and iron are those of the sample machine; the rest are handbook values.
MATERIALS: Mapping[str, Mapping[str, float]] = MappingProxyType({
    "steel": {"specific_heat": 460.0, "conductivity": 48.0, "expansion": 11.5},
    "cast_iron": {"specific_heat": 500.0, "conductivity": 50.0, "expansion": 10.8},
    "aluminium": {"specific_heat": 900.0, "conductivity": 160.0, "expansion": 23.5},
    "polymer_concrete": {"specific_heat": 900.0, "conductivity": 1.7, "expansion": 16.0},
    "granite": {"specific_heat": 800.0, "conductivity": 2.8, "expansion": 6.5},
    "invar": {"specific_heat": 515.0, "conductivity": 11.0, "expansion": 1.3},
    "brass": {"specific_heat": 380.0, "conductivity": 115.0, "expansion": 19.0},
    "copper": {"specific_heat": 385.0, "conductivity": 390.0, "expansion": 16.8},
})  # fmt: skip
