from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from data.errors import InputError
from data.machine import parse_machine
from models.base import Family
from models.families import FAMILIES
from models.families.mlr import MLR
from models.selection.conformal import RunBound
from models.selection.trust import Region
from pipelines.cli import app
from pipelines.commands.predict import as_cell, load_model, predict_batches, predict_file, summary
from pipelines.store import lookups, model_store, registry
from tests.toys.tracked import newcomer
from tests.toys.training import GAIN_UM_PER_K, machine_yaml, toy_batches, toy_model


@pytest.fixture(scope="module")
def promoted(store):
    new = newcomer(store, "toy-predict", [1.0] * 6)
    return registry.promote(new, store), new.training_id


@pytest.fixture
def stored(tmp_path) -> Path:
    batches = toy_batches("toy-folder", 4)
    model, region = toy_model(batches)
    model_store.save(tmp_path / "model", model, machine_yaml("toy-folder"), region, {"simulated": True})
    return tmp_path / "model"


def law_um(table: pd.DataFrame) -> np.ndarray:
    front, bed = (table[c] - table[c].iloc[0] for c in ("front", "bed"))
    return (GAIN_UM_PER_K[0] * front + GAIN_UM_PER_K[1] * bed).to_numpy()


@pytest.mark.parametrize("uri", ["models:/{name}@champion", "models:/{name}/1", "models:/{name}", "runs:/{run}/model"])
def test_a_raw_file_is_predicted_from_any_folder(promoted, store, tmp_path, monkeypatch, uri):
    promotion, training_id = promoted
    monkeypatch.chdir(tmp_path)
    table = toy_batches("toy-predict", 3)[2].table
    Path("run7.csv").write_text(table.drop(columns="z").to_csv(index=False))
    if uri.startswith("runs:"):
        uri = f"runs:/{training_id}/model"
    got = predict_file(uri.format(name=promotion.name, run=training_id), Path("run7.csv"), store)
    assert list(got) == ["batch_id", "time_s", "predicted_um", "outside_region", "outside_of", "distance", "authority",
                         "expected_S_um", "bound90_S_um", "flagged", "unit", "simulated", "standing"]  # fmt: skip
    assert np.allclose(got["predicted_um"], law_um(table), atol=1e-6)
    assert not got["outside_region"].any()
    assert got["simulated"].all() and (got["standing"] == "champion").all()
    assert summary(got.assign(standing="provisional")).startswith("warning: provisional model; ")
    assert (got["expected_S_um"] > 0.9).all() and (got["bound90_S_um"] > got["expected_S_um"]).all()  # S = 1 throughout


def test_files_of_channels_that_the_model_does_not_use_are_not_needed(store, tmp_path):
    batches = toy_batches("toy-schedule", 4)
    model, region = toy_model(batches)
    schedule = "{file: runs.csv, batch_column: b, stages: [{hours: h, drivers: {speed: n}}]}"
    text = machine_yaml("toy-schedule").replace("step_s: 60", f"step_s: 60, schedule: {schedule}")
    text = text.replace("unit: rpm,", "unit: rpm, source: schedule,")
    model_store.save(tmp_path / "model", model, text, region, {})
    batches[2].table.drop(columns=["z", "speed"]).to_csv(tmp_path / "run7.csv", index=False)
    got = predict_file(str(tmp_path / "model"), tmp_path / "run7.csv", store)
    assert np.allclose(got["predicted_um"], law_um(batches[2].table), atol=1e-6)
    assert not got["outside_region"].any()


@pytest.mark.slow
def test_a_new_process_in_another_folder_finds_the_model(promoted, store, tmp_path):
    """Nothing that an earlier call left in this process may be needed, and nothing may be written where one stands."""
    table = toy_batches("toy-predict", 3)[2].table
    (tmp_path / "run7.csv").write_text(table.drop(columns="z").to_csv(index=False))
    code = (
        "from pathlib import Path\n"
        "from pipelines import settings\n"
        "from pipelines.commands.predict import predict_file\n"
        "got = predict_file('models:/toy-predict-z@champion', Path('run7.csv'), settings.load())\n"
        "print(got['predicted_um'].iloc[-1])\n"
    )
    env = {k: v for k, v in os.environ.items() if not k.startswith("MLFLOW_")}
    root = str(Path(model_store.__file__).parent.parent)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**env, "THERMODRIFT_HOME": str(store.home), "PYTHONPATH": root},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert float(done.stdout) == pytest.approx(law_um(table)[-1], abs=1e-6)
    assert [p.name for p in tmp_path.iterdir()] == ["run7.csv"]


