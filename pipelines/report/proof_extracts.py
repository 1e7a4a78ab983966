"""What the page draws from the scoring's tables: detection by size, amplitudes, matrices in a readable order."""

from __future__ import annotations

import numpy as np
import pandas as pd

SIZES = ("below 1×", "1 to 2×", "2 to 4×", "4 to 10×", "above 10×")
_EDGES = (0.0, 1.0, 2.0, 4.0, 10.0, np.inf)
_MOST_ROWS = 34
NOTHING, UNLISTED, OTHER = "nothing", "unlisted", "other"
_MOST_RUNS = 4


def detection_by_size(terms: pd.DataFrame) -> pd.DataFrame:
    """effect, size (of `SIZES`), found, n for every true term of known size; `all effects` first, then by registry."""
    known = terms[terms["limit_share"].notna() & ~terms["decoy"].astype(bool)]
    share = known["limit_share"].astype(float)
    known = known.assign(size=pd.cut(share, list(_EDGES), labels=list(SIZES), right=False).astype(str),
                         found=known["found"].fillna(False).astype(bool))  # fmt: skip
    parts = [known.assign(effect="all effects"), known]
    counted = pd.concat(parts).groupby(["effect", "size"], sort=False)["found"].agg(["sum", "count"]).reset_index()
    counted = counted.rename(columns={"sum": "found", "count": "n"})
    order = {e: k for k, e in enumerate(["all effects", *_by_group(set(known["effect"]))])}
    places = [(order[e], SIZES.index(s)) for e, s in zip(counted["effect"], counted["size"], strict=True)]
    return counted.iloc[sorted(range(len(counted)), key=places.__getitem__)].reset_index(drop=True)


def with_amplitude(terms: pd.DataFrame) -> pd.DataFrame:
    """Visible terms with an amplitude: ratio found / true, both in detection limits, whether the interval holds it."""
    columns = ["amplitude_true", "amplitude_found", "low90", "high90", "limit_share"]
    out = terms[terms["visible"].eq(True)].copy()
    out[columns] = out[columns].apply(pd.to_numeric, errors="coerce").astype(float)
    out = out[out["amplitude_found"].notna() & out["amplitude_true"].notna() & (out["amplitude_true"] != 0)]
    true = out["amplitude_true"]
    out["ratio"] = (out["amplitude_found"] / true).clip(lower=1e-3)
    scale = out["limit_share"] / true
    out["true_limits"] = out["limit_share"]
    out["found_limits"] = out["ratio"] * out["limit_share"]
    ends = np.sort(np.stack([out["low90"] * scale, out["high90"] * scale]), axis=0)
    out["low_limits"], out["high_limits"] = np.maximum(ends[0], 1e-3 * out["limit_share"]), ends[1]
    told = out["low90"].notna() & out["high90"].notna()
    out["covers"] = ((out["low90"] <= true) & (true <= out["high90"])).where(told)
    order = {e: k for k, e in enumerate(_by_group(set(out["effect"])))}
    return out.sort_values("effect", key=lambda c: c.map(order), kind="stable").reset_index(drop=True)


def mechanism_matrix(counts: pd.DataFrame) -> tuple[pd.DataFrame, list[int]]:
    """Square at the front: what was there (rows) and named (columns), ordered by the registry's groups; then what was
    only named, `unlisted` and `nothing`. With it the rows after which a group ends."""
    names = _by_group(set(counts["true"]) | set(counts["named"]))
    wide = _wide(counts)
    rows = [n for n in names if n in wide.index]
    order = [*rows, *(n for n in names if n not in rows and n in wide.columns)]
    ordered = wide.reindex(index=rows, columns=order, fill_value=0)
    own = [_group(n) for n in rows]
    ends = [k for k in range(1, len(rows)) if own[k] != own[k - 1]]
    return ordered, [*ends, len(rows)]


def place_matrix(counts: pd.DataFrame) -> tuple[pd.DataFrame, list[int]]:
    """The same for places, by name; the rarest stand together as `other`."""
    total = pd.concat([counts.groupby("true")["count"].sum(), counts.groupby("named")["count"].sum()])
    often = total.groupby(level=0).sum().drop(NOTHING, errors="ignore").sort_values(ascending=False, kind="stable")
    kept = {*often.index[:_MOST_ROWS], NOTHING}
    folded = counts.assign(true=counts["true"].where(counts["true"].isin(kept), OTHER),
                           named=counts["named"].where(counts["named"].isin(kept), OTHER))  # fmt: skip
    wide = _wide(folded)
    rows = sorted(wide.index, key=_place_order)
    order = [*rows, *sorted(set(wide.columns) - set(rows), key=_place_order)]
    return wide.reindex(index=rows, columns=order, fill_value=0), [len(rows)]


def worst_channel(series: pd.DataFrame) -> pd.DataFrame:
    """Of one case's series the channel whose residual after the diagnosis is largest in noise (of its differences),
    in the runs where it is worst, in their order."""
    left = series.assign(after_left=(series["recorded"] - series["after"]).astype(float))
    by_channel = left.groupby("channel", sort=False)["after_left"]
    size = by_channel.agg(_rms) / by_channel.agg(_roughness)
    own = left[left["channel"] == size.idxmax()]
    rms = own.groupby("batch", sort=False)["after_left"].agg(_rms)
    chosen = set(rms.sort_values(ascending=False, kind="stable").index[:_MOST_RUNS])
    return own[own["batch"].isin(chosen)].drop(columns="after_left").reset_index(drop=True)


def _rms(residual: pd.Series) -> float:
    return float(np.sqrt(np.nanmean(residual.to_numpy(float) ** 2)))


def _roughness(residual: pd.Series) -> float:
    """Median step from row to row: what noise leaves, whatever the unit; 1 where the recording never moves."""
    steps = np.abs(np.diff(residual.to_numpy(float)))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else 1.0


def _wide(counts: pd.DataFrame) -> pd.DataFrame:
    return counts.pivot_table(index="true", columns="named", values="count", aggfunc="sum", fill_value=0)


def _by_group(names: set[str]) -> list[str]:
    """Mechanisms in the registry's order, which is by groups; then others by name; `unlisted`, `nothing` last."""
    from twin.mechanisms import MECHANISMS

    keys = list(MECHANISMS)
    last = {OTHER: 1, UNLISTED: 2, NOTHING: 3}
    return sorted(names, key=lambda n: (last.get(n, 0), keys.index(n) if n in keys else len(keys), n))


def _group(name: str) -> str:
    """The file that a mechanism stands in."""
    from twin.mechanisms import MECHANISMS

    if name in MECHANISMS:
        module: str = MECHANISMS[name].__module__
        return module
    return "last" if name in (OTHER, UNLISTED, NOTHING) else ""


def _place_order(place: str) -> tuple[int, str]:
    return {OTHER: 1, UNLISTED: 2, NOTHING: 3}.get(place, 0), place
