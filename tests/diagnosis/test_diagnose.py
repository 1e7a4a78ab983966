"""From recordings to a verdict: every verdict once, recordings with faults, and input that cannot be used."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from diagnosis.contracts import COLUMNS
from diagnosis.diagnose import diagnose
from diagnosis.findings.schema import Findings
from diagnosis.fitting.fitted import degraded_channels, left_out_rows, rows_as_given
from diagnosis.policy import POLICY
from diagnosis.result import Diagnosis
from tests.diagnosis.small_cases import runs, two_bodies
from tests.diagnosis.whole import CASES, LAMP, PUMP, clamped, clamped_runs, diagnosed
from tests.twin.recordings import empty_batches, recorded
from twin.compile import compile_network
from twin.schema import TwinPart, twin_part

LONGEST = pytest.param("partly_explained", marks=pytest.mark.slow)
UNLISTED = pytest.param("unlisted", marks=pytest.mark.integration)
UNDECIDABLE = pytest.param("undecidable", marks=pytest.mark.integration)
EXPLAINED = pytest.param("explained", marks=pytest.mark.integration)
VERDICTS = ["consistent", EXPLAINED, UNDECIDABLE, UNLISTED, LONGEST]


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_where_it_is_due(verdict: str) -> None:
    done = diagnosed(verdict)
    told = done.findings
    assert told.verdict == verdict
    assert bool(told.findings) == (verdict != "consistent")
    assert told.statement and all(f.statement for f in told.findings)
    again = Findings.model_validate_json(told.model_dump_json(by_alias=True))
    assert again.verdict == verdict and len(again.findings) == len(told.findings)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_table_is_there_and_of_its_columns(verdict: str) -> None:
    done = diagnosed(verdict)
    assert {k: tuple(t.columns) for k, t in done.tables.items()} == dict(COLUMNS)
    for name in ("rms", "series", "acf", "limits", "map"):
        assert len(done.tables[name]), name
    assert len(done.tables["flux"]) > 0 if verdict in ("unlisted", "partly_explained") else True
    assert done.simulated and not done.drafted
    probability = done.tables["candidates"]["probability"]
    assert ((probability >= 0) & (probability <= 0.99)).all()


@pytest.mark.parametrize("verdict", VERDICTS)
def test_no_channel_is_predicted_worse_than_before_or_than_by_the_file_as_given(verdict: str) -> None:
    done = diagnosed(verdict)
    assert done.search is not None
    after = left_out_rows(done.search.final)
    assert degraded_channels(left_out_rows(done.search.baseline), after) == {}
    assert not done.values or degraded_channels(rows_as_given(done.search.baseline), after) == {}  # noqa: PD011 - no frame


@pytest.mark.parametrize("verdict", [EXPLAINED, UNLISTED, LONGEST])
def test_with_what_was_found_only_noise_is_left(verdict: str) -> None:
    rms = diagnosed(verdict).findings.fit.left_out_rms
    for key, after in rms.after.items():
        before, noise = rms.before[key], rms.noise_floor[key]
        assert after is not None and before is not None and noise is not None
        assert after < 1.15 * noise and after <= 1.05 * before
    assert max(rms.before[k] / rms.after[k] for k in rms.after) > 3  # type: ignore[operator]


@pytest.mark.integration
def test_what_was_found_is_a_part_of_the_machine() -> None:
    done = diagnosed("explained")
    (found,) = done.findings.findings
    assert (found.mechanism, found.where.kind, found.where.name) == ("sensor_drift", "sensor", "t_head")
    rate = found.parameters["rate"]
    assert rate.interval90 is not None and rate.unit == "K/h"
    low, high = rate.interval90
    assert low is not None and high is not None and low < 0.3 < high
    assert found.probability > 0.7
    assert set(done.added) == {f"mechanisms.{found.name}"}
    network = compile_network(done.machine, part=done.part_after)
    fitted = {i.name for i in done.intervals}
    assert f"mechanisms.{found.name}.rate" in fitted and fitted <= {p.name for p in network.parameters}
    assert done.part_before == twin_part(done.machine)


@pytest.mark.integration
def test_an_effect_that_harms_left_out_runs_is_named_and_not_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """The file has the values of a fit without it: recalibrated, nothing added, no value or note of the effect."""
    monkeypatch.setattr("diagnosis.diagnose.harms", lambda before, after: True)
    done = diagnose(*CASES["explained"]())
    (found,) = done.findings.findings
    assert found.mechanism == "sensor_drift" and any("kept out of the machine file" in r for r in done.remarks)
    names = {p.name for p in compile_network(done.machine).parameters}
    assert set(done.values) and set(done.values) <= names and not done.added and not done.notes


@pytest.mark.integration
def test_when_drivers_act_is_learned_again_with_what_was_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The twin without an effect had another time: all begins again under that which is likeliest with it."""
    seen = []

    def other(machine: Machine, part: TwinPart, batches: Sequence[Batch]) -> float:
        seen.append(set(part.mechanisms))
        return 0.5

    monkeypatch.setattr("diagnosis.diagnose.lead_of", other)
    done = diagnose(*CASES["explained"]())
    assert done.search is not None and done.search.baseline.lead_rows == done.search.final.lead_rows == 0.5
    assert seen == [{*twin_part(done.machine).mechanisms, "sensor_drift_t_head"}]


