"""Of every mechanism: its equation once more with units that pint checks, see `tests.toys.points.Case`.

The law itself sees bare numbers; both must agree, so a Spec that states the wrong unit, by dimension or by a factor, is
found out. Constants of empirical laws carry their units too.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from tests.toys.points import ZERO, Case, U

K = U.kelvin
SIGMA = U.Quantity(5.670374419e-8, "W/m**2/K**4")
PALMGREN = U.Quantity(1.047e-4, "W/rpm/N/mm")


def _viscous(q: SimpleNamespace) -> Any:
    film = q.viscosity * q.speed / U("mm**2/s * rpm")
    return (
        q.count
        * PALMGREN
        * q.speed
        * 1e-7
        * U("N*mm")
        * q.lubrication
        * film ** (2 / 3)
        * (q.mean_diameter / U.mm) ** 3
    )


def _load(q: SimpleNamespace) -> Any:
    moment = q.load_factor * (q.preload / q.static_capacity) ** q.load_exponent * q.preload * q.mean_diameter
    return q.count * PALMGREN * q.speed * moment


def _motor(q: SimpleNamespace) -> Any:
    x = q.speed / q.rated
    return q.idle + q.linear * x + q.quadratic * x**2


def _wall(q: SimpleNamespace) -> Any:
    lead = q.T_air - q.T_body
    each_K = np.abs(lead) / K
    laminar, turbulent = 1.42 * (each_K / (q.height / U.m)) ** 0.25, 1.31 * each_K ** (1 / 3)
    return q.area * np.maximum(laminar, turbulent) * U("W/m**2/K") * lead


def _open(q: SimpleNamespace) -> Any:
    step = q.t[1] - q.t[0]
    counted = q.t + q.clock * (q.of_day - q.t)

    def since(t: Any) -> Any:
        return np.clip(((counted - t) / step).to("dimensionless") + 0.5, 0, 1)

    return since(q.start) - since(q.start + q.duration)


def _chiller(q: SimpleNamespace) -> Any:
    """The jacket cools evenly until the thermostat closes; what then flowed too long is made up for at once."""
    shift, jacket = q.follow * (q.T_room - ZERO - 20 * K), q.T_jacket
    supply, closes = q.supply + shift, q.set_point + shift - q.hysteresis
    opened = jacket > closes
    heat = q.conductance * (supply - jacket) * opened
    at = int(np.argmin(opened))
    since = (closes[at] - jacket[at]) / (jacket[at - 1] - jacket[at])
    heat[at] = heat[at] - since * q.conductance * (supply[at] - (closes[at] + jacket[at]) / 2)
    return heat


def _cycle(q: SimpleNamespace) -> Any:
    def run(t: Any) -> Any:
        turns = (t / q.period).to("dimensionless")
        return q.period * (q.duty * np.floor(turns) + np.minimum(turns - np.floor(turns), q.duty))

    step = q.t[1] - q.t[0]
    return q.heat * q.running * (run(q.t + step) - run(q.t)) / step


def _sun(q: SimpleNamespace) -> Any:
    part = ((q.of_day - q.rise) / (q.set - q.rise)).to("dimensionless")
    height = np.where((part > 0) & (part < 1), np.sin(np.pi * part), 0.0)
    return q.irradiance * q.area * q.absorptivity * height


def _ohmic(q: SimpleNamespace) -> Any:
    joule = q.resistance * q.current**2 * np.exp(q.coefficient * (q.T_body - q.reference))
    return joule + q.entropic * q.current * q.T_body


def _lag(q: SimpleNamespace) -> Any:
    return q.seen - q.slope * q.lag * (1 - np.exp(-q.t / q.lag))


def _skew(q: SimpleNamespace) -> Any:
    return q.s0 + q.slope * np.clip(q.t + q.delay, q.t[0], q.t[-1])


def _steps(q: SimpleNamespace) -> Any:
    return ZERO + q.step * np.round(((q.seen - ZERO) / q.step).to("dimensionless"))


def _through(q: SimpleNamespace, drawn: Any, points: list[Any]) -> Any:
    """The natural cubic spline through evenly spaced points, in the first one's unit."""
    spline = CubicSpline(np.arange(len(points)), [p.m_as(points[0].u) for p in points], bc_type="natural")
    return spline((drawn / q.capacity * (len(points) - 1)).m_as("")) * points[0].u


def _voltage_loss(q: SimpleNamespace) -> Any:
    middle = q.t + (q.t[1] - q.t[0]) / 2
    u = _through(q, q.start - q.current * middle, [getattr(q, f"u{k}") for k in range(8)])
    return q.current * (q.voltage - u)


def _charge_strain(q: SimpleNamespace) -> Any:
    drawn = q.start - q.current * q.t
    f = _through(q, drawn, [0 * q.f1, *(getattr(q, f"f{k}") for k in range(1, 13))])
    return f + q.rise_body * _through(q, drawn, [getattr(q, f"g{k}") for k in range(5)])


