"""What stands above a diagnosis: claims in short sentences, limits in the unit of the error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diagnosis.findings.schema import DetectionLimit, Finding, Place
from reports.diagnosis.first_screen import claim, limits_sentence, values_label
from reports.diagnosis.page import diagnosis_page, write_diagnosis_report
from reports.diagnosis.tables import effect_label
from reports.layout import Text
from tests.toys.diagnosis import toy_diagnosis


def test_without_a_demonstration_there_is_no_panel(tmp_path: Path) -> None:
    write_diagnosis_report(tmp_path / "plain.html", toy_diagnosis("explained"), pictures=False)
    text = (tmp_path / "plain.html").read_text(encoding="utf-8")
    assert '<div class="unsealed' not in text and '<div class="changed">' not in text
    assert "machine.yml" in text


def test_a_claim_is_one_sentence_and_a_short_one_names_what_cannot_be_distinguished() -> None:
    x = toy_diagnosis("undecidable").findings.findings[0]
    own = "heat to the floor at bed, conductance 10.2 W/K (90 %: 8.9 to 11.6), follow 0.48 (90 %: 0.39 to 0.57)"
    assert claim(x) == ("52\u202f%, more likely than not", f"{own}.")
    tied = tuple(a.model_copy(update={"alike": True}) for a in x.alternatives)
    (radiation, convection) = map(effect_label, tied)
    said = claim(x.model_copy(update={"alternatives": tied}))[1]
    assert said == f"{own}; or, which these runs cannot distinguish from it, {radiation} or {convection}."
    hidden = toy_diagnosis("unlisted").findings.findings[0]
    assert claim(hidden)[1].startswith(
        "missing heat of no listed mechanism at column_back, when spindle_rpm > 0, heat 58"
    )


def test_values_have_units_and_intervals_three_at_most() -> None:
    raw: dict[str, Any] = {
        "mechanism": "motor_loss", "where": {"kind": "node", "name": "motor"}, "probability": 0.9, "statement": "s",
        "parameters": {
            "rated": {"value": 6000.0, "unit": "rpm"},
            **{n: {"value": 40.0, "unit": "W", "interval90": [30.0, 51.0]} for n in ("idle", "linear", "quadratic")},
        },
    }  # fmt: skip
    finding = Finding(**raw)
    each = "40 W (90 %: 30 to 51)"
    assert values_label(finding) == f"idle {each}, linear {each}, quadratic {each}; 1 more in the table"
    assert effect_label(finding).endswith(" at motor")
    at = {"sensor": ": z", "error": " in the z error", "link": " at the link z"}
    for kind, words in at.items():
        assert effect_label(finding.model_copy(update={"where": Place(kind=kind, name="z")})).endswith(words)  # type: ignore[arg-type]


def test_consistent_states_what_would_have_been_seen_in_the_errors_unit() -> None:
    def limit(mechanism: str, kind: str, name: str, value: float | None, unit: str) -> DetectionLimit:
        return DetectionLimit(mechanism=mechanism, where=Place(kind=kind, name=name), limit=value, unit=unit)  # type: ignore[arg-type]

    limits = [
        limit("speed_shift", "error", "z", 7.22, "um"), limit("speed_shift", "error", "z", 9.0, "um"),
        limit("joint_slip", "error", "z", 0.81, "um"), limit("joint_slip", "error", "x", 0.7953, "um"),
        limit("joint_slip", "error", "y", None, "um"), limit("column_bending", "error", "y", 5.0, "um/K"),
        limit("floor_sink", "node", "bed", 3.0, "W/K"),
    ]  # fmt: skip
    said = limits_sentence(limits)
    assert said == (
        "Would be claimed: on x slip in a bolted or guided joint from 0.795 µm and on z axial shift of the shaft "
        "with the speed from 7.22 µm."
    )
    assert limits_sentence(limits[-2:]) == ""
    d = toy_diagnosis("consistent")
    d = type(d)(**{**d.__dict__, "findings": d.findings.model_copy(update={"detection_limits": tuple(limits)})})
    (lead,) = [b for b in diagnosis_page(d, False).top if isinstance(b, Text) and b.look == "lead"]
    assert lead.text.endswith(said)
