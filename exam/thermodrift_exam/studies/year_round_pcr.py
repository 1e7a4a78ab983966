"""The year-round study: PCA elimination and principal component regression, each model learned from one batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from features.design import Design
from models.base import Family
from models.families.bp import BP
from models.families.mlr import MLR
from models.families.pcr import PCR
from models.families.ridge import Ridge
from thermodrift_exam.plants.types.machines import VMC, VMC_SENSORS
from thermodrift_exam.plants.types.runs import Scatter, SimulatedRun
from thermodrift_exam.studies.base import (
    Figure,
    Inputs,
    Ordering,
    Study,
    accuracy_and_robustness_um,
    choices,
    predictions_um,
    residual_stds_um,
)

ON_THE_SPINDLE = {"front", "rear", "motor", "head_front", "head_rear"}
SPEEDS_RPM = (2000.0, 4000.0, 6000.0)
SPECTRUM_RPM, STAGE_S = (1500.0, 3000.0, 4500.0, 6000.0), 900.0
COLDEST_DEGC, WARMEST_DEGC = 2.94, 32.37
VERIFIED_DEGC = (25.6, 26.8)
SAMPLE_S, RUN_S, SWITCHED_ON_S = 300.0, 6 * 3600.0, 2 * 3600.0
N_MODELS, N_VERIFIED = 9, 3
SETTLED = Scatter(drift_K=(0.0, 0.0), start_K=(0.0, 0.0))
TRAINS = [(k,) for k in range(N_MODELS)]


@dataclass(frozen=True)
class Method:
    """A selector, a number of points and a family."""

    label: str
    selector: str
    n_tsp: int
    family: Family


# A net as published: 2-3-1, one start, trained until it stops, nothing that holds it back.
NET = BP(hidden=3, starts=1, decay=0.0, iterations=200, max_rows=100)
METHODS = {
    "fcgc2_mlr": Method("2 points by FCGC, least squares", "fcgc", 2, MLR()),
    "fcgc2_ridge": Method("the same points, ridge", "fcgc", 2, Ridge()),
    "fcgc2_bp": Method("the same points, BP net 2–3–1", "fcgc", 2, NET),
    "fcgc2_calm_bp": Method("the same points, BP net with weight decay, mean of three", "fcgc", 2, BP()),
    "fcgc2_pcr": Method("the same points, PCR", "fcgc", 2, PCR()),
    "pca4_mlr": Method("4 points by PCA elimination, least squares", "pca_elimination", 4, MLR()),
    "pca4_ridge": Method("4 points by PCA elimination, ridge", "pca_elimination", 4, Ridge()),
    **{
        f"pca{n}_pcr": Method(f"{n} point{'s' if n > 1 else ''} by PCA elimination, PCR", "pca_elimination", n, PCR())
        for n in range(1, len(VMC_SENSORS) + 1)
    },
}
PUBLISHED = {
    "pca4_pcr_S_mean": 6.8, "pca4_pcr_S_std": 2.4, "verified_S_mean": 6.12, "verified_S_std": 3.43,
    "first_component": 99.88, "compensated_least": -1.0, "compensated_most": 5.0, "compensated_range": 6.0,
}  # fmt: skip


def machine_year(seed: int, scatter: Scatter | None = None) -> list[Batch]:
    """K1..K9 in an order of their own, V1..V3 and the run that is compensated, of one machine."""
    rng = np.random.default_rng([seed, 1])
    rig = VMC.drawn(rng, SAMPLE_S)
    rest = (SAMPLE_S, 0.0)
    starts_degC = np.linspace(COLDEST_DEGC, WARMEST_DEGC, N_MODELS)
    constant = [(rest, (RUN_S, SPEEDS_RPM[k % 3])) for k in range(N_MODELS)]
    order = rng.permutation(N_MODELS)
    plans = [(f"K{i + 1}", constant[k], float(starts_degC[k])) for i, k in enumerate(order)]
    spectrum = (rest, *((STAGE_S, rpm) for rpm in SPECTRUM_RPM * int(RUN_S / STAGE_S / len(SPECTRUM_RPM))))
    plans += [(f"V{i + 1}", spectrum, float(rng.uniform(*VERIFIED_DEGC))) for i in range(N_VERIFIED)]
    plans += [("C", (rest, (RUN_S, SPEEDS_RPM[-1])), float(rng.uniform(*VERIFIED_DEGC)))]
    runs = [SimulatedRun.drawn(name, stages, degC, rng, scatter) for name, stages, degC in plans]
    return rig.record(runs, rng)


class YearRoundPCR(Study):
    """Nine models, each learned from one of nine batches of a year, predict the other eight.

    Source: the year-round study of a Vcenter-55 machining centre (10 sensors, K1..K9 over a year, Z).
    """

    key = "year_round_pcr"
    title = "Year-round PCR"
    summary = "PCA elimination and principal component regression over a year, trained on one batch"
    source = "year-round PCR study of a Vcenter-55 vertical machining centre"
    machine = (
        "the sample machine's type (14 bodies), every conductance, capacity and heat ±20 % by seed; 10 sensors to "
        "0.1 °C, Z to 1 µm every 5 min; K1..K9 at 2000, 4000 and 6000 rpm for 6 h from 2.94 to 32.37 °C"
    )
    assumed: ClassVar[tuple[str, ...]] = (
        "Which of K1..K9 had which speed and start ambient is not known: every seed draws the order.",
        "V1..V3 repeat the spectrum 1500, 3000, 4500, 6000 rpm (15 min each) for 6 h.",
        "Ridge and the BP net are given the two points of FCGC; ridge is also tried on the four of PCA elimination.",
        "The compensated run starts at the ambient of V1..V3; the whole prediction is taken off from 2 h on.",
        "The heat of the feed at 1500 mm/min is left out: the simulated axes stand.",
    )
    remarks: ClassVar[tuple[str, ...]] = (
        "Our errors exceed the published ones, {pca4_pcr_S_mean} µm where Z moves by {z_range} µm. They learn from "
        "one speed and predict three: on batches of their own speed they have {same_speed_S_mean} µm, without room "
        "drift and with settled starts {settled_same_speed_S_mean} µm. How far Z moved in the source is not known.",
    )
    figures: ClassVar[tuple[Figure, ...]] = (
        *(
            Figure(f"{key}_{kind}", f"{m.label}: {label}", published=PUBLISHED.get(f"{key}_{kind}"))
            for key, m in METHODS.items()
            for kind, label in (("S_mean", "accuracy S_mean"), ("S_std", "robustness S_std"), ("fit", "S of the fit"))
        ),
        Figure("verified_S_mean", "K models (PCR, 4 points) on V1..V3: S_mean", published=6.12),
        Figure("verified_S_std", "K models (PCR, 4 points) on V1..V3: S_std", published=3.43),
        Figure("compensated_least", "K1 model at 6000 rpm, on from 2 h: least residual", published=-1.0, digits=1),
        Figure("compensated_most", "K1 model at 6000 rpm, on from 2 h: greatest residual", published=5.0, digits=1),
        Figure("compensated_range", "K1 model at 6000 rpm, on from 2 h: range", published=6.0, digits=1),
        Figure("uncompensated_range", "the same run without compensation: range", digits=1),
        Figure("first_component", "K1, 2 points: share of the first component", "%", 99.88),
        Figure("pca2_spindle", "models with one of 2 PCA points at spindle or head", "%", digits=0),
        Figure("fcgc2_spindle", "models with one of 2 FCGC points at spindle or head", "%", digits=0),
        Figure("z_range", "range of Z in K1..K9, mean", digits=1),
        Figure("same_speed_S_mean", "4 points, PCR, on batches of the learned speed: S_mean"),
        Figure("settled_same_speed_S_mean", "the same without drift, from settled starts: S_mean"),
        Figure("settled_pca4_pcr_S_mean", "no drift, settled starts: 4 points, PCR: S_mean"),
        Figure("settled_fcgc2_mlr_S_mean", "no drift, settled starts: FCGC, least squares: S_mean"),
        Figure("settled_pca4_pcr_S_std", "no drift, settled starts: 4 points, PCR: S_std"),
        Figure("settled_fcgc2_mlr_S_std", "no drift, settled starts: FCGC, least squares: S_std"),
    )
    orderings: ClassVar[tuple[Ordering, ...]] = (
        Ordering(
            "pcr_more_accurate", "PCR on 4 points predicts better than FCGC with least squares",
            (("pca4_pcr_S_mean", "fcgc2_mlr_S_mean"),), 0.234,
            why="PCR gains where the room drifts and machines start unsettled: {pca4_pcr_S_mean} against "
            "{fcgc2_mlr_S_mean} µm; in the same years without that, {settled_pca4_pcr_S_mean} against "
            "{settled_fcgc2_mlr_S_mean} µm. Its 95 % rule costs it: the same four points with all components reach "
            "{pca4_mlr_S_mean} µm.",
        ),
        Ordering(
            "pcr_more_robust", "PCR on 4 points is more robust than FCGC with least squares",
            (("pca4_pcr_S_std", "fcgc2_mlr_S_std"),), 0.577,
            why="Estimator and points both count: PCR has {fcgc2_pcr_S_std} µm on FCGC's own two points, least squares "
            "{pca4_mlr_S_std} µm on the four, {fcgc2_mlr_S_std} µm on the two.",
        ),
        Ordering(
            "ridge_between", "ridge lies between them in accuracy",
            (("pca4_pcr_S_mean", "fcgc2_ridge_S_mean"), ("fcgc2_ridge_S_mean", "fcgc2_mlr_S_mean")),
            why="Ridge follows the points it is given: {fcgc2_ridge_S_mean} µm on FCGC's two, {pca4_ridge_S_mean} µm "
            "on PCR's four, where PCR has {pca4_pcr_S_mean} µm: it shrinks the small components that PCR discards.",
        ),
        Ordering(
            "bp_fits_best", "the BP net fits best",
            tuple(("fcgc2_bp_fit", f"{m}_fit") for m in ("fcgc2_mlr", "fcgc2_ridge", "pca4_pcr")),
        ),
        Ordering(
            "bp_predicts_worst", "the BP net predicts worst",
            tuple((f"{m}_S_mean", "fcgc2_bp_S_mean") for m in ("fcgc2_mlr", "fcgc2_ridge", "pca4_pcr")),
            why="The net has the greatest mean, {fcgc2_bp_S_mean} µm, and is the least robust, {fcgc2_bp_S_std} µm, "
            "but not in every year. With weight decay, the mean of three starts has {fcgc2_calm_bp_S_mean} µm.",
        ),
        Ordering(
            "more_points_less_accurate", "with more than 2 points accuracy falls",
            (("pca2_pcr_S_mean", "pca10_pcr_S_mean"),),
            why="PCA elimination does not use the error. Only {pca2_spindle} % of its models keep a point at spindle "
            "or head among two, {fcgc2_spindle} % of FCGC's do. From 4 to 10 "
            "points accuracy goes from {pca4_pcr_S_mean} to {pca10_pcr_S_mean} µm.",
        ),
        Ordering(
            "more_points_more_robust", "with more than 2 points robustness rises",
            (("pca10_pcr_S_std", "pca2_pcr_S_std"),),
        ),
        Ordering(
            "discarded_components_matter",
            "the four points with all components predict better: what the 95 % rule drops holds information",
            (("pca4_mlr_S_mean", "pca4_pcr_S_mean"),), evidence_for="pcr_more_accurate",
        ),
        Ordering(
            "same_points_pcr", "on FCGC's own two points PCR predicts better than least squares",
            (("fcgc2_pcr_S_mean", "fcgc2_mlr_S_mean"),), evidence_for="pcr_more_accurate",
        ),
        Ordering(
            "settled_pcr", "PCR still predicts better where the room does not drift and machines start settled",
            (("settled_pca4_pcr_S_mean", "settled_fcgc2_mlr_S_mean"),), evidence_for="pcr_more_accurate",
        ),
        Ordering(
            "same_points_robust", "on FCGC's own two points PCR is more robust than least squares",
            (("fcgc2_pcr_S_std", "fcgc2_mlr_S_std"),), evidence_for="pcr_more_robust",
        ),
        Ordering(
            "ridge_four_points", "ridge on PCR's four points predicts better than PCR on them",
            (("pca4_ridge_S_mean", "pca4_pcr_S_mean"),), evidence_for="ridge_between",
        ),
        Ordering(
            "bp_worse_than_least_squares", "on the same two points the net predicts worse than least squares",
            (("fcgc2_mlr_S_mean", "fcgc2_bp_S_mean"),), evidence_for="bp_predicts_worst",
        ),
        Ordering(
            "held_back_better", "with weight decay, the mean of three starts predicts better than the net",
            (("fcgc2_calm_bp_S_mean", "fcgc2_bp_S_mean"),), evidence_for="bp_predicts_worst",
        ),
        Ordering(
            "beyond_four_less_accurate", "from 4 to 10 points accuracy falls",
            (("pca4_pcr_S_mean", "pca10_pcr_S_mean"),), evidence_for="more_points_less_accurate",
        ),
        Ordering(
            "two_points_miss_the_spindle", "PCA elimination, which does not use the error, keeps spindle and head less "
            "often than FCGC", (("pca2_spindle", "fcgc2_spindle"),), evidence_for="more_points_less_accurate",
        ),
    )  # fmt: skip

    def run(self, seed: int) -> dict[str, float]:
        design = Design.build(machine_year(seed), VMC_SENSORS, "z")
        out: dict[str, float] = {}
        for key, method in METHODS.items():
            points, predicted_um = _models(design, method)
            S_um = residual_stds_um(design, predicted_um)
            mean_um, std_um = accuracy_and_robustness_um(S_um, _others(design))
            out |= {f"{key}_S_mean": mean_um, f"{key}_S_std": std_um, f"{key}_fit": float(np.diag(S_um).mean())}
            if key == "pca4_pcr":
                out |= _verification(design, S_um) | _compensation(design, predicted_um[:, 0])
                out["same_speed_S_mean"] = _same_speed_um(design, S_um)
            if key in ("pca2_pcr", "fcgc2_mlr"):
                seen = np.mean([bool(ON_THE_SPINDLE & set(p)) for p in points])
                out[f"{key.split('_')[0]}_spindle"] = 100.0 * float(seen)
            if key == "pca2_pcr":
                out["first_component"] = _first_component_percent(design.subset(points[0]))
        out["z_range"] = float(np.mean([np.ptp(design.y_um[design.rows(k)]) for k in range(N_MODELS)]))
        settled = Design.build(machine_year(seed, SETTLED), VMC_SENSORS, "z")
        for key in ("pca4_pcr", "fcgc2_mlr"):
            _, predicted_um = _models(settled, METHODS[key])
            S_um = residual_stds_um(settled, predicted_um)
            mean_um, std_um = accuracy_and_robustness_um(S_um, _others(settled))
            out |= {f"settled_{key}_S_mean": mean_um, f"settled_{key}_S_std": std_um}
            if key == "pca4_pcr":
                out["settled_same_speed_S_mean"] = _same_speed_um(settled, S_um)
        return out


def _models(design: Design, method: Method) -> tuple[list[Inputs], Array]:
    """Every K model's points, and its predictions (n, 9) on all rows."""
    points = choices(design, method.selector, TRAINS, method.n_tsp)
    return points, predictions_um(design, method.family, TRAINS, points)


