"""What every family promises, run over the registry: a new member is tested without touching this file."""

import json

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Channel
from data.errors import InputError
from data.machine import parse_machine
from features.design import Design
from models import FAMILIES
from models.base import Family, family_from_plain
from models.metrics import residual_std_um

INPUTS = ("front", "column", "bed")
N = 72


def make_batch(k: int) -> Batch:
    """A six-hour run whose error follows its sensors and its load, with noise."""
    rng = np.random.default_rng(k)
    time_s = np.arange(N) * 300.0
    load, ambient = rng.uniform(0.5, 1.2), rng.uniform(5, 30)
    fast, slow = load * 18 * (1 - np.exp(-time_s / 2400)), load * 9 * (1 - np.exp(-time_s / 9000))
    drift = rng.normal(0, 2) * time_s / time_s[-1]
    table = pd.DataFrame({
        "time_s": time_s,
        "front": ambient + 0.9 * fast + 0.2 * slow + drift,
        "column": ambient + 0.2 * fast + 0.8 * slow + drift,
        "bed": ambient + 0.3 * slow + drift,
        "spindle": np.where(time_s > 0, 4000.0 * load, 0.0),
        "z": 12.0 + 1.8 * fast + 2.4 * slow + 1.5 * drift + rng.normal(0, 0.3, N),
    })  # fmt: skip
    table[list(INPUTS)] = (table[list(INPUTS)] + rng.normal(0, 0.03, (N, 3))).round(1)
    channels = {name: Channel(name, "temperature", "degC", 0.1, -20, 120) for name in INPUTS}
    channels |= {"spindle": Channel("spindle", "driver", "rpm"), "z": Channel("z", "error", "um", 0.1)}
    return Batch("vmc", f"K{k + 1}", table, channels)


# Families of the physics need a machine file; its twin knows three bodies and what drives them, not the law above.
MACHINE = parse_machine(
    """
machine: vmc
recording: {step_s: 300}
channels:
  front: {role: temperature, unit: degC, resolution: 0.1}
  column: {role: temperature, unit: degC, resolution: 0.1}
  bed: {role: temperature, unit: degC, resolution: 0.1}
  spindle: {role: driver, unit: rpm}
  z: {role: error, unit: um, resolution: 0.1}
twin:
  surroundings: {hall: {first: [bed]}}
  bodies:
    front: {capacity: {value: 30 kJ/K, spread: 0.5}}
    column: {capacity: {value: 150 kJ/K, spread: 0.5}}
    bed: {capacity: {value: 400 kJ/K, spread: 0.5}}
  links: {front-column: {value: 20 W/K, spread: 0.5}, column-bed: {value: 20 W/K, spread: 0.5}}
  exposures: {front-hall: {value: 5 W/K, spread: 0.5}, column-hall: {value: 5 W/K, spread: 0.5}, bed-hall: 10 W/K}
  mechanisms:
    belt: {law: belt_loss, drivers: spindle, into: front, parameters: {power: {value: 600 W, spread: 0.5}}}
  sensors: {front: {at: front}, column: {at: column}, bed: {at: bed}}
  errors:
    z:
      chain:
        - {body: front, gain: {value: 2 um/K, spread: 1 um/K}}
        - {body: column, gain: {value: 2 um/K, spread: 1 um/K}}
""",
    "test",
)


def along_an_axis(batch: Batch) -> Batch:
    """The same run read at four positions in turn, after a first sweep at rest; the error grows with the position."""
    table = batch.table.assign(at=np.resize([0.0, 60.0, 120.0, 180.0], N))
    table.loc[1:3, [*INPUTS, "z"]] = table.loc[0, [*INPUTS, "z"]].to_numpy()
    table["z"] += 0.01 * table["at"] * (table["front"] - table["front"][0])
    channels = {
        **batch.channels,
        "at": Channel("at", "position", "mm"),
        "z": Channel("z", "error", "um", position="at"),
    }
    return Batch("vmc", batch.batch_id, table, channels)


BATCHES = [make_batch(k) for k in range(5)]
AXIS_BATCHES = [along_an_axis(b) for b in BATCHES]
_FITTED: dict[str, Family] = {}


@pytest.fixture(params=list(FAMILIES))
def key(request) -> str:
    return str(request.param)


