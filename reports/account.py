"""The account of a result's recordings as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from reports.layout import Column, Row, Table


def account_table(account: Mapping[str, Any], simulated: bool) -> Table | None:
    """A row for each batch, channel and check that took values away; `account` as `data.account.Account.as_dict`."""
    if not account.get("lost"):
        return None
    rows = tuple(
        Row.of(
            x["batch_id"], x["channel"], x["check"].replace("_", " "), x["state"], str(x["rows"]),
            f"{100 * x['share']:.2g}", f"{x['start_s'] / 3600:.2f} to {x['end_s'] / 3600:.2f}",
        )
        for x in account["lost"]
    )  # fmt: skip
    columns = (
        Column("batch"), Column("channel"), Column("check"), Column("state"), Column("rows", "", "number"),
        Column("of the batch", "%", "number"), Column("between", "h", "number"),
    )  # fmt: skip
    return Table("Values that are not used", columns, rows, simulated)
