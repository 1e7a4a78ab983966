"""Weight products against sums by hand, planted main factors, the gate, and error channels that add up."""

import numpy as np
import pandas as pd
import pytest
from stacked_rows import LENGTHS, orthonormal, stack, year

from data.arrays import Array
from data.batch import Batch, Channel
from features.design import Design
from features.nets import Nets
from features.selectors.main_factor_bp import MainFactorBP, held_out, weight_products

TRAIN = [0, 1, 3, 4]


def test_products_by_hand() -> None:
    # w (h, p) = [[1, 2], [3, −4]], b = 9 9, v = [0.5, −1], c = 7: Σ_j w_ij v_j = (0.5 − 3, 1 + 4)
    nets = Nets(np.array([[1.0, 2, 3, -4, 9, 9, 0.5, -1, 7]]), n_inputs=2, n_hidden=2)
    np.testing.assert_allclose(weight_products(nets), [[2.5, 5.0]])


def planted() -> Design:
    """An error of three uncorrelated inputs, weights 1, −0.6 and 0.3, bent a little; three more do nothing."""
    q = orthonormal(sum(LENGTHS), 6, seed=7) * 10
    q /= np.abs(q).max(axis=0)
    return stack(q, np.tanh(0.8 * (q[:, 4] - 0.6 * q[:, 1] + 0.3 * q[:, 3])), LENGTHS)


def test_planted_main_factors_come_in_their_order() -> None:
    selector = MainFactorBP(gate=0.0)
    got = selector.select_design(planted(), TRAIN, [1, 2, 3])
    assert got == {1: ("t4",), 2: ("t1", "t4"), 3: ("t1", "t3", "t4")}
    found = selector.sensitivity(planted(), TRAIN)
    share = (found.mean / found.mean.max())[np.argsort(found.columns)]
    weight = planted().stacked(TRAIN)[0].std(axis=0) * [0, 0.6, 0, 0.3, 1, 0]
    np.testing.assert_allclose(share, weight / weight.max(), atol=0.12)


def test_only_inputs_behind_the_gate_enter_and_others_follow_by_correlation() -> None:
    design = stack(*year(), LENGTHS)
    x, y, _ = design.stacked(TRAIN)
    r = np.abs(np.corrcoef(np.column_stack([x, y]), rowvar=False)[-1, :-1])
    gate = float(np.sort(r)[3:5].mean())  # three pass
    selector = MainFactorBP(gate=gate)
    found = selector.sensitivity(design, TRAIN)
    assert set(found.columns) == set(np.flatnonzero(r > gate)) and found.of_start.shape == (20, 3)
    got = selector.select_design(design, TRAIN, [3, 4, 5])
    ranked = [f"t{i}" for i in np.argsort(-r)]
    assert set(got[3]) == set(ranked[:3]) and set(got[4]) == set(ranked[:4]) and set(got[5]) == set(ranked[:5])
    assert MainFactorBP(gate=1.0).sensitivity(design, TRAIN).columns.size == 0


def with_two_channels(targets: dict[str, Array]) -> list[Batch]:
    design = planted()
    names = [*design.inputs, *targets]
    channels = {n: Channel(n, "error", "um") if n in targets else Channel(n, "temperature", "degC") for n in names}
    out = []
    for k in range(design.n_batches):
        rows = design.rows(k)
        columns = {"time_s": design.time_s[rows]} | {n: design.x[rows, i] + 20 for i, n in enumerate(design.inputs)}
        table = pd.DataFrame(columns | {n: y[rows] for n, y in targets.items()})
        out.append(Batch("lathe", f"b{k}", table, channels))
    return out


def test_sensitivity_is_the_sum_over_the_error_channels() -> None:
    x = planted().x
    errors = {"x_um": 3.0 * x[:, 0] + x[:, 2], "z_um": planted().y_um}
    inputs = planted().inputs
    selector = MainFactorBP(gate=0.0)
    both = selector.sensitivity(Design.build(with_two_channels(errors), inputs, "z_um"), TRAIN)
    one_by_one = [
        selector.sensitivity(Design.build(with_two_channels({n: y}), inputs, n), TRAIN) for n, y in errors.items()
    ]
    by_input = np.zeros((20, 6))
    for found in one_by_one:
        by_input[:, found.columns] += found.of_start
    # the starts meet the inputs in the order of their |corr|, so they agree on average, not start by start
    np.testing.assert_allclose(both.mean, by_input.mean(axis=0)[both.columns], atol=0.1)
    assert len(both.hidden) == 2 and set(selector.select(with_two_channels(errors), "x_um", 3)) == {"t0", "t1", "t4"}


def test_whole_batches_are_held_out_and_of_few_whole_quarters() -> None:
    y = np.random.default_rng(0).normal(size=60) * np.repeat([1, 3, 2, 5, 4, 6], 10)
    parts = [np.arange(10 * k, 10 * k + 10) for k in range(6)]
    held = held_out(parts, y).reshape(6, 10)
    assert (held.all(axis=1) | ~held.any(axis=1)).all()
    third = np.argsort([y[p].var() for p in parts])[2]
    assert np.flatnonzero(held[:, 0]).tolist() == [third]
    one = held_out([np.arange(12)], y)
    assert one.sum() == 3 and np.ptp(np.flatnonzero(one)) == 2


def test_the_size_is_the_one_of_least_error_on_what_is_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    selector, design = MainFactorBP(gate=0.0, most_extra=4), planted()
    errors = {3: 5.0, 4: 2.0, 5: 1.0, 6: 3.0}  # √(6 + 1) + a = 3, 4, 5, 6
    trained = []

    def nets_of(self: MainFactorBP, hidden: int, starts: int, x_t: Array, y: Array, known: Array) -> Nets:
        trained.append((hidden, starts, x_t.shape[1]))
        parameters = np.zeros((starts, hidden * 8 + 1))
        parameters[:, -1] = errors[hidden]  # a constant output, so the held-out error is known
        return Nets(parameters, 6, hidden)

    monkeypatch.setattr(MainFactorBP, "_trained", nets_of)
    assert selector.sensitivity(design, TRAIN).hidden == (5,)
    assert [t[0] for t in trained] == [3, 4, 5, 6, 5] and trained[-1][1] == 20
    assert trained[0][2] < trained[-1][2]  # the last learns from all rows


def test_starts_that_disagree_inside_a_collinear_group_are_told() -> None:
    q = orthonormal(sum(LENGTHS), 6, seed=9)
    apart = stack(np.column_stack([q[:, 0] + 0.3 * q[:, 1], q[:, 2]]), q[:, 0] + 0.2 * q[:, 2], LENGTHS)
    assert MainFactorBP(gate=0.0).diagnostics(apart, TRAIN, 1) == ()
    twins = stack(q[:, :1] + 1e-3 * q[:, 1:5], q[:, 0] + 0.05 * q[:, 5], LENGTHS)
    spread, changes = MainFactorBP().diagnostics(twins, TRAIN, 2)
    assert spread.value > 0.5 and not spread.ok and "t0, t1, t2, t3" in spread.comment
    assert changes.value > 0.2 and not changes.ok