@pytest.mark.parametrize("verdict", [UNLISTED, LONGEST])
def test_no_listed_mechanism_is_said_with_its_size(verdict: str) -> None:
    fluxes = [f for f in diagnosed(verdict).findings.findings if f.mechanism == "free_flux"]
    assert len(fluxes) == 1 and "no listed mechanism" in fluxes[0].statement
    product = fluxes[0].parameters["product"]
    assert product.value == pytest.approx(6.0, rel=0.05) and product.unit == "W/K"


@pytest.mark.slow
def test_what_listed_mechanisms_only_share_in_is_told_whole() -> None:
    """By vacuum and speed together: a switched heat of the library takes over some of it."""
    by_both = {
        "law": "free_flux", "into": "head", "at": {"body": "head"}, "drivers": {"level": "rpm", "other": "vacuum"},
        "parameters": {"cross": "0.03 W"},
    }  # fmt: skip
    done = diagnose(clamped("1"), clamped_runs({"own": by_both}, unit="1"))
    (found,) = done.findings.findings
    assert (done.findings.verdict, found.mechanism, found.where.name) == ("unlisted", "free_flux", "head")
    assert found.parameters["cross"].value == pytest.approx(0.03, rel=0.1)
    assert re.search(r"[1-9]\d W into the head \(it follows rpm vacuum\)", found.statement)


@pytest.mark.slow
def test_part_of_it_has_a_name_of_its_own() -> None:
    named = [f for f in diagnosed("partly_explained").findings.findings if f.mechanism != "free_flux"]
    assert [(f.mechanism, f.where.name) for f in named] == [("cabinet_heat", "shaft")]
    assert named[0].parameters["heat"].value == pytest.approx(100.0, rel=0.05)


@pytest.mark.integration
def test_what_cannot_be_told_apart_is_told_together() -> None:
    done = diagnosed("undecidable")
    first = done.findings.findings[0]
    told = {(first.mechanism, first.where.name), *((a.mechanism, a.where.name) for a in first.alternatives)}
    assert told >= {("cabinet_heat", "head"), ("electrical_heat", "head")}
    assert 0.2 < first.probability <= POLICY.few_runs_max_probability[0]
    run = done.findings.next_experiment  # no run separates two names of one law: a third one is among them
    assert run is None or len(run.separates) > 2


@pytest.mark.integration
def test_what_every_run_shows_is_probable_under_whichever_name() -> None:
    """A switched heat is a cabinet's or a heater's: the probability counts both, and the other name is marked."""
    told = diagnose(clamped("1"), clamped_runs({"own": PUMP}, unit="1")).findings
    (found,) = told.findings
    alike = {(a.mechanism, a.where.name) for a in found.alternatives if a.alike}
    assert {(found.mechanism, found.where.name), *alike} >= {("cabinet_heat", "head"), ("electrical_heat", "head")}
    assert told.verdict == "explained" and found.probability >= POLICY.stands_alone_probability
    assert all(a.probability < found.probability for a in found.alternatives)
    assert found.parameters["heat"].interval90 is not None
    low, high = found.parameters["heat"].interval90
    assert low is not None and high is not None and low < 14.0 < high


