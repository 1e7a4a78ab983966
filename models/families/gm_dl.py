"""Family: grey model followed by a distributed lag, piecewise by start temperature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from data.arrays import Array
from data.errors import InputError, closest
from features.design import Design
from models.base import Family, Plain
from models.families.distributed_lag import DistributedLag
from models.families.gm1n import GM1N
from models.families.grey_models import grey_layers, layer_design
from models.protocols import start_ambient_degC

BANDED = ("lag", "both")
_NEAREST_K = 0.5  # bands whose mean start temperatures are closer than this are one


class GMDL(Family):
    """Two layers in bands: a free-running GM(1,N), whose output, now and before, a distributed lag weighs.

    Every band of start temperature (ambient at the batch's start) has its own sub-model, placed at the mean
    start temperature of its training batches. A batch that starts at T0 between neighbours Ta < T0 < Tb gets the
    weights (Tb − T0)/(Tb − Ta) and (T0 − Ta)/(Tb − Ta); outside the range only the nearest counts. `bands` is their
    number, with equally many batches, or the temperatures between them, °C. A band of fewer than `least_batches`
    training batches joins a neighbour; `fitted` has the resulting bands. There is one band where start
    temperatures are not known.

    `banded`: "lag" bands the distributed lag behind one grey model of all batches; "both" bands both layers. The grey
    model learns from each batch's `recent_rows` most recent rows (None: all), the distributed lag from out-of-sample
    outputs: those for a training batch come from grey models of the other batches, with one or two batches those for a
    quarter from models that were not shown its errors (`models.families.grey_models`). `lags` and `lag_min` belong to
    the distributed lag.

    Source: study of a grey model and distributed lags, weighted by start temperature; Deng 1989; Almon 1965.
    """

    key = "gm_dl"
    summary = "grey model and distributed lag, piecewise by start temperature"
    source = "Deng 1989; Almon 1965"
    closed_form = False
    rank = 45

    def __init__(
        self,
        bands: int | Sequence[float] = 3,
        least_batches: int = 4,
        banded: str = "lag",
        lags: str = "free",
        lag_min: float = 10.0,
        recent_rows: int | None = 40,
        response: str = "difference",
    ) -> None:
        super().__init__()
        if banded not in BANDED:
            raise InputError(f"gm_dl: unknown banded {banded!r}: {closest(banded, BANDED)}")
        if least_batches < 1 or (isinstance(bands, int) and bands < 1):
            raise InputError(
                f"gm_dl: bands {bands}, least_batches {least_batches}; expected at least 1 of each, or bands as the "
                "temperatures between them in °C"
            )
        self.bands = bands if isinstance(bands, int) else [float(edge) for edge in bands]
        self.least_batches, self.banded = int(least_batches), banded
        self.lags, self.lag_min, self.recent_rows, self.response = lags, float(lag_min), recent_rows, response
        self._layers()

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """Grey models of all folds and pairs of batches left out from the same factors; equal bands are fitted once.

        Raises:
            InputError: too few usable rows, or training batches of different steps.
        """
        grey, lag = self._layers()
        start_degC = start_temperatures_degC(design)
        parts = [bands_of(start_degC, fold, self.bands, self.least_batches) for fold in folds]
        # The training batches that each band's grey model learns from.
        taught = [[tuple(fold)] * len(bands) if self.banded == "lag" else bands
                  for fold, bands in zip(folds, parts, strict=True)]  # fmt: skip
        pairs = dict.fromkeys(pair for sets, bands in zip(taught, parts, strict=True)
                              for pair in zip(sets, bands, strict=True))  # fmt: skip
        sets = list(dict.fromkeys(batches for batches, _ in pairs))
        first: dict[tuple[int, ...], GM1N] = {}
        second: dict[tuple[tuple[int, ...], tuple[int, ...]], DistributedLag] = {}
        for batches, layer in zip(sets, grey_layers(design, sets, [grey]), strict=True):
            bands = [band for own, band in pairs if own == batches]
            fitted = lag.fit_folds(layer_design(design, layer.outputs_um), bands)
            first[batches] = layer.models[0]
            second |= {(batches, band): model for band, model in zip(bands, fitted, strict=True)}
        return [
            self._learned(design, _plain(start_degC, bands, [first[batches] for batches in own],
                                         [second[pair] for pair in zip(own, bands, strict=True)]))
            for own, bands in zip(taught, parts, strict=True)
        ]  # fmt: skip

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Error_um (n_k,) per batch, from a zero error at its start.

        Raises:
            InputError: a batch of another step than the model learned from.
        """
        f = self.fitted
        grey, lag = self._layers()
        start_degC = start_temperatures_degC(design)
        shares = np.array([band_weights(start_degC[k], f["band_degC"], f["band_batches"]) for k in batches])
        total = [np.zeros(int(design.offsets[k + 1] - design.offsets[k])) for k in batches]
        for i in range(len(f["a"])):
            model = grey._learned(design, {"a": float(f["a"][i]), "b": f["b"][i], "step_s": f["step_s"]})
            outputs_um = np.full((len(design.time_s), 1), np.nan)
            for k, predicted in zip(batches, model.predict_design(design, batches), strict=True):
                outputs_um[design.rows(k), 0] = predicted
            layer = layer_design(design, outputs_um)
            behind = [band for band, own in enumerate(f["grey_of_band"]) if own == i]
            outputs = lag.predict_folds(
                layer, [lag._learned(layer, _lag_of(f, b)) for b in behind], [batches] * len(behind)
            )
            for band, own in zip(behind, outputs, strict=True):
                total = [t + share * p for t, share, p in zip(total, shares[:, band], own, strict=True)]
        return total

    def n_parameters(self) -> int:
        """Those of the grey models, and of every band coefficients, order, and intercept where the level is free."""
        f, more = self.fitted, 1 + (not self.zero_start)
        return int(f["a"].size + f["b"].size + f["weights"].size + more * len(f["band_batches"]))

    def _layers(self) -> tuple[GM1N, DistributedLag]:
        grey, lag = GM1N(self.response, recent_rows=self.recent_rows), DistributedLag(self.lags, self.lag_min)
        return (grey, lag) if self.zero_start else (grey.as_published(), lag.as_published())


def _plain(
    start_degC: Array, bands: Sequence[tuple[int, ...]], grey: Sequence[GM1N], lags: Sequence[DistributedLag]
) -> Plain:
    """What is learned, as plain data: equal grey models once, the responses of all bands one after the other."""
    own = list({id(model): model for model in grey}.values())
    degC = np.array([start_degC[list(band)].mean() for band in bands])
    fitted = [model.fitted for model in lags]
    return {
        "band_degC": degC[np.isfinite(degC)],
        "band_batches": [len(band) for band in bands],
        "grey_of_band": [next(i for i, model in enumerate(own) if model is g) for g in grey],
        "a": np.array([model.fitted["a"] for model in own]),
        "b": np.stack([model.fitted["b"] for model in own]),
        "bound": [model.fitted["bound"] for model in own],
        "step_s": own[0].fitted["step_s"],
        "band_of_response": np.repeat(np.arange(len(bands)), [len(f["delays_s"]) for f in fitted]),
        "delays_s": np.concatenate([f["delays_s"] for f in fitted]),
        "taus_s": np.concatenate([f["taus_s"] for f in fitted]),
        "weights": np.concatenate([f["weights_um_per_K"][:, 0] for f in fitted]),
        "intercept_um": np.array([f["intercept_um"] for f in fitted]),
        "k": np.array([f["k"] for f in fitted]),
    }


def _lag_of(f: Plain, band: int) -> Plain:
    own = f["band_of_response"] == band
    return {
        "delays_s": f["delays_s"][own],
        "taus_s": f["taus_s"][own],
        "weights_um_per_K": f["weights"][own][:, None],
        "intercept_um": float(f["intercept_um"][band]),
    }


def start_temperatures_degC(design: Design) -> Array:
    """Ambient at the start of every batch (K,); NaN where it is not known, as in a design made by hand."""
    if not design.batches:
        return np.full(design.n_batches, np.nan)
    return np.array([start_ambient_degC(batch) for batch in design.batches])


def bands_of(
    start_degC: Array, train: Sequence[int], bands: int | Sequence[float], least_batches: int
) -> list[tuple[int, ...]]:
    """The training batches in bands from cold to warm, by `start_degC` (n_batches,), by number of bands (equally many
    batches) or edges in °C.

    Bands of too few batches join their colder or warmer neighbour, whichever is smaller. One band where a start
    temperature is not known.
    """
    batches = np.array(sorted(train, key=lambda k: start_degC[k]), int)
    own = start_degC[batches]
    if not np.isfinite(own).all():
        return [tuple(sorted(train))]
    if isinstance(bands, int):
        n = max(1, min(bands, len(batches) // least_batches))
        parts = [part.tolist() for part in np.array_split(batches, n)]
    else:
        place = np.searchsorted(np.sort(bands), own, side="right")
        parts = [batches[place == p].tolist() for p in np.unique(place)]
    while len(parts) > 1:
        mean = np.array([start_degC[part].mean() for part in parts])
        size = [len(part) for part in parts]
        close = np.flatnonzero(np.diff(mean) < _NEAREST_K)
        if len(close):
            first = int(close[0])
        elif min(size) < least_batches:
            small = int(np.argmin(size))
            warmer = small == 0 or (small < len(parts) - 1 and size[small + 1] < size[small - 1])
            first = small if warmer else small - 1
        else:
            break
        parts[first : first + 2] = [parts[first] + parts[first + 1]]
    return [tuple(sorted(part)) for part in parts]


def band_weights(start_degC: float, band_degC: Array, band_batches: Sequence[int]) -> Array:
    """Weights (B,) of bands at rising temperatures (B,): linear between neighbours, outside the nearest alone.

    A batch whose start temperature is not known gets them by their numbers of training batches.
    """
    if not np.isfinite(start_degC) or len(band_batches) == 1:
        return np.asarray(np.array(band_batches) / np.sum(band_batches), float)
    return np.array([np.interp(start_degC, band_degC, own) for own in np.eye(len(band_degC))])