def test_a_file_without_an_input_is_told_in_one_line(stored, store, tmp_path):
    table = toy_batches("toy-folder", 1)[0].table
    (tmp_path / "run.csv").write_text(table.drop(columns="bed").to_csv(index=False))
    with pytest.raises(InputError) as caught:
        predict_file(str(stored), tmp_path / "run.csv", store)
    assert "bed" in str(caught.value)
    assert "run.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_batch_without_an_input_is_told(stored):
    model = model_store.load(stored)
    table = toy_batches("toy-folder", 1)[0].table.drop(columns="bed")
    with pytest.raises(InputError, match=r"needs 'bed' \(column 'bed'\).*it has front, speed; give a recording"):
        model.predict(model_store.frame_to_batch(model, table))
    table["bed"] = np.nan
    with pytest.raises(InputError, match="needs 'bed'"):
        model.predict(model_store.frame_to_batch(model, table))


def test_rows_beyond_the_training_are_marked_with_what(stored):
    model = model_store.load(stored)
    batch = toy_batches("toy-folder", 1)[0]
    table = batch.table.copy()
    table.loc[40:, "front"] += 30.0
    table.loc[50:, "speed"] = 9000.0
    outside = model.outside(model_store.frame_to_batch(model, table))
    assert outside[:40] == [""] * 40
    assert outside[45] == "front, pattern of the points"
    assert outside[55] == "front, speed, pattern of the points"
    cold = batch.table.assign(front=batch.table["front"] - 15)
    assert set(model.outside(model_store.frame_to_batch(model, cold))) == {"front@start"}


@pytest.mark.parametrize(("trained", "distance"), [(["speed"], np.nan), ([], 0.0)])
def test_a_model_without_inputs_predicts_a_run_without_drivers(trained, distance, tmp_path):
    batches = toy_batches("toy-mean", 3)
    channels = {n: c for n, c in batches[0].channels.items() if n != "speed"}
    bare = [replace(b, table=b.table.drop(columns="speed"), channels=channels) for b in batches]
    mean = FAMILIES["mean_curve"]().fit(batches, (), "z")
    region = Region.of(batches if trained else bare, ())
    assert list(region.ranges) == trained
    model_store.save(tmp_path, mean, machine_yaml("toy-mean"), region)
    table = predict_batches(model_store.load(tmp_path), bare[:1])
    np.testing.assert_allclose(table["predicted_um"], np.mean([b.table["z"] for b in batches], axis=0))
    np.testing.assert_array_equal(table["distance"], distance)
    assert (table["authority"] == 1.0).all() and not table["outside_region"].any()


@pytest.fixture
def bounded(tmp_path) -> model_store.StoredModel:
    """A stored model with two of other families, whose left-out runs had S = 5 µm and a disagreement of 0.1 µm."""
    batches = toy_batches("toy-bound", 8)
    model, region = toy_model(batches)
    runs = pd.DataFrame({"protocol": "leave-batch-out", "fold": "", "batch_id": [b.batch_id for b in batches],
                         "S_um": 5.0, "disagreement_um": 0.1, "distance": 0.0})  # fmt: skip
    siblings = [FAMILIES[key]().fit(batches, model.inputs, "z") for key in ("ridge", "distributed_lag")]
    model_store.save(tmp_path, model, machine_yaml("toy-bound"), region, {}, RunBound.of(runs), siblings)
    loaded = model_store.load(tmp_path)
    assert [s.key for s in loaded.siblings] == ["ridge", "distributed_lag"]
    return loaded


def test_a_run_has_one_expected_error_one_bound_and_one_line(bounded):
    table = predict_batches(bounded, toy_batches("toy-bound", 3))
    runs = table.groupby("batch_id")[["expected_S_um", "bound90_S_um", "flagged"]].nunique()
    assert (runs == 1).all(axis=None)
    assert (table["expected_S_um"] < table["bound90_S_um"]).all() and (table["flagged"] == "").all()
    line = summary(table)
    assert re.fullmatch(r"3 runs: expect S [\d.]+ µm, 90 % below [\d.]+ µm", line)


@pytest.mark.parametrize(
    ("alone_um", "choosing"), [(9.0, ""), (2.0, ", with the cost of choosing a model (2 µm by this one alone)")]
)
def test_what_the_training_stated_stands_next_to_what_the_run_may_expect(bounded, alone_um, choosing):
    stated = {"expected_S_um": 9.0, "expected_S_bound90_um": 20.0, "expected_S_alone_um": alone_um}
    line = summary(predict_batches(replace(bounded, info=stated), toy_batches("toy-bound", 1)))
    assert re.match(r"1 run: expect S [\d.]+ µm, 90 % below [\d.]+ µm\. The training stated", line)
    assert line.endswith(f"for any run of the next season S 9 µm, 90 % below 20 µm{choosing}")


