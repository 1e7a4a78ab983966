from __future__ import annotations

import re
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
import pandas as pd
import pytest

from compensation.faults import FaultCost
from data.errors import InputError
from models.families import FAMILIES
from models.protocols import PromotionRule
from models.selection.promotion import Choice, choose, decide
from models.selection.trust import Region
from pipelines.commands.predict import load_model
from pipelines.commands.registry import _print_overview as printed
from pipelines.commands.registry import overview
from pipelines.commands.status import _print_models as print_models
from pipelines.store import audit, registry, tracking
from tests.toys.tracked import client_of, log_training, newcomer
from tests.toys.training import GAIN_UM_PER_K, machine_yaml, toy_batches, toy_model, toy_result


def train(store, machine: str, S_um: list[float], *, force: bool = False, **more: Any):
    """Log and promote a training over len(S_um) batches."""
    return registry.promote(newcomer(store, machine, S_um, **more), store, force=force)


def aliases(store, name: str) -> dict[str, int]:
    return {a: int(v) for a, v in client_of(store).get_registered_model(name).aliases.items()}


@pytest.fixture(scope="module")
def story(store):
    """First model, a better one, a worse one."""
    worse = [5.0, 6.0, 5.5, 6.5, 5.0, 6.0]
    better = [*(s - 1 for s in worse), 5.0]
    return [train(store, "toy-story", s) for s in (worse, better, [9.0] * 8)]


def test_the_first_becomes_champion(story):
    assert (story[0].outcome, story[0].version, story[0].name) == ("champion", 1, "toy-story-z")
    assert "first champion of this machine and channel" in story[0].summary


def test_a_better_one_replaces_it_and_the_old_one_is_tagged(story, store):
    assert (story[1].outcome, story[1].version) == ("champion", 2)
    assert story[1].comparison is not None
    assert story[1].comparison.n_batches == 6  # the seventh is new, and the champion was never tried on it
    client = client_of(store)
    assert client.get_model_version("toy-story-z", "2").tags["replaces"] == "1"
    ends = registry.status(store).set_index(["name", "version"]).loc["toy-story-z", "was_champion_until"]
    assert ends[1] and not ends[2]


def test_a_worse_one_is_challenger_with_the_reason(story, store):
    assert (story[2].outcome, story[2].version, story[2].champion_version) == ("challenger", 3, 2)
    assert (story[2].against, story[2].obstacle, story[2].forced) == (2, "", False)
    assert "not shown to be better, the champion stays" in story[2].summary
    tags = client_of(store).get_model_version("toy-story-z", "3").tags
    assert "not shown to be better" in tags["reason"]
    assert tags["simulated"] == "true"
    assert aliases(store, "toy-story-z") == {"champion": 2, "challenger": 3}


def test_what_became_of_it_is_kept_with_the_training(story, store):
    table = tracking.trainings("toy-story", "z", store)
    assert table["promotion"].tolist() == ["challenger", "champion", "champion"]
    kept = tracking.load_training(table["training_id"][0], store).promotion
    assert kept["comparison"]["n_batches"] == 7
    assert kept["words"] == story[2].summary


def test_status_lists_every_version(story, store):
    table = registry.status(store)
    table = table[table["name"] == "toy-story-z"]
    assert table["version"].tolist() == [3, 2, 1]
    assert table["aliases"].tolist() == ["challenger", "champion", ""]
    assert table["n_batches"].tolist() == [8, 7, 6]
    assert table["simulated"].all()


def test_an_overview_reads_only_what_stands_and_the_newest_version(story, store, monkeypatch):
    table = registry.status(store)
    own = table[table["name"] == "toy-story-z"]
    monkeypatch.setattr(registry, "versions_by_model", None)  # whose cost grows with the history
    shown = registry.status(store, history=False)
    shown = shown[shown["name"] == "toy-story-z"]
    stands = (own["aliases"] != "") | (own["version"] == own["version"].max())
    assert len(own) > stands.sum() == len(shown)
    pd.testing.assert_frame_equal(shown.reset_index(drop=True), own[stands].reset_index(drop=True))


