from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data.errors import InputError
from data.machine import load_machine
from models.families import FAMILIES as REGISTERED
from models.protocols import PromotionRule
from models.selection.crossing import Plan, prepare, refit
from models.selection.grid import run_grid
from models.selection.loss import cost_of_choosing, paired, pooled
from models.selection.promotion import choose
from models.selection.race import _noise_um, drive, rounds
from models.selection.stack import Stack, weights_of

FAMILIES = ("zero", "mean_curve", "mlr", "ridge", "pls", "huber", "distributed_lag", "stack")
PLAN = Plan(families=FAMILIES, effort="quick")


@pytest.fixture(scope="module")
def raced(toy_batches):
    return run_grid(toy_batches(12), ["z"], PLAN)["z"]


def test_only_the_finalists_are_scored_by_all_folds_and_the_others_say_why_not(raced) -> None:
    crossing, result = raced
    run = result.cells.groupby(["selector", "family", "n_tsp"])["protocol"].nunique()
    everywhere = run[run == result.cells["protocol"].nunique()].index
    race = result.race
    last = race[(race["round"] == "runs") & race["kept"]]
    kept = {*last[["selector", "family", "n_tsp"]].itertuples(index=False, name=None)}
    assert {(s, f, n) for s, f, n in everywhere if f != "stack"} == kept
    assert len(kept) <= crossing.plan.finalists + 2  # and the baselines
    assert set(race["family"]) == set(FAMILIES) - {"stack"} and (race["kept"] == (race["why"] == "")).all()
    assert list(dict.fromkeys(race["round"])) == ["families", "points", "runs"]
    assert not set(result.cells["protocol"]) & {"train-on-one", "forward-gap"}


def test_the_race_says_what_every_family_cost_in_every_round(raced) -> None:
    race = raced[1].race
    assert (race["cpu_s"] > 0).all() and (race.groupby(["round", "family"])["cpu_s"].nunique() == 1).all()


def test_the_race_finds_what_the_whole_crossing_finds(raced, toy_batches) -> None:
    complete = run_grid(toy_batches(12), ["z"], Plan(families=FAMILIES, effort="complete"))["z"][1]
    rule = PromotionRule()
    quick, best = choose(raced[1], rule), choose(complete, rule)
    assert quick.S_mean_um <= 1.05 * best.S_mean_um
    assert len(raced[1].scores) < len(complete.scores) / 5


def test_named_selectors_and_families_are_crossed_whole(toy_batches) -> None:
    crossing = prepare(toy_batches(6), "z", Plan(("none", "correlation"), ("zero", "mlr"), effort="quick"))
    (zero, mlr) = next(rounds(crossing))
    assert crossing.plan.finalists == 0 and len(mlr.cells) == 1 + len(crossing.design.inputs)
    assert zero.cells == (("none", 0),)


def test_a_stack_is_a_weighted_sum_of_its_members_fitted_on_everything(raced) -> None:
    crossing, result = raced
    members = result.stack
    assert 2 <= len(members) <= 5 and members["family"].is_unique and (members["weight"] >= 0).all()
    model = refit(crossing, "stack", "stack", len(crossing.design.inputs), members)
    each = [refit(crossing, s, f, n) for s, f, n in members[["selector", "family", "n_tsp"]].itertuples(index=False)]
    batch = crossing.batches[3]
    want = np.column_stack([m.predict(batch) for m in each]) @ members["weight"].to_numpy()
    np.testing.assert_allclose(model.predict(batch), want, atol=1e-9)


def test_a_forward_run_is_predicted_by_weights_that_do_not_know_it(toy_batches) -> None:
    """Another error of the last runs changes their own prediction by no weight, only that of nothing after them."""
    batches = toy_batches(12)
    predicted = []
    for offset_um in (0.0, 50.0):
        changed = [b if k < 11 else b.__class__(b.machine, b.batch_id, b.table.assign(z=b.table["z"] * (1 + offset_um)),
                   b.channels, start=b.start) for k, b in enumerate(batches)]  # fmt: skip
        plan = Plan(("none",), ("zero", "mlr", "ridge", "distributed_lag", "stack"), ("forward",))
        result = run_grid(changed, ["z"], plan)["z"][1]
        raced = next(iter(result.cells.query("family == 'stack'")["S_mean_um"]))
        predicted.append(result.scores.query("family == 'stack'").set_index("batch_id")["S_um"].iloc[:-1])
        assert np.isfinite(raced)
    np.testing.assert_allclose(predicted[0], predicted[1], rtol=1e-9)


def test_weights_follow_the_records_until_runs_are_known() -> None:
    families = ["lag_dictionary", "ridge"]
    first = weights_of([], families)
    assert first.sum() == pytest.approx(1.0) and first[0] > 3 * first[1]
    rng = np.random.default_rng(0)
    runs = []
    for _ in range(12):
        bad, good = 20 * rng.standard_normal(50), 20 * rng.standard_normal(50)
        runs.append((good + rng.standard_normal(50), np.column_stack([bad, good])))
    learned = weights_of(runs, families)
    assert learned[0] < 0.05 and learned[1] == pytest.approx(1.0, abs=0.05)