def test_a_run_unlike_the_training_is_flagged_with_the_reason_and_expected_to_be_worse(bounded):
    usual, hot = toy_batches("toy-bound", 2)
    hot = replace(hot, table=hot.table.assign(front=hot.table["front"] + 25, bed=hot.table["bed"] + 25))
    table = predict_batches(bounded, [usual, hot])
    runs = table.groupby("batch_id").first()
    assert list(runs["flagged"]) == ["", "front at start 46 degC, trained 20 to 27"]
    assert runs["expected_S_um"].iloc[1] > 1.1 * runs["expected_S_um"].iloc[0]
    far = bounded.distance(hot)[0]
    assert far > 1 and list(runs["authority"]) == pytest.approx([1.0, 1 / (1 + far - 0.05)])
    line = summary(table)
    assert re.match(r"warning: 2 runs: expect S [\d.]+ to [\d.]+ µm, 90 % below [\d.]+ to [\d.]+ µm; ", line)
    assert f"run {hot.batch_id} is unlike the training ({runs['flagged'].iloc[1]}): error may exceed" in line
    assert "60 of 120 rows are outside the trained range (front at start, bed at start" in line


def test_rows_of_a_broken_sensor_are_not_predicted_and_the_account_names_it(stored, tmp_path):
    table = toy_batches("toy-folder", 1)[0].table.drop(columns="z")
    table.loc[30:, "front"] += 15.0
    table.to_csv(tmp_path / "loose.csv", index=False)
    done = CliRunner().invoke(app, ["predict", str(tmp_path / "loose.csv"), "--model", str(stored)])
    predicted = pd.read_csv(StringIO(done.stdout))["predicted_um"]
    assert done.exit_code == 0 and predicted[:30].notna().all() and predicted[30:].isna().all()
    assert "30 values masked: front 30 (jump_no_return)" in done.stderr


def test_the_folder_of_a_prediction_is_made_or_refused_before_the_work(stored, tmp_path):
    toy_batches("toy-folder", 1)[0].table.drop(columns="z").to_csv(tmp_path / "run.csv", index=False)
    ask = ["predict", str(tmp_path / "run.csv"), "--model", str(stored), "--out"]
    assert CliRunner().invoke(app, [*ask, str(tmp_path / "new" / "deep" / "out.csv")]).exit_code == 0
    assert len(pd.read_csv(tmp_path / "new" / "deep" / "out.csv")) == 60
    refused = CliRunner().invoke(app, [*ask, str(tmp_path / "run.csv" / "out.csv")])
    assert isinstance(refused.exception, InputError)
    assert "is a file, expected a folder; give another --out" in str(refused.exception)


def test_a_run_that_other_models_disagree_about_is_flagged(bounded):
    batches = toy_batches("toy-bound", 4)
    double = MLR().fit([replace(b, table=b.table.assign(z=2 * b.table["z"])) for b in batches], ("front", "bed"), "z")
    agreed, doubted = (model.run_error(batches[1], model.predict(batches[1]))
                       for model in (bounded, replace(bounded, siblings=(double,))))  # fmt: skip
    assert agreed.flagged == ""
    assert re.fullmatch(r"other models differ by \d+ µm, usually 0\.1", doubted.flagged)
    assert doubted.bound90_S_um > 2 * agreed.bound90_S_um


def test_the_command_warns_on_standard_error_and_succeeds(stored, tmp_path):
    table = toy_batches("toy-folder", 1)[0].table.drop(columns="z")
    table.assign(front=table["front"] + 30).to_csv(tmp_path / "hot.csv", index=False)
    done = CliRunner().invoke(app, ["predict", str(tmp_path / "hot.csv"), "--model", str(stored)])
    assert done.exit_code == 0
    assert done.stderr.startswith(
        "SIMULATED model or recordings\nwarning: 1 run: no expected error is stored; train again; run hot is unlike"
    )
    _, _, account = done.stderr.strip().splitlines()
    assert account == "rows: 60 read, 0 dropped; nothing masked"
    assert pd.read_csv(StringIO(done.stdout))["flagged"].notna().all()


