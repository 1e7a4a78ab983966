"""A proof that nobody ran: outcomes drawn by lot from a seed, only to have a page to look at."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from thermodrift_exam.proof.report.tables import ProofRun
from thermodrift_exam.proof.scoring.tables import CLAIMS, missed

EFFECTS = (
    "floor_sink", "cabinet_heat", "guide_friction", "sun", "radiation", "rotating_convection", "natural_convection",
    "draught", "stratification", "viscosity_feedback", "preload_feedback", "speed_shift", "sensor_drift", "sensor_lag",
    "sensor_swap", "time_skew", "motor_loss", "column_bending", "spindle_growth", "mandrel_fixture",
    "unlisted_warm_speed",
)  # fmt: skip
PLACES = ("node bed", "node column_front", "node column_back", "node head", "node motor", "node table",
          "link bed-floor", "sensor t_bed", "sensor t_head", "sensor t_column", "error x_um", "error y_um",
          "error z_um")  # fmt: skip
KINDS = {"nothing": 0.15, "decoy": 0.15, "one": 0.35, "two": 0.12, "three": 0.05, "confounded": 0.07, "unlisted": 0.07,
         "invisible": 0.04}  # fmt: skip
ROOT = "5f0c" * 16


PLANTS = ("elements", "volumes")


def toy_proof(
    cases: int = 300, seed: int = 1, plants: Sequence[str] = PLANTS, worst_cases: int = 10, **changed: Any
) -> ProofRun:
    """Plausible tables of every kind, all of them made up."""
    draws = np.random.default_rng(seed)
    outcomes, terms = _answers(cases, draws, plants)
    worst = outcomes[outcomes["visible"].eq(True)].sort_values("error_after", ascending=False)[:worst_cases]
    why = [f"{e} was taken for heat of the cabinet; both work all day." for e in worst["effect"]]
    worst = worst[["case", "plant", "kind", "effect"]].assign(why=why)
    tables = {
        "ledger": _ledger(),
        "outcomes": outcomes,
        "terms": terms,
        "goals": _goals(draws, plants),
        "compared": _compared(draws),
        "reliability": _reliability(draws),
        "confusion_mechanism": _counted(terms, "mechanism"),
        "confusion_place": _counted(terms, "place"),
        "missed": missed(terms),
        "claims": _claims(terms),
        "leak": pd.DataFrame({"question": ["nothing or something", "kind"], "auc": [0.51, 0.49], "low90": [0.46, 0.45],
                              "high90": [0.56, 0.53], "chance": [0.5, 0.5], "p": [0.38, 0.61], "n": [300, 300]}),
        "convergence": _convergence(),
        "worst": worst,
        "series": _series(list(worst["case"]), draws),
        "windows": pd.DataFrame({"case": [worst["case"].iloc[0]] * 2, "batch": ["run_03"] * 2,
                                 "start_s": [1800.0, 12600.0], "end_s": [9000.0, 18000.0]}),
    }  # fmt: skip
    given: dict[str, Any] = {
        "root": ROOT, "suite": "sealed", "cases": cases + 1, "sealed": "2026-01-05T06:00:00Z",
        "opened": "2026-01-05T19:30:10Z", "version": "0.1.0", "source_digest": "ab12" * 16,
        "isolation": {"landlock and audit hook": cases}, "void": {"case_9999": "answered twice"},
        "failed": {"case_0007": "diagnosis: 300 s were not enough"}, "tables": tables,
    }  # fmt: skip
    return ProofRun(**(given | changed))


def without(run: ProofRun, *names: str) -> dict[str, pd.DataFrame]:
    """The tables of a run but those named."""
    return {k: v for k, v in run.tables.items() if k not in names}


def _answers(cases: int, draws: np.random.Generator, plants: Sequence[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    rows, terms = [], []
    kinds = draws.choice(list(KINDS), size=cases, p=list(KINDS.values()))
    for k, kind in enumerate(kinds):
        case, plant = f"case_{k + 1:04d}", str(draws.choice(plants))
        n = {"nothing": 0, "two": 2, "three": 3}.get(kind, 1)
        found_all = True
        effects = [str(e) for e in draws.choice(EFFECTS, size=n, replace=False)]
        shares = []
        for effect in effects:
            share = float(np.exp(draws.uniform(np.log(0.3), np.log(10.0))))
            visible, place = share > 0.9, str(draws.choice(PLACES))
            found = bool(visible and draws.uniform() < 0.93)
            named = effect.split("_warm")[0] if draws.uniform() < 0.92 else str(draws.choice(EFFECTS))
            there = place if draws.uniform() < 0.9 else str(draws.choice(PLACES))
            size = share * 12.0
            told = size * float(np.exp(0.12 * draws.standard_normal()))
            found_all &= found and named == effect
            shares.append(share)
            terms.append({
                "case": case, "kind": kind, "plant": plant, "effect": effect,
                "mechanism": effect.split("_warm")[0], "place": place, "visible": visible,
                "limit_share": share, "decoy": kind == "decoy", "named_mechanism": named if found else "nothing",
                "named_place": there if found else "nothing", "found": found, "amplitude_true": size,
                "amplitude_found": told if found else np.nan, "low90": 0.8 * told if found else np.nan,
                "high90": 1.22 * told if found else np.nan, "gain_nats": 130.0 * share, "bar_nats": 140.0,
                "told_gain_nats": np.nan if not found else 130.0 * share,
            })  # fmt: skip
        floor = 1.0
        before = floor * (1 + float(np.exp(draws.normal(0.8, 0.9))) * (max(shares) / 3 if shares else 0.02))
        true = floor * float(np.exp(abs(draws.normal(0, 0.05))))
        left = float(draws.uniform(0, 0.08) if found_all else draws.uniform(0.2, 1.0))
        after = true + (before - true) * left
        rows.append({
            "case": case, "kind": kind, "plant": plant, "suite": "sealed", "simulated": plant != "withheld",
            "effect": "+".join(effects), "verdict": "explained" if n else "consistent", "failed": k == 6,
            "seconds": float(draws.uniform(12, 34)),
            "probability": float(draws.beta(8, 1)) if n else np.nan, "visible": bool(shares) and max(shares) > 0.9,
            "error_before": before, "error_after": after, "error_true": true if n else np.nan, "error_floor": floor,
            "limit_share": max(shares) if shares else np.nan, "right": found_all,
        })  # fmt: skip
    return pd.DataFrame(rows), pd.DataFrame(terms)


def _claims(terms: pd.DataFrame) -> pd.DataFrame:
    """One a term that was found; true where it has the term's own name."""
    own = terms[terms["found"]]
    named = {"mechanism": own["named_mechanism"], "place": own["named_place"], "probability": 0.8}
    table = own[["case", "plant", "kind", "gain_nats"]].assign(**named)
    table["true"] = own["named_mechanism"] == own["mechanism"]
    return table[list(CLAIMS)].reset_index(drop=True)


