"""Data of the report: effects with place, size and probability, and the tables of a diagnosis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from data.arrays import Array
from diagnosis.contracts import COLUMNS, CandidateKind, Where
from diagnosis.findings.schema import rms_key
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import LeftOutRows
from diagnosis.formatting import Estimate, few, listed, of_error
from diagnosis.policy import POLICY
from diagnosis.search.claims import Round, explanations
from twin.calibration.whiteness import lagged_sums
from twin.mechanisms import MECHANISMS
from twin.schema import MechanismPart, TwinPart, several


@dataclass(frozen=True)
class Rms:
    """Left-out errors of one channel without and with the effects, in `unit`; `noise` is the given noise."""

    channel: str
    unit: str
    before: float
    after: float
    noise: float = math.nan
    sensor: bool = False  # False: an error channel

    @property
    def key(self) -> str:
        return rms_key(self.channel, self.unit)

    @property
    def times_noise(self) -> float:
        """What is left after all that was found over the given noise; 0 where none is given."""
        return self.after / self.noise if self.noise > 0 else 0.0


@dataclass(frozen=True)
class Other:
    """Another explanation, and whether these runs cannot distinguish it from the effect."""

    mechanism: str
    where: Where
    place: str
    probability: float
    context: str = ""
    indistinguishable: bool = True


@dataclass(frozen=True)
class Effect:
    """One effect that a diagnosis found.

    Attributes:
        mechanism: a registry key or a `CandidateKind`.
        place, context: from `place_label` and `context_label`.
        parameters: by name; of a wrong parameter by path ("exposures.front-air.conductance"). Of a value that varies
            between runs the one estimate is its sd, as a share where the unit is 1.
        was: the machine file's values of a wrong parameter.
        size: the effect's size where no parameter is one (root mean square watts of a `free_flux`).
        separates: the run that would distinguish the alternatives ("a night switched off").
        caps: what limits the probability ("3 runs only").
    """

    mechanism: str
    where: Where
    place: str
    parameters: Mapping[str, Estimate]
    probability: float
    name: str = ""
    context: str = ""
    others: tuple[Other, ...] = ()
    regime: str = "always"
    windows: tuple[tuple[str, float, float], ...] = ()
    rms: tuple[Rms, ...] = ()
    separates: str = ""
    caps: tuple[str, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=dict)
    was: Mapping[str, float] = field(default_factory=dict)
    size: Estimate | None = None

    @property
    def kind(self) -> CandidateKind:
        return CandidateKind.of(self.mechanism)

    @property
    def main(self) -> tuple[str, ...]:
        """Its parameters that say how large it is: the mechanism's amplitudes, else the first that was fitted."""
        scales = (MECHANISMS[self.mechanism].off or {}) if self.mechanism in MECHANISMS else {}
        own = tuple(p for p in scales if p in self.parameters)
        fitted = [p for p, e in self.parameters.items() if e.known]
        return tuple(p for p in own if p in fitted) or own[:1] or tuple(fitted[:1]) or tuple(self.parameters)[:1]

    @property
    def separate_probability(self) -> float:
        """Its probability without those of the explanations that are indistinguishable from it."""
        return max(0.0, self.probability - sum(o.probability for o in self.others if o.indistinguishable))

    @property
    def tied(self) -> tuple[Other, ...]:
        """Explanations that these runs cannot distinguish from it and that are nearly as probable."""
        if self.separate_probability > POLICY.untied_probability:
            return ()
        least = POLICY.tied_min_probability_share * self.separate_probability
        return tuple(o for o in self.others if o.indistinguishable and o.probability >= least)


def beyond_noise(rms: Sequence[Rms]) -> list[Rms]:
    """Channels whose left-out errors after all that was found are no noise, the worst first."""
    return sorted((r for r in rms if r.times_noise > POLICY.noise_max_ratio), key=lambda r: -r.times_noise)


def times_noise(rms: Sequence[Rms]) -> float:
    """Left-out errors after all that was found over the given noise, the median over channels; 0 where none is."""
    return float(np.nanmedian([r.times_noise for r in rms if r.noise > 0] or [0.0]))


def place_label(where: Where, part: TwinPart) -> str:
    """``the bed``, ``the shaft and the front bearing housing`` of a link, channels by their name.

    A body goes by its `words`, or by its name with blanks for underscores (words with a colon explain, not name).
    """
    if where.kind == "link" and where.name in part.links:
        return listed([_thing(p, part) for p in part.links[where.name].between])
    if where.kind == "link" and where.name in part.exposures:
        exposure = part.exposures[where.name]
        return listed([_thing(p, part) for p in (exposure.of, exposure.to)])
    return _thing(where.name, part) if where.kind == "node" else where.name


def context_label(given: MechanismPart, where: Where, part: TwinPart) -> str:
    """What else a mechanism depends on: ``surrounding: the room, speed: spindle_rpm``; nothing for the place itself."""
    ports = given.at if isinstance(given.at, Mapping) else {}
    at = {port: listed([_thing(p, part) for p in several(places)]) for port, places in ports.items()}
    parts = [f"{port.replace('_', ' ')}: {place}" for port, place in at.items() if place != place_label(where, part)]
    if isinstance(given.drivers, Mapping):
        parts += [f"{role.replace('_', ' ')}: {channel}" for role, channel in given.drivers.items()]
    elif given.drivers:
        parts.append(f"driver: {given.drivers}")
    if where.kind != "node" and isinstance(given.at, str):
        parts.insert(0, _thing(given.at, part))
    on = [target for target in several(given.acts_on) if target != where.name]
    if on:
        parts.insert(0, f"{'with' if where.kind == 'sensor' else 'acts on'}: {listed(on)}")
    return ", ".join(parts)


