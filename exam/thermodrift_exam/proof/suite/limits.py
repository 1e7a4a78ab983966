"""The size at which each effect is at the detection limit, measured on development plants.

    python -m thermodrift_exam.proof.suite.limits --plant volumes [--seeds 3] [--effects sun,draught]

renews `limits.yml`. A plant without concealed effects is drawn and the twin of the machine file fitted to its
recordings. The contribution of an effect is the difference of two simulations without noise. It is at the limit where
its own signature, with recalibration and structure integrated out, is expected to gain what structure alone gives once
in a hundred cases: where a perfect answer could be seen.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from threadpoolctl import threadpool_limits

from data.arrays import Array
from data.batch import Batch
from data.files import write_atomic
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import baseline
from diagnosis.search.claims import least_relative_gain
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.plant import draw, posed
from thermodrift_exam.plants.structure import FEATURES, Plant
from thermodrift_exam.proof.suite.setting import setting
from thermodrift_exam.proof.suite.sizes import ALL_OR_NOTHING, most
from twin.schema import twin_part

HOW = (
    "Size at which an effect's own signature, with recalibration and structure integrated out, is expected to gain "
    "what a claim takes; median over development plants that lack nothing else."
)
MOST = 40.0  # the largest size
SELDOM = ("mandrel",)  # most machines are measured without one
TABLE = Path(__file__).with_name("limits.yml")
CLEAN = {"noise_K": 0.0, "noise_um": 0.0, "quantisation_K": 1e-6}
EVEN = {"missing": 0.0, "early_s": 0.0, "gaps": 0.0, "absent": 0.0}  # rows that can be subtracted
STEP_S = 60.0  # of the solver


@dataclass(frozen=True)
class Bench:
    """A fitted plant without concealed effects, the information in its recordings, and its arguments."""

    seed: int
    plant: str
    options: Mapping[str, Any]
    fitted: Fitted
    threshold: float  # nats

    @classmethod
    def of(cls, seed: int, plant: str, stated: Sequence[str]) -> Bench:
        """The plant of a seed whose machine file states these features and whose plant has no others."""
        lacks = [f for f in FEATURES if f not in stated]
        options = {**setting(seed, "development"), **EVEN, "has": list(stated), "lacks": lacks, "solver_s": STEP_S}
        case = draw(seed, plant=plant, **options)
        fitted = baseline(case.machine, twin_part(case.machine), case.batches, None, len(case.batches))
        return cls(seed, plant, options, fitted, least_relative_gain() * abs(fitted.log_evidence))

    def clean(self, sizes: Mapping[str, float]) -> list[Batch]:
        """The same runs without noise, with effects of these sizes."""
        return draw(self.seed, sizes=sizes, plant=self.plant, **{**self.options, **CLEAN}).batches

    @cached_property
    def plain(self) -> list[Batch]:
        return self.clean({})

    def signature(self, effect: str, size: float) -> list[Array]:
        """Contribution of the effect to the rows of every batch, in units of the noise."""
        problem = self.fitted.problem
        out = []
        for m, one, other in zip(problem.measured, self.clean({effect: size}), self.plain, strict=True):
            added = [one.values(c) - other.values(c) for c in problem.channels]
            out.append(m.of(np.stack(added, axis=1)) / problem.noise[m.channel])
        return out

    def limit(self, effect: str) -> float:
        """The size at the detection limit: from size 1, and once more from the result, since few effects are linear."""
        if effect == "wrong_parameter":
            return float(np.sqrt(2.0 * self.threshold) / self._doubt(effect, 1.0))
        if effect in ALL_OR_NOTHING:
            return self._times(self.signature(effect, 1.0))
        size = 1.0
        for _ in range(2):
            at = min(size, most(effect))
            size = self._times([rows / at for rows in self.signature(effect, at)])
        return size

    def _times(self, rows: Sequence[Array]) -> float:
        """The multiple of these rows at the limit; `MOST` where more is needed."""
        now, p = self.fitted, len(self.fitted.z)
        white = now.marginal.white([r[:, None] for r in rows])
        c = now.level.reduced(
            now.marginal.grams([np.hstack([x[:, :-1], w]) for x, w in zip(now.columns, white, strict=True)])
        )
        taken = c[:p, p] @ np.linalg.solve(c[:p, :p] + np.eye(p), c[:p, p])
        return float(min(MOST, np.sqrt(2.0 * self.threshold / max(float(c[p, p] - taken), 1e-300))))

    def _plant(self) -> Plant:
        return posed(self.seed, {}, self.plant, **self.options).plant

    def _doubt(self, effect: str, size: float) -> float:
        """Deviation of a value of the file in prior sd, as estimated from the recordings."""
        drawn = EFFECTS[effect](self._plant(), size, stream(self.seed, f"effect {effect}"))
        ((path, factor),) = drawn.misread().items()
        unknowns = self.fitted.problem.unknowns
        at = next(k for k, u in enumerate(unknowns) if u.name == path or u.name.startswith(f"{path}."))
        left = self.fitted.state.arrow.covariance[at, at]
        return float(abs(np.log(factor)) / unknowns[at].spread * np.sqrt(max(1.0 - left, 0.0)))


@threadpool_limits.wrap(limits=1)
def measured(plant: str, seeds: Sequence[int], effects: Sequence[str]) -> Iterator[tuple[str, int, float]]:
    """(effect, seed, size at the limit); a withheld effect where the machine file leaves out that feature alone."""
    for seed in seeds:
        benches: dict[str | None, Bench] = {}
        for effect in effects:
            withheld = EFFECTS[effect].withholds
            if withheld not in benches:
                benches[withheld] = Bench.of(seed, plant, [f for f in FEATURES if f not in {withheld, *SELDOM}])
            yield effect, seed, benches[withheld].limit(effect)


def renewed(table: Mapping[str, Any], plant: str, found: Sequence[tuple[str, int, float]]) -> dict[str, Any]:
    """The table with new measurements of these effects of a plant."""
    by_effect: dict[str, list[float]] = {}
    for effect, _, size in found:
        by_effect.setdefault(effect, []).append(size)
    limits = {p: dict(rows) for p, rows in table.get("limits", {}).items()}
    plants = {p: dict(rows) for p, rows in table.get("plants", {}).items()}
    for effect, sizes in by_effect.items():
        limits.setdefault(plant, {})[effect] = float(f"{np.median(sizes):.3g}")
        plants.setdefault(plant, {})[effect] = [float(f"{s:.3g}") for s in sizes]
    return {"how": HOW, "limits": limits, "plants": plants}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plant", default="volumes")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=101)
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--dry", action="store_true", help="print only")
    args = parser.parse_args()
    found = []
    for row in measured(args.plant, range(args.first, args.first + args.seeds), args.effects.split(",")):
        print(f"{row[0]:24} plant {row[1]}  {row[2]:.3g}", flush=True)
        found.append(row)
    if args.dry:
        return
    table = yaml.safe_load(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}
    write_atomic(TABLE, yaml.safe_dump(renewed(table, args.plant, found), sort_keys=False, width=120))


if __name__ == "__main__":
    main()
