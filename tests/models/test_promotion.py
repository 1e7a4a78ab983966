from __future__ import annotations

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from data.errors import InputError
from models.protocols import PromotionRule, forward, leave_batch_out
from models.selection import promotion
from models.selection.promotion import choose, compare_paired, left_out, pick, sign_flip_p
from models.selection.result import GridResult
from tests.toys.training import toy_batches, toy_result

RULE = PromotionRule(record_runs=0)


RANKS = {"zero": 0, "mean_curve": 1, "mlr": 10, "ridge": 20, "lag_dictionary": 30, "stack": 60}


def scored(
    cells: dict[str, dict[str, list[float]]], groups: dict[str, list[str]] | None = None, parameters: int = 5
) -> GridResult:
    """A result of cells ``selector|family|n_tsp`` with S by protocol of the runs b0, b1, …; `groups`: folds."""
    rows, summary, n = [], [], max(len(s) for own in cells.values() for s in own.values())
    ids = [f"b{i}" for i in range(n)]
    for label, own in cells.items():
        selector, family, points = label.split("|")
        for protocol, S_um in own.items():
            keys = {"protocol": protocol, "selector": selector, "family": family, "n_tsp": int(points)}
            folds = (groups or {}).get(protocol, ids)
            rows += [{**keys, "fold": f, "batch_id": b, "S_um": v} for f, b, v in zip(folds, ids, S_um, strict=False)]
            summary.append({
                **keys, "S_mean_um": np.mean(S_um), "S_std_um": np.std(S_um, ddof=1), "n_batches": len(S_um),
                "n_parameters": parameters, "rank": RANKS[family], "tsp_stability": 1.0,
                "inputs": "|".join(f"t{i}" for i in range(int(points))), "n_inputs": int(points),
            })  # fmt: skip
    batches = pd.DataFrame({"batch_id": ids, "digest": ids})
    return GridResult("toy", "z", False, batches, pd.DataFrame(rows), pd.DataFrame(summary), *(4 * [pd.DataFrame()]))


def by_lbo(**cells: list[float]) -> GridResult:
    """Cells ``none_mlr_4`` with S by leave-batch-out, next to no model with 20 µm."""
    n = len(next(iter(cells.values())))
    own = {re.sub(r"_(?=\d)|(?<=^none)_|(?<=^fcgc)_|(?<=^stack)_", "|", name): {"leave-batch-out": S_um}
           for name, S_um in cells.items()}  # fmt: skip
    return scored({"none|zero|0": {"leave-batch-out": [20.0] * n}, **own})


SPREAD = [-0.6, 0.6, -0.3, 0.3, 0.0, 0.0]


def test_the_least_expected_loss_wins_and_says_what_no_model_has():
    got = choose(by_lbo(none_mlr_4=[3.0] * 6, fcgc_ridge_4=[4.0] * 6), RULE)
    assert (got.cell, got.score_um, got.standing) == ("none|mlr|4", 3.0, "champion")
    assert "expected loss 3.00 µm" in got.summary and "zero has 20.00 µm" in got.summary


@pytest.mark.parametrize(
    ("other", "behind_um", "winner"),
    [
        ("fcgc_ridge_3", 0.05, "fcgc|ridge|3"),  # fewer inputs; with the cost of choosing 0.17 µm, standard error 0.19
        ("fcgc_mlr_4", 0.1, "fcgc|mlr|4"),  # same inputs, simpler family
        ("fcgc_ridge_3", 0.3, "none|ridge|4"),
        ("fcgc_stack_4", 0.1, "none|ridge|4"),  # more than the best: no tie in its favour
    ],
)
def test_ties_within_a_standard_error_go_to_the_simpler(other: str, behind_um: float, winner: str):
    cells = {"none_ridge_4": [4.0] * 6, other: [4.0 + behind_um + d for d in SPREAD]}
    assert choose(by_lbo(**cells), RULE).cell == winner
    assert choose(by_lbo(**dict(reversed(cells.items()))), RULE).cell == winner
    at_once = choose(by_lbo(**cells), RULE.model_copy(update={"ties_se": 0.0}))
    assert at_once.cell == "none|ridge|4"


def test_of_few_runs_the_record_on_other_machines_decides_of_many_the_runs_do():
    """lag_dictionary left the least on other machines; here it is 10 % behind."""
    few = by_lbo(none_ridge_4=[4.0] * 4, none_lag_dictionary_4=[4.4] * 4)
    many = by_lbo(none_ridge_4=[4.0] * 60, none_lag_dictionary_4=[4.4] * 60)
    rule = PromotionRule(protocols={"leave-batch-out": 1.0}, ties_se=0.0)
    assert choose(few, rule).family == "lag_dictionary" and choose(many, rule).family == "ridge"
    assert choose(few, rule.model_copy(update={"record_runs": 0.0})).family == "ridge"


