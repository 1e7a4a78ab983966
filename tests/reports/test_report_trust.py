"""The part of the page that shows the error to expect of a run."""

import pandas as pd

from models.selection.trust import COLUMNS
from reports.comparison.certainty import bound_panel, bound_table


def left_out() -> pd.DataFrame:
    """Twelve runs left out one by one, and each twice as bad as a later run that is half a width out."""
    start, rows = pd.Timestamp("2026-01-01"), []
    for k in range(12):
        rows.append(("c", "leave-batch-out", f"b{k}", f"b{k}", start, 0.0, "", 9.0, 1.0, 2.0 + k))
        rows.append(("c", "forward", "autumn", f"b{k}", start, 0.5, "room@start", 9.0, 2.0, 4.0 + 2 * k))
        rows.append(("c", "train-on-one", "b0", f"b{k}", start, 3.0, "bed@start", 9.0, 3.0, 90.0))
    return pd.DataFrame(rows, columns=COLUMNS)


def test_the_table_compares_every_protocol_with_the_bound() -> None:
    table = bound_table("z", left_out(), 1, True)
    assert table is not None and table.simulated
    later, near = (row.cells for row in table.rows)
    assert later[:3] == ("forward", "12", "15.0") and near[:3] == ("leave-batch-out", "12", "7.5")
    assert float(later[3]) > float(near[3]) and float(later[4]) > float(later[3])
    assert later[5].endswith(" %")
    assert table.notes[1] == "Later runs left the trained region most often in room@start (12)."


def test_every_left_out_run_is_a_marker_and_models_of_one_batch_are_not_counted() -> None:
    panel = bound_panel("z", left_out(), True)
    assert panel is not None
    assert [k.label for k in panel.keys] == ["later run", "run left out", "as expected", "90 % bound"]
    *clouds, expected, bound = panel.plots[0].figure.axes[0].lines
    assert [len(c.get_xdata()) for c in clouds] == [12, 12]
    assert (bound.get_ydata() > expected.get_ydata()).all()


def test_tables_of_older_trainings_and_without_runs_are_read() -> None:
    older = left_out().drop(columns=["start", "predicted_rms_um", "disagreement_um"])
    assert bound_table("z", older, 1, False) is not None
    for nothing in (pd.DataFrame(), left_out().query("protocol == 'train-on-one'")):
        assert bound_panel("z", nothing, False) is None and bound_table("z", nothing, 1, False) is None
