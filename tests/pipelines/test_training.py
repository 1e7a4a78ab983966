"""The whole job on a small year: lake, tracked runs, promoted versions, report, prediction, and what comes after."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from data.lake import Lake
from models.families import FAMILIES
from models.selection.crossing import Plan
from pipelines.caller import DirectCaller
from pipelines.commands.predict import load_model, predict_file
from pipelines.commands.train import print_training, training_dict
from pipelines.jobs.recordings import load_batches
from pipelines.jobs.request import TrainRequest
from pipelines.jobs.training import TrainOutcome, promote_tracked, train
from pipelines.store import lookups, registry, tracking
from tests.toys.small_year import NOISE_UM, law_um, write_machine, write_year
from tests.toys.tracked import client_of

NAME = "small-train"
MODEL = f"{NAME}-z"
ZERO = Plan(("none",), ("zero",), ("leave-batch-out",))
QUICK = Plan(("none", "correlation"), ("zero", "ridge", "mlr"), ("leave-batch-out", "train-on-one"))


@dataclass
class Story:
    """One machine's year, training after training; tests look at it and do not change it."""

    folder: Path
    machine: Path
    files: list[Path]
    steps: dict[str, Any]
    champion: dict[str, int | None]


@pytest.fixture(scope="module")
def home(store: Any, store_home: Path) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMODRIFT_HOME", str(store_home))
        yield store_home


@pytest.fixture(scope="module")
def story(home: Path, store: Any, tmp_path_factory: pytest.TempPathFactory) -> Story:
    folder = tmp_path_factory.mktemp("year")
    machine, files = write_machine(folder / "small.yml", NAME), write_year(folder / "in")
    client, said = client_of(store), []
    story = Story(folder, machine, files, {"said": said}, {})

    def step(name: str, work: Callable[[], Any]) -> None:
        story.steps[name] = work()
        champion = client.get_registered_model(MODEL).aliases.get("champion")
        story.champion[name] = None if champion is None else int(champion)

    def training(plan: Plan, **more: Any) -> TrainOutcome:
        request = TrainRequest(machine, (folder / "in",), ("z",), plan, **more)
        return train(request, store, DirectCaller(), said.append)

    step("zero", lambda: training(ZERO))
    step("zero again", lambda: training(ZERO))
    step("better", lambda: training(QUICK, report=folder / "out" / "better.html"))
    step("known", lambda: lookups.kept(store))
    step("not new", lambda: training(QUICK, only_if_new=True))
    story.files += write_year(folder / "in", 1, first=6)
    step("season", lambda: training(QUICK, only_if_new=True))
    season = story.steps["season"].training_ids["z"]
    step("by hand", lambda: promote_tracked(season, machine, "none|zero|0", False, store))
    step("by force", lambda: promote_tracked(season, machine, "none|zero|0", True, store))
    step("rolled back", lambda: registry.rollback(MODEL, store))
    return story


def test_every_recording_is_in_the_lake(story: Story, home: Path) -> None:
    ingested = story.steps["zero"].ingested
    assert [r.status for r in ingested.rows] == ["new"] * 6
    assert [r.status for r in story.steps["zero again"].ingested.rows] == ["unchanged"] * 6
    assert [r.status for r in story.steps["season"].ingested.rows] == ["unchanged"] * 6 + ["new"]
    lake = Lake(home / "lake")
    assert lake.batch_ids(NAME) == [f.stem for f in story.files]
    assert all(len(lake.versions(NAME, f.stem)) == 1 for f in story.files)
    assert ingested.rows_in == ingested.rows_stored == sum(len(pd.read_csv(f)) for f in story.files[:6])


def test_the_leaderboard_says_what_the_recordings_say(story: Story) -> None:
    """Without a model S is the recordings' own spread; the law's regression leaves the noise."""
    cells = story.steps["better"].results["z"].cells
    cells = cells[cells["protocol"] == "leave-batch-out"].set_index(["selector", "family", "n_tsp"])
    z = [pd.read_csv(f)["z"].to_numpy() for f in story.files[:6]]
    by_hand = [np.sqrt(((y - y[0]) ** 2).sum() / (len(y) - 1)) for y in z]
    assert cells.loc[("none", "zero", 0), "S_mean_um"] == pytest.approx(np.mean(by_hand), rel=1e-6)
    assert cells.loc[("none", "ridge", 3), "S_mean_um"] < 3 * NOISE_UM
    assert cells.loc[("none", "mlr", 3), "S_mean_um"] < 3 * NOISE_UM
    assert len(cells) == 1 + 2 * (1 + 3)  # zero; ridge and mlr on all, and by correlation on 1 to 3