def test_where_nothing_is_missing_limits_are_told() -> None:
    done = diagnosed("consistent")
    assert done.part_after == done.part_before == twin_part(done.machine)
    assert done.findings.fit.batches_improved == 0 and not done.added
    limits = [x for x in done.findings.detection_limits if x.limit is not None]
    assert len(limits) > 20 and all(x.limit > 0 for x in limits if x.limit is not None)


def test_the_order_of_the_recordings_does_not_matter() -> None:
    known, batches = CASES["consistent"]()
    done, again = diagnosed("consistent"), diagnose(known, batches[::-1])
    assert done.findings.model_dump(exclude={"seconds"}) == again.findings.model_dump(exclude={"seconds"})
    for name, table in done.tables.items():
        pd.testing.assert_frame_equal(again.tables[name], table)


# Recordings as they are


def changed(channel: str, change: Callable[[np.ndarray, int], np.ndarray]) -> list[Batch]:
    out = []
    for k, b in enumerate(runs(two_bodies(), {"own": LAMP}, count=4)):
        out.append(replace(b, table=b.table.assign(**{channel: change(b.table[channel].to_numpy(), k)})))
    return out


def lamp_of(done: Diagnosis, rel: float) -> None:
    first = done.findings.findings[0]
    assert (first.mechanism, first.where.name) == ("cabinet_heat", "shaft")
    assert first.parameters["heat"].value == pytest.approx(100.0, rel=rel)


@pytest.mark.slow
def test_a_fifth_of_the_samples_missing() -> None:
    def holes(values: np.ndarray, k: int) -> np.ndarray:
        gone = np.random.default_rng(k).random(len(values)) < 0.2
        return np.where(gone, np.nan, values)

    given = changed("t_shaft", holes)
    for channel in ("t_head", "z"):
        given = [
            replace(b, table=b.table.assign(**{channel: holes(b.table[channel].to_numpy(), 10 + k)}))
            for k, b in enumerate(given)
        ]
    lamp_of(diagnose(two_bodies(), given), 0.1)


@pytest.mark.slow
def test_a_sensor_that_shows_half_kelvins() -> None:
    lamp_of(diagnose(two_bodies(), changed("t_shaft", lambda v, k: np.round(2 * v) / 2)), 0.1)


@pytest.mark.slow
def test_a_channel_that_was_not_always_recorded() -> None:
    done = diagnose(two_bodies(), changed("t_head", lambda v, k: np.full(len(v), np.nan) if k % 2 else v))
    lamp_of(done, 0.1)
    rows = done.tables["rms"]
    assert len(rows[rows["channel"] == "t_head"]) == 2 and len(rows[rows["channel"] == "z"]) == 4


@pytest.mark.slow
def test_two_runs_are_cut_and_nothing_is_too_sure() -> None:
    known = two_bodies()
    given = [
        recorded(two_bodies(mechanisms__own=LAMP), [b], seed=k)[0]
        for k, b in enumerate(empty_batches(known, 2, hours=12.0))
    ]
    done = diagnose(known, given)
    assert done.findings.batches == ("b00", "b01")
    assert any(w.startswith("2 runs only: cut into 4 blocks") for w in done.remarks)
    assert done.findings.verdict != "consistent" and all(f.probability <= 0.7 for f in done.findings.findings)


# What cannot be used


def test_runs_that_cannot_be_used() -> None:
    given = runs(two_bodies(), count=4)
    strange = replace(given[2], machine="lathe")
    for batches, words in (
        ([*given[:2], strange], "batch b02: is of machine 'lathe', expected 'two_bodies'; leave it out"),
        ([*given, given[1]], "batch b01: given 2 times; give it once"),
        ([], "machine two_bodies: no batches to diagnose; give recordings"),
    ):
        with pytest.raises(InputError, match=words):
            diagnose(two_bodies(), batches)


def test_without_a_twin_part_temperatures_are_needed() -> None:
    bare = two_bodies().model_copy(update={"twin": None})
    channels = {n: c for n, c in bare.channels.items() if c.role != "temperature"}
    bare = bare.model_copy(update={"channels": channels})
    given = [
        replace(b, channels={n: c for n, c in b.channels.items() if n in channels},
                table=b.table.drop(columns=["t_shaft", "t_head"]))
        for b in runs(two_bodies(), count=4)
    ]  # fmt: skip
    with pytest.raises(InputError, match="temperature") as error:
        diagnose(bare, given)
    assert "two_bodies" in str(error.value) and "\n" not in str(error.value)
