"""Heat, a displacement or a reading concealed in a chain of five bodies: right place, right kind, right time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from diagnosis.contracts import COLUMNS
from diagnosis.localisation.where_when import RANKING, Located, locate, regimes_of
from tests.diagnosis.concealed import BODIES, Case, calibrated, case, coolant, flux, shift

WATTS = 30.0


def located(given: Case, **options: Any) -> Located:
    return locate(given.problem, given.fit.x, given.fit.nuisance, given.batches, **options)


def cell(found: Located, kind: str, place: str, label: str) -> pd.Series:
    own = found.map[(found.map["kind"] == kind) & (found.map["place"] == place) & (found.map["label"] == label)]
    assert len(own) == 1
    return own.iloc[0]


@pytest.fixture(scope="module")
def nothing() -> Case:
    return case()


@pytest.fixture(scope="module", params=["column", "saddle", "bed"])
def heated(request: pytest.FixtureRequest) -> tuple[str, Case, Located]:
    """The saddle has no sensor of its own."""
    given = case(flux(request.param, linear=f"{WATTS} W"))
    return request.param, given, located(given)


def test_heat_is_found_where_it_is(heated: tuple[str, Case, Located]) -> None:
    body, _, found = heated
    assert found.kind == "heat"
    assert [(f.kind, f.place) for f in found.found] == [("heat", body)]
    assert found.odds["heat"] > 0.99 and found.found[0].odds["heat"] > 0.99
    best = found.ranking.iloc[0]
    assert (best["kind"], best["place"], best["unit"]) == ("heat", body, "W")
    assert best["gain"] == pytest.approx(found.found[0].gain)
    assert best["gain"] - found.ranking.iloc[1]["gain"] > 20


def test_its_course_is_reconstructed(heated: tuple[str, Case, Located]) -> None:
    body, given, found = heated
    knots = found.point.hats.knot_s
    true = WATTS * np.array([np.interp(knots, b.time_s, coolant(b, k)) for k, b in enumerate(given.batches)])
    assert np.corrcoef(true.ravel(), found.found[0].series.mean.ravel())[0, 1] > 0.9
    flux_table = found.over_time("heat", body)
    assert tuple(flux_table.columns) == COLUMNS["flux"]
    assert set(flux_table["unit"]) == {"W"} and set(flux_table["place"]) == {body}
    own = flux_table[flux_table["batch"] == "b02"]
    np.testing.assert_allclose(own["time_s"], knots)
    np.testing.assert_allclose(own["value"], found.found[0].series.mean[2])


def test_averages_over_regimes_and_batches(heated: tuple[str, Case, Located]) -> None:
    body, given, found = heated
    on, off = (cell(found, "heat", body, f"coolant {s}") for s in ("on", "off"))
    assert 0.55 * WATTS < on["value"] < WATTS and on["z"] > 5  # hats round the steps off, capacities give way
    assert abs(off["value"]) < 0.2 * WATTS
    share = np.array([coolant(b, k)[:-1].mean() for k, b in enumerate(given.batches)])
    means = [cell(found, "heat", body, b.batch_id)["value"] for b in given.batches]
    assert np.corrcoef(WATTS * share, means)[0, 1] > 0.8
    elsewhere = found.map[(found.map["kind"] == "heat") & (found.map["place"] != body)]
    assert elsewhere["value"].abs().max() < 0.3 * on["value"]


def test_nothing_concealed(nothing: Case) -> None:
    found = located(nothing)
    assert found.kind == "nothing" and found.found == ()
    assert found.odds["nothing"] > 0.5
    assert found.map["z"].abs().max() < 3
    assert tuple(found.map.columns) == COLUMNS["map"] and tuple(found.ranking.columns) == RANKING
    assert sum(found.odds.values()) == pytest.approx(1.0)
    assert set(zip(found.map["kind"], found.map["place"], strict=True)) == {
        *(("heat", b) for b in BODIES), ("displacement", "z"), ("displacement", "y"),
        *(("sensor", f"t_{b}") for b in BODIES if b != "saddle"),
    }  # fmt: skip


def test_a_displacement_is_no_heat() -> None:
    found = located(case(shift("z", linear="8 um")))
    assert [(f.kind, f.place) for f in found.found] == [("displacement", "z")]
    assert found.odds["displacement"] > 0.99
    assert cell(found, "displacement", "z", "coolant on")["value"] == pytest.approx(8.0, rel=0.3)
    assert (found.found[0].series.mean[:, 0] == 0).all()  # errors count from their first value


def test_a_reading_is_no_heat(nothing: Case) -> None:
    drifting = [
        replace(b, table=b.table.assign(t_column=b.table["t_column"] + 0.25 * b.time_s / 3600)) for b in nothing.batches
    ]
    found = located(calibrated(nothing.machine, drifting))
    assert [(f.kind, f.place) for f in found.found] == [("sensor", "t_column")]
    assert found.odds["sensor"] > 0.99
    later, first = (cell(found, "sensor", "t_column", s)["value"] for s in ("2–4 h", "0–30 min"))
    assert later - first == pytest.approx(0.25 * 2.75, rel=0.3)


def test_two_at_once() -> None:
    found = located(case(flux("bed", linear="40 W") | shift("z", linear="8 um")))
    assert {(f.kind, f.place) for f in found.found} == {("heat", "bed"), ("displacement", "z")}
    for f in found.found:
        assert f.odds[f.kind] > 0.99
    assert len(located(case(flux("bed", linear="40 W") | shift("z", linear="8 um")), most=1).found) == 1


def test_missing_samples_and_unequal_lengths() -> None:
    given = case(flux("bed", linear=f"{WATTS} W"))
    rng = np.random.default_rng(0)
    cut = []
    for k, b in enumerate(given.batches):
        table = b.table.iloc[: len(b.table) - 6 * (k % 3)].copy()
        for name in ("t_bed", "t_column", "z"):
            table.loc[rng.random(len(table)) < 0.2, name] = np.nan
        cut.append(replace(b, table=table))
    found = located(calibrated(given.machine, cut))
    assert (found.found[0].kind, found.found[0].place) == ("heat", "bed")
    ends = found.over_time("heat", "bed").groupby("batch")["time_s"].max()
    assert ends["b00"] == 14400 and ends["b01"] == 14400 - 1800


def test_the_order_of_batches_is_checked(nothing: Case) -> None:
    with pytest.raises(InputError, match=r"locate: got the batches b01, b00, .* expected those of the calibration"):
        locate(nothing.problem, nothing.fit.x, nothing.fit.nuisance, [nothing.batches[k] for k in (1, 0, 2, 3, 4, 5)])


def test_regimes(nothing: Case) -> None:
    found = {(r.by, r.label): r for r in regimes_of(nothing.batches)}
    labels = [label for by, label in found if by == "regime"]
    assert labels == ["rpm = 0 before it ran", "rpm = 2000", "rpm = 3500", "rpm = 5000", "cooling down after rpm",
                      "coolant off", "coolant on", "room below 19.6 degC", "room 19.6–20.8 degC",
                      "room above 20.8 degC"]  # fmt: skip
    assert [label for by, label in found if by == "since_start"] == ["0–30 min", "30–60 min", "1–2 h", "2–4 h", "4–6 h"]
    assert [label for by, label in found if by == "hour"] == ["06–10 h", "10–14 h"]
    rpm = nothing.batches[1].values("rpm")
    np.testing.assert_array_equal(found["regime", "rpm = 3500"].mask[1], rpm == 3500)
    np.testing.assert_array_equal(found["regime", "cooling down after rpm"].mask[1], (rpm == 0) & (np.arange(49) > 5))
    many = [replace(b, table=b.table.assign(rpm=b.time_s)) for b in nothing.batches]
    bands = [r for r in regimes_of(many) if r.label.startswith("rpm ")]
    assert len(bands) == 4 and sum(m.sum() for r in bands for m in r.mask) == sum(b.n_rows for b in many)