def test_the_cost_of_choosing_grows_with_the_number_of_cells_and_the_scatter() -> None:
    rng = np.random.default_rng(1)
    luck = []
    for _ in range(400):  # of 30 equal cells the best looks better than the reference by about its cost
        S_um = 10.0 + rng.standard_normal((30, 16))
        cells = [("fcgc", "mlr", n) for n in range(1, 30)] + [("none", "mlr", 30)]
        cost = cost_of_choosing(S_um, cells, {})
        best = int(np.argmin(S_um.mean(axis=1)[:-1]))
        luck.append(S_um[best].mean() + cost[best] - S_um[-1].mean())
    assert cost[-1] == 0.0 and (cost[:-1] > 0).all()
    assert np.mean(luck) > -0.1 and np.mean(luck) < 0.5
    few = cost_of_choosing(S_um[-3:], cells[-3:], {})
    assert few[0] < cost[-3]


def test_pooling_follows_the_record_for_few_runs_and_the_runs_for_many() -> None:
    own = np.array([4.0, 4.4])
    few, share = pooled(own, ["ridge", "lag_dictionary"], 2)
    many, _ = pooled(own, ["ridge", "lag_dictionary"], 200)
    assert few[1] < few[0] and many[0] < many[1] and share == pytest.approx(0.2)
    np.testing.assert_array_equal(pooled(own, ["ridge", "pls"], 2, record_runs=0.0)[0], own)


def test_paired_differences_have_the_standard_error_of_their_mean() -> None:
    d = np.array([[1.0, 2.0, 3.0, 6.0]])
    mean, se = paired(d, np.zeros(4))
    assert mean[0] == 3.0 and se[0] == pytest.approx(np.std(d, ddof=1) / 2)


def test_a_stack_with_more_weights_than_members_is_refused() -> None:
    with pytest.raises(InputError, match="stack: got 1 members and 2 weights"):
        Stack([("mlr", ["a"])], [0.5, 0.5])


@pytest.mark.parametrize("noise_um", [0.0, 1000.0])
def test_networks_enter_a_quick_race_only_where_others_leave_much(toy_batches, monkeypatch, noise_um):
    monkeypatch.setattr("models.selection.race._noise_um", lambda design: noise_um)
    quick, usual = Plan(effort="quick").suited(None), Plan(effort="usual").suited(None)
    assert set(quick.late) == {f for f in usual.families if "torch" in REGISTERED[f].packages} and not usual.late
    assert {"bp", "lstm", "gru", "tcn"} <= set(quick.late) and quick.suited(None) == quick
    assert not Plan(families=("gru",), effort="quick").suited(None).late
    plan = Plan(("correlation",), ("zero", "mlr", "ridge", "gru"), effort="quick", late=("gru",), finalists=4)
    crossing = prepare(toy_batches(6), "z", plan)
    raced = drive({"z": crossing}, lambda jobs: [job.run(crossing) for job in jobs])["z"]
    assert ("gru" in set(raced.race["family"])) == (noise_um == 0.0)
    assert ("family gru" in dict(raced.result.failures)) == (noise_um > 0.0)


def test_the_twin_and_selectors_that_train_networks_enter_a_quick_race_late(toy_batches, monkeypatch):
    machine = load_machine(Path(__file__).parents[2] / "machines" / "sample_vmc.yml")
    quick, usual = (Plan(effort=effort).suited(machine) for effort in ("quick", "usual"))
    twins = {f for f in usual.families if REGISTERED[f].needs_twin}
    assert twins and twins < set(quick.late) and quick.late_selectors == ("main_factor_bp",)
    assert not usual.late and not usual.late_selectors and quick.suited(machine) == quick
    assert not Plan(("main_factor_bp",), effort="quick").suited(machine).late_selectors
    monkeypatch.setattr("models.selection.race._noise_um", lambda design: 1000.0)
    plan = Plan(families=("zero", "mlr", "ridge"), effort="quick")
    crossing = prepare(toy_batches(6), "z", plan)
    raced = drive({"z": crossing}, lambda jobs: [job.run(crossing) for job in jobs])["z"]
    assert "selector main_factor_bp" in dict(raced.result.failures)
    assert "main_factor_bp" not in set(raced.race["selector"]) and "fcgc" in set(raced.race["selector"])


def test_the_noise_of_an_error_is_known_from_its_second_differences():
    time_s, rng = np.arange(400.0), np.random.default_rng(0)
    y_um = 30.0 * (1.0 - np.exp(-time_s / 100.0)) + rng.normal(0.0, 0.5, 400)
    assert _noise_um(SimpleNamespace(y_um=y_um, group=np.repeat([0, 1], 200))) == pytest.approx(0.5, rel=0.1)