def test_a_stack_is_kept_only_where_it_is_better_beyond_a_standard_error():
    stack = [3.9 + d for d in SPREAD]
    assert choose(by_lbo(none_ridge_4=[4.0] * 6, stack_stack_4=stack), RULE).family == "ridge"
    assert choose(by_lbo(none_ridge_4=[4.5] * 6, stack_stack_4=stack), RULE).family == "stack"


def test_a_baseline_wins_only_where_nothing_beats_it_and_is_refused():
    got = promotion.decide(by_lbo(none_mlr_4=[22.0] * 6), RULE)
    assert (got.family, got.standing, got.trusted) == ("zero", "refused", False)
    assert "nothing beats zero (best other: 22.00 µm): no trustworthy model" in got.summary


def test_only_the_rules_protocols_count_and_a_missing_one_is_reported():
    result = scored({
        "none|zero|0": {"leave-batch-out": [20.0] * 4, "train-on-one": [20.0] * 4},
        "none|mlr|4": {"leave-batch-out": [3.0] * 4, "train-on-one": [3.0] * 4},
        "none|ridge|4": {"leave-batch-out": [5.0] * 4, "train-on-one": [0.1] * 4},
    })  # fmt: skip
    assert choose(result, RULE).family == "mlr"
    with pytest.raises(
        InputError, match="by leave-batch-out, train-on-one, expected one of its protocols leave-season"
    ):
        choose(result, RULE.only("leave-season-out"))


def test_a_run_predicted_from_earlier_ones_counts_most():
    def both(later: float, near: float) -> dict[str, list[float]]:
        return {"forward": [later] * 6, "leave-batch-out": [near] * 6}

    cells = {"none|zero|0": both(20, 20), "none|mlr|4": both(14, 4), "none|ridge|4": both(11, 9)}
    got = choose(scored(cells), RULE)
    assert (got.family, got.protocol) == ("ridge", "forward")
    assert got.score_um == pytest.approx((6 * 11 + 0.25 * 6 * 9) / (6 + 0.25 * 6))
    assert choose(scored(cells), RULE.only("leave-batch-out")).family == "mlr"


def test_a_season_of_two_runs_does_not_outvote_eighteen_later_runs():
    """Weighted by runs, and pooled: of the two runs' excess a third counts."""
    seasons = ["warm"] * 18 + ["cold"] * 2
    own = {"forward": [10.0] * 18, "leave-season-out": [10.0] * 18 + [60.0] * 2}
    safe = {"forward": [12.0] * 18, "leave-season-out": [12.0] * 20}
    none = {"forward": [20.0] * 18, "leave-season-out": [20.0] * 20}
    result = scored({"none|zero|0": none, "none|mlr|4": own, "none|ridge|4": safe}, {"leave-season-out": seasons})
    got = choose(result, RULE)
    assert got.family == "mlr"
    alone = choose(result, RULE.model_copy(update={"group_runs": 0.0}))
    assert alone.score_um == pytest.approx((18 * 10 + 0.25 * (18 * 10 + 2 * 60)) / (18 + 0.25 * 20))
    assert got.score_um < alone.score_um


def test_a_cell_that_not_all_protocols_scored_is_not_chosen():
    cells = {
        "none|zero|0": {"forward": [20.0] * 6, "leave-batch-out": [20.0] * 6},
        "none|mlr|4": {"leave-batch-out": [1.0] * 6},
        "none|ridge|4": {"forward": [11.0] * 6, "leave-batch-out": [6.0] * 6},
    }
    assert choose(scored(cells), RULE).family == "ridge"


def test_choosing_among_many_cells_costs_their_family():
    """Each of eight cells is bad on one run: the standard error of a difference is large, and so is the cost."""
    lucky = {f"fcgc|mlr|{n}": {"leave-batch-out": [3.0] * (n - 1) + [11.0] + [3.0] * (8 - n)} for n in range(1, 9)}
    steady = {"none|ridge|9": {"leave-batch-out": [5.2] * 8}, "none|zero|0": {"leave-batch-out": [20.0] * 8}}
    result = scored(lucky | steady)
    table = promotion.judged(result, RULE).set_index("family")
    cost_um = table.loc["mlr"].set_index("n_tsp")["choosing_um"]
    assert table.loc["ridge", "choosing_um"] == 0.0 == cost_um[8]  # the reference has all points
    assert cost_um[1] == pytest.approx(stats.norm.ppf(7.625 / 8.25) * np.std([8.0, -8.0] + [0.0] * 6, ddof=1) / 8**0.5)