@pytest.fixture
def batches(key) -> list[Batch]:
    return AXIS_BATCHES if FAMILIES[key].needs_position else BATCHES


@pytest.fixture(scope="module")
def designs() -> dict[bool, Design]:
    return {along: Design.build(b, INPUTS, "z", MACHINE) for along, b in ((False, BATCHES), (True, AXIS_BATCHES))}


@pytest.fixture
def design(key, designs) -> Design:
    return designs[FAMILIES[key].needs_position]


@pytest.fixture
def fitted(key, design) -> Family:
    if key not in _FITTED:
        _FITTED[key] = FAMILIES[key]().fit_design(design, [0, 1, 2, 3])
    return _FITTED[key]


def test_says_what_it_is(key):
    cls = FAMILIES[key]
    assert cls.key == key and issubclass(cls, Family)
    assert cls.summary and cls.source and isinstance(cls.rank, int)


def test_fit_gives_a_new_copy_that_predicts_every_row(key, design, fitted):
    empty = FAMILIES[key]()
    assert empty.fitted == {} and empty.inputs == ()
    assert empty.fit_design(design, [0, 1, 2, 3]) is not empty and empty.fitted == {}
    assert (fitted.inputs, fitted.target) == (INPUTS, "z")
    first, second = fitted.predict_design(design, [4, 1])
    assert first.shape == second.shape == (N,) and first.dtype == np.float64
    assert np.isfinite(first).all() and np.isfinite(second).all()
    assert fitted.n_parameters() >= (0 if key == "zero" else 1)


def test_fit_and_predict_on_whole_batches_are_the_same_model(key, batches, fitted):
    model = FAMILIES[key]().fit(batches[:4], INPUTS, "z", MACHINE)
    got = fitted.predict(batches[4])
    np.testing.assert_allclose(model.predict(batches[4]), got, rtol=0, atol=1e-6 * max(1.0, np.abs(got).max()))


def test_beats_no_model_on_a_batch_it_never_saw(key, design, fitted):
    error_um = design.y_um[design.rows(4)]
    left = fitted.predict_design(design, [4])[0] - error_um
    if key != "zero":
        assert np.std(left) < 0.6 * np.std(error_um)


def test_is_the_same_every_time(key, design, fitted):
    again = FAMILIES[key]().fit_design(design, [0, 1, 2, 3])
    np.testing.assert_array_equal(again.predict_design(design, [4])[0], fitted.predict_design(design, [4])[0])


def test_nothing_crosses_a_border_between_batches(batches, fitted):
    alone = fitted.predict_design(Design.build([batches[4]], INPUTS, "z", MACHINE), [0])[0]
    for neighbours in ([4, 0], [0, 4]):
        both = Design.build([batches[k] for k in neighbours], INPUTS, "z", MACHINE)
        np.testing.assert_allclose(fitted.predict_design(both, [neighbours.index(4)])[0], alone, rtol=0, atol=1e-9)


def test_a_prediction_never_sees_the_recorded_error(batches, design, fitted):
    blind = Design.build(batches, INPUTS, None, MACHINE)
    np.testing.assert_array_equal(fitted.predict_design(blind, [4])[0], fitted.predict_design(design, [4])[0])


def test_a_prediction_is_zero_where_the_recorded_error_is(key, batches, design, fitted):
    """Exactly, at the first row; along an axis throughout the first sweep."""
    start = 4 if FAMILIES[key].needs_position else 1
    one_by_one = [fitted.predict(b) for b in batches]
    (at_once,) = fitted.predict_folds(design, [fitted], [range(5)])
    for predicted in (*one_by_one, *at_once, *fitted.predict_design(design, range(5))):
        assert (predicted[:start] == 0.0).all()
        assert key == "zero" or np.abs(predicted).max() > 1.0


def test_without_its_first_readings_a_prediction_is_zero_at_its_first_row(key, batches, fitted):
    table = batches[4].table.copy()
    table.loc[:2, "front"] = np.nan
    table.loc[:1, "column"] = np.nan
    late = Batch("vmc", "late", table, batches[4].channels)
    predicted = fitted.predict(late)
    known = np.isfinite(predicted)
    assert known.sum() >= N - 3 and predicted[np.argmax(known)] == 0.0
    model = FAMILIES[key]().fit([*batches[:3], late], INPUTS, "z", MACHINE)
    again = model.predict(late)
    assert again[np.argmax(np.isfinite(again))] == 0.0


