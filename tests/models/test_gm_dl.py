"""Bands by hand, the published weights, and a machine whose growth depends on the temperature it starts at."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from features.design import Design
from models.families.distributed_lag import DistributedLag
from models.families.gm1n import GM1N
from models.families.gm_dl import GMDL, band_weights, bands_of, start_temperatures_degC
from models.families.grey_models import grey_layers, layer_design

STARTS_DEGC = (4.0, 31.0, 12.0, 5.0, 19.0, 30.0, 20.0, 6.0, 18.0, 29.0, 21.0, 13.0)
INPUTS = ("head", "bed")


def make_batch(k: int, start_degC: float, slope_per_K: float = 0.0, n: int = 60) -> Batch:
    """The error follows the head; its gain changes by `slope_per_K` per K of start temperature from 1 at 18 °C."""
    rng = np.random.default_rng(k)
    hours, load = np.arange(n) / 12.0, rng.uniform(0.6, 1.2)
    head, bed = 15 * load * (1 - np.exp(-hours / 0.8)), 6 * load * (1 - np.exp(-hours / 3))
    gain = 1 + slope_per_K * (start_degC - 18)
    table = pd.DataFrame({
        "time_s": hours * 3600,
        "head": start_degC + head + rng.normal(0, 0.02, n),
        "bed": start_degC + bed + rng.normal(0, 0.02, n),
        "room": start_degC + 0.1 * hours,
        "z": 5 + gain * (2.0 * head + 1.5 * bed) + rng.normal(0, 0.1, n),
    })  # fmt: skip
    channels = {name: Channel(name, "temperature", "degC") for name in INPUTS}
    channels |= {"room": Channel("room", "ambient", "degC"), "z": Channel("z", "error", "um")}
    return Batch("vmc", f"K{k + 1}", table, channels)


def make_design(slope_per_K=0.0, starts=STARTS_DEGC) -> Design:
    return Design.build([make_batch(k, t, slope_per_K) for k, t in enumerate(starts)], INPUTS, "z")


def rms_um(model, design, k) -> float:
    return float(np.sqrt(np.mean((model.predict_design(design, [k])[0] - design.y_um[design.rows(k)]) ** 2)))


@pytest.mark.parametrize(("train", "bands", "least", "want"), [
    (range(12), 3, 4, [(0, 2, 3, 7), (4, 6, 8, 11), (1, 5, 9, 10)]),
    (range(7), 3, 2, [(0, 2, 3), (4, 6), (1, 5)]),
    # by edges in °C; bands that are too small join the smaller neighbour
    (range(12), [10.0, 25.0], 3, [(0, 3, 7), (2, 4, 6, 8, 10, 11), (1, 5, 9)]),
    (range(12), [25.0, 10.0, 15.0], 3, [(0, 2, 3, 7, 11), (4, 6, 8, 10), (1, 5, 9)]),
    (range(12), [-5.0, 40.0], 1, [tuple(range(12))]),
    # too few batches
    (range(7), 3, 4, [tuple(range(7))]),
    (range(8), 3, 4, [(0, 2, 3, 7), (1, 4, 5, 6)]),
])  # fmt: skip
def test_bands_from_cold_to_warm(train, bands, least, want):
    assert bands_of(np.array(STARTS_DEGC), train, bands, least) == want


def test_equal_or_unknown_start_temperatures_give_fewer_bands():
    assert bands_of(np.full(12, 20.0), range(12), 3, 4) == [tuple(range(12))]
    start = np.array(STARTS_DEGC)
    start[5] = np.nan
    assert bands_of(start, range(12), 3, 4) == [tuple(range(12))]
    assert len(bands_of(start, [0, 1, 2, 3, 4, 6, 7, 8], 2, 4)) == 2


def test_weights_are_the_published_ones():
    at, many = np.array([5.0, 15.0, 30.0]), [4, 4, 2]
    for start in (7.0, 15.0, 21.0):
        i = 0 if start < 15 else 1
        a, b = at[i], at[i + 1]
        want = np.zeros(3)
        want[i], want[i + 1] = (b - start) / (b - a), (start - a) / (b - a)
        np.testing.assert_allclose(band_weights(start, at, many), want)
    np.testing.assert_array_equal(band_weights(-3.0, at, many), [1, 0, 0])
    np.testing.assert_array_equal(band_weights(41.0, at, many), [0, 0, 1])
    np.testing.assert_allclose(band_weights(np.nan, at, many), [0.4, 0.4, 0.2])


@pytest.mark.parametrize("banded", ["lag", "both"])
def test_a_prediction_is_the_weighted_sum_of_its_neighbours(banded):
    design = make_design(0.02)
    train = list(range(11))
    model = GMDL(banded=banded, least_batches=3).fit_design(design, train)
    start = start_temperatures_degC(design)
    bands = bands_of(start, train, 3, 3)
    centres = np.array([start[list(band)].mean() for band in bands])
    np.testing.assert_allclose(model.fitted["band_degC"], centres)
    told = []
    for band in bands:
        taught = train if banded == "lag" else band
        layer = grey_layers(design, [taught], [GM1N(recent_rows=40)])[0]
        second = DistributedLag("free", 10).fit_design(layer_design(design, layer.outputs_um), band)
        outputs = np.full((len(design.time_s), 1), np.nan)
        outputs[design.rows(11), 0] = layer.models[0].predict_design(design, [11])[0]
        told.append(second.predict_design(layer_design(design, outputs), [11])[0])
    want = band_weights(start[11], centres, [len(b) for b in bands]) @ np.array(told)
    np.testing.assert_allclose(model.predict_design(design, [11])[0], want, atol=1e-8)


def test_bands_follow_a_gain_that_depends_on_the_start_temperature():
    design = make_design(0.03)
    rms = {bands: [] for bands in (1, 3)}
    for left_out in (2, 7, 9, 11):  # between the bands' means, and near the coldest and the warmest
        train = [k for k in range(12) if k != left_out]
        for bands in rms:
            rms[bands].append(rms_um(GMDL(bands, 3).fit_design(design, train), design, left_out))
    assert np.mean(rms[3]) < 0.5 * np.mean(rms[1])


def test_beyond_the_trained_temperatures_the_nearest_band_stands_alone():
    design = make_design(0.03, (*STARTS_DEGC, -15.0))
    model = GMDL(3, 3).fit_design(design, range(12))
    cold = model.predict_design(design, [12])[0]
    same = make_batch(12, -15.0, 0.03)
    warmer = replace(same, table=same.table.assign(room=same.table["room"] + 20.0))
    moved = Design.build([warmer], INPUTS, None)
    assert start_temperatures_degC(moved)[0] <= model.fitted["band_degC"][0]
    np.testing.assert_allclose(model.predict_design(moved, [0])[0], cold, atol=1e-9)


def test_where_start_temperatures_are_not_known_there_is_one_band():
    built = make_design(0.02)
    by_hand = Design(built.inputs, "z", built.batch_ids, built.x, built.y_um, built.time_s, built.offsets, 300.0)
    model = GMDL(3, 3).fit_design(by_hand, range(12))
    assert model.fitted["band_batches"] == [12] and model.fitted["band_degC"].size == 0
    one = GMDL(1).fit_design(built, range(12)).predict_design(built, [0])[0]
    np.testing.assert_allclose(model.predict_design(by_hand, [0])[0], one, atol=1e-8)
    assert GMDL([10, 25], 3).fit_design(built, range(12)).fitted["band_batches"] == [3, 6, 3]
    banded = GMDL(3, 3).fit_design(built, range(12))
    alone = [
        banded.predict_design(by_hand, [0])[0],
        np.mean([band_prediction(banded, built, b) for b in range(3)], axis=0),
    ]
    np.testing.assert_allclose(*alone, atol=1e-8)  # equally many batches in each band: equal weights


def band_prediction(model, design, band):
    """Batch 0 by one band alone: moved to where the band stands."""
    batch = design.batches[0]
    shift = model.fitted["band_degC"][band] - start_temperatures_degC(design)[0]
    moved = replace(batch, table=batch.table.assign(room=batch.table["room"] + shift))
    return model.predict_design(Design.build([moved], INPUTS, None), [0])[0]


def test_folds_at_once_are_the_folds_alone_in_bands_too():
    design = make_design(0.02)
    folds = [[j for j in range(12) if j != k] for k in (0, 5)] + [[1, 2]]
    for banded in ("lag", "both"):
        family = GMDL(3, 3, banded)
        for fold, model in zip(folds, family.fit_folds(design, folds), strict=True):
            alone = family.fit_design(design, fold)
            assert alone.fitted["band_batches"] == model.fitted["band_batches"]
            for a, b in zip(alone.predict_design(design, [0, 5]), model.predict_design(design, [0, 5]), strict=True):
                np.testing.assert_allclose(a, b, atol=1e-6)