def test_the_same_again_changes_nothing(store):
    first = train(store, "toy-same", [5.0] * 6)
    again = train(store, "toy-same", [5.0] * 6)
    assert (again.outcome, again.version) == ("unchanged", first.version)
    assert "nothing new registered" in again.summary
    commented = train(store, "toy-same", [5.0] * 6, yaml=machine_yaml("toy-same") + "# a remark\n")
    assert commented.outcome == "unchanged"
    other = train(store, "toy-same", [5.0] * 6, yaml=machine_yaml("toy-same") + "description: other\n")
    assert (other.outcome, other.version) == ("challenger", 2)


def test_an_interrupted_registration_is_done_again(store, monkeypatch):
    train(store, "toy-cut", [5.0] * 6)
    with monkeypatch.context() as cut:
        cut.setattr(registry.MlflowClient, "set_registered_model_alias", _power_cut)
        with pytest.raises(OSError, match="power cut"):
            train(store, "toy-cut", [4.0] * 7)
    again = train(store, "toy-cut", [4.0] * 7)
    assert (again.outcome, again.version) == ("champion", 2)  # goes on with the version that is there
    assert registry.rollback("toy-cut-z", store).version == 1


def _power_cut(*_: object) -> None:
    raise OSError("power cut")


def test_too_few_batches_in_common_keep_the_champion(store):
    train(store, "toy-few", [5.0] * 4)
    got = train(store, "toy-few", [1.0] * 9)
    assert got.outcome == "challenger"
    assert "4 batches in common, need at least 5: the champion stays" in got.summary


def test_the_champions_own_prediction_counts_on_batches_new_to_it(store):
    train(store, "toy-unseen", [5.0] * 4)
    got = train(store, "toy-unseen", [1.0] * 9, batches_given=True)
    assert got.comparison is not None
    assert got.comparison.n_batches == 9
    # The toy law is exact, so the champion's S on its five new batches is 0.
    assert got.comparison.old_S_mean_um == pytest.approx(4 * 5 / 9, abs=1e-6)
    assert "(5 of them new to the champion)" in got.summary


def test_by_force(store):
    train(store, "toy-force", [5.0] * 6)
    beaten = train(store, "toy-force", [9.0] * 7)
    assert beaten.outcome == "challenger"
    forced = train(store, "toy-force", [9.0] * 7, force=True)
    assert (forced.version, forced.champion_version) == (2, 2)
    assert aliases(store, "toy-force-z") == {"champion": 2}
    assert registry.rollback("toy-force-z", store).version == 1


def test_roll_back_goes_to_the_version_before_and_no_further(store):
    train(store, "toy-back", [5.0, 6.0, 5.0, 6.0, 5.0, 6.0])
    train(store, "toy-back", [4.0, 5.0, 4.0, 5.0, 4.0, 5.0, 4.0])
    client = client_of(store)
    experiment = client.get_experiment_by_name("toy-back z").experiment_id

    def shown() -> tuple[list[bool], str]:
        """Which trainings have the star of the champion in MLflow's list, the newest first, and the note's claim."""
        runs = client.search_runs([experiment], "tags.kind = 'training'")
        note = client.get_experiment(experiment).tags["mlflow.note.content"]
        return [r.info.run_name.startswith("★ ") for r in runs], note.partition(",")[0]

    assert shown() == ([True, False], "★ Champion: version 2")
    back = registry.rollback("toy-back-z", store)
    assert back.version == 1
    assert aliases(store, "toy-back-z")["champion"] == 1
    assert shown() == ([False, True], "★ Champion: version 1")
    assert client.get_model_version("toy-back-z", "2").tags["rolled_back"] == "true"
    ends = registry.status(store).set_index(["name", "version"]).loc["toy-back-z", "was_champion_until"]
    assert ends[2] and not ends[1]
    with pytest.raises(InputError, match="no version was champion before version 1 and not rolled back"):
        registry.rollback("toy-back-z", store)
    with pytest.raises(InputError, match="unknown model 'toy-bakc-z'; did you mean 'toy-back-z'"):
        registry.rollback("toy-bakc-z", store)