def test_a_row_of_nulls_is_outside_the_region(stored):
    model = model_store.load(stored)
    table = toy_batches("toy-folder", 1)[0].table
    known = model_store.predict_frame(model, table)
    table.loc[20, [c for c in table if c != "time_s"]] = np.nan
    done = model_store.predict_frame(model, table)
    assert np.isnan(done["predicted_um"][20]) and bool(done["outside_region"][20])
    others = np.arange(len(table)) != 20
    assert (done["outside_region"][others] == known["outside_region"][others]).all()


def test_a_model_stored_without_bounds_still_predicts(stored):
    path = stored / "model.json"
    document = json.loads(path.read_text())
    document |= {"schema": "thermodrift.model/2", "rise": None}
    del document["bound"], document["siblings"]
    path.write_text(json.dumps(document))
    batch = toy_batches("toy-folder", 4)[1]
    table = predict_batches(model_store.load(stored), [batch])
    assert np.allclose(table["predicted_um"], law_um(batch.table), atol=1e-6) and table["expected_S_um"].isna().all()


def test_a_stored_model_is_plain_data_and_comes_back_equal(stored):
    assert {p.name for p in stored.iterdir()} == set(model_store.FILES)
    document = json.loads((stored / "model.json").read_text())
    assert document["schema"] == "thermodrift.model/3"
    assert document["region"]["ranges"]["speed"] == [4000.0, 4000.0]
    batch = toy_batches("toy-folder", 4)[1]
    before, _ = toy_model(toy_batches("toy-folder", 4))
    assert np.array_equal(model_store.load(stored).predict(batch), before.predict(batch))


def test_a_driver_that_the_model_follows_must_be_there(tmp_path):
    batches = toy_batches("toy-driver", 4)
    model_store.save(
        tmp_path, FAMILIES["thermal_exponential"]().fit(batches, (), "z"), machine_yaml("toy-driver"), Region.of([], ())
    )
    model = model_store.load(tmp_path)
    assert model.channels() == ("speed",)
    table = batches[0].table
    assert np.isfinite(model.predict(model_store.frame_to_batch(model, table))).all()
    with pytest.raises(InputError, match="needs 'speed'"):
        model.predict(model_store.frame_to_batch(model, table.drop(columns="speed")))


def test_every_kind_of_plain_data_comes_back(tmp_path, monkeypatch):
    class Odd(Family):
        key = "odd"
        words = source = "test"

        def fit_design(self, design, train):
            return self._learned(design, {})

        def respond(self, design, batches):
            return [design.x[design.rows(k)].sum(axis=1) for k in batches]

    odd = Odd()
    odd.inputs, odd.target = ("front@lag30min",), "z"
    odd.fitted = {
        "w": np.arange(6.0).reshape(2, 3), "n": np.int64(3), "f": float("inf"), "words": "ä µm", "flag": True,
        "list": [1, 2.5, "x", np.array([1, 2])], "nested": {"deep": np.array([[True]])}, "none": None,
    }  # fmt: skip
    monkeypatch.setitem(FAMILIES._members, "odd", "here:Odd")
    monkeypatch.setattr("data.registry.import_module", lambda _: type("here", (), {"Odd": Odd}))
    model_store.save(tmp_path, odd, machine_yaml("m"), Region.of([], ()))
    got = model_store.load(tmp_path).family.fitted
    assert np.array_equal(got["w"], odd.fitted["w"])
    assert got["nested"]["deep"].dtype == bool
    assert got["list"][:3] == [1, 2.5, "x"]
    assert (got["n"], got["f"], got["words"], got["flag"], got["none"]) == (3, float("inf"), "ä µm", True, None)
    odd.fitted = {"bad": object()}
    with pytest.raises(TypeError, match="object is not plain data"):
        model_store.save(tmp_path, odd, machine_yaml("m"), Region.of([], ()))


