"""Words, digits and colours of the report."""

from __future__ import annotations

INK, BLUE, ORANGE = "#1f2933", "#0072b2", "#d55e00"  # Okabe & Ito 2008: safe for the colour-blind


_FAMILIES = {"zero": "no model", "mean_curve": "mean curve", "thermal_exponential": "thermal exponential",
             "pcr_lbo": "PCR (leave-batch-out)", "gm1n": "GM(1,N)", "lssvm": "LS-SVM"}  # fmt: skip
_SELECTORS = {"none": "all sensors", "pca_elimination": "PCA elimination", "fcgc": "FCGC"}
_SHOUTED = {"mlr", "pcr", "pls", "bp"}


def family_label(key: str) -> str:
    """A family's name for people."""
    return _FAMILIES.get(key) or (key.upper() if key in _SHOUTED else key.replace("_", " "))


def selector_label(key: str) -> str:
    """A selector's name for people."""
    return _SELECTORS.get(key) or key.replace("_", " ")
