"""Plant D: real recordings without an input or an effect that the machine file is known to need.

Each case removes or replaces parts of a machine file, and states the terms that a diagnosis should find. Sizes of board
and cell are those that the full file calibrates; those of the lathe are the values of its file, which is fitted to its
runs. Inputs are withheld one at a time: each driver and the room of lathe and spindle test, each heater of the board.
The spindle test has no twin part, so that its network is drafted.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from data.batch import Batch
from data.errors import InputError, closest
from data.machine import Machine
from thermodrift_exam.plants.real import Place, RealCase, Term, answer, linked, parts_at, recorded, there, windows

TermOf = Callable[[Mapping[str, Any], list[Batch]], Term]  # from the full file's twin part (plain data) and the runs


@dataclass(frozen=True)
class Withheld:
    """One case. `without` and `instead` are dotted paths below the machine file's `twin`; `channels` are hidden, and
    with them the mechanisms that they drive.

    `terms` state the answer. `twin` False: the file has no twin part at all.
    """

    name: str
    machine: str
    summary: str
    terms: tuple[TermOf, ...]
    without: tuple[str, ...] = ()
    instead: Mapping[str, Any] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    twin: bool = True
    kind: str = "one"

    def hidden_from(self, machine: Machine, batches: list[Batch]) -> tuple[Machine, list[Batch]]:
        """Machine file and runs without the withheld part."""
        part = copy.deepcopy(machine.twin) if self.twin else None
        mechanisms = part["mechanisms"] if part is not None else {}
        for name in _driven(mechanisms, self.channels):
            del mechanisms[name]
        for path in self.without:
            *keys, last = path.split(".")
            for at in parts_at(part, keys):
                del at[last]
        for path, new in self.instead.items():
            *keys, last = path.split(".")
            for at in parts_at(part, keys):
                at[last] = copy.deepcopy(new)
        channels = {n: c for n, c in machine.channels.items() if n not in self.channels}
        bare = machine.model_copy(update={"twin": part, "channels": channels})
        return bare, [self._hidden(b) for b in batches]

    def _hidden(self, batch: Batch) -> Batch:
        kept = {n: c for n, c in batch.channels.items() if n not in self.channels}
        return replace(batch, channels=kept, table=batch.table.drop(columns=list(self.channels)))


def _driven(mechanisms: Mapping[str, Any], channels: Collection[str]) -> list[str]:
    """Mechanisms that a channel drives, and those that act on these alone."""
    out = [name for name, m in mechanisms.items() if set(_several(m.get("drivers", ()))) & set(channels)]
    for name, m in mechanisms.items():
        others = _several(m.get("acts_on", ()))
        if name not in out and others and set(others) <= set(out):
            out.append(name)
    return out


def _several(given: Any) -> list[str]:
    return [given] if isinstance(given, str) else list(given.values() if isinstance(given, Mapping) else given)


# The laboratory board: its heaters share one supply and one circuit board.
BOARD: Mapping[str, float] = MappingProxyType({
    "mechanisms.heat2.gain": 0.004823, "mechanisms.sag1.sag": 0.2744, "mechanisms.sag2.sag": 0.4511,
    "links.heater1-heater2.conductance": 0.00543,
})  # fmt: skip


def _sag(number: int) -> TermOf:
    """The heat of a heater that falls while the other one is on."""
    other = f"heater{3 - number}"

    def term(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
        both = [(b.values("heater1") > 0) & (b.values("heater2") > 0) for b in batches]
        return Term(
            "supply_sag", "supply_sag", ("node", f"heater{number}"), also=[("node", f"heat{number}")],
            parameters={"sag": (BOARD[f"mechanisms.sag{number}.sag"], "1"), "rated": (100.0, "1")},
            neighbours=[other], active=windows(batches, both), driver=other,
            words=f"heater {number} warms less while the other one is on",
        )  # fmt: skip

    return term


def _bridge(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
    """Heat from one heater to the other through the board."""
    return Term(
        "heat_bridge", "heat_bridge", ("node", "heater1"), also=[("node", "heater2"), ("link", "heater1-heater2")],
        parameters={"conductance": (BOARD["links.heater1-heater2.conductance"], "W/K")},
        words="the board conducts from heater to heater",
    )  # fmt: skip


def _second_heater(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
    on = [b.values("heater2") > 0 for b in batches]
    return Term(
        "electrical_heat", "electrical_heat", ("node", "heater2"), neighbours=["heater1"],
        parameters={"gain": (BOARD["mechanisms.heat2.gain"], "W")}, active=windows(batches, on),
        driver="heater2", words="heater 2 warms its place",
    )  # fmt: skip


# The cell: its lost voltage heats it, its charge makes it grow.
NEUTRAL_V = (4.113, 4.056, 3.938, 3.827, 3.712, 3.646, 3.507, 3.233)
STRAIN_UM_PER_M = (
    -101.1, -48.58, -99.84, -182.1, -246.2, -263.3, -232.6, -195.0, -144.4, -74.97, -23.55, 2.443,
)  # fmt: skip
STRAIN_UM_PER_M_K = (15.45, 7.500, -1.334, -3.936, -5.299)
CELL: Mapping[str, float] = MappingProxyType(
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


def _of_cell(mechanism: str, unit: Mapping[str, str]) -> dict[str, tuple[float, str]]:
    """Calibrated parameters of a mechanism; the unit goes by the first letter of the name."""
    start = f"mechanisms.{mechanism}."
    own = {k.removeprefix(start): v for k, v in CELL.items() if k.startswith(start)}
    return {k: (v, unit[k[0]]) for k, v in own.items()}


def _lost_voltage(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
    return Term(
        "voltage_loss_heat", "voltage_loss_heat", ("node", "core"), parameters=_of_cell("heat", {"u": "V"}),
        neighbours=["can"], driver="current times voltage", words="the cell's lost voltage warms its core",
    )  # fmt: skip


def _charge(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
    return Term(
        "charge_strain", "charge_strain", ("error", "hoop_strain"),
        parameters=_of_cell("growth", {"f": "um/m", "g": "um/m/K"}), driver="current",
        words="the electrodes swell and shrink with the charge",
    )  # fmt: skip


def _radiation(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
    """For a file with a linear exchange only."""
    return Term(
        "radiation", "radiation", ("node", "can"), neighbours=["core"],
        parameters={"area": (CELL["mechanisms.loss.area"], "m**2"), "emissivity": (0.9, "1")},
        same_as=[("natural_convection", ("node", "can"))],
        words="the loss grows faster than the temperature difference",
    )  # fmt: skip


# The lathe. Feed is 5000 mm/min in nearly all runs, so that laws proportional to it are alike; so are losses of two
# exponents of the speed.
BY_FEED = ("nut_friction", "guide_friction", "screw_bearing")
BY_SPEED = ("belt_loss", "motor_loss", "bearing_viscous", "bearing_load")
UNITS = {"moment": "N*m", "power": "W", "shift": "um", "slope": "1/K"}


def _of_lathe(
    instance: str, where: Place, amplitude: str, also: tuple[Place, ...] = (), alike: tuple[str, ...] = ()
) -> TermOf:
    """The term of a mechanism of the file; `alike` are laws that these runs cannot distinguish from its own."""

    def term(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
        given = twin["mechanisms"][instance]
        value = float(str(given["parameters"][amplitude]["value"]).split()[0])
        driver = given.get("drivers")
        moving = [b.values(driver or "spindle_rpm") > 0 for b in batches]
        return Term(
            given["law"], given["law"], where, also=also, parameters={amplitude: (value, UNITS[amplitude])},
            neighbours=linked(twin, where[1]), active=windows(batches, moving), driver=driver,
            same_as=[(law, where) for law in alike if law != given["law"]],
            words=f"{instance.replace('_', ' ')} of the lathe",
        )  # fmt: skip

    return term


def _hidden(channel: str, *bodies: str) -> TermOf:
    """The heat of an input that no channel shows, at any of these bodies; without bodies, or where their places are not
    documented, at any that has a sensor."""

    def term(twin: Mapping[str, Any], batches: list[Batch]) -> Term:
        first, *others = bodies or tuple(twin.get("bodies", ())) or batches[0].names("temperature")
        driver = batches[0].channels[channel].role == "driver"
        active = windows(batches, [b.values(channel) > 0 for b in batches]) if driver else "always"
        return Term(
            f"unlisted_{channel}", None, ("node", first), also=[("node", b) for b in others], active=active,
            words=f"heat that follows {channel}, which was not recorded",
        )  # fmt: skip

    return term


UNLOGGED = {"per_batch": "0.5 K"}  # a room as a file states it that has no channel for it


_CASES = (
    Withheld("board_sag1", "tclab_board", "supply sag of heater 1 withheld", (_sag(1),), ("mechanisms.sag1",)),
    Withheld("board_sag2", "tclab_board", "supply sag of heater 2 withheld", (_sag(2),), ("mechanisms.sag2",)),
    Withheld("board_both_sags", "tclab_board", "supply sag of both heaters withheld", (_sag(1), _sag(2)),
             ("mechanisms.sag1", "mechanisms.sag2"), kind="two"),
    Withheld("board_bridge", "tclab_board", "heat bridge between the heaters withheld", (_bridge,),
             ("links.heater1-heater2",)),
    Withheld("board_heater2", "tclab_board", "heat of the second heater withheld", (_second_heater,),
             ("mechanisms.heat2", "mechanisms.sag2")),
    Withheld("cell_lost_voltage", "cell_30q", "Joule heat instead of the heat by lost voltage", (_lost_voltage,),
             instead={"mechanisms.heat": JOULE}),
    Withheld("cell_charge", "cell_30q", "growth with the charge withheld", (_charge,), ("mechanisms.growth",),
             {"errors.hoop_strain": WARMTH}),
    Withheld("cell_both", "cell_30q", "Joule heat and thermal expansion alone", (_lost_voltage, _charge),
             ("mechanisms.growth",), {"mechanisms.heat": JOULE, "errors.hoop_strain": WARMTH}, kind="two"),
    Withheld("cell_radiation", "cell_30q", "a linear loss instead of radiation", (_radiation,), ("mechanisms.loss",),
             {"exposures": {"can-room": {"value": "0.1 W/K", "spread": 0.7}}}),
    Withheld("lathe_nut", "lathe_gv1203", "friction of the nut withheld",
             (_of_lathe("nut", ("node", "nut"), "moment", alike=BY_FEED),), ("mechanisms.nut",),
             {"mechanisms.guide_oil.acts_on": ["programme", "x_drive"]}),
    Withheld("lathe_x_drive", "lathe_gv1203", "heat of the X drive withheld",
             (_of_lathe("x_drive", ("node", "x_drive"), "moment", alike=BY_FEED),), ("mechanisms.x_drive",),
             {"mechanisms.guide_oil.acts_on": ["programme", "nut"]}),
    Withheld("lathe_belt", "lathe_gv1203", "losses of the belt withheld",
             (_of_lathe("belt", ("node", "motor_cover"), "power", alike=BY_SPEED),), ("mechanisms.belt",)),
    Withheld("lathe_grease", "lathe_gv1203", "grease that thins withheld",
             (_of_lathe("grease", ("node", "nose"), "slope", (("node", "head"), ("node", "bearings_viscous"))),),
             ("mechanisms.grease",)),
    Withheld("lathe_z_shift", "lathe_gv1203", "shift of Z by the speed withheld",
             (_of_lathe("z_shift", ("error", "disp_z"), "shift"),), ("mechanisms.z_shift",)),
    Withheld("board_input1", "tclab_board", "the first heater's level withheld", (_hidden("heater1", "heater1"),),
             channels=("heater1",), kind="unlisted"),
    Withheld("board_input2", "tclab_board", "the second heater's level withheld", (_hidden("heater2", "heater2"),),
             channels=("heater2",), kind="unlisted"),
    Withheld("lathe_speed", "lathe_gv1203", "the spindle's speed withheld",
             (_hidden("spindle_rpm", "nose", "head", "motor", "motor_cover"),), channels=("spindle_rpm",),
             kind="unlisted"),
    Withheld("lathe_feed", "lathe_gv1203", "the feed withheld",
             (_hidden("feed_mm_min", "nut", "nut_house", "cast", "x_drive", "z_drive", "slide", "saddle", "cover_a"),),
             channels=("feed_mm_min",), kind="unlisted"),
    Withheld("lathe_room", "lathe_gv1203", "the room's temperature withheld", (_hidden("TC08"),),
             instead={"surroundings.room": UNLOGGED | {"first": ["PT01", "TC01"]}}, channels=("TC08",),
             kind="unlisted"),
    Withheld("spindle_speed", "spindle_fl", "the spindle's speed withheld", (_hidden("spindle_rpm"),),
             channels=("spindle_rpm",), twin=False, kind="unlisted"),
    Withheld("spindle_room", "spindle_fl", "the room's temperature withheld", (_hidden("t16"),),
             channels=("t16",), twin=False, kind="unlisted"),
)  # fmt: skip
CASES: Mapping[str, Withheld] = MappingProxyType({c.name: c for c in _CASES})


def cases(data: Path) -> list[str]:
    """Names of all cases whose recordings lie in the folder `data`."""
    return [name for name, c in CASES.items() if there(c.machine, data)]


def build(name: str, data: Path, seed: int) -> RealCase:
    """A case; the seed picks the runs where there are many, and their hours where only dates are known.

    Raises:
        InputError: an unknown name, no recordings in `data`; one line.
    """
    if name not in CASES:
        raise InputError(f"withheld: unknown case {name!r}; {closest(name, CASES)}")
    case = CASES[name]
    machine, batches = recorded(case.machine, data, seed)
    terms = [term(machine.twin or {}, batches) for term in case.terms]
    bare, seen = case.hidden_from(machine, batches)
    redraw = {"plant": "withheld", "name": name, "seed": seed}
    return RealCase(bare, seen, answer(redraw, case.kind, bare, terms, f"real recordings: {case.summary}"))
