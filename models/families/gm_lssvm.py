"""Family: grey models of several sequence lengths, corrected by an LS-SVM."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from data.arrays import Array
from data.errors import InputError, closest
from features.design import Design
from models.base import Family
from models.families.gm1n import GM1N
from models.families.grey_models import grey_layers, layer_design
from models.families.lssvm import LSSVM
from models.numerics.batches import steps_s

LENGTHS_IN = ("rows", "min")
_SECOND = ("support", "alpha", "bias", "gamma", "sigma", "scale", "inner_rms_um")


class GMLSSVM(Family):
    """Two layers: GM(1,N) of several sequence lengths, free-running, whose outputs are the inputs of an LS-SVM.

    A grey model of length L learns from the L most recent usable rows of every training batch. `lengths` count rows, as
    published (2-min samples), or minutes with `lengths_in` "min"; none is shorter than the model has unknowns. The
    LS-SVM (RBF and linear, at most `max_rows` rows, evenly) learns from out-of-sample outputs: those for a training
    batch come from grey models of the other training batches, with one or two batches those for a quarter from models
    that were not shown its errors (`models.families.grey_models`). γ and σ by exact leave-batch-out of this second
    layer on a grid (`tuning` "closed_form") or by "particle_swarm" as published.

    Source: study of a THM6380 machining centre (GM(1,6) of 25, 30, 35 and 40 rows, LS-SVM tuned by particle swarm);
    Deng 1989; Suykens et al. 2002. The study ran within one batch.
    """

    key = "gm_lssvm"
    summary = "grey models of several lengths, corrected by an LS-SVM"
    source = "Deng 1989; Suykens et al. 2002; study of a THM6380 machining centre"
    closed_form = False
    rank = 65

    def __init__(
        self,
        lengths: Sequence[float] = (25, 30, 35, 40),
        lengths_in: str = "rows",
        tuning: str = "closed_form",
        max_rows: int = 240,
        response: str = "difference",
        seed: int = 0,
    ) -> None:
        super().__init__()
        if lengths_in not in LENGTHS_IN:
            raise InputError(f"gm_lssvm: unknown lengths_in {lengths_in!r}: {closest(lengths_in, LENGTHS_IN)}")
        if not lengths or min(lengths) <= 0:
            raise InputError(f"gm_lssvm: lengths {list(lengths)}; expected at least one, above 0 {lengths_in}")
        self.lengths, self.lengths_in = list(lengths), lengths_in
        self.tuning, self.max_rows, self.response, self.seed = tuning, int(max_rows), response, int(seed)
        self._corrector(self.max_rows)  # raises for an unknown tuning

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """Grey models of all folds and pairs of batches left out from the same factors; an LS-SVM per fold.

        Raises:
            InputError: too few usable rows, or training batches of different steps.
        """
        rows = self._rows(design)
        grey = [GM1N(self.response, recent_rows=n) for n in rows]
        out = []
        for fold, layer in zip(folds, grey_layers(design, folds, grey), strict=True):
            # An LS-SVM shares its rows among all batches of a design; here only those of the fold have any.
            share = self.max_rows * design.n_batches // max(1, len(fold))
            second = self._corrector(share).fit_design(layer_design(design, layer.outputs_um), fold)
            first = [m.fitted for m in layer.models]
            fitted = {
                "a": np.array([f["a"] for f in first]),
                "b": np.stack([f["b"] for f in first]),
                "bound": [f["bound"] for f in first],
                "rows": rows,
                "step_s": first[0]["step_s"],
                **{name: second.fitted[name] for name in _SECOND},
            }
            out.append(self._learned(design, fitted))
        return out

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Error_um (n_k,) per batch, from a zero error at its start.

        Raises:
            InputError: a batch of another step than the model learned from.
        """
        f = self.fitted
        outputs_um = np.full((len(design.time_s), len(f["a"])), np.nan)
        for g, (a, b) in enumerate(zip(f["a"], f["b"], strict=True)):
            model = GM1N(self.response)._learned(design, {"a": float(a), "b": b, "step_s": f["step_s"]})
            for k, predicted in zip(batches, model.predict_design(design, batches), strict=True):
                outputs_um[design.rows(k), g] = predicted
        second = layer_design(design, outputs_um)
        corrector = self._corrector(self.max_rows)._learned(second, {name: f[name] for name in _SECOND})
        return corrector.predict_design(second, batches)

    def n_parameters(self) -> int:
        """Those of the grey models, and a weight per support row, bias, γ and σ."""
        return int(self.fitted["a"].size + self.fitted["b"].size + self.fitted["alpha"].size) + 3

    def _corrector(self, max_rows: int) -> LSSVM:
        corrector = LSSVM(max_rows=max_rows, tuning=self.tuning, seed=self.seed)
        return corrector if self.zero_start else corrector.as_published()

    def _rows(self, design: Design) -> list[int]:
        least = len(design.inputs) + 2
        step_min = 1.0 if self.lengths_in == "rows" else float(np.nanmax(steps_s(design))) / 60.0
        return [max(least, round(length / step_min)) for length in self.lengths]
