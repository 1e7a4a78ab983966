"""The part of the page that says how far a model may be trusted."""

import pandas as pd

from models.trust import COLUMNS
from reports.comparison.certainty import rise_panel, rise_table


def distances() -> pd.DataFrame:
    """Each of 12 batches twice as bad at half a width, and once more from a single batch."""
    rows = []
    for k in range(12):
        rows.append(("c", "leave-batch-out", f"b{k}", f"b{k}", 0.0, "", 2.0 + k))
        rows.append(("c", "leave-season-out", "cold", f"b{k}", 0.4, "room@start", 4.0 + 2 * k))
        rows.append(("c", "train-on-one", "b0", f"b{k}", 3.0, "bed@start", 90.0))
    return pd.DataFrame(rows, columns=COLUMNS)


def test_the_table_gives_the_measured_factor_and_what_to_expect() -> None:
    table = rise_table("z", distances(), 1, True)
    assert table is not None and table.simulated
    (row,) = table.rows
    assert row.cells == ("0.25 to 0.5", "12", "2.00", "2.00", "15.0")  # 7.5 µm in the median, twice
    assert table.notes[0] == "Inside, by leave-batch-out, S is 7.5 µm in the median."
    assert table.notes[1] == "Farthest out most often: room@start (12)."


def test_every_left_out_batch_is_a_marker_and_models_of_one_batch_are_not_counted() -> None:
    panel = rise_panel("z", distances(), True)
    assert panel is not None
    markers = [t for t in panel.plots[0].figure.data if t.mode == "markers"]
    assert [t.name for t in markers] == ["trained on one batch", "season left out"] and len(markers[0].x) == 12
    (median,) = [t for t in panel.plots[0].figure.data if t.mode == "lines"]
    assert set(median.y) == {2.0}


def test_nothing_measured_shows_nothing() -> None:
    empty = pd.DataFrame()
    near = distances().query("protocol == 'leave-batch-out'")
    assert rise_panel("z", empty, False) is None and rise_table("z", empty, 1, False) is None
    assert rise_panel("z", near, False) is None and rise_table("z", near, 1, False) is None
