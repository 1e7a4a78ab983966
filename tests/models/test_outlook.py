"""The error to expect in the next season."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from models.protocols import PromotionRule
from models.selection.outlook import outlook
from models.selection.promotion import pick
from models.selection.result import GridResult
from tests.toys.training import toy_batches, toy_result

RULE = PromotionRule()


def trained(forward: list[float], near: float = 2.0, n: int = 6) -> GridResult:
    """A cell of S = `near` left out one by one, and forward S of the last batches; two seasons, alternating."""
    result = toy_result(toy_batches("toy-outlook", n), {"none|zero|0": [30.0] * n, "none|mlr|2": [near] * n})
    labels = result.batches.assign(season=["cold", "warm"] * (n // 2), speed="2000 rpm")
    later = result.scores[result.scores["family"] == "mlr"].tail(len(forward)).assign(protocol="forward", S_um=forward)
    later["fold"] = [f"{i // 2}" for i in range(len(forward))]
    cell = result.cells[result.cells["family"] == "mlr"]
    cell = cell.assign(protocol="forward", S_mean_um=np.mean(forward), S_std_um=np.std(forward, ddof=1))
    return GridResult(
        result.machine, "z", True, labels, pd.concat([result.scores, later]), pd.concat([result.cells, cell]),
        result.subsets, result.predictions, result.findings, result.excluded,
    )  # fmt: skip


def chosen(result: GridResult):
    return outlook(result, pick(result, RULE.only(result.cells["protocol"].iloc[-1]), "none|mlr|2"))


def test_it_leads_with_forward_and_then_leave_batch_out() -> None:
    got = chosen(trained([2.0, 2.4, 2.2, 2.6]))
    assert (got.protocol, got.n_runs, got.S_um) == ("forward", 4, pytest.approx(2.3))
    assert got.summary == (
        f"expected error next season: S 2.30 ± 0.26 µm, 90 % of runs below {got.bound_um:.2f} µm (forward, 4 runs); "
        f"leave-batch-out 2.00 ± 0.00 µm; {got.kept}"
    )
    assert 2.6 < got.bound_um < 2 * 2.6


def test_what_earlier_blocks_promised_stands_next_to_what_later_ones_held() -> None:
    got = chosen(trained([2.0, 2.4, 2.2, 9.0]))
    assert got.kept == (
        "promised from earlier runs S 2.20 µm, held 5.60 ± 4.81 µm; 1 of 2 later runs below the promised bound"
    )
    assert chosen(trained([2.0, 2.4])).kept == ""


def test_much_worse_is_said_first_and_names_the_season_that_fails() -> None:
    got = chosen(trained([2.0, 9.0, 2.0, 11.0]))
    assert got.summary.startswith(
        "later runs fail: S 6.0 µm forward in time, 2.0 µm where only the run itself is left out; "
        "worst in season warm (10.0 µm, runs: 2); expected error next season: S 6.00 ± 4.69 µm"
    )


def test_with_one_season_and_speed_the_block_is_named() -> None:
    result = trained([2.0, 2.0, 9.0, 11.0])
    result.batches["season"] = "warm"
    assert "worst in block 1 (10.0 µm, runs: 2)" in chosen(result).warning


def test_without_forward_the_number_is_called_optimistic_with_the_reason() -> None:
    result = toy_result(toy_batches("toy-outlook", 6), {"none|zero|0": [30.0] * 6, "none|mlr|2": [2.0] * 6})
    result.excluded.loc[0] = ["forward", "6 of 6 batches have no start time (first: b00)"]
    got = chosen(result)
    assert got.protocol == "leave-batch-out" and got.note == (
        "optimistic: no later run was predicted from earlier ones (6 of 6 batches have no start time (first: b00))"
    )
    assert "by leave-batch-out: S 2.00 ± 0.00 µm" in got.summary and got.kept == ""


def test_where_choosing_costs_the_nested_score_comes_first() -> None:
    result = trained([2.0, 2.4, 2.2, 2.6])
    choice = replace(pick(result, RULE.only("forward"), "none|mlr|2"), nested_S_mean_um=4.6, nested_S_std_um=1.5)
    got, own = outlook(result, choice), chosen(result)
    assert (got.S_um, got.cell_S_um, got.bound_um) == pytest.approx((4.6, 2.3, 2.0 * own.bound_um))
    assert "season: S 4.60 ± 1.50 µm" in got.summary and "flattered by the choice, 2.30 µm" in got.summary
    assert outlook(result, replace(choice, nested_S_mean_um=2.2)).S_um == pytest.approx(2.3)