def _thing(place: str, part: TwinPart) -> str:
    """A body or surrounding with its article; numbered ones (node3) have none."""
    name, _, at = place.partition("@")
    held = part.bodies.get(name) or part.surroundings.get(name)
    label = held.words if held and held.words and ":" not in held.words else name.replace("_", " ")
    article = "" if label[-1].isdigit() or label.split()[0].lower() in ("a", "an", "the") else "the "
    return f"{article}{label}{f' at {at}' if at else ''}"


ACF_LAGS = 40


def rises(worse: Mapping[str, tuple[float, float]], units: Mapping[str, str]) -> str:
    """``the left-out error of T1 from 1.4 to 4.5 K``, of every channel that got worse, the largest ratio first."""
    first = sorted(worse, key=lambda c: worse[c][0] / worse[c][1])
    phrases = [f"{c} from {few(worse[c][0])} to {of_error(worse[c][1], units[c])}" for c in first]
    return f"the left-out error of {listed(phrases)}"


def rms_table(before: LeftOutRows, after: LeftOutRows, fitted: Fitted) -> pd.DataFrame:
    """Left-out rms by batch and channel, with the noise that the machine file states."""
    noise = dict(zip(fitted.problem.channels, fitted.problem.noise, strict=True))
    out = before.rms.rename(columns={"rms": "before"})
    out["after"] = after.rms["rms"]
    out["floor"] = out["channel"].map(noise)
    return out[list(COLUMNS["rms"])]


def series_table(before: LeftOutRows, after: LeftOutRows, fitted: Fitted) -> pd.DataFrame:
    """Recorded and predicted series of the batches left out."""
    problem = fitted.problem
    parts = []
    for k, m in enumerate(problem.measured):
        time_s = fitted.batches[k].time_s
        parts.append(
            pd.DataFrame({
                "batch": m.batch_id,
                "channel": [problem.channels[c] for c in m.channel],
                "unit": [problem.units[c] for c in m.channel],
                "time_s": time_s[m.row],
                "recorded": m.value,
                "before": m.value - before.error[k],
                "after": m.value - after.error[k],
            })
        )  # fmt: skip
    out = pd.concat(parts, ignore_index=True)
    sensors = {r.channel for r in problem.network.readings}
    out.loc[out["channel"].isin(sensors), "unit"] = "degC"
    return out


def acf_table(before: LeftOutRows, after: LeftOutRows, fitted: Fitted) -> pd.DataFrame:
    """Autocorrelation of the left-out errors, pooled over batches."""
    problem = fitted.problem
    rows: list[tuple[str, float, float, float]] = []
    for c, name in enumerate(problem.channels):
        first, step_s = _acf(before.error, fitted, c)
        second, _ = _acf(after.error, fitted, c)
        rows += [(name, k * step_s, a, b) for k, (a, b) in enumerate(zip(first, second, strict=True))]
    return pd.DataFrame(rows, columns=list(COLUMNS["acf"]))


def _acf(errors: Sequence[Array], fitted: Fitted, channel: int) -> tuple[Array, float]:
    total, step_s = np.zeros(ACF_LAGS), 0.0
    for k, m in enumerate(fitted.problem.measured):
        at = m.channel == channel
        if at.sum() < 3:
            continue
        step_s = m.stride * fitted.batches[k].step_s
        series = np.full(int((m.row[at][-1] - m.row[at][0]) // m.stride) + 1, np.nan)
        series[(m.row[at] - m.row[at][0]) // m.stride] = errors[k][at]
        sums = lagged_sums(series)[0][:ACF_LAGS]
        total[: len(sums)] += sums
    return (total / total[0] if total[0] > 0 else total), step_s


def candidates_table(rounds: Sequence[Round]) -> pd.DataFrame:
    """All that was tried in full or in its cluster, round by round, the likeliest first."""
    rows: list[tuple[object, ...]] = []
    for done in rounds:
        n = len(done.before.batches)
        for e in explanations(done)[0]:
            s, c = e.tried.scored, e.tried.candidate
            amplitude, unit = _amplitude(e.tried.scored.amplitudes, c.mechanism)
            rows.append(
                (len(rows) + 1, c.mechanism, c.where.kind, c.where.name, c.label, e.tried.cluster, e.tried.gain,
                 e.tried.improved, n, s.absorbed, amplitude, unit, e.probability)
            )  # fmt: skip
    table = pd.DataFrame(rows, columns=list(COLUMNS["candidates"]))
    return table.assign(cluster=1 + pd.factorize(table["cluster"])[0])


def _amplitude(amplitudes: Mapping[str, float], mechanism: str) -> tuple[float, str]:
    if not amplitudes or mechanism not in MECHANISMS:
        return float(np.exp(amplitudes["factor"])) if "factor" in amplitudes else np.nan, "1"
    name = next(iter(amplitudes))
    off = (MECHANISMS[mechanism].off or {}).get(name, 0.0)
    return (
        (off + amplitudes[name], MECHANISMS[mechanism].spec(name).unit)
        if name in (MECHANISMS[mechanism].off or {})
        else (amplitudes[name], "1")
    )


def steps_table(rounds: Sequence[Round]) -> pd.DataFrame:
    rows = [
        (k + 1, r.best.candidate.label, r.best.gain, r.threshold, r.claim_probability, r.best.improved, r.accepted)
        for k, r in enumerate(rounds)
        if r.best is not None
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS["steps"]))
