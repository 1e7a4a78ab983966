"""Labels, digits, units and colours that all reports share."""

from __future__ import annotations

import math
from collections.abc import Sequence

# Okabe & Ito 2008, safe for the colour-blind; yellow, unreadable on white, replaced by olive.
INK, BLUE, ORANGE, GREEN = "#1f2933", "#0072b2", "#d55e00", "#00755a"
NOTHING = "–"
_HUGE = 10_000.0

_FAMILIES = {"zero": "no model", "mean_curve": "mean curve", "thermal_exponential": "thermal exponential",
             "twin": "physics twin", "hist_gradient_boosting": "gradient boosting",
             "twin_residual": "twin + residual", "twin_kalman": "twin with sensors", "pcr": "PCR 95 %",
             "pcr_lbo": "PCR tuned", "gm1n": "GM(1,N)", "lssvm": "LS-SVM"}  # fmt: skip
_SELECTORS = {"none": "all sensors", "pca_elimination": "PCA elimination", "fcgc": "FCGC", "fcm_grey": "FCM + grey",
              "main_factor_bp": "main factor BP", "mrmr": "mRMR", "elastic_net_path": "elastic net",
              "vif_pruning": "VIF pruning", "kmedoids": "k-medoids", "exhaustive": "all subsets"}  # fmt: skip
_SHOUTED = {"mlr", "pls", "bp"}


def family_label(key: str) -> str:
    """A family's name for people."""
    return _FAMILIES.get(key) or (key.upper() if key in _SHOUTED else key.replace("_", " "))


def selector_label(key: str) -> str:
    """A selector's name for people."""
    return _SELECTORS.get(key) or key.replace("_", " ")


def cell_label(selector: str, family: str, n_tsp: int) -> str:
    """A cell's label: ``ridge on 4 points by FCGC``."""
    if not n_tsp:
        return family_label(family)
    if selector in ("none", family):  # a stack's members bring their own points
        return f"{family_label(family)} on all {n_tsp} points"
    return f"{family_label(family)} on {count(n_tsp, 'point')} by {selector_label(selector)}"


def tex_escaped(name: str) -> str:
    """A name that matplotlib reads as text, not as mathematics."""
    return name.replace("$", r"\$")


def three_digits(value: float) -> str:
    """Three significant digits, without a power of ten up to a million."""
    return (f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}").replace("-", "−")


def count(n: int, noun: str) -> str:
    """``1 batch``, ``3 batches``, ``2 points``."""
    plural = noun + ("es" if noun.endswith("ch") else "s")
    return f"{n} {noun if n == 1 else plural}"


def decimals(S_std_um: float, n: int) -> int:
    """Decimals of a mean over n batches: two where its standard error is below 0.1 µm, else one."""
    return 2 if n > 0 and math.isfinite(S_std_um) and S_std_um / math.sqrt(n) < 0.1 else 1


def number(value: float, digits: int = 1, sign: bool = False) -> str:
    """A number with fixed digits; a dash for none, a power of ten where it has run away."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if abs(value) >= _HUGE:
        power = math.floor(math.log10(abs(value)))
        raised = str(power).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{value / 10**power:.1f}·10{raised}".replace("-", "−")
    text = f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"
    return text.replace("-", "−")


def digits_of(*values: float) -> int:
    """Digits after the point for values that are compared: two that count of the largest, one of the smallest."""
    sizes = [abs(v) for v in values if v and math.isfinite(v)]
    if not sizes:
        return 0
    largest, smallest = 1 - math.floor(math.log10(max(sizes) * 1.005)), -math.floor(math.log10(min(sizes) * 1.05))
    return max(0, min(2, max(largest, smallest)))


def plus_minus(mean: float, std: float, digits: int) -> str:
    """``2.9 ± 0.8``; without a spread the mean alone."""
    return f"{number(mean, digits)} ± {number(std, digits)}" if math.isfinite(std) else number(mean, digits)


def percent(share: float) -> str:
    """``87 %`` of a share 0..1."""
    return f"{100 * share:.0f} %" if math.isfinite(share) else NOTHING


def p_label(p: float) -> str:
    """A p-value with its significant digits."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def between(start_s: float, end_s: float) -> str:
    """A stretch of a batch in h:min from its start; NaN is the batch's end on that side."""
    open_start, open_end = not math.isfinite(start_s), not math.isfinite(end_s)
    if open_start and open_end:
        return "whole batch"
    if open_start:
        return f"start to {_clock(end_s)}"
    if open_end:
        return f"{_clock(start_s)} to end"
    return _clock(start_s) if start_s == end_s else f"{_clock(start_s)} to {_clock(end_s)}"


def _clock(time_s: float) -> str:
    minutes = round(time_s / 60)
    return f"{minutes // 60}:{minutes % 60:02d}"


def listed(names: Sequence[str], most: int = 12, last: str = "and") -> str:
    """``a, b and c``; a long list is cut and counted."""
    shown = list(names) if len(names) <= most else [*names[:most], f"{len(names) - most} more"]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} {last} {shown[-1]}" if shown else ""


def sentence(text: str) -> str:
    """The text with a capital at its head and a full stop; nothing for nothing."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""