def _others(design: Design) -> NDArray[np.bool_]:
    """For each K model the other K batches, (9, batches)."""
    tested = np.zeros((N_MODELS, design.n_batches), bool)
    tested[:, :N_MODELS] = ~np.eye(N_MODELS, dtype=bool)
    return tested


def _same_speed_um(design: Design, S_um: Array) -> float:
    """Mean S over pairs of different K batches at one speed."""
    rpm = np.array([b.values("spindle_rpm").max() for b in design.batches])
    return float(S_um[_others(design) & (rpm[:N_MODELS, None] == rpm)].mean())


def _verification(design: Design, S_um: Array) -> dict[str, float]:
    tested = np.zeros(S_um.shape, bool)
    tested[:, N_MODELS : N_MODELS + N_VERIFIED] = True
    mean_um, std_um = accuracy_and_robustness_um(S_um, tested)
    return {"verified_S_mean": mean_um, "verified_S_std": std_um}


def _compensation(design: Design, predicted_um: Array) -> dict[str, float]:
    """The last batch under the K1 model, switched on after 2 h."""
    rows = design.rows(design.n_batches - 1)
    on = design.time_s[rows] > SWITCHED_ON_S + SAMPLE_S
    recorded_um = design.y_um[rows][on]
    left_um = recorded_um - predicted_um[rows][on]
    return {
        "compensated_least": float(left_um.min()),
        "compensated_most": float(left_um.max()),
        "compensated_range": float(np.ptp(left_um)),
        "uncompensated_range": float(np.ptp(design.y_um[rows])),
    }


def _first_component_percent(design: Design) -> float:
    """Share of the first covariance component of the first batch's rises."""
    variances = np.linalg.eigvalsh(np.cov(design.x[design.rows(0)].T))
    return float(100.0 * variances[-1] / variances.sum())