def _free(q: SimpleNamespace, over: Any) -> Any:
    by_driver = q.linear * q.level + q.square * q.level**2 + q.cross * q.level * q.other
    by_driver = by_driver + q.square_cross * q.level**2 * q.other
    return by_driver + (q.per_K + q.product * q.level) * over


def _friction(q: SimpleNamespace) -> Any:
    return 2 * np.pi * (q.feed / q.lead) * q.moment


CASES: Mapping[str, Case] = {
    "bearing_viscous": Case(_viscous),
    "bearing_load": Case(_load),
    "viscosity_feedback": Case(lambda q: np.exp(-2 / 3 * q.slope * (q.T_oil - q.reference))),
    "preload_feedback": Case(lambda q: (1 + q.kappa * (q.T_shaft - q.T_housing)) ** (1 + q.load_exponent)),
    "motor_loss": Case(_motor),
    "belt_loss": Case(lambda q: q.power * (q.speed / q.rated) ** q.exponent),
    "nut_friction": Case(_friction),
    "guide_friction": Case(lambda q: q.friction * q.load * q.feed),
    "screw_bearing": Case(_friction),
    "rotating_convection": Case(lambda q: 1 + q.gain * (q.speed / q.rated) ** q.exponent),
    "natural_convection": Case(_wall),
    "radiation": Case(lambda q: q.emissivity * SIGMA * q.area * (q.T_surrounding**4 - q.T_body**4)),
    "draught": Case(
        lambda q: 1 + (q.factor - 1) * _open(q),
        {"start": 2.3, "duration": 45.0},
        more={"surrounding_K": lambda q: -q.drop * _open(q)},
    ),
    "joint_conductance": Case(lambda q: q.ratio ** q.closed[0]),
    "heat_bridge": Case(),
    "jacket_chiller": Case(_chiller, ports={"jacket": lambda t_h: 24.0 - 1.7 * t_h}, either_way=True),
    "coolant_jacket": Case(
        lambda q: q.conductance * (q.supply + q.follow * (q.T_room - ZERO - 20 * K) - q.T_jacket), either_way=True
    ),
    "cutting_fluid": Case(lambda q: q.conductance * q.flow * (q.T_tank - q.T_body)),
    "enclosure_air": Case(open=True),
    "stratification": Case(lambda q: q.gradient * q.height),
    "floor_sink": Case(open=True),
    "cabinet_heat": Case(lambda q: q.heat * q.running),
    "hydraulic_unit": Case(_cycle, {"period": 11.3}),
    "sun": Case(_sun),
    "cutting_heat": Case(lambda q: q.share * q.power),
    "electrical_heat": Case(lambda q: q.gain * q.level),
    "supply_sag": Case(lambda q: 1 - q.sag * q.other / q.rated),
    "ohmic_heat": Case(_ohmic, either_way=True),
    "voltage_loss_heat": Case(_voltage_loss, {"capacity": 30.0, "start": 28.0}, either_way=True),
    "charge_strain": Case(_charge_strain, {"capacity": 30.0, "start": 28.0}, unit="um/m"),
    "column_bending": Case(),
    "spindle_growth": Case(),
    "speed_shift": Case(lambda q: q.shift * (q.speed / q.rated) ** 2),
    "screw_elongation": Case(
        lambda q: q.expansion * np.maximum(q.rise_screw - q.pretension, 0 * K) * (q.position - q.fixed_end),
        ports={"screw": lambda t_h: 20.0 + 6.0 * t_h},
    ),
    "joint_slip": Case(lambda q: np.minimum(q.gain * q.rise_part, q.limit), {"limit": 3.1}),
    "mandrel_fixture": Case(),
    "sensor_lag": Case(_lag, {"lag": 900.0}),
    "sensor_bonding": Case(lambda q: q.T_air + q.bonding * (q.seen - q.T_air)),
    "sensor_offset": Case(lambda q: q.seen + q.offset),
    "sensor_drift": Case(lambda q: q.seen + q.rate * q.t),
    "sensor_place": Case(lambda q: q.seen + q.share * (q.T_towards - q.seen)),
    "sensor_self_heat": Case(lambda q: q.seen + q.excess),
    "sensor_swap": Case(),
    "sensor_stuck": Case(lambda q: q.s0 + q.slope * np.minimum(q.t, q.start)),
    "sensor_quantised": Case(_steps, {"step": 0.13}, stepped=("seen", "step")),
    "time_skew": Case(_skew),
    "initial_state": Case(lambda q: q.excess, open=True),
    "free_flux": Case(lambda q: q.constant + _free(q, q.T_body - ZERO - 20 * K), either_way=True, undriven=True),
    "free_shift": Case(lambda q: _free(q, q.rise_body), undriven=True),
}
