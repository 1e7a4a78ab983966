"""What the report of a diagnosis takes from its tables: sums over batches, and which batches and places to draw."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import chi2

CHANCE = 0.001  # a place is coloured where chance gives as much in fewer cases than this
SEEN_Z = 2.0  # a cell of where × when below it is pale


def by_channel(rms: pd.DataFrame) -> pd.DataFrame:
    """One row a channel, in order of appearance: unit, rows, before, after, floor over all rows, batches, improved.

    Args:
        rms: the diagnosis' table of left-out rms by batch and channel.
    """
    out = []
    for channel, part in rms.groupby("channel", sort=False):
        rows = part["rows"].to_numpy(float)
        kept = rows > 0
        square = [
            float(np.sqrt(np.average(part[k].to_numpy(float)[kept] ** 2, weights=rows[kept]))) if kept.any() else np.nan
            for k in ("before", "after", "floor")
        ]
        improved = int((part["after"] < part["before"]).sum())
        out.append((channel, part["unit"].iloc[0], int(rows.sum()), *square, len(part), improved))
    columns = ["channel", "unit", "rows", "before", "after", "floor", "batches", "improved"]
    return pd.DataFrame(out, columns=columns)


def by_change(channels: pd.DataFrame) -> pd.DataFrame:
    """The same rows, displacements first, the greatest change by the noise floor first."""
    change = (channels["before"] - channels["after"]).abs() / channels["floor"].replace(0.0, np.nan)
    ranked = channels.assign(change=change.fillna(0.0), kelvin=channels["unit"].isin(["K", "degC"]))
    return ranked.sort_values(["kelvin", "change"], ascending=[True, False], kind="stable").drop(columns="kelvin")


def telling(rms: pd.DataFrame, changed: bool, most: int = 3) -> list[tuple[str, str]]:
    """Batches worth drawing, each with the reason: the greatest change (or error) and the one of median change."""
    if rms.empty:
        return []
    size = (rms["before"] - rms["after"] if changed else rms["before"]) / rms["floor"].replace(0.0, np.nan)
    of_batch = size.groupby(rms["batch"], sort=False).mean().fillna(0.0).sort_values(ascending=False, kind="stable")
    what = "change" if changed else "error"
    names = [str(b) for b in of_batch.index]
    great = names[: max(min(most - 1, len(names) - 1), 1)]
    words = [f"greatest {what}", f"second greatest {what}", f"third greatest {what}"]
    chosen = list(zip(great, words, strict=False))
    typical = names[len(names) // 2]
    return chosen if typical in great else [*chosen, (typical, f"typical, median {what}")]


def chosen_channels(channels: pd.DataFrame, changed: bool, most: int = 4) -> list[str]:
    """Two to four channels that change most (without a change: that differ most), one displacement at least."""
    size = (channels["before"] - channels["after"] if changed else channels["before"]) / channels["floor"]
    ranked = channels.assign(size=size.fillna(0.0)).sort_values("size", ascending=False, kind="stable")
    strong = ranked[ranked["size"] > 0.1 * ranked["size"].max()] if len(ranked) else ranked
    names = [str(c) for c in (strong if len(strong) >= 2 else ranked)["channel"][:most]]
    errors = [str(c) for c in ranked["channel"][~ranked["unit"].isin(["K", "degC"])]]
    if errors and not set(errors) & set(names):
        names = [*names[: most - 1], errors[0]]
    return [str(c) for c in by_change(channels)["channel"] if c in names]


def mismatch(where: pd.DataFrame) -> pd.DataFrame:
    """One row a kind and place over all batches: unit, size (rms), mean, shown (whether chance can be ruled out).

    Args:
        where: the diagnosis' table "map"; only its rows by batch count.
    """
    out = []
    for (kind, place), part in where[where["by"] == "batch"].groupby(["kind", "place"], sort=False):
        value, z = part["value"].to_numpy(float), part["z"].to_numpy(float)
        good = np.isfinite(value) & np.isfinite(z)
        if not good.any():
            continue
        shown = float(chi2.sf(float(np.sum(z[good] ** 2)), int(good.sum()))) < CHANCE
        size = float(np.sqrt(np.mean(value[good] ** 2)))
        out.append((kind, place, part["unit"].iloc[0], size, float(np.mean(value[good])), shown))
    return pd.DataFrame(out, columns=["kind", "place", "unit", "size", "mean", "shown"])


def strongest(where: pd.DataFrame, kind: str, most: int) -> list[str]:
    """Places of a kind by their greatest |z|, at most `most`, in the table's order."""
    own = where[where["kind"] == kind]
    z = own["z"].abs().groupby(own["place"], sort=False).max().sort_values(ascending=False, kind="stable")
    chosen = set(z.index[:most])
    return [str(p) for p in dict.fromkeys(own["place"]) if p in chosen]


def ordered(where: pd.DataFrame, by: str) -> list[str]:
    """Labels of a group in the table's order."""
    return [str(x) for x in dict.fromkeys(where[where["by"] == by]["label"])]
