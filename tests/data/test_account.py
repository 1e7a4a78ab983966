"""The account of a result: rows read, dropped and masked, by channel and by check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data.account import Account
from data.batch import Batch
from data.checks import check_machine, checked
from data.machine import Overrule
from tests.toys.recordings import STEP_S, toy_batch, toy_machine


def jumped(row: int = 30) -> Batch:
    batch = toy_batch(0)
    table = batch.table.assign(x=batch.values("x") + 60.0 * (np.arange(batch.n_rows) >= row))
    return replace(batch, table=table, repairs={"rows_in": 500, "rows_dropped": 7})


def known(batch: Batch, *rules: Overrule) -> Account:
    machine = toy_machine(overrule=list(rules))
    return Account.of(check_machine([checked(batch, machine)], machine))


def test_the_account_says_what_was_taken_from_which_channel_by_which_check() -> None:
    account, n = known(jumped()), toy_batch(0).n_rows
    (lost,) = account.lost
    assert (lost.batch_id, lost.channel, lost.check, lost.state) == ("b00", "x", "jump_no_return", "masked")
    assert (lost.rows, lost.start_s) == (n - 30, 30 * STEP_S)
    why = "jump_no_return: a step of one channel that noise, drivers and the other channels do not explain"
    assert account.summary == f"rows: 500 read, 7 dropped; {n - 30} values masked: x {n - 30} (jump_no_return); {why}"
    assert account.as_dict()["lost"][0]["rows"] == n - 30
    assert account.warning("x").startswith(f"{(n - 30) / n:.0%} of the rows of x are masked ({why})")
    assert account.warning("z") == ""


def test_nothing_is_claimed_of_a_clean_recording() -> None:
    account = known(toy_batch(0))
    assert account.lost == () and account.summary.endswith("nothing masked")


def test_a_large_mask_is_stated_until_it_is_lifted_or_confirmed() -> None:
    (line,) = known(jumped()).large(["b00"])
    assert line.startswith("x: jump_no_return masks 69% of b00 from 2 h 30 min to 8 h 00 min; to lift it")
    assert "{channel: x, check: jump_no_return, mask: true, reason: ...}" in line
    assert known(jumped()).large([]) == []
    lifted = known(jumped(), Overrule(channel="x", check="jump_no_return", reason="probe was moved"))
    assert lifted.large(["b00"]) == [] and lifted.lost == ()
    confirmed = known(jumped(), Overrule(channel="x", check="jump_no_return", mask=True, reason="probe was knocked"))
    assert confirmed.large(["b00"]) == [] and {x.rows for x in confirmed.lost} == {toy_batch(0).n_rows - 30}