def test_the_logged_model_has_no_pickle_and_predicts_through_plain_mlflow(story, store):
    """Held against the law that the toy batches follow."""
    folder = mlflow.artifacts.download_artifacts(
        artifact_uri=client_of(store).get_model_version("toy-story-z", "2").source,
        tracking_uri=store.store_uri,
    )
    names = {p.name for p in Path(folder).rglob("*") if p.is_file()}
    assert {"model.json", "arrays.npz", "machine.yml", "pyfunc_model.py", "requirements.txt"} <= names
    assert not [n for n in names if n.endswith((".pkl", ".pickle", ".joblib"))]
    mlflow.set_tracking_uri(store.store_uri)
    loaded = mlflow.pyfunc.load_model("models:/toy-story-z@champion")
    table = toy_batches("toy-story", 7)[3].table
    got = loaded.predict(table[["time_s", "front", "bed"]])
    front, bed = (table[c] - table[c].iloc[0] for c in ("front", "bed"))
    assert np.allclose(got["predicted_um"], GAIN_UM_PER_K[0] * front + GAIN_UM_PER_K[1] * bed, atol=1e-6)
    assert not got["outside_region"].any()
    whole = table[["time_s", "front", "bed"]].round().astype(int).assign(speed=3000)  # as pandas reads whole numbers
    assert np.isfinite(loaded.predict(whole)["predicted_um"]).all()
    null = table[["time_s", "front", "bed"]].assign(front=[*table["front"][:-1], np.nan])
    last = loaded.predict(null).iloc[-1]
    assert np.isnan(last["predicted_um"]) and last["outside_region"]
    assert loaded.metadata.signature.inputs.input_names() == ["time_s", "front", "bed", "speed", "batch_id"]


def test_a_registered_model_that_was_changed_is_refused_whatever_it_says_of_itself(store):
    train(store, "toy-changed", [5.0, 6.0] * 3)
    load_model("models:/toy-changed-z@champion", store)
    client = client_of(store)
    source = client.get_model_version("toy-changed-z", "1").source
    file = Path(registry.local_folder(source, store)) / "artifacts" / "model.json"
    file.write_text(file.read_text().replace('"n_batches": 6', '"n_batches": 9'))
    with pytest.raises(InputError, match=r"model\.json is not the one that was registered \(sha256"):
        load_model("models:/toy-changed-z@champion", store)
    load_model(str(file.parent), store)  # a folder has no registry to be held against


def test_a_changed_loader_of_a_registered_model_is_refused(store):
    train(store, "toy-loader", [5.0, 6.0] * 3)
    load_model("models:/toy-loader-z@champion", store)
    client = client_of(store)
    source = client.get_model_version("toy-loader-z", "1").source
    file = Path(registry.local_folder(source, store)) / "pyfunc_model.py"
    file.write_text(file.read_text() + "\n")
    with pytest.raises(InputError, match=r"not a stored model as it was promoted \(pyfunc_model\.py has sha256"):
        load_model("models:/toy-loader-z@champion", store)


def test_a_choice_that_is_not_to_be_trusted_says_so(store):
    batches = toy_batches("toy-zero", 6)
    result = toy_result(batches, {"none|zero|0": [5.0] * 6, "none|mlr|2": [9.0] * 6})
    choice: Choice = choose(result, store.promotion)
    from models.families.baselines import Zero

    zero, training_id = Zero().fit(batches, (), "z"), log_training(result, store)
    new = registry.Newcomer(result, choice, zero, machine_yaml("toy-zero"), training_id, Region.of([], ()))
    got = registry.promote(new, store)
    assert not got.trusted
    assert "nothing beats zero (best other: 9.00 µm): no trustworthy model" in got.summary
    assert (got.outcome, got.version, got.champion_version) == ("challenger", 1, None)
    assert aliases(store, "toy-zero-z") == {"challenger": 1}
    row = registry.status(store).set_index("name").loc["toy-zero-z"]
    assert not row["trusted"] and row["reason"] == "no trustworthy model, nothing beats zero (best other: 9.00 µm)"
    lacking = r"has no champion: no trustworthy model, nothing beats zero .* such as --model models:/toy-zero-z/1$"
    with pytest.raises(InputError, match=lacking):
        registry.find_version(client_of(store), "toy-zero-z", "champion")
    again = registry.promote(new, store)
    assert (again.outcome, again.version, again.champion_version) == ("unchanged", 1, None)
    assert registry.promote(new, store, force=True).champion_version == 1