def _goals(draws: np.random.Generator, plants: Sequence[str]) -> pd.DataFrame:
    wanted = (
        ("false alarms, nothing missing", "≤ 1 %", 0.01, "lower", 0.006),
        ("detection, visible", "≥ 97 %", 0.97, "higher", 0.955),
        ("place exact", "≥ 92 %", 0.92, "higher", 0.94), ("mechanism first", "≥ 95 %", 0.95, "higher", 0.93),
        ("mechanism within the reported set", "≥ 98 %", 0.98, "higher", 0.985),
        ("mean size of the reported set", "≤ 2", 2.0, "lower", 1.4),
        ("when: overlap", "≥ 0.8", 0.8, "higher", 0.86), ("amplitude error, median", "≤ 12 %", 0.12, "lower", 0.10),
        ("90 % intervals cover", "85–95 %", 0.9, "higher", 0.91),
        ("three effects: all named", "≥ 65 %", 0.65, "higher", np.nan),
        ("expected calibration error", "≤ 0.05", 0.05, "lower", 0.04),
        ("time, one case", "≤ 30 s", 30.0, "lower", 22.0),
        ("better than the best baseline", "≥ 15 points", 0.15, "higher", 0.31),
    )  # fmt: skip
    rows = []
    for measure, goal, want, better, value in wanted:
        for plant in ("all", *plants):
            spread = 0.02 * want * (1 if plant == "all" else 2)
            v = value if plant == "all" else value + spread * draws.standard_normal()
            met = pd.NA if np.isnan(v) else bool(v >= want) if better == "higher" else bool(v <= want)
            n = 0 if np.isnan(v) else 120 if plant == "all" else 60
            rows.append({"measure": measure, "goal": goal, "wanted": want, "better": better, "value": v, "met": met,
                         "low90": v - spread, "high90": v + spread, "n": n, "plant": plant,
                         "informed": np.nan if "time" in measure else v + 2 * spread, "informed_n": n})  # fmt: skip
    return pd.DataFrame(rows)


