"""Diagnoses of real recordings: what is taken from a machine file that is known to fit comes back, or is not claimed.

The board's effects hide each other: what its neighbour conducts to a heater, the common supply takes from it. No single
one gains enough to be claimed from four short runs, so the order is that of forward refits, each beside the last.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from data.machine import Machine
from diagnosis.diagnose import diagnose
from diagnosis.drafting.draft import drafted_part
from diagnosis.findings.schema import Findings
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import baseline, relearned
from diagnosis.localisation.where_when import FoundPlace, Located, locate
from diagnosis.result import Diagnosis
from diagnosis.screening.screen import proposed, screen
from diagnosis.search.refits import refit
from tests.real.recorded import recorded
from twin.quantity import Value
from twin.schema import twin_part

OF_THE_BOARD = ("heat_bridge_heater1_heater2", "supply_sag_heat1_heater2", "supply_sag_heat2_heater1")
OF_NO_BOARD = ("cutting_fluid", "jacket_chiller", "natural_convection", "radiation")


def with_twin(machine: Machine, **parts: Any) -> Machine:
    assert machine.twin is not None
    return machine.model_copy(update={"twin": {**machine.twin, **parts}})


def bare_board(machine: Machine) -> Machine:
    """Two bodies that know nothing of each other, and sensors that show them at once."""
    twin = machine.twin or {}
    return with_twin(
        machine,
        links={},
        mechanisms={n: m for n, m in twin["mechanisms"].items() if m["law"] != "supply_sag"},
        sensors={n: {"at": s["at"], "noise": s["noise"]} for n, s in twin["sensors"].items()},
    )


def bare_cell(machine: Machine) -> Machine:
    """Joule heat and thermal expansion."""
    twin = machine.twin or {}
    joule = {
        "law": "ohmic_heat", "drivers": {"current": "current"}, "at": "core", "into": "core",
        "parameters": {"resistance": {"value": "25 mohm", "spread": 0.7}},
    }  # fmt: skip
    growth = {"chain": [{"body": "can", "gain": {"value": "10 um/m/K", "spread": "20 um/m/K"}}], "noise": "1.1 um/m"}
    mechanisms = {"heat": joule, "loss": twin["mechanisms"]["loss"]}
    return with_twin(machine, mechanisms=mechanisms, errors={"hoop_strain": growth})


@cache
def board() -> Fitted:
    machine, batches = recorded("tclab_board", "tclab", 2.0)
    bare = bare_board(machine)
    return baseline(bare, twin_part(bare), batches)


@cache
def forward(steps: int) -> tuple[list[str], Fitted]:
    """Names in the order in which they add most evidence; the last fit."""
    now, names = board(), []
    for _ in range(steps):
        every = {s.candidate.name: s for s in screen(now, proposed(now)).scored}
        wanted = [s for n, s in every.items() if n in OF_THE_BOARD or s.candidate.mechanism in OF_NO_BOARD]
        tried = [(s.candidate.name, relearned(f)) for s in wanted if (f := refit(now, s)) is not None]
        name, now = max(tried, key=lambda t: t[1].log_evidence)
        names.append(name)
    return names, now


def value(fitted: Fitted, ending: str) -> float:
    return float(fitted.values[next(k for k, p in enumerate(fitted.problem.network.parameters) if ending in p.name)])


def test_a_run_of_ten_minutes_is_looked_at_sixty_times() -> None:
    rows = [np.bincount(m.channel) for m in board().problem.measured]
    assert all((r >= 55).all() and (r <= 70).all() for r in rows)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="a film at the first heater that rises with its temperature comes first")
def test_the_board_comes_back_in_the_order_of_what_it_matters() -> None:
    """The first two; the second heater's sag comes after films that follow their temperature difference."""
    names, fitted = forward(2)
    assert set(names) == {"supply_sag_heat1_heater2", "heat_bridge_heater1_heater2"}
    assert 0.001 < value(fitted, "heat_bridge_heater1_heater2.conductance") < 0.01  # W/K; 6 mW/K where lags are known
    assert 0.15 < value(fitted, "supply_sag_heat1_heater2.sag") < 0.4


@cache
def diagnosed_board() -> Findings:
    machine, batches = recorded("tclab_board", "tclab", 2.0)
    return diagnose(bare_board(machine), list(batches)).findings


@pytest.mark.integration
def test_of_the_board_nothing_is_claimed_that_boards_do_not_have() -> None:
    found = diagnosed_board().findings
    assert {f.mechanism for f in found} <= {"heat_bridge", "supply_sag", "sensor_lag", "free_flux"}
    assert all(f.probability <= 0.9 for f in found)  # four runs


