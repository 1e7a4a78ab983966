"""What a plant knows of a casting before it is cut into cells or elements: name, material, mass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Cells = NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """Handbook values: kg/m³, J/kg/K, W/m/K, µm/m/K."""

    density_kg_per_m3: float
    specific_heat_J_per_kgK: float
    conductivity_W_per_mK: float
    expansion_um_per_mK: float


MATERIALS: Mapping[str, Material] = MappingProxyType({
    "steel": Material(7850.0, 460.0, 48.0, 11.5),
    "cast_iron": Material(7200.0, 500.0, 50.0, 10.8),
})  # fmt: skip


@dataclass(frozen=True)
class Casting:
    """One solid part of the machine; its material is one of `MATERIALS`."""

    name: str
    material: str
    mass_kg: float