def _compared(draws: np.random.Generator) -> pd.DataFrame:
    methods = {
        "diagnosis": ("diagnosis",), "baseline": ("raw_correlation", "sparse_regression", "in_sample_bic"),
        "ablation": ("reference", "independent_noise", "in_sample", "no_structural_null",
                     "no_floor_check"),
    }  # fmt: skip
    measures = {
        "right answers": 0.9,
        "mechanism first, one visible effect": 0.93,
        "false alarms, nothing missing": 0.01,
    }
    rows = []
    for group, names in methods.items():
        for name in names:
            for measure, base in measures.items():
                off = 0.0 if name in ("diagnosis", "reference") else float(draws.uniform(0.1, 0.5))
                v = base + off if measure.startswith("false") else base - off
                lead = base - v if measure == "right answers" and off else np.nan
                rows.append({"method": name, "group": group, "measure": measure, "value": v, "low90": max(v - 0.04, 0),
                             "high90": min(v + 0.04, 1), "n": 300, "lead": lead, "lead_low90": lead - 0.05,
                             "lead_high90": lead + 0.05})  # fmt: skip
    return pd.DataFrame(rows)


def _reliability(draws: np.random.Generator) -> pd.DataFrame:
    low = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95])
    high = np.append(low[1:], 1.0)
    claimed = (low + high) / 2
    right = np.clip(claimed + 0.05 * draws.standard_normal(7), 0, 1)
    return pd.DataFrame({"low": low, "high": high, "claimed": claimed, "right": right,
                         "low90": np.clip(right - 0.1, 0, 1), "high90": np.clip(right + 0.1, 0, 1),
                         "n": [3, 5, 12, 20, 40, 60, 120]})  # fmt: skip


def _counted(terms: pd.DataFrame, what: str) -> pd.DataFrame:
    pairs = pd.DataFrame({"true": terms[what], "named": terms[f"named_{what}"]})
    return pairs.value_counts().rename("count").reset_index()


def _ledger() -> pd.DataFrame:
    steps = (("2026-01-05T06:00:00Z", "sealed", "301 cases, root committed"),
             ("2026-01-05T06:12:00Z", "run begun", "2 workers"),
             ("2026-01-05T09:01:00Z", "interrupted", "114 answers kept"),
             ("2026-01-05T10:00:00Z", "run taken up", "2 workers"),
             ("2026-01-05T19:10:00Z", "run ended", "300 answers"),
             ("2026-01-05T19:30:10Z", "opened", "every commitment agrees"))  # fmt: skip
    return pd.DataFrame(steps, columns=["time", "step", "words"])


def _convergence() -> pd.DataFrame:
    rows = []
    for plant in ("elements", "volumes"):
        for refined, unit, sizes in (("grid", "mm", (80.0, 40.0, 20.0)), ("step", "s", (120.0, 60.0, 30.0))):
            for k, size in enumerate(sizes):
                rows.append({"plant": plant, "quantity": "temperature at the nose, K", "refined": refined, "size": size,
                             "unit": unit, "error": 0.04 / 4**k, "order": np.nan if k == 0 else 1.97})  # fmt: skip
    return pd.DataFrame(rows)


def _series(cases: Sequence[str], draws: np.random.Generator) -> pd.DataFrame:
    time_s = np.arange(0.0, 21600.0, 300.0)
    parts = []
    for case in cases:
        for batch in ("run_03", "run_07"):
            course = 20 * (1 - np.exp(-time_s / 5000))
            noise = 0.7 * draws.standard_normal(len(time_s))
            values = {"recorded": course + noise, "before": 0.7 * course, "after": 0.9 * course}
            names = {"case": case, "batch": batch, "channel": "z_um", "unit": "um"}
            parts.append(pd.DataFrame({"time_s": time_s, **values}).assign(**names))
    return pd.concat(parts, ignore_index=True)
