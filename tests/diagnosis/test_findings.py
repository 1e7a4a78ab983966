"""findings.json as DESIGN promises it: keys and their order, four digits, no nan, one clear line for what is none."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from data.errors import InputError
from diagnosis.findings.schema import Findings, as_json, read_findings, rms_key

BED = {"kind": "node", "name": "bed"}
RAW: dict[str, Any] = {
    "schema": "thermodrift.findings/1", "machine": "vmc", "batches": ["b1", "b2"], "verdict": "explained",
    "findings": [{
        "mechanism": "floor_sink", "where": BED,
        "when": {"regime": "spindle_rpm > 0", "windows": [["b1", 123456.78, 200000.0]]},
        "parameters": {"conductance": {"value": 10.23456, "unit": "W/K", "interval90": [8.9, 11.6]}},
        "probability": 0.97,
        "alternatives": [{"mechanism": "radiation", "where": BED, "probability": 0.02, "alike": True}],
        "equation": "P = 10.2 W/K · (T_floor - T)", "statement": "Missing: heat to the floor.",
        "evidence": {"gain_nats": 41.23456, "left_out_rms": {"before": {"z_um": 9.123456}}},
    }],
    "fit": {
        "left_out_rms": {"before": {"z_um": 9.1}, "after": {"z_um": 1.4}, "noise_floor": {"z_um": 1.2}},
        "batches_improved": 11, "batches": 12,
    },
    "detection_limits": [{"mechanism": "cabinet_heat", "where": BED, "limit": 12.0, "unit": "W"}],
    "next_experiment": {"separates": ["floor_sink_bed", "radiation_bed"], "run": "a night off", "hours": 3.0},
    "seconds": 41.2,
}  # fmt: skip


def changed(**keys: Any) -> dict[str, Any]:
    return RAW | keys


def test_every_key_of_the_design_stands_in_its_order() -> None:
    told = json.loads(as_json(Findings.from_json(RAW)))
    assert list(told)[: len(RAW)] == list(RAW)
    assert list(told["findings"][0])[: len(RAW["findings"][0])] == list(RAW["findings"][0])
    assert list(told["fit"]["left_out_rms"]) == ["before", "after", "noise_floor"]
    assert told["detection_limits"][0] | RAW["detection_limits"][0] == told["detection_limits"][0]
    assert told["next_experiment"] | RAW["next_experiment"] == told["next_experiment"]
    assert (told["simulated"], told["remarks"], told["refinements"]) == (False, [], [])


def test_numbers_have_four_digits_and_windows_stay_where_they_were() -> None:
    one = json.loads(as_json(Findings.from_json(RAW)))["findings"][0]
    assert one["parameters"]["conductance"] == {"value": 10.23, "unit": "W/K", "interval90": [8.9, 11.6]}
    assert one["evidence"] == {"gain_nats": 41.23, "left_out_rms": {"before": {"z_um": 9.123}}}
    assert one["when"]["windows"] == [["b1", 123456.8, 200000.0]]


def test_what_is_not_known_is_null_and_what_is_not_certain_is_below_one() -> None:
    raw = changed(seconds=math.nan, fit={"left_out_rms": {"before": {"z_um": math.inf}}, "batches_improved": 0,
                                         "batches": 2})  # fmt: skip
    raw["findings"] = [RAW["findings"][0] | {"probability": 0.99999, "evidence": {"sign_test_p": np.float64("nan"),
                                             "batches": np.int64(3)}}]  # fmt: skip
    told = json.loads(as_json(Findings.from_json(raw)))
    assert told["seconds"] is None and told["fit"]["left_out_rms"]["before"] == {"z_um": None}
    assert told["findings"][0]["probability"] == 0.9999
    assert told["findings"][0]["evidence"] == {"sign_test_p": None, "batches": 3}
    assert Findings.from_json(told).seconds is None


def test_an_alternative_of_an_older_file_is_distinguishable() -> None:
    plain = {"mechanism": "radiation", "where": BED, "probability": 0.02}
    older = changed(findings=[RAW["findings"][0] | {"alternatives": [plain]}])
    (now,), (then,) = (Findings.from_json(raw).findings[0].alternatives for raw in (RAW, older))
    assert now.alike and not then.alike
    alternatives = json.loads(as_json(Findings.from_json(older)))["findings"][0]["alternatives"]
    assert alternatives == [plain | {"alike": False}]


def test_a_file_reads_back_and_writes_the_same_text(tmp_path: Path) -> None:
    text = as_json(Findings.from_json(RAW))
    assert text.endswith("}\n") and "·" in text
    path = tmp_path / "findings.json"
    path.write_text(text, encoding="utf-8")
    assert as_json(read_findings(path)) == text


def test_nothing_can_be_changed_or_added() -> None:
    findings = Findings.from_json(RAW)
    with pytest.raises(ValidationError):
        findings.verdict = "consistent"
    with pytest.raises(ValidationError):
        Findings.model_validate(changed(mood="good"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[1, 2]", r"f.json: is no findings file; expected a mapping with the key 'schema': 'thermodrift.findings/1'"),
        ("{}", r"f.json: is no findings file"),
        ('{"schema": "thermodrift.findings/9"}',
         r"f.json: schema is 'thermodrift.findings/9', expected '.*/1'; diagnose"),
        ("{1}", r"f.json line 1: not valid JSON .*; diagnose again"),
        (json.dumps(changed(verdict="sure")), r"f.json: key 'verdict': got 'sure'; Input should be 'consistent', "),
        (json.dumps(changed(bathes=[])), r"f.json: unknown key 'bathes'; did you mean 'batches'\?"),
        (json.dumps({k: v for k, v in RAW.items() if k != "fit"}), r"f.json: key 'fit' is missing"),
        (json.dumps(changed(findings=[RAW["findings"][0] | {"probability": 1.2}])),
         r"key 'findings.0.probability': got 1.2"),
        (json.dumps(changed(findings=[RAW["findings"][0] | {"where": {"kind": "body", "name": "b"}}])),
         r"key 'findings.0.where.kind': got 'body'; Input should be 'node', 'link', 'sensor' or 'error'"),
    ],
)  # fmt: skip
def test_what_is_no_findings_file_is_told_in_one_line(content: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "f.json"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=words) as told:
        read_findings(path)
    assert str(told.value).startswith(f"findings file {path}") and "\n" not in str(told.value)


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent.json: cannot be read .*; give the findings.json of a diagnosis"):
        read_findings(tmp_path / "absent.json")


def test_keys_of_errors_say_channel_and_unit() -> None:
    assert (rms_key("z", "um"), rms_key("front", "degC"), rms_key("hoop", "um/m")) == ("z_um", "front_K", "hoop_um/m")