def test_first_model_then_nothing_new_then_a_better_one(story: Story) -> None:
    first, again, better = (story.steps[k].promotions["z"] for k in ("zero", "zero again", "better"))
    assert (first.outcome, first.version, first.champion_version, first.trusted) == ("challenger", 1, None, False)
    assert "version 1 is challenger: no trustworthy model; zero" in first.summary
    assert (again.outcome, again.version) == ("unchanged", 1)
    assert "nothing new registered" in again.summary
    assert (better.outcome, better.version, better.trusted) == ("champion", 2, True)
    assert "first champion of this machine and channel" in better.summary
    assert story.champion["zero again"] is None and story.champion["better"] == 2


def test_the_same_batches_are_not_learned_again(story: Story, store: Any) -> None:
    stopped = story.steps["not new"]
    assert stopped.stopped == "the last training saw the same batches; nothing new to learn"
    assert not stopped.training_ids and stopped.report is None
    assert len(tracking.trainings(NAME, "z", store)) == 4


def test_a_new_season_is_learned_and_judged(story: Story) -> None:
    outcome = story.steps["season"]
    promotion = outcome.promotions["z"]
    assert not outcome.stopped and len(outcome.results["z"].batches) == 7
    assert promotion.version == 3 and promotion.outcome in ("champion", "challenger")
    assert "against version 2" in promotion.summary and "over 7 batches" in promotion.summary
    assert "(1 of them new to the champion)" in promotion.summary
    assert promotion.comparison is not None and promotion.comparison.n_batches == 7
    assert story.champion["season"] == promotion.champion_version


def test_by_hand_by_force_and_back(story: Story) -> None:
    by_hand, by_force, back = (story.steps[k] for k in ("by hand", "by force", "rolled back"))
    assert (by_hand.outcome, by_hand.version) == ("challenger", 4)
    assert "no trustworthy model" in by_hand.summary
    assert story.champion["by hand"] == story.champion["season"]
    assert story.champion["by force"] == by_force.champion_version == 4
    assert "by force" in by_force.summary
    assert story.champion["rolled back"] == back.version == story.champion["season"]


def test_what_cannot_be_promoted_is_told(story: Story, store: Any, tmp_path: Path) -> None:
    season = story.steps["season"].training_ids["z"]
    with pytest.raises(InputError, match=r"unknown cell 'none\|rigde\|3' .* expected selector\|family\|n_tsp, such as"):
        promote_tracked(season, story.machine, "none|rigde|3", False, store)
    other = write_machine(tmp_path / "other.yml", "other")
    with pytest.raises(InputError, match=f"training {season} is of {NAME}, the machine file of other"):
        promote_tracked(season, other, "", False, store)


def test_runs_are_tracked_with_their_batches(story: Story, store: Any) -> None:
    client = client_of(store)
    training_id = story.steps["better"].training_ids["z"]
    run = client.get_run(training_id)
    assert {d.dataset.name for d in run.inputs.dataset_inputs} == {f.stem for f in story.files[:6]}
    children = client.search_runs([run.info.experiment_id], f"tags.mlflow.parentRunId = '{training_id}'")
    assert len(children) == 5  # zero, and two families under two selectors
    assert set(run.data.params["families"].split(", ")) == {c.data.params["family"] for c in children}
    for child in children:
        options = FAMILIES[child.data.params["family"]]().options()
        assert {k: child.data.params[f"option.{k}"] for k in options} == {k: str(v) for k, v in options.items()}
    loaded = tracking.load_training(training_id, store).result
    pd.testing.assert_frame_equal(loaded.scores, story.steps["better"].results["z"].scores)


def test_simulated_is_said_everywhere(story: Story, store: Any) -> None:
    outcome = story.steps["better"]
    assert outcome.simulated
    for table in (outcome.results["z"].cells, outcome.results["z"].batches):
        assert table["simulated"].all()
    client = client_of(store)
    assert client.get_run(outcome.training_ids["z"]).data.tags["simulated"] == "true"
    assert client.get_registered_model(MODEL).tags["simulated"] == "true"
    assert client.get_model_version(MODEL, "2").description.startswith("SIMULATED. ")
    assert "simulated" in outcome.report.read_text(encoding="utf-8").split("<script", 1)[0].lower()
    status = registry.status(store)
    assert status[status["name"] == MODEL]["simulated"].all()


def test_the_report_lies_where_it_was_asked_for(story: Story, home: Path) -> None:
    assert story.steps["better"].report == story.folder / "out" / "better.html"
    assert story.steps["zero"].report.parent == home / "reports"
    assert NAME in story.steps["better"].report.read_text(encoding="utf-8")


def test_the_champion_predicts_a_raw_file(story: Story, store: Any, tmp_path: Path) -> None:
    table = pd.read_csv(story.files[3])
    table.drop(columns=["x", "z"]).to_csv(tmp_path / "20250915.csv", index=False)
    got = predict_file(f"models:/{MODEL}/2", tmp_path / "20250915.csv", store)
    assert len(got) == len(table)
    assert np.abs(got["predicted_um"] - law_um(table)).max() < 1.5
    assert got["simulated"].all()