@pytest.mark.integration
def test_thirty_times_the_noise_is_not_called_noise() -> None:
    found = diagnosed_board()
    left = found.fit.left_out_rms
    assert left.after["temperature2_K"] < 5.0 * left.noise_floor["temperature2_K"] or found.verdict != "consistent"


def diagnosed_cell(*rates: str) -> Diagnosis:
    machine, batches = recorded("cell_30q", "cell_30q", 10.0)
    return diagnose(bare_cell(machine), [b for b in batches if b.batch_id[-2:] in rates])


@pytest.mark.slow
def test_the_cell_lacks_the_heat_of_its_lost_voltage_and_the_strain_of_its_charge() -> None:
    found = diagnosed_cell("1C", "2C", "3C", "4C")
    named = {(f.mechanism, f.where.name) for f in found.findings.findings}
    assert named == {("voltage_loss_heat", "can"), ("charge_strain", "hoop_strain")}
    mean = found.tables["rms"].groupby("channel")[["before", "after"]].mean()
    assert mean.loc["can", "after"] < 0.5 * mean.loc["can", "before"]
    assert mean.loc["hoop_strain", "after"] < 0.2 * mean.loc["hoop_strain", "before"]


@pytest.mark.slow
def test_two_rates_are_too_few_to_be_sure_and_it_says_so() -> None:
    found = diagnosed_cell("2C", "4C")
    assert found.remarks and "2 runs only" in found.remarks[0]
    assert all(f.probability <= 0.9 for f in found.findings.findings)
    assert found.findings.batches == ("Q30_S001_2C", "Q30_S001_4C")


@cache
def spindle_without_its_speed() -> tuple[Located, Mapping[str, tuple[np.ndarray, np.ndarray]]]:
    """Located by a network whose structure the speed helped to draft, without that heat; and the speed by run."""
    machine, batches = recorded("spindle_fl", "spindle_fl", 60.0)
    part = drafted_part(machine.model_copy(update={"twin": None}), batches, max_bodies=3).part
    first = next(iter(part.bodies))  # without a known heat one capacity sets the scale
    capacity = part.bodies[first].capacity
    assert capacity is not None
    held = part.bodies[first].model_copy(update={"capacity": Value(value=capacity.value)})
    part = part.model_copy(update={"mechanisms": {}, "bodies": {**part.bodies, first: held}})
    blind = machine.model_copy(
        update={"channels": {n: c for n, c in machine.channels.items() if n != "spindle_rpm"}, "twin": None}
    )
    blind = blind.model_copy(update={"recording": blind.recording.model_copy(update={"split": None})})
    seen = [
        replace(
            b,
            channels={n: c for n, c in b.channels.items() if n != "spindle_rpm"},
            table=b.table.drop(columns=["spindle_rpm"]),
        )
        for b in batches
    ]
    fitted = baseline(blind, part, seen)
    return locate(fitted.problem, fitted.x, fitted.fitted_nuisance, seen), {
        b.batch_id: (b.time_s, b.values("spindle_rpm")) for b in batches
    }


def beside_speed(
    located: Located, found: FoundPlace, speed: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> list[np.ndarray]:
    """By run (2, K): the speed's mean about every knot and the reconstructed series there."""
    out = []
    for k, (time_s, rpm) in enumerate(speed.values()):
        hats = located.point.hats.at(time_s)
        covered = hats.sum(axis=0) > 0.3 * hats.sum(axis=0).max()
        mean = (hats.T @ rpm)[covered] / hats.sum(axis=0)[covered]
        out.append(np.array([mean, found.series.mean[k][covered]]))
    return out


@pytest.mark.slow
def test_the_withheld_speed_is_found_as_heat_that_follows_it() -> None:
    located, speed = spindle_without_its_speed()
    heat = next(f for f in located.found if f.kind == "heat")
    pairs = beside_speed(located, heat, speed)
    together = np.hstack(pairs)
    assert together.shape[1] > 80
    assert np.corrcoef(together)[0, 1] > 0.8
    assert min(np.corrcoef(p)[0, 1] for p in pairs) > 0.7  # within every run as well


@pytest.mark.integration
def test_the_boards_missing_link_is_named_by_the_balance_of_heat_and_no_channel_is_worse() -> None:
    machine, batches = recorded("tclab_board", "tclab", 1.0)
    done = diagnose(with_twin(machine, links={}), batches)
    answer = done.findings
    assert any(r.startswith("temperature2 warms by") and "brings heater2 any heat" in r for r in answer.remarks)
    first = answer.findings[0]
    assert (first.mechanism, first.where.name) == ("heat_bridge", "heater1") and first.probability >= 0.75
    rms = answer.fit.left_out_rms
    assert all(rms.after[k] < rms.before[k] for k in rms.after)  # type: ignore[operator]
    assert rms.after["temperature2_K"] < 0.4 * rms.before["temperature2_K"]  # type: ignore[operator]