@pytest.mark.parametrize(
    ("S_um", "standing"),
    [([2.0] * 6, "champion"), ([2.0] * 4 + [7.5] * 2, "provisional"), ([2.0] * 3 + [7.5] * 3, "refused")],
)
def test_between_champion_and_refused_stands_provisional(S_um: list[float], standing: str):
    result = by_lbo(none_mlr_4=S_um)
    zero = result.scores["family"] == "zero"
    result.scores.loc[zero, "S_um"] = 6.0
    got = promotion.decide(result, RULE)
    assert got.standing == standing and got.trusted == (standing == "champion")
    assert (got.caution == "") == (standing == "champion")


def test_the_authority_is_the_least_share_that_is_not_shown_to_be_worse():
    """The true error is 0.6 of what the model predicts, with noise."""
    rng = np.random.default_rng(0)
    runs = []
    for k in range(8):
        predicted = np.linspace(0.0, 30.0, 40)
        recorded = 0.6 * predicted + 0.5 * rng.standard_normal(40)
        runs.append(pd.DataFrame({"protocol": "leave-batch-out", "fold": f"b{k}", "batch_id": f"b{k}",
                                  "recorded_um": recorded, "predicted_um": predicted}))  # fmt: skip
    choice = choose(by_lbo(none_mlr_4=[2.0] * 6), RULE)
    assert promotion.authority(pd.concat(runs), choice) == pytest.approx(0.6, abs=0.051)
    assert promotion.authority(pd.DataFrame(), choice) == 0.5


def test_a_cell_chosen_by_hand():
    result = by_lbo(none_mlr_4=[7.0] * 6)
    assert pick(result, RULE, "none|mlr|4").score_um == pytest.approx(7.0)
    with pytest.raises(InputError, match=r"unknown cell 'none\|mlr\|5'.* none\|mlr\|4"):
        pick(result, RULE, "none|mlr|5")


def test_sign_flip_p_is_the_count_of_sign_patterns():
    d = np.array([0.5, -0.2, 1.0, 0.4, 0.0, 0.7, -0.1])
    by_hand = np.mean([np.dot(signs, d) >= d.sum() - 1e-12 for signs in product([1, -1], repeat=7)])
    assert sign_flip_p(d) == by_hand
    scipys = stats.permutation_test(
        (d,), np.mean, permutation_type="samples", alternative="greater", n_resamples=np.inf
    )
    assert sign_flip_p(d) == pytest.approx(scipys.pvalue)
    assert sign_flip_p(np.full(5, 1.0)) == 1 / 32


def test_sign_flip_p_of_many_batches_is_near_students():
    d = np.random.default_rng(3).normal(0.4, 1.0, 40)
    assert sign_flip_p(d) == pytest.approx(stats.ttest_1samp(d, 0, alternative="greater").pvalue, abs=0.005)
    assert sign_flip_p(d) == sign_flip_p(d.copy())


def series(S_um: list[float], digest: str = "d", first: int = 0) -> pd.DataFrame:
    ids = [f"b{i + first}" for i in range(len(S_um))]
    table = pd.DataFrame({"batch_id": ids, "digest": [digest + i for i in ids], "S_um": S_um})
    return table.assign(protocol="leave-batch-out")


def test_a_newcomer_better_on_every_batch_replaces():
    got = compare_paired(series([4, 5, 6, 4, 5, 6]), series([5, 6.1, 7, 5.2, 6, 7]), RULE)
    assert got.better
    assert (got.n_batches, got.n_better, got.p_value) == (6, 6, 1 / 64)
    assert got.difference_um == pytest.approx(1.05)
    ref = stats.t.interval(0.9, 5, loc=1.05, scale=stats.sem([1, 1.1, 1, 1.2, 1, 1]))
    assert (got.low_um, got.high_um) == pytest.approx(ref)
    assert "the newcomer replaces the champion" in got.words


def test_of_several_protocols_a_batch_counts_once_with_their_weighted_mean():
    forward = [series(S_um).assign(protocol="forward") for S_um in ([9.0] * 3, [8.0] * 3)]
    new = pd.concat([series([4.0] * 6), forward[0]])
    old = pd.concat([series([5.0] * 6), forward[1], series([1.0] * 6).assign(protocol="leave-season-out")])
    got = compare_paired(new, old, RULE)
    later = (1.0 * -1 + 0.25 * 1) / 1.25
    assert (got.n_batches, got.n_better, got.difference_um) == (6, 3, pytest.approx((3 * later + 3 * 1) / 6))


def test_four_batches_show_nothing():
    result = toy_result(toy_batches("toy-trust", 4), {"none|zero|0": [9.0] * 4, "none|mlr|2": [1.0] * 4})
    assert promotion.decide(result, RULE).caution == (
        "not shown to be better than no model (4 batches in common, need at least 5)"
    )


