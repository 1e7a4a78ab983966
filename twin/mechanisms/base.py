"""Base class of the mechanisms, and functions for writing their laws.

To add a mechanism, write a subclass of `Mechanism` in the file of its group and a line in
`twin/mechanisms/__init__.py`. It declares its drivers, ports and parameters and overrides one or two effects. Laws are
plain numpy on arrays of any shape. Derivatives are taken by complex steps (Squire and Trapp 1998), so a law must be
analytic: use `size`, `power`, and `numpy.where` on `real` values instead of abs() and comparisons.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from data.arrays import Numeric
from data.errors import closest
from twin.quantity import Spec, Value

if TYPE_CHECKING:
    from twin.schema import MechanismPart, TwinPart

Target = Literal["node", "link", "exposure", "heat", "sensor", "error", "surrounding", "start"]

# Where a diagnosis places a port: at the target, at each surrounding, at each body linked with the target (of an error,
# with the previous port), at any other body, at a body without a link to the target (each pair once), at a surrounding
# or a body, or where the multiplied heat goes.
PortRole = Literal["itself", "surrounding", "neighbour", "body", "unlinked", "facing", "outlet"]
SURROUNDING_PORTS = ("air", "surrounding", "room", "supply")  # by these names a port is a surrounding

# What a mechanism may need that not every machine has; see `Mechanism.needs`.
EQUIPMENT = frozenset({
    "battery cell", "bearings", "ball screw", "belt", "cabinet", "coolant jacket", "cutting", "cutting fluid",
    "enclosure", "guides", "heater", "hydraulic unit", "motor", "rotating parts", "test bar", "window",
})  # fmt: skip


@dataclass(frozen=True)
class View:
    """Inputs of a law. All arrays broadcast together; time is the last axis.

    degC: temperatures by port. rise_K: the same less the batch's first value. driver: driver channels by the law's
    own names for them (held during each interval). time_s from the batch's start; clock_h the time of day, nan where
    the start is not known. step_s: the spacing of the last axis where a law works along it (sensors, paths).
    """

    degC: Mapping[str, Numeric] = field(default_factory=dict)
    rise_K: Mapping[str, Numeric] = field(default_factory=dict)
    driver: Mapping[str, Numeric] = field(default_factory=dict)
    time_s: Numeric = field(default_factory=lambda: np.zeros(1))
    clock_h: Numeric = field(default_factory=lambda: np.full(1, np.nan))
    step_s: float = np.nan


class Mechanism(ABC):
    """A physical effect that a machine file can use and a diagnosis can propose.

    Parameters reach the effects as a mapping name -> value (scalar or array that broadcasts), in the units stated.
    """

    key: ClassVar[str]
    summary: ClassVar[str]  # "viscous friction of the bearings": the name an engineer would use
    equation: ClassVar[str]  # plain text
    source: ClassVar[str]  # author, year, equation
    signature: ClassVar[str]  # how it shows in recordings
    acts_at: ClassVar[tuple[Target, ...]]
    drivers: ClassVar[Mapping[str, str]] = {}  # the law's name for a driver -> unit
    optional_drivers: ClassVar[frozenset[str]] = frozenset()  # those of `drivers` that a machine file may leave out
    any_unit: ClassVar[frozenset[str]] = frozenset()  # those of `drivers` whose channel may have any unit, its own
    takes_from: ClassVar[str | None] = None  # the port that loses the heat which `into` gains, where it is a body
    ports: ClassVar[tuple[str, ...]] = ()  # names of the temperatures that the law needs
    optional_ports: ClassVar[frozenset[str]] = frozenset()  # those of `ports` that a machine file may leave out
    parameters: ClassVar[tuple[Spec, ...]] = ()
    along_time: ClassVar[bool] = False  # True: the effect at a time needs the times before it (lag, slip, hysteresis)

    # What a diagnosis needs
    off: ClassVar[Mapping[str, float] | None]  # what scales the effect, at the values without one; None: nothing does
    shape: ClassVar[tuple[str, ...]] = ()  # parameters that change its form in time or over drivers, not its size
    null_values: ClassVar[Mapping[str, float]] = {}  # of a structural mechanism that is disabled
    fault: ClassVar[bool] = False  # True: of a sensor or a clock, no physics of the machine
    port_roles: ClassVar[Mapping[str, PortRole]] = {}  # of every port; the usual ones need not be stated
    together: ClassVar[int] = 1  # how many targets one instance acts on
    needs: ClassVar[str] = ""  # the equipment without which it cannot be, one of `EQUIPMENT`; "": any machine
    # Values, besides the usual one, at which a diagnosis evaluates it, by parameter. A parameter of `shape`: the
    # amplitude is screened at each. A parameter of `off`: it is not linear in it, each value is a finite change.
    scan: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    scan_points: ClassVar[tuple[Mapping[str, float], ...]] = ()  # the same where several parameters go together
    window: ClassVar[tuple[str, str] | None] = None  # start and duration of what happens once in a run
    # Parameters that mean something only with an optional port: that port, and the value of a candidate that names it
    # (None: the usual one).
    of_port: ClassVar[Mapping[str, tuple[str, float | None]]] = {}
    all_errors: ClassVar[bool] = False  # True: one instrument shows all errors, so it may act on all of them together
    all_air: ClassVar[bool] = False  # True: it may act on all surroundings of one recorded channel together
    multiplies: ClassVar[tuple[str, ...]] = ()  # the heat laws that it makes sense on; none named: any
    of_network: ClassVar[bool] = False  # True: a property of the network's discretisation, not of a real body
    goes_with: ClassVar[tuple[str, ...]] = ()  # laws of which one acts at the same place in every real machine
    only_driven: ClassVar[bool] = False  # True: proposed only with its optional driver
    proposable: ClassVar[bool] = True  # False: no use as a candidate

    linear_reading: ClassVar[bool] = False  # True: `reading` is affine in the temperatures that it depends on

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Fills in the usual roles: at a node the first port is the node itself, and air is a surrounding."""
        super().__init_subclass__(**kwargs)
        itself = cls.ports[:1] if "node" in getattr(cls, "acts_at", ()) else ()
        usual: dict[str, PortRole] = {port: "itself" for port in itself}
        usual |= {port: "surrounding" for port in cls.ports if port in SURROUNDING_PORTS}
        cls.port_roles = {**usual, **cls.port_roles}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        """Heat into the places of `into`, W, in the shape of the view. A law with ports is temperature-dependent."""
        raise NotImplementedError

    def factor(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        """Factor on the conductance of a link or exposure (drivers only), or on another mechanism's heat."""
        raise NotImplementedError

    def displacement(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        """Added to an error channel, in the channel's unit, in the shape of the view."""
        raise NotImplementedError

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        """Reading of a sensor or probe from the true value, in the channel's unit; time along the last axis."""
        raise NotImplementedError

    def surrounding_K(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        """Added to a surrounding's temperature, K, in the shape of the view."""
        raise NotImplementedError

    def start_K(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        """Added to the start temperature of every place of `into`, K."""
        raise NotImplementedError

    def multiplying(self, law: str) -> Mechanism:
        """The mechanism as it multiplies the heat of this law; another object where the factor depends on the law."""
        return self

    def at_work(self, view: View, p: Mapping[str, Numeric]) -> Numeric | None:
        """Activity, 0 to 1, for mechanisms with time windows; None: active while its drivers run, or always."""
        return None

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        """A structural mechanism's work: the twin part with its bodies, links, exposures or chain links added.

        The instance itself is removed by the caller. Default: nothing to add.
        """
        return twin

    def given(self, name: str, part: MechanismPart) -> dict[str, Value]:
        """Every parameter as the file gives it, with the value and bounds of its `Spec` where it does not.

        Raises:
            ValueError: a parameter that the mechanism does not have, with the closest.
        """
        self.check_names(name, part)
        out = {}
        for spec in self.parameters:
            value = part.parameters.get(spec.name) or Value(value=spec.value or 0.0, source=self.source)
            out[spec.name] = value if value.bounds else value.model_copy(update={"bounds": (spec.low, spec.high)})
        return out

    def check_names(self, name: str, part: MechanismPart) -> None:
        """Raises ValueError: a parameter that the mechanism does not have, with the closest."""
        names = [s.name for s in self.parameters]
        for p in part.parameters:
            if p not in names:
                raise ValueError(
                    f"mechanisms.{name}.parameters: {self.key} has no parameter {p!r}; {closest(p, names)}"
                )

    @classmethod
    def effects(cls) -> tuple[str, ...]:
        """Names of the effects that this class has."""
        return _effects(cls)

    @classmethod
    def spec(cls, name: str) -> Spec:
        return next(s for s in cls.parameters if s.name == name)


def real(a: Numeric) -> NDArray[np.float64]:
    """The real part, for comparisons in `numpy.where` that must not see a derivative's imaginary part."""
    return np.real(a)


@cache
def _effects(mechanism: type[Mechanism]) -> tuple[str, ...]:
    every = ("heat_W", "factor", "displacement", "reading", "surrounding_K", "start_K", "expand")
    return tuple(e for e in every if getattr(mechanism, e) is not getattr(Mechanism, e))


ZERO_DEGC_K = 273.15
REFERENCE_DEGC = 20.0  # ISO 1


def size(x: Any) -> Numeric:
    """|x| by the sign of the real part, any shape."""
    return np.asarray(np.where(real(x) < 0, -x, x))


def power(x: Any, exponent: Any) -> Numeric:
    """|x| ** exponent for exponents above 0, exactly 0 where x is 0; the arguments broadcast."""
    rests = real(x) == 0
    return np.asarray(np.where(rests, 0.0, np.where(rests, 1.0, size(x)) ** exponent))


def steps_s(view: View) -> Numeric:
    """Length of the interval that follows each time, s, shape of `time_s`; the last is as long as the one before it."""
    if view.time_s.shape[-1] < 2:
        return np.full(view.time_s.shape, view.step_s)
    steps = np.diff(view.time_s, axis=-1)
    return np.concatenate([steps, steps[..., -1:]], axis=-1)


def course(share: Numeric, *values: Numeric) -> Numeric:
    """The natural cubic spline through `values` at shares 0 … 1 of the range; beyond its ends, the end's value.

    All arguments broadcast. Linear in the values, so that a fit of them stays easy; equal values give exactly
    themselves.
    """
    inside = np.where(real(share) < 0, 0.0, np.where(real(share) > 1, 1.0, share))
    points = inside * (len(values) - 1)
    piece = np.minimum(np.floor(real(points)).astype(int), len(values) - 2)
    beyond = points - piece
    out = values[0]
    for value, (cubic, square, slope, constant) in zip(values[1:], _pieces(len(values))[1:, :, piece], strict=True):
        weight = ((cubic * beyond + square) * beyond + slope) * beyond + constant
        out = out + weight * (value - values[0])
    return np.asarray(out)


@cache
def _pieces(n: int) -> NDArray[np.float64]:
    """Coefficients (n, 4, n - 1): what each value adds, by power from the third down and by piece."""
    from scipy.interpolate import CubicSpline  # takes long to load

    return np.moveaxis(CubicSpline(np.arange(n), np.eye(n), bc_type="natural").c, -1, 0)
