"""The grey + distributed-lag study: one pair of layers for the year, or a pair for every band of start temperatures."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from data.batch import Batch
from features.design import Design
from models.base import Family
from models.families.distributed_lag import DistributedLag
from models.families.gm1n import GM1N
from models.families.gm_dl import GMDL
from models.families.ridge import Ridge
from thermodrift_exam.plants.types.machines import VMC, VMC_SENSORS
from thermodrift_exam.plants.types.runs import SimulatedRun
from thermodrift_exam.studies.base import Figure, Ordering, Study, choices, predictions_um, residual_stds_um

SAMPLE_S, RUN_S, POINTS = 300.0, 6 * 3600.0, 4
SPEEDS_RPM = (2000.0, 4000.0, 6000.0)
BANDS_DEGC, EDGES_DEGC = (6.0, 14.0, 22.0, 30.0), (10.0, 18.0, 26.0)
JITTER_K = 1.0
TESTED_DEGC = {"inside": BANDS_DEGC, "between": EDGES_DEGC, "outside": (1.0, 35.0)}
WHERE = {"inside": "inside the bands", "between": "between the bands", "outside": "outside all bands"}
REPEATS = 2  # of the training runs: the year of the study, and a second one for more
N_YEAR = len(BANDS_DEGC) * len(SPEEDS_RPM)
ONE_BAND, FOUR_BANDS = GMDL(bands=1, least_batches=3), GMDL(bands=EDGES_DEGC, least_batches=3)
METHODS: dict[str, tuple[str, Family, int]] = {
    "gm1n": ("GM(1,N)", GM1N(), N_YEAR),
    "plain": ("GM(1,N) and distributed lag", ONE_BAND, N_YEAR),
    "piecewise": ("GM(1,N) and distributed lag, piecewise", FOUR_BANDS, N_YEAR),
    "plain_more": ("GM(1,N) and distributed lag, twice the runs", ONE_BAND, REPEATS * N_YEAR),
    "piecewise_more": ("GM(1,N) and distributed lag, piecewise, twice the runs", FOUR_BANDS, REPEATS * N_YEAR),
    "lag": ("distributed lag alone", DistributedLag(), N_YEAR),
    "ridge": ("ridge", Ridge(), N_YEAR),
}


def machine_years(seed: int) -> tuple[list[Batch], dict[str, list[int]]]:
    """Training runs of two years, then the tested ones, of one machine; which batches are tested where."""
    rng = np.random.default_rng([seed, 6])
    rig = VMC.drawn(rng, SAMPLE_S)
    starts = [(f"year {r + 1}", degC) for r in range(REPEATS) for degC in BANDS_DEGC]
    starts += [(where, degC) for where, levels in TESTED_DEGC.items() for degC in levels]
    plans = [(where, degC, rpm) for where, degC in starts for rpm in SPEEDS_RPM]
    runs = [
        SimulatedRun.drawn(
            f"{where} {k}", ((SAMPLE_S, 0.0), (RUN_S, rpm)), degC + float(rng.uniform(-JITTER_K, JITTER_K)), rng
        )
        for k, (where, degC, rpm) in enumerate(plans)
    ]
    tested = {where: [k for k, plan in enumerate(plans) if plan[0] == where] for where in TESTED_DEGC}
    return rig.record(runs, rng), tested


class GreyDistributedLag(Study):
    """Four bands of start temperatures, each with its own pair of layers, against one pair for all."""

    key = "grey_distributed_lag"
    title = "Grey model and distributed lag"
    summary = "a grey model behind a distributed lag, sub-models weighted by the start temperature"
    source = "grey + distributed-lag study, batches at several start temperatures"
    machine = (
        "the sample machine's type (14 bodies), every conductance, capacity and heat ±20 % by seed; 10 sensors to "
        "0.1 °C, Z to 1 µm every 5 min; runs of 6 h at 2000, 4000 and 6000 rpm, started at 6, 14, 22 and 30 °C (±1 K)"
    )
    assumed: ClassVar[tuple[str, ...]] = (
        "Machine and figures of the source are unknown; the tested claim is that piecewise "
        "weighting by start temperature adapts the model to season and time of day.",
        "Bands have their borders at 10, 18 and 26 °C. Tested are new runs at the bands' own temperatures, at their "
        "borders (between) and at 1 and 35 °C (outside), each at three speeds.",
        "Four points by FCGC from the training runs, the same for every method; both layers as the product's family "
        "gm_dl has them, the grey model alone as gm1n.",
        "A band learns from three runs; with twice the runs, from six.",
    )
    figures: ClassVar[tuple[Figure, ...]] = tuple(
        Figure(f"{method}_{where}", f"{label}, {name}: S_mean")
        for where, name in WHERE.items()
        for method, (label, _, _) in METHODS.items()
    )
    orderings: ClassVar[tuple[Ordering, ...]] = (
        *(
            Ordering(
                f"piecewise_{where}", f"piecewise weighting predicts better {name}",
                ((f"piecewise_{where}", f"plain_{where}"),),
                why=f"S_mean {name}: one pair of layers {{plain_{where}}} µm, four {{piecewise_{where}}}; with twice "
                f"the runs {{plain_more_{where}}} and {{piecewise_more_{where}}}; ridge {{ridge_{where}}} µm.",
            )
            for where, name in WHERE.items()
        ),
        *(
            Ordering(
                f"layers_{where}", f"grey model and distributed lag predict better than the grey model alone {name}",
                ((f"plain_{where}", f"gm1n_{where}"),),
                why=f"S_mean {name}: grey model {{gm1n_{where}}} µm, with the distributed lag {{plain_{where}}}, the "
                f"distributed lag alone {{lag_{where}}} µm.",
            )
            for where, name in WHERE.items()
        ),
        *(
            Ordering(
                f"piecewise_more_{where}", "piecewise weighting predicts better where every band has six runs",
                ((f"piecewise_more_{where}", f"plain_more_{where}"),), evidence_for=f"piecewise_{where}",
            )
            for where in WHERE
        ),
        *(
            Ordering(
                f"more_runs_{where}", "twice the runs help four pairs of layers",
                ((f"piecewise_more_{where}", f"piecewise_{where}"),), evidence_for=f"piecewise_{where}",
            )
            for where in WHERE
        ),
        *(
            Ordering(
                f"ridge_{where}", "ridge on the same points, without bands or lags, predicts better than piecewise",
                ((f"ridge_{where}", f"piecewise_{where}"),), evidence_for=f"piecewise_{where}",
            )
            for where in WHERE
        ),
        *(
            Ordering(
                f"lag_alone_{where}", "the distributed lag alone predicts better than both layers",
                ((f"lag_{where}", f"plain_{where}"),), evidence_for=f"layers_{where}",
            )
            for where in WHERE
        ),
    )  # fmt: skip

    def run(self, seed: int) -> dict[str, float]:
        batches, tested = machine_years(seed)
        design = Design.build(batches, VMC_SENSORS, "z")
        inputs = choices(design, "fcgc", [range(N_YEAR)], POINTS)
        out: dict[str, float] = {}
        for method, (_, family, n_runs) in METHODS.items():
            S_um = residual_stds_um(design, predictions_um(design, family, [range(n_runs)], inputs))[0]
            out |= {f"{method}_{where}": float(S_um[which].mean()) for where, which in tested.items()}
        return out