def test_the_next_command_needs_no_mlflow_to_find_the_champion(story: Story, store: Any) -> None:
    place = story.steps["known"].place(MODEL, "champion")
    assert place == story.steps["known"].place(MODEL, "2")
    version = client_of(store).get_model_version(MODEL, "2")
    folder = registry.version_folder(version.source, version.tags, store)
    assert Path(place.folder) == folder and place.sha256


def test_progress_is_said(story: Story) -> None:
    said = story.steps["said"]
    assert said[:2] == ["ingest in", "features and selectors of 6 batches"]
    assert said[2:5] == ["grid", "trust", "track"] and "promote" in said and "report" in said


def test_without_promotion_any_protocol_will_do(story: Story, store: Any) -> None:
    plan = Plan(("none",), ("zero", "ridge"), ("train-on-one",))
    outcome = train(TrainRequest(story.machine, targets=("x",), plan=plan, promote=False), store, DirectCaller())
    assert not outcome.promotions and outcome.report is not None and outcome.report.exists()
    with pytest.raises(InputError, match="got train-on-one, but promotion judges by forward, leave-season-out"):
        train(TrainRequest(story.machine, targets=("x",), plan=plan), store, DirectCaller())


def test_two_batches_train_and_one_does_not(home: Path, store: Any, tmp_path: Path) -> None:
    machine = write_machine(tmp_path / "m.yml", "small-two")
    files = write_year(tmp_path / "in", 2)
    plan = Plan(("none",), ("zero", "ridge"), ("leave-batch-out",))
    with pytest.raises(InputError, match=r"got 1 batch\(es\), \d+, need at least 2; ingest more recordings"):
        train(TrainRequest(machine, (files[0],), ("z",), plan), store, DirectCaller())
    outcome = train(TrainRequest(machine, (files[1],), ("z",), plan), store, DirectCaller())
    promotion = outcome.promotions["z"]
    assert (promotion.outcome, promotion.champion_version) == ("challenger", None)
    assert promotion.caution == "not shown to be better than no model (2 batches in common, need at least 5)"


def test_few_runs_are_counted_and_the_largest_error_comes_first(
    home: Path, store: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = write_machine(tmp_path / "m.yml", "small-few")
    write_year(tmp_path / "in", 4)
    plan = Plan(("none",), ("zero", "ridge"), ("forward", "leave-batch-out"))
    request = TrainRequest(machine, (tmp_path / "in",), ("x", "z"), plan, report=tmp_path / "r.html")
    outcome = train(request, store, DirectCaller())
    print_training(outcome)
    few = "a champion needs at least 9 runs, there are 4"
    first, second = capsys.readouterr().out.splitlines()[:2]
    assert first.startswith("z: ") and second.startswith("x: ") and few in first and few in second
    assert list(training_dict(outcome)["expected"]) == ["z", "x"]
    sentences = re.findall(r'<p class="lead">(.*?)</p>', (tmp_path / "r.html").read_text())
    assert [f" A{few[1:]}." in s for s in sentences] == [True, True]
    details = (tmp_path / "r.txt").read_text()
    assert details.count("* ridge") == 2 and details.index("small-few z") < details.index("small-few x")
    with pytest.raises(InputError, match=f"has no champion: .*{few}; `predict`") as refused:
        load_model("models:/small-few-z@champion", store)
    usable = str(refused.value).rpartition("--model ")[2]
    assert load_model(usable, store).family.target == "z" and f"(--model {usable})" in first


def test_a_batch_without_a_usable_target_does_not_train_for_ever(home: Path, store: Any, tmp_path: Path) -> None:
    """What cannot teach is not new either."""
    machine = write_machine(tmp_path / "m.yml", "small-masked")
    files = write_year(tmp_path / "in", 4)
    table = pd.read_csv(files[3])
    table["z"] = ""
    table.to_csv(files[3], index=False)
    request = TrainRequest(machine, (tmp_path / "in",), ("z",), ZERO, only_if_new=True)
    first = train(request, store, DirectCaller())
    assert len(first.results["z"].batches) == 3
    assert "batch 20250414 is left out: no usable z" in set(first.results["z"].excluded["reason"])
    assert train(request, store, DirectCaller()).stopped


def test_an_empty_lake_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = write_machine(tmp_path / "m.yml", "nobody")
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    from data.machine import load_machine

    with pytest.raises(InputError, match=r"no batch of machine 'nobody'; it is empty\. Run thermodrift ingest first"):
        load_batches(Lake(tmp_path / "home" / "lake"), load_machine(machine))