def test_a_newcomer_that_is_not_trustworthy_never_replaces_a_champion(store):
    train(store, "toy-doubt", [5.0] * 6)
    batches = toy_batches("toy-doubt", 7)
    result = toy_result(batches, {"none|zero|0": [4.5] * 7, "none|mlr|2": [1.0] * 3 + [4.6] * 4})
    choice = decide(result, PromotionRule())
    model, region = toy_model(batches)
    new = registry.Newcomer(result, choice, model, machine_yaml("toy-doubt"), log_training(result, store), region)
    got = registry.promote(new, store)
    assert got.comparison is not None and got.comparison.better and not got.trusted
    assert (got.outcome, got.champion_version) == ("challenger", 1)


PROVISIONAL = {"standing": "provisional", "authority": 0.6, "caution": "not shown to be better than zero"}


def test_a_provisional_version_stands_in_until_there_is_a_champion(store):
    client, name = client_of(store), "toy-maybe-z"
    refused = train(store, "toy-maybe", [5.0] * 6, standing="refused", caution="not shown to be better than zero")
    assert (refused.outcome, refused.standing) == ("challenger", "refused")
    first = train(store, "toy-maybe", [5.0] * 6, **PROVISIONAL)  # the same data, judged by another rule
    assert (first.outcome, first.version, first.champion_version) == ("provisional", 2, None)
    assert (
        "version 2 is provisional: better than no model, not shown beyond doubt; it sends 60 % of its correction"
        in first.summary
    )
    assert train(store, "toy-maybe", [5.0] * 6, **PROVISIONAL).outcome == "unchanged"
    with pytest.raises(
        InputError, match=r"has no champion: .*take provisional version 2: --model models:/toy-maybe-z$"
    ):
        registry.find_version(client, name, "champion")
    assert train(store, "toy-maybe", [5.0] * 7, **PROVISIONAL).outcome == "provisional"
    assert aliases(store, name) == {"challenger": 1, "provisional": 3}
    info = load_model(f"models:/{name}@provisional", store).info
    assert (info["standing"], info["authority"]) == ("provisional", 0.6)
    row = registry.status(store).set_index(["name", "version"]).loc[(name, 3)]
    assert (row["aliases"], row["standing"]) == ("provisional", "provisional")
    shown = overview(client, [audit.read(client.get_registered_model(name))])
    assert (shown["provisional"][0], shown["champion"].isna()[0]) == (3, True)
    assert train(store, "toy-maybe", [4.0] * 8).outcome == "champion"
    assert aliases(store, name) == {"champion": 4}
    late = train(store, "toy-maybe", [5.0] * 9, **PROVISIONAL)
    assert (late.outcome, late.champion_version) == ("challenger", 4)
    assert aliases(store, name) == {"champion": 4, "challenger": 5}


def test_a_name_alone_is_the_provisional_version_until_there_is_a_champion(store, tmp_path, monkeypatch, call):
    monkeypatch.setenv("THERMODRIFT_HOME", str(store.home))
    monkeypatch.chdir(tmp_path)
    train(store, "toy-name", [5.0] * 7, **PROVISIONAL)
    Path("in").mkdir()
    toy_batches("toy-name", 2)[1].table.to_csv("in/run.csv", index=False)
    commands = [["predict", "in/run.csv", "--out", "out.csv"], ["rehearse", "--recordings", "in", "--sample-s", "60"],
                ["export", "--to", "json", "--out", "export"]]  # fmt: skip
    for command in commands:
        done = call(*command, "--model", "models:/toy-name-z")
        named = [line for line in (done.out + done.err).splitlines() if "provisional model" in line]
        assert done.code == 0 and len(named) == 1, done
        if command[0] != "export":
            assert (done.err if command[0] == "predict" else done.out).startswith("SIMULATED ")
        done = call(*command, "--model", "models:/toy-name-z@champion")
        assert (done.code, done.out) == (2, "")
        lacking = (
            r"better than no model, not shown beyond doubt; it sends 60 % of its .*, not shown to be better than zero"
        )
        usable = "`predict`, `rehearse` and `export` take provisional version 1: --model models:/toy-name-z\n"
        assert re.search(f"has no champion: {lacking}; {usable}", done.err)
    assert call("export", "models:/toy-name-z", "--out", "again").code == 0
    assert [p.suffix for p in sorted(Path("again").iterdir())] == [".c", ".h"], "C without --to"
    done = call("compensate", "models:/toy-name-z", "--from", "in/run.csv", "--replay")
    assert done.code == 2 and "is provisional: better than no model in most" in done.err
    done = call("export", "--to", "json")
    assert (done.code, "export: got no model; give --model models:/NAME" in done.err) == (2, True)
    train(store, "toy-name", [4.0] * 8)
    assert "provisional" not in call("predict", "in/run.csv", "--out", "out.csv", "--model", "models:/toy-name-z").err
    assert load_model("models:/toy-name-z", store).standing == "champion"


