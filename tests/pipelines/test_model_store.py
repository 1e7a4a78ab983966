"""Stored models: what was changed or cut after it was stored is refused, in one line that says what to do; a twin."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from data.errors import InputError
from models.base import Family
from models.families import FAMILIES
from models.families.twin import Twin
from models.families.twin_kalman import TwinKalman
from models.selection.trust import Region
from pipelines.store import model_store
from pipelines.store.pyfunc_model import SERVED, Served
from pipelines.store.serving import write_served
from reports.labels import family_label
from tests.models.twin_year import year
from tests.toys.training import machine_yaml, toy_batches, toy_model


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """The folder of a model with the files by which it is served."""
    batches = toy_batches("toy-hash", 4)
    model, _ = toy_model(batches)
    folder = tmp_path / "model"
    region = Region.of(batches, ("front", "bed"))
    model_store.save(folder, model, machine_yaml("toy-hash"), region, {"training_id": "abc"})
    assert write_served(model_store.load(folder), folder, 60.0) == SERVED == model_store.SERVED
    return folder


def changed(path: Path, how: str) -> None:
    body = path.read_bytes()
    if how == "cut":
        path.write_bytes(body[:-7])
    elif how == "other values" and path.suffix == ".npz":  # a valid file, which no reader would notice
        with np.load(path) as arrays:
            np.savez(path, **{name: arrays[name] + 1 for name in arrays.files})
    else:
        path.write_bytes(body.replace(b"80]", b"90]", 1) if how == "other values" else body + b" ")


def test_every_file_has_its_hash(stored: Path) -> None:
    document = json.loads((stored / "model.json").read_text(encoding="utf-8"))
    assert set(document["sha256"]) == {*model_store.FILES, *SERVED} - {"model.json"}
    assert model_store.load(stored).info == {"training_id": "abc"}
    Served(stored)


@pytest.mark.parametrize("how", ["cut", "other values", "longer"])
@pytest.mark.parametrize("name", ["arrays.npz", "machine.yml"])
def test_a_changed_file_is_refused(stored: Path, name: str, how: str) -> None:
    changed(stored / name, how)
    with pytest.raises(InputError) as caught:
        model_store.load(stored)
    said = str(caught.value)
    assert said.startswith(f"model folder {stored}: not a stored model as it was promoted ({name} has sha256 ")
    assert said.endswith("); load the model from the registry again, or promote it again")
    assert "model.json names " in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("name", SERVED)
def test_a_changed_file_of_the_server_is_refused_with_and_without_thermodrift(stored: Path, name: str) -> None:
    changed(stored / name, "longer")
    with pytest.raises(InputError, match=f"not a stored model as it was promoted .{name} has sha256"):
        model_store.load(stored)
    with pytest.raises(RuntimeError, match=f"{name} is not the file that was promoted; load the model from the reg"):
        Served(stored)


def test_a_model_without_what_serves_it_is_read_and_one_without_its_arrays_is_not(stored: Path) -> None:
    for name in SERVED:
        (stored / name).unlink()
    model_store.load(stored)
    (stored / "arrays.npz").unlink()
    with pytest.raises(InputError, match=r"not a stored model \(.*arrays\.npz.*\); expected the files model\.json"):
        model_store.load(stored)


@pytest.mark.parametrize("name", [None, "arrays.npz", "machine.yml", "model.onnx"])
def test_a_hash_cannot_be_left_out(stored: Path, name: str | None) -> None:
    document = json.loads((stored / "model.json").read_text(encoding="utf-8"))
    del (document if name is None else document["sha256"])[name or "sha256"]
    (stored / "model.json").write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(InputError, match=f"{name or 'arrays.npz'} has sha256 .*, model.json names none"):
        model_store.load(stored)
    if name in (None, "model.onnx"):
        with pytest.raises(RuntimeError, match="is not the file that was promoted"):
            Served(stored)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("{", '{"a":' * 20_000, "not a stored model"),
        ('"schema"', '"skema"', "got schema None, expected"),
        ('"sha256": {', '"sha256": [1], "other": {', "model.json names none"),
        ('"options"', '"optoins"', "model.json is damaged (KeyError: 'options')"),
        ('"a0"', '"a99"', "model.json is damaged (KeyError: 'a99')"),
    ],
)
def test_a_damaged_description_is_refused_in_one_line(stored: Path, old: str, new: str, words: str) -> None:
    text = (stored / "model.json").read_text(encoding="utf-8")
    assert old in text
    (stored / "model.json").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        model_store.load(stored)
    assert words in str(caught.value) and len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("family", [Twin(), TwinKalman()])
def test_a_stored_twin_predicts_the_same_and_says_what_it_needs(family: Family, tmp_path: Path) -> None:
    machine, batches = year(3)
    model = family.fit(batches[:2], ["t_head"], "z", machine)
    text = yaml.safe_dump(json.loads(machine.model_dump_json(exclude_none=True)), sort_keys=False)
    model_store.save(tmp_path, model, text, Region.of([], ()))
    back = model_store.load(tmp_path)
    np.testing.assert_array_equal(back.predict(batches[2]), model.predict(batches[2]))
    assert {"rpm", "room"} <= set(back.channels())
    silent = batches[2].table.assign(rpm=np.nan)
    with pytest.raises(InputError, match=r"needs 'rpm' .*, which the recording does not have"):
        model_store.predict_frame(back, silent)


def test_every_family_has_a_name_of_its_own() -> None:
    assert len({family_label(k) for k in FAMILIES}) == len(FAMILIES)
    assert [family_label(k) for k in ("twin", "twin_residual", "twin_kalman")] == [
        "physics twin", "twin + residual", "twin with sensors",
    ]  # fmt: skip
