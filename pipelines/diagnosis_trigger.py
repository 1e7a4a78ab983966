"""A training whose twin predicts what is new worse than it used to is followed by a diagnosis."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data.errors import InputError, WorkError
from models import FAMILIES
from models.promotion import left_out, score_um
from models.protocols import PromotionRule
from models.result import GridResult
from pipelines import tracking
from pipelines.diagnosing import Diagnose, DiagnosisOutcome, DiagnosisRequest, dated_folder, diagnose_file
from pipelines.settings import Settings


@dataclass(frozen=True)
class Growth:
    """A twin family's left-out S of a channel: its mean in the last training, and now, on `n_new` new batches.

    Where no batch is new (`n_new` 0) it is the mean over all of them.
    """

    target: str
    family: str
    before_um: float
    after_um: float
    n_new: int

    @property
    def share(self) -> float:
        """0.25 for a quarter more."""
        return self.after_um / self.before_um - 1 if self.before_um > 0 else math.nan

    @property
    def words(self) -> str:
        where = f"{self.n_new} new batch{'' if self.n_new == 1 else 'es'}" if self.n_new else "the same batches"
        return (
            f"{self.target}: left-out S of the family {self.family} is {self.after_um:.2f} µm on {where}, was "
            f"{self.before_um:.2f} µm ({100 * self.share:+.0f} %)"
        )


def greatest_growth(now: Mapping[str, GridResult], settings: Settings, ids: Mapping[str, str]) -> Growth | None:
    """The twin family and channel whose left-out error grew most since the last training; None without one before.

    A family that learns from the residual or the sensors hides what the physics lacks, so each counts for itself.

    Args:
        now: results by channel, just trained.
        ids: their trainings, which are tracked already and are not the last ones.

    Raises:
        WorkError: the store does not answer.
    """
    found: list[Growth] = []
    for result in now.values():
        families = [f for f in result.cells["family"].unique() if f in FAMILIES and FAMILIES[f].needs_twin]
        last = _last_result(result, settings, ids) if families else None
        if last is not None:
            found += [g for f in families if (g := growth(last, result, f, settings.promotion)) is not None]
    return max((g for g in found if math.isfinite(g.share)), key=lambda g: g.share, default=None)


def growth(before: GridResult, after: GridResult, family: str, rule: PromotionRule) -> Growth | None:
    """Of a family's best cells in two trainings; None where one of them has none with a finite score.

    New batches count by id and content, since the mean over all dilutes what a season has brought.
    """
    old, new = (_left_out_of(result, family, rule) for result in (before, after))
    if old is None or new is None:
        return None
    known = set(before.batches["digest"].astype(str))
    fresh = [s for digest, s in new if digest not in known]
    scores = fresh or [s for _, s in new]
    return Growth(after.target, family, float(np.mean([s for _, s in old])), float(np.mean(scores)), len(fresh))


def diagnose_if_grown(
    machine_file: Path,
    now: Mapping[str, GridResult],
    ids: Mapping[str, str],
    settings: Settings,
    say: Callable[[str], None] = lambda text: None,
    work: Diagnose | None = None,
) -> tuple[DiagnosisOutcome | None, str]:
    """Diagnose on all batches of the lake where the error has grown by more than the settings allow.

    Gives the outcome and what happened in words, empty where nothing was to be done. A diagnosis that fails takes
    nothing from the training that it follows: the words say why. It lies in `dated_folder`.
    """
    limit = settings.diagnose.when_error_grows_by
    if limit is None:
        return None, ""
    try:
        grown = greatest_growth(now, settings, ids)
        if grown is None or grown.share <= limit:
            return None, ""
        say(f"diagnose: {grown.words}")
        machine = next(iter(now.values())).machine
        request = DiagnosisRequest(machine_file, dated_folder(machine))
        outcome = diagnose_file(request, settings, say, work=work)
    except (InputError, WorkError) as error:
        return None, f"not diagnosed: {error}"
    except Exception as error:
        return None, f"not diagnosed: {type(error).__name__}: {error}"
    return outcome, f"{grown.words}; {outcome.words}"


def _last_result(result: GridResult, settings: Settings, ids: Mapping[str, str]) -> GridResult | None:
    past = tracking.trainings(result.machine, result.target, settings)
    past = past[~past["training_id"].isin(list(ids.values()))]
    if past.empty:
        return None
    try:
        return tracking.load_training(str(past.iloc[0]["training_id"]), settings).result
    except InputError:  # its tables are gone
        return None


def _left_out_of(result: GridResult, family: str, rule: PromotionRule) -> list[tuple[str, float]] | None:
    """Digest and left-out S of every batch, by the family's best cell."""
    cells = result.cells[(result.cells["protocol"] == rule.protocol) & (result.cells["family"] == family)]
    cells = cells.assign(score_um=score_um(cells, rule))
    cells = cells[np.isfinite(cells["score_um"])]
    if cells.empty:
        return None
    best = cells.nsmallest(1, "score_um").iloc[0]
    table = left_out(result, rule.protocol, str(best["selector"]), family, int(best["n_tsp"]))
    rows = [(str(d), float(s)) for d, s in zip(table["digest"], table["S_um"], strict=True) if np.isfinite(s)]
    return rows or None