def test_a_training_that_refuses_every_model_ends_the_provisional_one(store):
    refused = {"standing": "refused", "caution": "not shown to be better than zero"}
    assert train(store, "toy-ends", [5.0] * 6, **PROVISIONAL).outcome == "provisional"
    assert train(store, "toy-ends", [5.0] * 7, **refused).outcome == "challenger"
    assert aliases(store, "toy-ends-z") == {"challenger": 2}


def test_badges_of_a_provisional_version_are_printed(store, capsys):
    train(store, "toy-badge", [5.0] * 6, **PROVISIONAL)
    client = client_of(store)
    printed(overview(client, [audit.read(client.get_registered_model("toy-badge-z"))]))
    assert capsys.readouterr().out.startswith("toy-badge-z: no champion; version 1 is provisional")
    table = registry.status(store)
    print_models(table[table["name"] == "toy-badge-z"].to_dict("records"))
    line = capsys.readouterr().out
    assert "toy-badge-z/1 provisional: " in line and "no trustworthy model" not in line


def test_the_error_to_expect_leads_the_tags(story, store):
    tags = client_of(store).get_model_version("toy-story-z", "2").tags
    assert (tags["expected_by"], float(tags["expected_S_um"])) == ("leave-batch-out", pytest.approx(33 / 7))
    assert 5.5 < float(tags["expected_S_bound90_um"]) < 11 and "optimistic" in tags["expected"]
    row = registry.status(store).set_index(["name", "version"]).loc["toy-story-z", 2]
    assert row["expected_S_um"] == pytest.approx(33 / 7)


@pytest.fixture(scope="module")
def stacked(store):
    """Four champions, the last two by force."""
    for worse, more, force in ((1.0, 0, False), (0.0, 1, False), (9.0, 2, True), (8.0, 3, True)):
        train(store, "toy-stack", [4.0 + worse, 5.0 + worse] * 3 + [5.0] * more, force=force)
    return client_of(store)


def test_roll_backs_walk_down_and_never_return_to_what_was_rolled_back(store, stacked):
    name = "toy-stack-z"
    assert aliases(store, name)["champion"] == 4
    assert [registry.rollback(name, store).version for _ in range(2)] == [3, 2]
    assert "champion is version 2, not 3; nothing changed" in registry.rollback(name, store, of=3).summary
    assert registry.rollback(name, store, of=2).version == 1
    with pytest.raises(InputError, match="no version was champion before version 1"):
        registry.rollback(name, store)
    train(
        store, "toy-stack", [12.0, 13.0] * 3 + [5.0] * 3, force=True
    )  # a promotion makes it champion again: as version 4 was: the same batches and cell
    assert aliases(store, name)["champion"] == 4
    assert registry.rollback(name, store).version == 1


def test_an_interrupted_roll_back_is_finished_by_the_next_and_goes_no_further(store):
    name = "toy-half-z"
    for k in range(3):
        train(store, "toy-half", [9.0 - k] * (6 + k), force=True)
    with pytest.MonkeyPatch.context() as patch:

        def killed(*_: Any) -> None:
            raise KeyboardInterrupt

        patch.setattr(audit, "finish", killed)
        with pytest.raises(KeyboardInterrupt):
            registry.rollback(name, store)
    assert aliases(store, name)["champion"] == 2
    again = registry.rollback(name, store)
    assert (again.version, aliases(store, name)["champion"]) == (2, 2)
    assert "the roll-back of version 3 is finished" in again.summary
    client = client_of(store)
    assert client.get_model_version(name, "3").tags["rolled_back"] == "true"
    assert registry.rollback(name, store).version == 1


