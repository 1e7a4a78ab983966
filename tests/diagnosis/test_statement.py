"""The sentences: claim, evidence, advice, caveat, honest digits, and never surer than the probability."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import pytest

from data.machine import load_machine
from diagnosis.contracts import Kind, Where
from diagnosis.findings.report_data import Effect, Other, Rms, context_label, place_label
from diagnosis.findings.schema import DetectionLimit, Place
from diagnosis.findings.statement import (
    build_finding,
    claim_phrase,
    equation_with_numbers,
    reductions,
    statement,
    verdict_statement,
)
from diagnosis.formatting import Estimate, amount, as_given, few, percent
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism, Target
from twin.quantity import Spec
from twin.schema import MechanismPart, twin_part

BED = Where("node", "bed")
Z = Rms("z", "um", 9.1, 1.4, 1.2)
SINK = Effect(
    "floor_sink", BED, "the bed", {"conductance": Estimate(10.2, "W/K", 8.9, 11.6)}, 0.92, name="floor_sink_bed",
    others=(Other("radiation", BED, "the bed", 0.08),), rms=(Z,), separates="a night switched off",
    evidence={"batches_improved": 11, "batches": 12, "gain_nats": 41.0},
)  # fmt: skip
KIND: dict[Target, Kind] = {
    "node": "node", "heat": "node", "start": "node", "surrounding": "node", "link": "link", "exposure": "link",
    "sensor": "sensor", "error": "error",
}  # fmt: skip
PLACE: dict[Kind, str] = {"node": "the bed", "link": "the bed and the room", "sensor": "head_rear", "error": "z"}


def found(mechanism: str, kind: Kind, value: float = 0.12, unit: str = "K/h", probability: float = 0.95) -> Effect:
    parameters = {MECHANISMS[mechanism].parameters[0].name: Estimate(value, unit, 0.9 * value, 1.1 * value)}
    return Effect(mechanism, Where(kind, PLACE[kind]), PLACE[kind], parameters, probability)


def test_claim_evidence_advice_and_caveat() -> None:
    assert statement(SINK) == (
        "Missing: heat to the floor at the bed, 10 W/K (90 %: 9–12); with it the z error of runs left out of the fit "
        "falls from 9.1 to 1.4 µm (noise 1.2), more probable in 11 of 12 runs. Radiation to walls or from a hot "
        "neighbour at the bed (8 %) would look the same in these runs; a night switched off would distinguish them."
    )
    capped = replace(SINK, others=(), separates="", caps=("3 runs only", "a resolution of 0.5 K"))
    assert statement(capped).endswith("runs. No surer than that: 3 runs only and a resolution of 0.5 K.")


@pytest.mark.parametrize(
    ("probability", "begins"),
    [(0.97, "Missing: heat"), (0.9, "Most likely (90 %) missing: heat"), (0.6, "Most likely (60 %) missing: heat"),
     (0.59, "Perhaps (59 %) missing: heat"), (0.005, "Perhaps (under 1 %) missing")],
)  # fmt: skip
def test_no_surer_than_the_probability(probability: float, begins: str) -> None:
    assert claim_phrase(replace(SINK, probability=probability, others=())).startswith(begins)
    drift = replace(found("sensor_drift", "sensor"), probability=probability)
    assert claim_phrase(drift).startswith("The sensor") == (probability > 0.9)


def test_a_tie_is_said_as_one() -> None:
    tied = replace(SINK, probability=0.83, others=(Other("radiation", BED, "the bed", 0.31, "surrounding: the room"),))
    assert statement(tied) == (
        "These runs cannot distinguish two explanations: heat to the floor at the bed, 10 W/K (90 %: 9–12) (52 %) or "
        "radiation to walls or from a hot neighbour at the bed (surrounding: the room) (31 %); with it the z error of "
        "runs left out of the fit falls from 9.1 to 1.4 µm (noise 1.2), more probable in 11 of 12 runs. A night "
        "switched off would distinguish them."
    )
    likelier = replace(tied, probability=0.924, others=(replace(tied.others[0], probability=0.92),))
    assert claim_phrase(likelier) == (
        "These runs cannot distinguish two explanations: radiation to walls or from a hot neighbour at the bed "
        "(surrounding: the room) (92 %) or heat to the floor at the bed, 10 W/K (90 %: 9–12) (under 1 %)"
    )
    unlike = replace(tied, probability=0.52, others=(replace(tied.others[0], indistinguishable=False),))
    assert claim_phrase(unlike).startswith("Perhaps (52 %) missing: heat to the floor")


@pytest.mark.parametrize(
    ("one", "words"),
    [
        (found("sensor_drift", "sensor"),
         "The sensor head_rear drifts, 0.12 K/h (90 %: 0.11–0.13). Check it at the machine before the model is "
         "changed."),
        (found("sensor_offset", "sensor", 0.5, "K"),
         "In the measurement: constant error of the sensor head_rear, 0.50 K"),
        (found("sensor_bonding", "sensor", 0.8, "1"),
         "In the measurement: poorly bonded sensor head_rear, bonding 0.80 (90 %: 0.72–0.88)"),
        (found("sensor_place", "sensor", 0.12, "1"), "In the measurement: the sensor head_rear off its body's mean"),
        (Effect("sensor_swap", Where("sensor", "front"), "front", {}, 0.95, context="with: rear"),
         "In the measurement: two sensors exchanged: front (with: rear)."),
        (found("time_skew", "error", 120.0, "s"), "clock of the channel z against the others, 120 s (90 %: 110–130)"),
        (found("joint_conductance", "link", 0.4, "1", 0.7),
         "Most likely (70 %) the joint between the bed and the room conducts better or worse than assumed, ratio 0.40"),
        (found("speed_shift", "error", -4.0, "um"), "axial shift of the shaft with the speed in the z error, −4.0 µm"),
        (replace(found("cabinet_heat", "node", 60.0, "W"), regime="coolant on"), "at the bed (when: coolant on), 60 W"),
        (Effect("motor_loss", BED, "the bed",
          {"idle": Estimate(40, "W", 30, 50), "linear": Estimate(110, "W", 90, 130)},
               0.99), "motor at the bed, idle 40 W (90 %: 30–50) and linear 110 W (90 %: 90–130)."),
        (Effect("wrong_parameter", Where("link", "front-air"), "", {"exposures.front-air.conductance":
               Estimate(4.2, "W/K", 3.6, 4.9)}, 0.95, was={"exposures.front-air.conductance": 1.0}),
         "The value of exposures.front-air.conductance (1 W/K → 4.2 W/K (90 %: 3.6–4.9)) in the machine file is wrong. "
         "Check the value against the drawing or the data sheet."),
        (Effect("free_flux", Where("node", "column_back"), "the column back", {"linear": Estimate(0.01, "W")}, 0.95,
               regime="coolant on", size=Estimate(58, "W", 49, 66)),
         "58 W (90 %: 49–66) into the column back (when: coolant on); no listed mechanism does this."),
        (Effect("free_shift", Where("error", "z"), "z", {"linear": Estimate(3.0, "um", 2.0, 4.0)}, 0.5),
         "Perhaps (50 %) 3.0 µm (90 %: 2.0–4.0) in the z error; no listed mechanism does this."),
    ],
)  # fmt: skip
def test_how_things_are_worded(one: Effect, words: str) -> None:
    assert words in statement(one)


@pytest.mark.parametrize("key", list(MECHANISMS))
def test_every_mechanism_is_worded_with_its_place_and_size(key: str) -> None:
    mechanism = MECHANISMS[key]
    for target in mechanism.acts_at:
        kind = KIND[target]
        parameters = {s.name: Estimate(1.234, s.unit, 1.1, 1.4) for s in mechanism.parameters}
        said = statement(Effect(key, Where(kind, "place"), PLACE[kind], parameters, 0.95))
        assert PLACE[kind] in said and said[0].isupper() | said[0].isdigit() and said.endswith(".")
        assert "  " not in said and " ," not in said and ".." not in said and "_" not in said.replace(PLACE[kind], "")
        if mechanism.parameters:
            assert "1.2" in said
            assert build_finding(Effect(key, Where(kind, "place"), PLACE[kind], parameters, 0.95)).equation


class WiperFriction(Mechanism):
    key = "wiper_friction"
    summary = "friction of the wipers"
    equation = "P = force |v|"
    acts_at = ("node",)
    parameters = (Spec("force", "N", "drag of all wipers", 60.0, 0.6, 0.0, 2000.0),)
    off: ClassVar[Mapping[str, float]] = {"force": 0.0}


def test_a_new_mechanism_is_worded_without_a_line_more(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("wipers_said")
    module.WiperFriction = WiperFriction  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wipers_said", module)
    monkeypatch.setitem(MECHANISMS._members, "wiper_friction", "wipers_said:WiperFriction")
    new = build_finding(Effect("wiper_friction", BED, "the guides", {"force": Estimate(81.0, "N", 71.0, 93.0)}, 0.95))
    assert new.statement == "Missing: friction of the wipers at the guides, 81 N (90 %: 71–93)."
    assert new.equation == "P = 81.0 N · |v|"


def test_the_finding_has_what_the_sentence_says() -> None:
    finding = build_finding(SINK)
    assert finding.statement == statement(SINK)
    assert finding.equation == "P = 10.2 W/K · (T_floor - T), T_floor = temperature + follow (T_room(0) - temperature)"
    assert finding.where == Place(kind="node", name="bed") and finding.name == "floor_sink_bed"
    assert finding.parameters["conductance"].interval90 == (8.9, 11.6)
    assert finding.alternatives[0].mechanism == "radiation" and finding.alternatives[0].probability == 0.08
    assert finding.evidence["left_out_rms"] == {
        "before": {"z_um": 9.1}, "after": {"z_um": 1.4}, "noise_floor": {"z_um": 1.2},
    }  # fmt: skip
    assert finding.evidence["gain_nats"] == 41.0
    fixed = build_finding(replace(SINK, parameters={"follow": Estimate(0.5, "1")}))
    assert fixed.parameters["follow"].interval90 is None


def test_errors_that_fall_are_told_the_greatest_fall_first_and_those_that_rise_behind() -> None:
    same, sensor = Rms("x", "um", 2.0, 2.02, 0.9), Rms("front", "degC", 0.8, 0.05, math.nan, sensor=True)
    worse, noise = Rms("y", "um", 2.7, 3.0, 0.9), Rms("w", "um", 0.5, 0.8, 0.9)
    equal = replace(worse, before=2.96, after=3.04)  # both are 3.0 in the sentence
    assert reductions((same,)) == reductions((worse,)) == reductions((replace(Z, before=3.04, after=2.96),)) == ""
    told = (
        "the misfit of the sensor front of runs left out of the fit falls from 0.80 to 0.050 K and the z error falls "
        "from 9.1 to 1.4 µm (noise 1.2)"
    )
    assert reductions((Z, same, sensor, noise)) == told
    assert reductions((Z, same, sensor, worse, equal)) == f"{told}, while the y error rises from 2.7 to 3.0 µm"


def test_verdicts() -> None:
    limits = [DetectionLimit(mechanism=m, where=Place(kind="node", name="bed"), limit=v, unit=u)
              for m, v, u in (("bearing_load", 0.001, "1"), ("floor_sink", 1.82, "W/K"), ("floor_sink", 2.5, "W/K"),
                              ("cabinet_heat", 12.3, "W"), ("sun", 20.0, "W/m**2"),
                              ("belt_loss", 5.0, "W"))]  # fmt: skip
    after = (Rms("z", "um", 1.3, 1.3, 1.2),)
    assert verdict_statement("consistent", rms=after, limits=limits, places=["the bed"] * 6) == (
        "Nothing is missing: the remaining error is the noise (z 1.3 µm (noise 1.2)). An effect above these limits "
        "would be claimed: heat to the floor at the bed 1.8 W/K, waste heat of a control cabinet or of auxiliaries "
        "at the bed 12 W, sunlight on one face at the bed 20 W/m² and 3 more in the table of limits."
    )
    assert verdict_statement("consistent", rms=after, limits=limits[:2], places=["the bed"] * 2).endswith(
        "would be claimed: heat to the floor at the bed 1.8 W/K and 1 more in the table of limits."
    )
    assert verdict_statement("consistent") == "Nothing is missing: the remaining error is the noise."
    more = "Too weak for a claim: heat to the floor: bed. A night switched off would show more."
    open_question = {"separates": "a night switched off", "possible": ["heat to the floor: bed"]}
    assert verdict_statement("consistent", **open_question).endswith(f"the noise. {more}")
    assert verdict_statement("partly_explained", [SINK], [Z], **open_question).endswith(f"what remains. {more}")
    assert verdict_statement("undecidable", **open_question).endswith(f"do not show what. {more}")
    assert "Too weak" not in verdict_statement("consistent", separates="a night switched off")
    coarse = (Rms("z", "um", 13.0, 13.0, 1.2), Rms("x", "um", 6.0, 6.0, 1.2), Rms("y", "um", 30.0, 30.0, 1.2))
    assert verdict_statement("consistent", rms=coarse) == (
        "No missing effect is supported by these runs; the remaining error, 11 times the noise in the median channel "
        "and 25 times in y, is not explained: a network this coarse may leave as much (y 30 µm (noise 1.2), z 13 µm "
        "(noise 1.2), x 6.0 µm (noise 1.2))."
    )
    one = (*after, Rms("x", "um", 1.0, 1.1, 1.0), Rms("front", "degC", 0.35, 0.35, 0.03, sensor=True))
    assert verdict_statement("consistent", rms=one).startswith(
        "No missing effect is supported by these runs; the remaining error, 1.1 times the noise in the median channel "
        "and 12 times in front, is not explained: a network this coarse may leave as much (front 0.35"
    )
    assert verdict_statement("explained", [SINK], [Z]) == (
        "The difference is heat to the floor at the bed, 10 W/K (90 %: 9–12); with it the z error of runs left out of "
        "the fit falls from 9.1 to 1.4 µm (noise 1.2). With it every channel is within 1.5 times its noise on runs "
        "left out."
    )
    partly = verdict_statement("partly_explained", [replace(SINK, probability=0.7)], [Z])
    assert partly.startswith("Most likely (70 %) part of the difference is heat to the floor")
    assert partly.endswith("Not explained: what remains.")
    rear = Rms("T_rear", "degC", 0.9, 0.36, 0.03, sensor=True)
    partly = verdict_statement("partly_explained", [SINK], [Z, rear])
    assert partly.endswith("Not explained: T_rear still at 12 times its noise.")
    flux = Effect("free_flux", Where("node", "column_back"), "the column back", {}, 0.95, regime="coolant on, no lag",
                 size=Estimate(60, "W"))  # fmt: skip
    assert verdict_statement("unlisted", [flux]) == (
        "No listed mechanism explains the difference: 60 W into the column back (when: coolant on, no lag)."
    )
    tied = replace(SINK, probability=0.9, others=(Other("radiation", BED, "the bed", 0.4),))
    assert verdict_statement("undecidable", [tied], separates="a night switched off") == (
        "Something is missing. These runs cannot distinguish two explanations: heat to "
        "the floor at the bed, 10 W/K (90 %: 9–12) (50 %) or radiation to walls or from a hot neighbour at the bed "
        "(40 %). A night switched off would decide."
    )
    assert verdict_statement("explained", [flux, tied, replace(SINK, probability=0.7, others=())]) == (
        "The difference is 60 W into the column back (when: coolant on, no lag), heat to the floor at the bed, 10 W/K "
        "(90 %: 9–12) (90 %; or radiation to walls or from a hot neighbour at the bed, 40 %) and heat to the floor at "
        "the bed, 10 W/K (90 %: 9–12) (70 %). With them every channel is within 1.5 times its noise on runs left out."
    )
    unsure = replace(SINK, probability=0.4, others=())
    assert verdict_statement("undecidable", [unsure]).startswith(
        "Something is missing, and these runs do not show what. Perhaps (40 %) missing: heat to the floor at the bed"
    )


@pytest.mark.parametrize(
    ("estimate", "words"),
    [
        (Estimate(10.2, "W/K", 8.9, 11.6), "10 W/K (90 %: 9–12)"),
        (Estimate(9.4, "W/K", 8.1, 10.9), "9.4 W/K (90 %: 8.1–10.9)"),
        (Estimate(5.23, "um", 5.21, 5.26), "5.23 µm (90 %: 5.21–5.26)"),
        (Estimate(5.230001, "um", 5.23, 5.230002), "5.230 µm (90 %: 5.230–5.230)"),
        (Estimate(0.02, "K", -0.5, 0.6), "0.02 K (90 %: −0.50 to 0.60)"),
        (Estimate(12345.0, "J/K", 9000.0, 16000.0), "12000 J/K (90 %: 9000–16000)"),
        (Estimate(0.0351, "1/K", 0.03, 0.04), "0.035/K (90 %: 0.030–0.040)"),
        (Estimate(0.997, "1", 0.9, 1.1), "1.0 (90 %: 0.9–1.1)"),
        (Estimate(17.6, "degC"), "18 °C"),
        (Estimate(0.52, "N*m"), "0.52 N·m"),
        (Estimate(9.96, "W"), "10 W"),
    ],
)
def test_digits_are_honest(estimate: Estimate, words: str) -> None:
    assert amount(estimate) == words


def test_numbers_by_themselves() -> None:
    assert [few(v) for v in (0.0, 0.123, 134.0, -2.04)] == ["0", "0.12", "130", "−2.0"]
    assert [as_given(v) for v in (1.0, 0.95, 26000.0, 17.65)] == ["1", "0.95", "26000", "17.65"]
    assert [percent(v) for v in (0.001, 0.08, 0.999)] == ["under 1 %", "8 %", "over 99 %"]


@pytest.mark.parametrize(
    ("key", "values", "equation"),
    [
        ("floor_sink", {"conductance": 10.2, "temperature": 17.6, "follow": 0.48},
         "P = 10.2 W/K · (T_floor - T), T_floor = 17.6 °C + 0.480 · (T_room(0) - 17.6 °C)"),
        ("belt_loss", {"power": 71.2, "exponent": 1.53, "rated": 6000.0}, "P = 71.2 W · (n / 6000 rpm)^1.53"),
        ("motor_loss", {"idle": 40, "linear": 110, "quadratic": 80, "rated": 6000},
         "P = 40.0 W + 110 W · x + 80.0 W · x^2 with x = n / 6000 rpm; 0 at rest"),
        ("radiation", {"area": 1.02, "emissivity": 0.9},
         "P = 0.900 · sigma · 1.02 m² · (T_surrounding^4 - T^4), T in K"),
        ("sun", {"irradiance": 150.0, "area": 2.0, "absorptivity": 0.5, "rise": 8.0, "set": 16.0},
         "P = 150 W/m² · 2.00 m² · 0.500 · sin(pi (t - 8.00 h) / (16.0 h - 8.00 h)) from 8.00 h to 16.0 h, else 0"),
        ("spindle_growth", {"gain": 1.2}, "error = 1.20 µm/K · θ_spindle,  gain = ± α · length"),
        ("guide_friction", {"friction": 0.0102, "load": 5090.0}, "P = mu F v; friction 0.0102 and load 5090 N"),
        ("initial_state", {"excess": -0.5}, "T(0) = first reading + (−0.500 K)"),
        ("sensor_swap", {}, "T_a = T_s(place b),  T_b = T_s(place a)"),
    ],
)  # fmt: skip
def test_equations_with_numbers(key: str, values: dict[str, float], equation: str) -> None:
    assert equation_with_numbers(MECHANISMS[key], values) == equation


@pytest.mark.parametrize("key", list(MECHANISMS))
def test_every_value_stands_in_the_equation(key: str) -> None:
    mechanism = MECHANISMS[key]
    values = {s.name: 1.11 + k / 100 for k, s in enumerate(mechanism.parameters)}
    text = equation_with_numbers(mechanism, values)
    assert all(few(v, 3) in text for v in values.values())
    assert not re.search("[\x00\x01]", text)


def test_places_go_by_the_files_words() -> None:
    part = twin_part(load_machine(Path(__file__).parents[2] / "machines" / "sample_vmc.yml"))
    assert place_label(Where("node", "front"), part) == "the front bearing housing"
    assert place_label(Where("node", "column_back"), part) == "the column back"
    assert place_label(Where("node", "room"), part) == "the room"
    assert place_label(Where("link", "shaft-front"), part) == "the shaft and the front bearing housing"
    assert place_label(Where("link", "bed-floor"), part) == "the bed and the floor"
    assert place_label(Where("sensor", "head_rear"), part) == "head_rear"
    numbered = part.model_copy(update={"bodies": {"node3": part.bodies["bed"]}})
    assert place_label(Where("node", "node3"), numbered) == "node3"
    drafted = part.bodies["bed"].model_copy(update={"words": "drafted: where bed sits"})
    assert place_label(BED, part.model_copy(update={"bodies": {"bed": drafted}})) == "the bed"
    radiation = MechanismPart(law="radiation", at={"body": "bed", "surrounding": "room"}, into="bed")
    assert context_label(radiation, BED, part) == "surrounding: the room"
    grease = MechanismPart(law="viscosity_feedback", at={"oil": ("front", "shaft")}, acts_on="front_bearings")
    assert context_label(grease, Where("node", "shaft"), part) == (
        "acts on: front_bearings, oil: the front bearing housing and the shaft"
    )
    growth = MechanismPart(law="speed_shift", acts_on="z", drivers="spindle_rpm")
    assert context_label(growth, Where("error", "z"), part) == "driver: spindle_rpm"
