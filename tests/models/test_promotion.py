from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from data.errors import InputError
from models import promotion
from models.promotion import choose, compare_paired, left_out, pick, sign_flip_p
from models.protocols import PromotionRule
from models.result import GridResult
from tests.toys.training import toy_batches, toy_result

RULE = PromotionRule()


def cells(*rows: tuple) -> pd.DataFrame:
    """(selector, family, n_tsp, S_mean, S_std, stability, rank, n_parameters)"""
    names = ["selector", "family", "n_tsp", "S_mean_um", "S_std_um", "tsp_stability", "rank", "n_parameters"]
    table = pd.DataFrame(rows, columns=names)
    table["protocol"], table["n_batches"], table["max_abs_um"] = "leave-batch-out", 9, 3 * table["S_mean_um"]
    table["n_inputs"] = table["n_tsp"]
    table["inputs"] = ["|".join(f"t{i}" for i in range(n)) for n in table["n_tsp"]]
    return table


ZERO = ("none", "zero", 0, 20.0, 5.0, 1.0, 0, 0)


def test_least_mean_plus_spread_wins_not_least_mean():
    got = choose(
        cells(ZERO, ("none", "mlr", 4, 3.0, 4.0, 1.0, 10, 5), ("fcgc", "ridge", 4, 4.0, 1.0, 1.0, 20, 5)), RULE
    )
    assert got.cell == "fcgc|ridge|4"
    assert got.score_um == 5.0
    assert got.trusted
    assert "S_mean 4.00 + S_std 1.00 = 5.00 µm" in got.summary
    assert "zero has 25.00 µm" in got.summary


def test_an_unstable_set_of_points_is_passed_over():
    got = choose(cells(ZERO, ("fcgc", "mlr", 2, 1.0, 1.0, 0.5, 10, 3), ("none", "mlr", 4, 3.0, 1.0, 1.0, 10, 5)), RULE)
    assert got.cell == "none|mlr|4"
    alone = choose(cells(ZERO, ("fcgc", "mlr", 2, 1.0, 1.0, 0.5, 10, 3)), RULE)
    assert alone.cell == "fcgc|mlr|2"
    assert not alone.trusted
    assert "no set of points is stable (best 0.50, required 0.7): no trustworthy model" in alone.summary


@pytest.mark.parametrize(
    ("other", "winner"),
    [
        (("fcgc", "ridge", 3, 4.05, 1.0, 1.0, 20, 9), "fcgc|ridge|3"),  # fewer inputs
        (("fcgc", "mlr", 4, 4.05, 1.0, 1.0, 10, 9), "fcgc|mlr|4"),  # same inputs, simpler family
        (("fcgc", "ridge", 4, 4.05, 1.0, 1.0, 20, 2), "fcgc|ridge|4"),  # same family, fewer parameters
        (("fcgc", "ridge", 3, 4.15, 1.0, 1.0, 20, 2), "none|ridge|4"),  # 3 % worse is no tie
    ],
)
def test_a_tie_goes_to_the_simpler(other, winner):
    table = cells(ZERO, ("none", "ridge", 4, 4.0, 1.0, 1.0, 20, 5), other)
    assert choose(table, RULE).cell == winner
    assert choose(table.iloc[::-1], RULE).cell == winner


def test_a_baseline_wins_only_where_nothing_beats_it_and_is_not_trusted():
    got = choose(cells(ZERO, ("none", "mlr", 4, 22.0, 9.0, 1.0, 10, 5)), RULE)
    assert got.family == "zero"
    assert not got.trusted
    assert "nothing beats zero (best other: 31.00 µm): no trustworthy model" in got.summary
    # A tie in the tolerance does not hand the place to a baseline.
    close = choose(cells(("none", "zero", 0, 5.05, 0.0, 1.0, 0, 0), ("none", "mlr", 4, 5.0, 0.0, 1.0, 10, 5)), RULE)
    assert close.family == "mlr"


def test_only_the_rules_protocol_counts_and_a_missing_one_is_told():
    table = cells(ZERO, ("none", "mlr", 4, 3.0, 1.0, 1.0, 10, 5))
    lucky = cells(("none", "ridge", 4, 0.1, 0.1, 1.0, 20, 5)).assign(protocol="train-on-one")
    assert choose(pd.concat([table, lucky]), RULE).family == "mlr"
    with pytest.raises(InputError, match="by leave-batch-out, expected one of its protocols leave-season"):
        choose(table, RULE.only("leave-season-out"))