def test_a_damaged_or_foreign_folder_is_told(stored, store, tmp_path):
    with pytest.raises(InputError, match="not a stored model"):
        load_model(str(tmp_path), store)
    with pytest.raises(InputError, match=r"no such folder; expected models:/NAME@champion"):
        load_model(str(tmp_path / "nowhere"), store)
    text = (stored / "model.json").read_text()
    (stored / "model.json").write_text(text.replace("thermodrift.model/3", "thermodrift.model/9"))
    with pytest.raises(InputError, match=r"got schema 'thermodrift.model/9', expected 'thermodrift.model/3'"):
        load_model(str(stored), store)
    (stored / "model.json").write_text(text)
    np.savez(stored / "arrays.npz", a0=np.array([object()], dtype=object))
    with pytest.raises(InputError, match=r"not a stored model as it was promoted \(arrays.npz has sha256"):
        load_model(str(stored), store)
    document = json.loads(text)
    document["sha256"]["arrays.npz"] = hashlib.sha256((stored / "arrays.npz").read_bytes()).hexdigest()
    (stored / "model.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"not a stored model \(Object arrays"):  # a pickled array is never loaded
        load_model(str(stored), store)


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("models:/toy-predcit-z@champion", "unknown model 'toy-predcit-z'; did you mean 'toy-predict-z'?"),
        ("models:/toy-predict-z@champoin", "has no alias 'champoin'; did you mean 'champion'?"),
        ("models:/toy-predict-z/7", "has no version '7'; Allowed: 1, champion"),
        ("models:/", "expected models:/NAME@alias"),
        ("runs:/0123/model", "no run '0123' in sqlite"),
    ],
)
def test_unknown_models_are_told_with_the_closest(promoted, store, uri, words):
    with pytest.raises(InputError) as caught:
        load_model(uri, store)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_name_is_looked_up_once_until_the_store_changes(promoted, store, monkeypatch):
    name = promoted[0].name
    look_up, asked = registry.look_up, []
    monkeypatch.setattr(registry, "look_up", lambda *given: (asked.append(given[:2]), look_up(*given))[1])
    client = registry.open_store(store)
    client.set_registered_model_alias(name, "tried", "1")
    for uri in (f"models:/{name}@tried", f"models:/{name}/1", f"models:/{name}"):
        load_model(uri, store)
    with pytest.raises(InputError, match="unknown model 'toy-predcit-z'; did you mean 'toy-predict-z'"):
        load_model("models:/toy-predcit-z", store)
    assert asked == [(name, "tried")]
    client.delete_registered_model_alias(name, "tried")
    with pytest.raises(InputError, match="has no alias 'tried'"):
        load_model(f"models:/{name}@tried", store)
    assert asked == [(name, "tried")] * 2


def test_nothing_is_kept_of_a_server_or_of_files_elsewhere(store, tmp_path):
    own, place = replace(store, home=tmp_path), lookups.Place(str(tmp_path / "download"), "")
    for changed in ({"store_uri": "http://127.0.0.1:1"}, {"artifacts_uri": "s3://bucket"}, {}):
        settings = replace(own, **changed)
        lookups.keep(lookups.kept(settings), {"m": {}}, {"m/1": place}, settings.home)
        assert not lookups.kept(settings).aliases
    inside = replace(own, artifacts_uri=tmp_path.as_uri())
    lookups.keep(lookups.kept(inside), {"m": {"champion": "1"}}, {"m/1": place}, tmp_path)
    assert lookups.kept(inside).place("m", "champion") == place
    (tmp_path / "registry.json").write_text("[]")
    assert lookups.kept(inside).place("m", "champion") is None


def test_a_table_of_several_batches_starts_each_at_zero(stored):
    model = model_store.load(stored)
    parts = [b.table.assign(batch_id=b.batch_id) for b in toy_batches("toy-folder", 2)]
    table = pd.concat(parts[::-1], ignore_index=True)
    got = model_store.predict_frame(model, table)
    assert np.allclose(got["predicted_um"], np.concatenate([law_um(p) for p in parts[::-1]]), atol=1e-6)
    table["time_s"] **= 2
    with pytest.raises(InputError, match="table of b01: 'time_s' is not a regular grid"):
        model_store.predict_frame(model, table)
    with pytest.raises(InputError, match="no column 'time_s'"):
        model_store.predict_frame(model, table.drop(columns="time_s"))


def test_needed_channels_follow_from_the_features(stored):
    model = model_store.load(stored)
    with_room = machine_yaml("m") + "  room: {role: ambient, unit: degC}\n"
    model.family.inputs = ("front@lag30min", "bed@ambient", "front")
    other = model_store.StoredModel(model.family, parse_machine(with_room, "test"), Region.of([], ()))
    assert other.channels() == ("front", "bed", "room")


@pytest.mark.parametrize(
    ("name", "cell"),
    [("=HYPERLINK(1)", "'=HYPERLINK(1)"), ("@SUM(A1)", "'@SUM(A1)"), ("-run", "'-run"), ("-5.2", "-5.2"),
     ("run=1", "run=1"), ("20250113_6000rpm", "20250113_6000rpm")],
)  # fmt: skip
def test_a_name_is_no_formula_of_a_spreadsheet(name: str, cell: str) -> None:
    assert as_cell(name) == cell