def test_the_published_form_has_a_level_of_its_own_and_keeps_it_in_store(key, design):
    free = FAMILIES[key]().as_published().fit_design(design, [0, 1, 2, 3])
    back = family_from_plain(free.as_plain())
    assert not free.zero_start and not back.zero_start and FAMILIES[key]().zero_start
    np.testing.assert_array_equal(back.predict_design(design, [4])[0], free.predict_design(design, [4])[0])
    (own,) = free.respond(design, [4])
    np.testing.assert_array_equal(free.predict_design(design, [4])[0], own)


def test_the_stated_sd_does_not_shrink_from_the_start_on(key, design, fitted):
    if not fitted.has_sd:
        return
    sd_um = fitted.sd_um(design, [4])[0]
    assert np.isfinite(sd_um).all() and sd_um[0] > 0
    assert sd_um[0] <= 1.02 * np.median(sd_um)


def test_folds_at_once_are_the_folds_one_by_one(key, design, fitted):
    folds = [[0, 1, 2, 3], [2]]
    together = FAMILIES[key]().fit_folds(design, folds)
    one_by_one = [fitted, FAMILIES[key]().fit_design(design, [2])]
    for a, b in zip(together, one_by_one, strict=True):
        want = b.predict_design(design, [4])[0]
        got = a.predict_design(design, [4])[0]
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-6 * max(1.0, np.abs(want).max()))
    (first,), (_, second) = fitted.predict_folds(design, together, [[4], [0, 4]])
    np.testing.assert_allclose(first, together[0].predict_design(design, [4])[0], atol=1e-6)
    np.testing.assert_allclose(second, together[1].predict_design(design, [4])[0], atol=1e-6)


def test_fitting_accuracy_without_rows_is_that_of_the_predictions(key, design, fitted):
    S_um = fitted.fitting_S_um(design, [fitted], [[0, 2]])
    if S_um is not None:
        own = [design.y_um[design.rows(k)] - fitted.predict_design(design, [k])[0] for k in (0, 2)]
        assert S_um.shape == (1,) and S_um[0] == pytest.approx(np.mean([residual_std_um(e) for e in own]), rel=1e-8)


def test_one_batch_is_enough(key, design):
    model = FAMILIES[key]().fit_design(design, [1])
    error_um = design.y_um[design.rows(1)]
    own = model.predict_design(design, [1])[0]
    assert np.isfinite(own).all()
    if key != "zero":
        assert np.std(own - error_um) < 0.3 * np.std(error_um)


def test_left_out_batches_do_not_touch_the_fit(key, batches, design, fitted):
    strange = make_batch(99)
    strange = along_an_axis(strange) if FAMILIES[key].needs_position else strange
    other = Design.build([*batches[:4], strange], INPUTS, "z", MACHINE)
    model = FAMILIES[key]().fit_design(other, [0, 1, 2, 3])
    got, want = model.predict_design(other, [0])[0], fitted.predict_design(design, [0])[0]
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-6 * max(1.0, np.abs(want).max()))


def test_stored_as_json_and_arrays_it_predicts_the_same(key, design, fitted):
    def encode(value: object) -> object:
        assert isinstance(value, np.ndarray) and value.dtype != object, f"not plain data: {type(value)}"
        return {"array": value.tolist(), "dtype": str(value.dtype)}

    def decode(part: dict) -> object:
        return np.array(part["array"], part["dtype"]) if set(part) == {"array", "dtype"} else part

    text = json.dumps(fitted.as_plain(), default=encode, allow_nan=False)
    back = family_from_plain(json.loads(text, object_hook=decode))
    assert type(back) is type(fitted) and back.options() == fitted.options()
    np.testing.assert_array_equal(back.predict_design(design, [4])[0], fitted.predict_design(design, [4])[0])


def test_no_usable_row_is_told_in_one_line(key, batches):
    if key == "zero":
        pytest.skip("learns nothing")
    table = batches[0].table.assign(z=np.nan)
    dead = Batch("vmc", "K9", table, batches[0].channels)
    with pytest.raises(InputError) as error:
        FAMILIES[key]().fit([dead], INPUTS, "z", MACHINE)
    assert "\n" not in str(error.value) and "K9" in str(error.value) and key.split("_")[0] in str(error.value)