def by_protocol(**S_mean_um: float) -> pd.DataFrame:
    """Cells of two families under two protocols: S_mean without spread, and no model with 20 µm."""
    parts = []
    for protocol in ("forward", "leave-batch-out"):
        rows = [
            ("none", f.split("_")[0], 4, s, 0.0, 1.0, 20, 5) for f, s in S_mean_um.items() if f.endswith(protocol[0])
        ]
        parts.append(cells(("none", "zero", 0, 20.0, 0.0, 1.0, 0, 0), *rows).assign(protocol=protocol))
    return pd.concat(parts)


def test_the_worst_protocol_decides():
    table = by_protocol(mlr_f=14.0, mlr_l=4.0, ridge_f=11.0, ridge_l=6.0)
    got = choose(table, RULE)
    assert (got.family, got.protocol, got.score_um) == ("ridge", "forward", 11.0)
    assert choose(table, RULE.only("leave-batch-out")).family == "mlr"


def test_weights_and_the_mean_of_the_protocols():
    table = by_protocol(mlr_f=14.0, mlr_l=4.0, ridge_f=11.0, ridge_l=9.0)
    mean = PromotionRule(combine="mean", protocols={"forward": 1.0, "leave-batch-out": 3.0})
    assert choose(table, mean).family == "mlr" and choose(table, mean).score_um == pytest.approx((14 + 3 * 4) / 4)
    heavy = PromotionRule(protocols={"forward": 1.0, "leave-batch-out": 10.0})
    assert (choose(table, heavy).family, choose(table, heavy).protocol) == ("mlr", "leave-batch-out")


def test_a_cell_that_failed_under_one_protocol_is_not_chosen():
    table = by_protocol(mlr_l=1.0, ridge_f=11.0, ridge_l=6.0)
    assert choose(table, RULE).family == "ridge"


def test_points_must_be_stable_under_every_protocol():
    table = by_protocol(mlr_f=3.0, mlr_l=3.0, ridge_f=11.0, ridge_l=6.0)
    table.loc[(table["family"] == "mlr") & (table["protocol"] == "forward"), "tsp_stability"] = 0.5
    assert choose(table, RULE).family == "ridge"


def test_other_scores():
    table = cells(ZERO, ("none", "mlr", 4, 3.0, 4.0, 1.0, 10, 5), ("fcgc", "ridge", 4, 4.0, 1.0, 1.0, 20, 5))
    assert choose(table, PromotionRule(score="S_mean")).family == "mlr"
    assert choose(table, PromotionRule(score="max_abs")).score_um == 9.0


def test_a_cell_chosen_by_hand():
    table = cells(ZERO, ("none", "mlr", 4, 3.0, 4.0, 1.0, 10, 5))
    assert pick(table, RULE, "none|mlr|4").score_um == 7.0
    with pytest.raises(InputError, match=r"unknown cell 'none\|mlr\|5'.* none\|mlr\|4"):
        pick(table, RULE, "none|mlr|5")


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


def test_of_several_protocols_a_batch_counts_once_with_its_worst():
    forward = [series(S_um).assign(protocol="forward") for S_um in ([9.0] * 3, [8.0] * 3)]
    new = pd.concat([series([4.0] * 6), forward[0]])
    old = pd.concat([series([5.0] * 6), forward[1], series([1.0] * 6).assign(protocol="leave-season-out")])
    got = compare_paired(new, old, RULE)
    assert (got.n_batches, got.n_better, got.difference_um) == (6, 3, pytest.approx((3 * -1 + 3 * 1) / 6))
    mean = compare_paired(new, old, PromotionRule(combine="mean"))
    assert (mean.n_better, mean.difference_um) == (3, pytest.approx((3 * 0 + 3 * 1) / 6))


