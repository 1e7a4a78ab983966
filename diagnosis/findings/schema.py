"""findings.json: what a diagnosis found, for machines and for people, as docs and other programs rely on it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from data.errors import InputError
from data.files import from_json
from data.yaml_file import parse_part
from diagnosis.contracts import Kind

SCHEMA = "thermodrift.findings/1"
DIGITS = 4  # significant, of every number but the seconds of a window
LARGEST_PROBABILITY = 0.9999  # a probability below 1 is not written as 1

Verdict = Literal["consistent", "explained", "partly_explained", "unlisted", "undecidable"]
Number = float | None  # None: not known; nan is written as null
Share = Annotated[float, Field(ge=0, le=1)]

# The keys of a finding's evidence; others may be added.
EVIDENCE: Mapping[str, str] = {
    "gain_nats": "rise of the log score of the batches left out, in nats",
    "threshold_nats": "gain from which on an effect is claimed",
    "relative_gain": "gain over the absolute log evidence of the fit before, which the probability follows",
    "lead_share": "share of the gain that the best explanation of another mechanism and place lacks",
    "batches_improved": "left-out batches whose error falls",
    "batches": "left-out batches",
    "sign_test_p": "chance of so many improved batches if improving were a coin's toss",
    "absorbed_share": "share of the effect's signature that recalibration imitates, 0 to 1",
    "left_out_rms": "{before, after, noise_floor} by channel, as in fit",
    "when_overlap": "share of the gain that falls into the named regime or windows, 0 to 1",
    "amplitude_sd": "standard deviation of the amplitude over refined networks, in its unit",
    "seasons_left_out": "{season: gain in nats} where a whole season was left out",
    "regimes_left_out": "{regime: gain in nats} where a whole regime was left out",
}


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Place(_Part):
    """A body or surrounding (node), a link or exposure (link), a sensor or an error channel."""

    kind: Kind
    name: str


class When(_Part):
    """In which regime ("spindle_rpm > 0", "always") and in which windows (batch, start s, end s) it shows."""

    regime: str = "always"
    windows: tuple[tuple[str, float, float], ...] = ()


class FittedParameter(_Part):
    """A fitted value in its unit; no interval where it was not freed."""

    value: Number
    unit: str
    interval90: tuple[Number, Number] | None = None


class Alternative(_Part):
    """What would explain the same difference, and how probable that is; `alike`: these recordings cannot distinguish it
    from the finding, whose probability counts it."""

    mechanism: str
    where: Place
    probability: Share
    alike: bool = False


class Finding(_Part):
    """One effect. `evidence` is free; `EVIDENCE` says what its usual keys mean. `name`: its key in machine.yml."""

    mechanism: str
    where: Place
    when: When = When()
    parameters: Mapping[str, FittedParameter] = {}
    probability: Share
    alternatives: tuple[Alternative, ...] = ()
    equation: str = ""
    statement: str
    evidence: Mapping[str, Any] = {}
    name: str | None = None


class LeftOutRms(_Part):
    """Root mean squares over all left-out rows, by `rms_key`."""

    before: Mapping[str, Number] = {}
    after: Mapping[str, Number] = {}
    noise_floor: Mapping[str, Number] = {}


class FitSummary(_Part):
    left_out_rms: LeftOutRms = LeftOutRms()
    batches_improved: int
    batches: int


class DetectionLimit(_Part):
    """The least effect that these recordings would have shown, in its own unit, and what absorbs the rest of it."""

    mechanism: str
    where: Place
    limit: Number
    unit: str
    words: str = ""
    absorbed: Number = None
    absorbed_by: str = ""


class NextExperiment(_Part):
    """The run that would distinguish tied causes; `file`: the run plan, ready to use."""

    separates: tuple[str, ...]
    run: str
    hours: Number
    file: str | None = None


class Refinement(_Part):
    """What was refined before any physics was sought; left-out score before and after."""

    what: str
    why: str = ""
    before: Number = None
    after: Number = None


class Findings(_Part):
    """The whole file. `statement` is the verdict as a sentence; `remarks` say what limits the confidence."""

    schema_: Literal["thermodrift.findings/1"] = Field(default="thermodrift.findings/1", alias="schema")
    machine: str
    batches: tuple[str, ...]
    verdict: Verdict
    findings: tuple[Finding, ...] = ()
    fit: FitSummary
    detection_limits: tuple[DetectionLimit, ...] = ()
    next_experiment: NextExperiment | None = None
    seconds: Number
    statement: str = ""
    simulated: bool = False
    drafted: bool = False
    remarks: tuple[str, ...] = ()
    refinements: tuple[Refinement, ...] = ()
    account: Mapping[str, Any] = {}  # rows read and dropped, and what each check took of each channel and batch

    @classmethod
    def from_json(cls, raw: Any, where: str = "findings") -> Findings:
        """From what JSON gives.

        Raises:
            InputError: another schema, an unknown or missing key, a wrong value; one line that begins with `where`.
        """
        if not isinstance(raw, dict) or "schema" not in raw:
            raise InputError(f"{where}: is no findings file; expected a mapping with the key 'schema': '{SCHEMA}'")
        if raw["schema"] != SCHEMA:
            raise InputError(f"{where}: schema is {raw['schema']!r}, expected '{SCHEMA}'; diagnose again to write it")
        return parse_part(raw, cls, where)


def rms_key(channel: str, unit: str) -> str:
    """``z_um`` of an error channel, ``front_K`` of a temperature."""
    return f"{channel}_{'K' if unit == 'degC' else unit}"


def as_json(findings: Findings) -> str:
    """The file's text: keys in the schema's order, numbers to four significant digits, nan as null."""
    tree = findings.model_dump(by_alias=True)
    return json.dumps(_rounded(tree), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def read_findings(path: Path) -> Findings:
    """Read and check a findings file.

    Raises:
        InputError: file missing, not JSON, another schema, a misspelt key (with the closest), a wrong value.
    """
    try:
        raw = from_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"findings file {path}: cannot be read ({error}); give the findings.json of a diagnosis"
        ) from None
    except json.JSONDecodeError as error:
        raise InputError(
            f"findings file {path} line {error.lineno}: not valid JSON ({error.msg}); diagnose again"
        ) from None
    return Findings.from_json(raw, f"findings file {path}")


def _rounded(value: Any, key: str = "") -> Any:
    if isinstance(value, Mapping):
        return {str(k): _rounded(v, str(k)) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v, key) for v in value]
    if hasattr(value, "item"):  # a numpy scalar in the evidence
        value = value.item()
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None
    if key == "windows":
        return round(value, 1)
    rounded = float(f"{value:.{DIGITS}g}")
    return min(rounded, LARGEST_PROBABILITY) if key == "probability" and value < 1 else rounded