@pytest.mark.parametrize(("runs", "ordered", "needed"), [(4, True, 9), (8, True, 9), (9, True, 0), (4, False, 5)])
def test_how_many_runs_a_champion_needs(runs, ordered, needed):
    rule = PromotionRule()
    assert rule.few(runs, ordered) == (f"a champion needs at least {needed} runs, there are {runs}" if needed else "")
    batches = [replace(b, start=pd.Timestamp("2026-01-01") + pd.Timedelta(days=k))
               for k, b in enumerate(toy_batches("toy-few", max(runs, needed)))]  # fmt: skip
    tested = sum(len(f.test) for f in (forward if ordered else leave_batch_out)(batches))
    assert tested >= rule.least_tested and promotion.sign_flip_p(np.ones(tested)) <= rule.significance
    assert rule.least_tested == rule.min_batches == 5 and rule.model_copy(update={"min_batches": 2}).least_tested == 5
    assert promotion.sign_flip_p(np.ones(4)) > rule.significance


def test_a_mixed_newcomer_does_not():
    got = compare_paired(series([4, 7, 6, 4, 7, 6]), series([5, 6, 7, 5, 6, 7]), RULE)
    assert not got.better
    assert "not shown to be better, the champion stays" in got.words


def test_only_the_same_batches_count():
    new, old = series([1.0] * 9), series([9.0] * 9)
    old.loc[5:, "digest"] = "another content"
    assert compare_paired(new, old, RULE).n_batches == 5
    old.loc[4:, "digest"] = "another content"
    few = compare_paired(new, old, RULE)
    assert not few.better
    assert few.words == "4 batches in common, need at least 5: the champion stays"
    assert compare_paired(new, series([9.0] * 3, first=20), RULE).n_batches == 0
    new.loc[0, "S_um"] = np.nan
    assert compare_paired(new, series([9.0] * 9), RULE).n_batches == 8


def test_left_out_gives_the_scores_with_their_digests():
    batches = toy_batches("toy-left-out", 3)
    result = toy_result(batches, {"none|mlr|2": [1, 2, 3], "none|zero|0": [9, 9, 9]})
    got = left_out(result, RULE, "none", "mlr", 2)
    assert got["S_um"].tolist() == [1, 2, 3]
    assert got["digest"].tolist() == [b.digest for b in batches]


def _many_lucky_cells(seed: int, cells: int, gain_um: float) -> GridResult:
    """K batches, `cells` cells whose S is that of doing nothing plus luck, and one that is truly better."""
    rng = np.random.default_rng(seed)
    lucky = {f"correlation|mlr|{c}": 10.0 + 2.0 * rng.standard_normal(8) - (gain_um if c == 1 else 0.0)
             for c in range(1, cells + 1)}  # fmt: skip
    return scored({k: {"leave-batch-out": S_um} for k, S_um in {"none|zero|0": [10.0] * 8, **lucky}.items()})


@pytest.mark.slow
def test_the_nested_score_takes_the_flattery_out_of_choosing() -> None:
    rule = PromotionRule(ties_se=0)
    choices = [promotion.decide(_many_lucky_cells(seed, 15, 0.0), rule) for seed in range(30)]
    assert np.mean([c.S_mean_um for c in choices]) < 9.4  # luck looks like most of a µm
    assert np.mean([c.nested_S_mean_um for c in choices]) == pytest.approx(10.0, abs=0.4)  # nothing was gained


@pytest.mark.slow
def test_a_lucky_winner_is_not_trusted_and_a_true_one_is() -> None:
    rule = PromotionRule(ties_se=0)
    lucky = [promotion.decide(_many_lucky_cells(s, 15, 0.0), rule) for s in range(10)]
    true = [promotion.decide(_many_lucky_cells(s, 15, 6.0), rule) for s in range(10)]
    assert sum(not c.trusted for c in lucky) >= 3 and all(
        "no trustworthy model" in c.summary for c in lucky if not c.trusted
    )
    assert all(c.trusted and c.nested_S_mean_um == pytest.approx(c.S_mean_um) for c in true)


def test_without_the_batch_in_question_the_choice_is_made_by_hand() -> None:
    result = _many_lucky_cells(3, 5, 0.0)
    rule = PromotionRule(ties_se=0)
    got = promotion.score_of_choice(result, rule).set_index("batch_id")
    s = result.scores.pivot(index="n_tsp", columns="batch_id", values="S_um")
    for batch in s.columns:
        others = s.drop(columns=batch)
        best = others.mean(axis=1).idxmin()
        assert got.loc[batch, "cell"].endswith(f"|{best}") and got.loc[batch, "S_um"] == s.loc[best, batch]


def test_equal_points_are_one_model_and_go_by_the_plainest_name() -> None:
    got = choose(by_lbo(fcgc_mlr_3=[2.0] * 6, none_mlr_3=[2.0] * 6), RULE)
    assert got.cell == "none|mlr|3"
    assert "simpler" not in got.summary