@pytest.mark.parametrize(("better", "trusted"), [(5, True), (3, False)])
def test_a_model_is_trustworthy_where_it_is_shown_to_beat_the_baselines(better: int, trusted: bool):
    batches = toy_batches("toy-trust", 5)
    S_um = [2.0] * better + [6.5] * (5 - better)
    result = toy_result(batches, {"none|zero|0": [6.0] * 5, "none|mlr|2": S_um, "none|mean_curve|0": [9.0] * 5})
    got = promotion.decide(result, PromotionRule(score="S_mean"))
    assert (got.family, got.trusted) == ("mlr", trusted)
    if not trusted:
        assert got.caution.startswith("not shown to be better than zero (S 3.80 against 6.00 µm over 5 batches")
        assert got.summary.endswith("better on 3 of 5, p = 0.125 > 0.05): no trustworthy model")


def test_four_batches_show_nothing():
    result = toy_result(toy_batches("toy-trust", 4), {"none|zero|0": [9.0] * 4, "none|mlr|2": [1.0] * 4})
    assert promotion.decide(result, RULE).caution == (
        "not shown to be better than zero (4 batches in common, need at least 5)"
    )


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
    ids = [f"b{i}" for i in range(8)]
    rows, summary = [], []
    for c in range(cells + 1):
        family, selector = ("zero", "none") if c == 0 else ("mlr", "correlation")
        s = np.full(8, 10.0) if c == 0 else 10.0 + 2.0 * rng.standard_normal(8) - (gain_um if c == 1 else 0.0)
        keys = {"protocol": "leave-batch-out", "selector": selector, "family": family, "n_tsp": c}
        rows += [
            {**keys, "fold": b, "batch_id": b, "S_um": v, "max_abs_um": 2 * v} for b, v in zip(ids, s, strict=True)
        ]
        summary.append({
            **keys, "S_mean_um": s.mean(), "S_std_um": s.std(ddof=1), "max_abs_um": 2 * s.max(), "n_batches": 8,
            "n_parameters": c, "rank": 10, "tsp_stability": 1.0, "inputs": "a", "n_inputs": c, "simulated": False,
        })  # fmt: skip
    empty, batches = pd.DataFrame(), pd.DataFrame({"batch_id": ids, "digest": ids})
    return GridResult("toy", "z", False, batches, pd.DataFrame(rows), pd.DataFrame(summary), *(4 * [empty]))


@pytest.mark.slow
@pytest.mark.slow
def test_the_nested_score_takes_the_flattery_out_of_choosing() -> None:
    rule = PromotionRule(tie_percent=0, score="S_mean")
    choices = [promotion.decide(_many_lucky_cells(seed, 15, 0.0), rule) for seed in range(30)]
    assert np.mean([c.S_mean_um for c in choices]) < 9.2  # luck looks like a µm
    assert np.mean([c.nested_S_mean_um for c in choices]) == pytest.approx(10.0, abs=0.4)  # nothing was gained


@pytest.mark.slow
def test_a_lucky_winner_is_not_trusted_and_a_true_one_is() -> None:
    rule = PromotionRule(tie_percent=0, score="S_mean")
    lucky = [promotion.decide(_many_lucky_cells(s, 15, 0.0), rule) for s in range(10)]
    true = [promotion.decide(_many_lucky_cells(s, 15, 6.0), rule) for s in range(10)]
    assert sum(not c.trusted for c in lucky) >= 3 and all(
        "no trustworthy model" in c.summary for c in lucky if not c.trusted
    )
    assert all(c.trusted and c.nested_S_mean_um == pytest.approx(c.S_mean_um) for c in true)


def test_without_the_batch_in_question_the_choice_is_made_by_hand() -> None:
    result = _many_lucky_cells(3, 5, 0.0)
    rule = PromotionRule(tie_percent=0)
    got = promotion.score_of_choice(result, rule).set_index("batch_id")
    s = result.scores.pivot(index="n_tsp", columns="batch_id", values="S_um")
    for batch in s.columns:
        others = s.drop(columns=batch)
        best = (others.mean(axis=1) + others.std(axis=1)).idxmin()
        assert got.loc[batch, "cell"].endswith(f"|{best}") and got.loc[batch, "S_um"] == s.loc[best, batch]


def test_equal_points_are_one_model_and_go_by_the_plainest_name() -> None:
    table = cells(("fcgc", "mlr", 3, 2.0, 1.0, 1.0, 10, 4), ("none", "mlr", 3, 2.0, 1.0, 1.0, 10, 4), ZERO)
    got = choose(table, RULE)
    assert got.cell == "none|mlr|3"
    assert "simplest" not in got.summary
