"""Parameter table: every value of a twin part by its path, created once."""

from __future__ import annotations

from data.errors import closest
from twin.quantity import Monomial, Parameter, Spec, Value, parameter
from twin.schema import MATERIALS, Body, TwinPart

CAPACITY = Spec("capacity", "J/K", "a heat capacity")
MASS = Spec("mass", "kg", "a mass")
CONDUCTANCE = Spec("conductance", "W/K", "a conductance", spread=0.5)
AREA = Spec("area", "m**2", "an area")
COEFFICIENT = Spec("coefficient", "W/m**2/K", "a heat transfer coefficient")
LENGTH = Spec("length", "m", "a length")
SHARE = Spec("share", "1", "a share of the heat", scale="logit")
TEMPERATURE = Spec("value", "degC", "a temperature", scale="linear")
OFFSET = Spec("offset", "K", "an offset", scale="linear")
MATERIAL = {
    "specific_heat": Spec("specific_heat", "J/kg/K", "a specific heat"),
    "conductivity": Spec("conductivity", "W/m/K", "a thermal conductivity"),
    "expansion": Spec("expansion", "um/m/K", "a coefficient of thermal expansion"),
}


class ParameterTable:
    """Collects parameters by path; a repeated path gives the same number."""

    def __init__(self, part: TwinPart) -> None:
        self.part = part
        self.rows: list[Parameter] = []
        self._number: dict[str, int] = {}

    def add(self, path: str, spec: Spec, given: Value | None, source: str = "") -> int:
        """Number of the parameter at a path.

        Raises:
            ValueError: see `twin.quantity.parameter`.
        """
        if path not in self._number:
            self._number[path] = len(self.rows)
            self.rows.append(parameter(path, spec, given, source))
        return self._number[path]

    def one(self, path: str, spec: Spec, given: Value | None) -> Monomial:
        """The parameter by itself."""
        return Monomial(1.0, ((self.add(path, spec, given), 1.0),))

    def material(self, name: str | None, quantity: str, key: str) -> int:
        """A material's property, shared by all that are made of it.

        Raises:
            ValueError: no material given, or an unknown one.
        """
        if name is None:
            raise ValueError(f"{key}: needs {MATERIAL[quantity].words}; give 'material' or write the value here")
        path = f"materials.{name}.{quantity}"
        if name in self.part.materials:
            return self.add(path, MATERIAL[quantity], getattr(self.part.materials[name], quantity))
        if name not in MATERIALS:
            raise ValueError(f"{key}: no material {name!r}; {closest(name, {*MATERIALS, *self.part.materials})}")
        return self.add(path, MATERIAL[quantity], Value(value=MATERIALS[name][quantity]), "handbook")

    def capacity(self, name: str, body: Body) -> Monomial:
        """Of the whole body, J/K."""
        key = f"bodies.{name}"
        if body.capacity is not None and body.mass is None:
            return self.one(f"{key}.capacity", CAPACITY, body.capacity)
        if body.mass is not None and body.capacity is None:
            heat = self.material(body.material, "specific_heat", f"{key}.mass")
            return Monomial(1.0, ((self.add(f"{key}.mass", MASS, body.mass), 1.0), (heat, 1.0)))
        raise ValueError(
            f"{key}: give either capacity or mass with a material, not {'both' if body.mass else 'neither'}"
        )

    def inside(self, name: str, body: Body) -> tuple[Monomial, Monomial]:
        """Conductances end to end along the first and the second side of a bar or plate, W/K."""
        key = f"bodies.{name}"
        if body.conductance is not None:
            if body.shape == "plate":
                raise ValueError(
                    f"{key}.conductance: a plate conducts two ways; give length, width, thickness, material"
                )
            along = self.one(f"{key}.conductance", CONDUCTANCE, body.conductance)
            return along, along
        conductivity = (self.material(body.material, "conductivity", f"{key}.material"), 1.0)
        length = self.add(f"{key}.length", LENGTH, body.length)
        if body.shape == "bar":
            along = Monomial(1.0, (conductivity, (self.add(f"{key}.area", AREA, body.area), 1.0), (length, -1.0)))
            return along, along
        width = self.add(f"{key}.width", LENGTH, body.width)
        sheet = (conductivity, (self.add(f"{key}.thickness", LENGTH, body.thickness), 1.0))
        return Monomial(1.0, (*sheet, (width, 1.0), (length, -1.0))), Monomial(
            1.0, (*sheet, (length, 1.0), (width, -1.0))
        )
