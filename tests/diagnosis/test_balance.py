"""Nothing is made worse, and what a twin cannot do is named without statistics."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from diagnosis.diagnose import diagnose
from diagnosis.fitting.fitted import LeftOutRows, degraded_channels, left_out_rows, rows_as_given
from diagnosis.localisation.balance import impossible
from tests.diagnosis.small_cases import cold_floor, consistent, fitted, runs, two_bodies


def left(**by_channel: list[float]) -> LeftOutRows:
    rows = [(f"b{k}", c, "degC", 10, rms) for c, own in by_channel.items() for k, rms in enumerate(own)]
    return LeftOutRows([], pd.DataFrame(rows, columns=["batch", "channel", "unit", "rows", "rms"]))


def test_a_channel_is_worse_where_its_rise_is_more_than_other_runs_would_make() -> None:
    before = left(t1=[1.0, 1.2, 0.8, 1.0], t2=[1.0, 1.0, 1.0, 1.0], t3=[2.0, 2.0, 2.0, 2.0])
    after = left(t1=[1.1, 1.3, 0.8, 1.0], t2=[4.0, 4.5, 5.0, 4.5], t3=[1.0, 1.0, 1.0, 1.0])
    assert degraded_channels(before, after) == {"t2": (1.0, 4.5)}
    assert degraded_channels(after, before) == {"t3": (1.0, 2.0)}


def test_a_part_that_warms_without_heat_is_impossible_and_the_watts_are_stated() -> None:
    known = two_bodies(links={})
    (found,) = impossible(fitted(known, runs(two_bodies(), count=6)))
    assert (found.channel, found.bodies) == ("t_head", ("head",)) and found.excess_K > 0
    assert 1.0 < found.watts < 240.0  # of the belt's 120 W the head gets a part
    assert f"t_head warms by {found.excess_K:.2g} K more than it can in run {found.batch}" in found.words


def test_what_the_twin_can_do_is_not_impossible() -> None:
    assert impossible(consistent()) == () == impossible(cold_floor())


@pytest.mark.integration
def test_the_missing_path_is_found_and_no_channel_is_worse() -> None:
    """The file has no link between the bodies, so that nothing warms the head; the recordings know one."""
    done = diagnose(two_bodies(links={}), runs(two_bodies(), count=4))
    answer = done.findings
    assert answer.findings[0].mechanism == "heat_bridge" and answer.findings[0].where.name in ("shaft", "head")
    assert any("t_head warms by" in r for r in answer.remarks)
    search = done.search
    assert search is not None
    assert degraded_channels(left_out_rows(search.baseline), left_out_rows(search.final)) == {}
    assert degraded_channels(rows_as_given(search.baseline), left_out_rows(search.final)) == {} and done.added


def test_the_file_as_given_is_predicted_by_its_own_values() -> None:
    known = two_bodies()
    own = fitted(known, runs(known, seed=3))
    given, best = rows_as_given(own), left_out_rows(own)
    by_channel = given.rms.groupby("channel")["rms"].mean() / best.rms.groupby("channel")["rms"].mean()
    assert by_channel.max() > 1.5  # other values than the file's made the recordings
    assert [len(e) for e in given.error] == [len(e) for e in best.error]
    assert np.isfinite(given.rms["rms"]).all()