def test_a_clock_that_was_set_back_is_named_and_orders_nothing_anew(store):
    def at(day: str) -> Any:
        patch = pytest.MonkeyPatch()
        patch.setattr(audit, "now", lambda: audit.datetime.fromisoformat(f"2026-{day}T09:00+00:00"))
        return patch

    for day, runs in (("04-10", 6), ("03-11", 7)):
        patch = at(day)
        train(store, "toy-clock", [9.0] * runs, force=True)
        patch.undo()
    log = audit.read(client_of(store).get_registered_model("toy-clock-z"))
    assert [r.version for r in log.champions(audit.span_of("2026-03-20"))] == []
    last = log.champions(audit.span_of("2026-05-01"))
    assert [r.version for r in last] == [2]
    assert "the clock showed 2026-03-11" in last[0].note and "since when is not certain" in last[0].note


def test_a_model_that_a_failed_sensor_can_ruin_is_no_champion_where_a_budget_says_so(store, monkeypatch):
    cost = FaultCost({"front": 9.0, "bed": 2.0}, 12, 3, "front: a drift of 1 K/h", 55.0)
    monkeypatch.setattr(registry.fitted_model, "faults_of", lambda family, batches, substitutes: cost)
    within = replace(store, promotion=store.promotion.model_copy(update={"fault_budget_um": 60.0}))
    above = replace(store, promotion=store.promotion.model_copy(update={"fault_budget_um": 50.0}))
    refused = train(above, "toy-dear", [5.0, 6.0] * 3)
    assert (refused.outcome, refused.champion_version) == ("challenger", None)
    assert "a fault of a sensor costs 55 µm (front: a drift of 1 K/h), more than fault_budget_um" in refused.summary
    taken = train(within, "toy-dear", [5.0, 6.0] * 3 + [5.0])
    assert taken.outcome == "champion" and taken.faults == f"{cost.summary}; every model that was judged reads front"
    tags = client_of(store).get_model_version("toy-dear-z", "2").tags
    assert tags["worst_fault"] == "front: a drift of 1 K/h" and tags["worst_fault_um"] == "55.0"
    assert tags["sensor_um_per_K"] == '{"front": 9.0, "bed": 2.0}'
    assert load_model("models:/toy-dear-z@champion", store).info["faults"]["missed"] == 3


def test_what_a_model_without_the_sensor_of_the_dearest_fault_costs_and_saves_is_stated(store):
    """A model of the front alone cannot have its sensor exchanged with that of the bed."""
    batches = toy_batches("toy-spared", 6)
    more_um = np.array([0.2, 0.9, 0.4, 0.1, 0.6, 0.2])
    result = toy_result(batches, {
        "none|zero|0": [50.0] * 6, "none|mlr|2": [1.0, 2.0] * 3, "fcgc|mlr|1": more_um + [1.0, 2.0] * 3,
        "fcgc|ridge|1": [9.0] * 6,
    })  # fmt: skip
    choice, (both, region) = replace(choose(result, store.promotion), authority=1.0), toy_model(batches)
    assert choice.cell == "none|mlr|2"
    new = registry.Newcomer(
        result, choice, both, machine_yaml("toy-spared"), log_training(result, store), region, batches
    )
    assert new.faults is not None and new.faults.worst == "bed and front: exchanged"
    alone = FAMILIES["mlr"]().fit(batches, ("front",), "z")
    cost = registry.fitted_model.faults_of(alone, batches, registry.fitted_model.guarded(alone, batches))
    said = registry.promote(new, store).faults
    assert said.startswith(new.faults.summary)
    assert said.endswith(
        f"; without bed, mlr on 1 point by fcgc leaves {more_um.mean():.2g} ± {more_um.std(ddof=1) / 6**0.5:.2g} µm "
        f"more, and its dearest fault costs {cost.worst_um:.3g} µm"
    )


def test_a_model_states_the_range_of_a_package_of_an_extra_that_is_not_installed(monkeypatch):
    def installed(package):
        if package == "onnxruntime":
            raise PackageNotFoundError(package)
        return "1.2+cpu"

    monkeypatch.setattr(registry, "installed", installed)
    stated = registry._requirements(FAMILIES["ridge"]())
    assert stated[:3] == ["mlflow==1.2", "numpy==1.2", "pandas==1.2"]
    assert re.fullmatch(r"onnxruntime[<>=.,\d]+", stated[3])
